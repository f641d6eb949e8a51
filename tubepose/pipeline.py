"""The stages in the paper's order, each timed: detection, rack, slots, tube."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

from tubepose.baselines import fit_global_icp, fit_slot_icp, fit_upright
from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.capture.registration import estimate_intrinsics
from tubepose.capture.session import SlotHint
from tubepose.config import Config
from tubepose.detection import Detection, Detector, rows_in_box
from tubepose.detection.assisted import AssistedDetector
from tubepose.labware import RackModel, TubeModel
from tubepose.preprocessing import remove_outliers
from tubepose.profile import ProfileTube, fit_profiles
from tubepose.rack import RackPose, RackStatus, register_rack
from tubepose.rivals import fit_gicp, fit_kiss_matcher
from tubepose.slots import SlotAssignment, assign_slots, crop_to_slot, identify_tube
from tubepose.stage_times import Clock, StageTime
from tubepose.transforms import FloatArray, invert_transform, transform_points
from tubepose.tube import TubeMethod, TubePose, TubeStatus, fit_tube

TUBE_METHODS: Mapping[str, TubeMethod] = {
    "paper": fit_tube,
    "upright": fit_upright,
    "slot-icp": fit_slot_icp,
    "global-icp": fit_global_icp,
    "kiss-matcher": fit_kiss_matcher,
    "gicp": fit_gicp,
}
"""Methods that are asked for one tube at a time, with the points that a detector and its slot give it."""
DEFAULT_METHOD = "profile"
METHODS = (DEFAULT_METHOD, *TUBE_METHODS)
"""All methods; `profile` looks at the whole frame, and finds its tubes and their slots itself."""
RACK_MARGIN = 0.10
"""A rack is looked for in a little more than its box: a box that is drawn too tight cuts its edges off."""
STOCHASTIC = frozenset({"global-icp", "kiss-matcher"})


@dataclass(frozen=True, slots=True, eq=False)
class TubeTarget:
    """A detected tube, ready for any method.

    Attributes:
        detection: Index of the detection; None for a tube that `profile` found itself.
        slot: Name of the slot, or None.
        tube: The tube's model, or None where its type is unknown.
        share: Share of its projected hull in the slot's opening; of `profile`, how much of its top was seen.
        reason: Why no method can be asked; empty otherwise.
        points_m: Points, rack frame, shape (N, 3), metres.
    """

    detection: int | None
    slot: str | None
    tube: TubeModel | None
    share: float
    reason: str
    points_m: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What all methods share of one frame: boxes, rack, slots.

    Attributes:
        frame: The frame.
        rack: The rack's model.
        tubes: The kinds of tube that can stand in it.
        intrinsics: Recorded or, for an organised cloud, estimated from it; None where there are none.
        detections: All boxes.
        rack_pose: The rack's pose, or why there is none.
        targets: Every detected tube (empty without a rack's pose).
        times: Duration of the shared stages.
    """

    frame: RgbdFrame
    rack: RackModel
    tubes: tuple[TubeModel, ...]
    intrinsics: CameraIntrinsics | None
    detections: tuple[Detection, ...]
    rack_pose: RackPose
    targets: tuple[TubeTarget, ...]
    times: tuple[StageTime, ...]


@dataclass(frozen=True, slots=True, eq=False)
class TubeEstimate:
    """One method's answer for one detected tube.

    Attributes:
        method: Name in `METHODS`.
        seed: Seed of a stochastic method, else None.
        target: What the method was asked.
        pose: Its answer in the rack frame.
        T_camera_tube: The same in the camera frame, shape (4, 4), metres; None without a pose.
    """

    method: str
    seed: int | None
    target: TubeTarget
    pose: TubePose
    T_camera_tube: FloatArray | None


def prepare_scene(
    frame: RgbdFrame,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    detector: Detector,
    config: Config,
    hint: SlotHint | None = None,
    T_camera_rack: FloatArray | None = None,
    methods: Sequence[str] = tuple(TUBE_METHODS),
) -> Scene:
    """Detect, register the rack, and find the slot and the type of every detected tube.

    Args:
        frame: The frame.
        rack: The rack that stands in it.
        tubes: The kinds of tube that can stand in it.
        detector: Source of boxes.
        config: All sections.
        hint: Which way round the rack stands, if known.
        T_camera_rack: The rack's pose where it is known; its registration is then left out.
        methods: Methods that will be asked; slots of detected tubes are left out where none needs them.
    """
    clock = Clock()
    intrinsics = frame.intrinsics
    if intrinsics is None and frame.organised:
        intrinsics = estimate_intrinsics(frame.cloud_m)

    def registered(boxes: Sequence[Detection]) -> RackPose:
        with clock.stage("rack"):
            return _rack_pose(frame, rack, boxes, config, hint, intrinsics)

    with clock.stage("detect"):
        detections = detector.detect(frame)
    if T_camera_rack is not None:
        rack_pose = RackPose(RackStatus.OK, T_camera_rack=T_camera_rack, resolved_by="given")
    else:
        rack_pose = registered(detections)
        if rack_pose.T_camera_rack is None and _may_be_helped(detector, detections):
            with clock.stage("detect"):
                others = detector.second_opinion(frame, rack_pose.reason)
            other_pose = registered(others)
            # Where that fails too, the first answer stays.
            if other_pose.T_camera_rack is not None:
                detections, rack_pose = others, other_pose
    targets: tuple[TubeTarget, ...] = ()
    if rack_pose.T_camera_rack is not None and any(method in TUBE_METHODS for method in methods):
        if isinstance(detector, AssistedDetector):
            with clock.stage("detect"):
                detections = detector.checked(frame, rack_pose.T_camera_rack, detections)
        with clock.stage("slots"):
            targets = _targets(frame, rack, tubes, detections, rack_pose.T_camera_rack, config)
    return Scene(frame, rack, tuple(tubes), intrinsics, detections, rack_pose, targets, clock.shared())


def estimate_tubes(
    scene: Scene, method: str, config: Config, seed: int | None = None
) -> tuple[tuple[TubeEstimate, ...], tuple[StageTime, ...]]:
    """Ask one method for every tube of a scene.

    The time of `profile`, which does all tubes at once, is shared out evenly among them.
    """
    if method == DEFAULT_METHOD:
        return _profile_estimates(scene, config)
    clock = Clock()
    estimates = []
    for target in scene.targets:
        if target.slot is None or target.tube is None:
            pose = TubePose(TubeStatus.REJECTED, target.reason, n_points=len(target.points_m))
        else:
            slot = scene.rack.slot(target.slot)
            with clock.stage("tube", method, target.slot, seed):
                points_m = remove_outliers(target.points_m, config.preprocess)
                pose = TUBE_METHODS[method](points_m, slot, target.tube, scene.rack, config, seed or 0)
        estimates.append(_estimate(scene, method, seed, target, pose))
    return tuple(estimates), tuple(clock.times)


def _estimate(scene: Scene, method: str, seed: int | None, target: TubeTarget, pose: TubePose) -> TubeEstimate:
    T_camera_rack = scene.rack_pose.T_camera_rack
    T_camera_tube = None
    if pose.T_rack_tube is not None and T_camera_rack is not None:
        T_camera_tube = T_camera_rack @ pose.T_rack_tube
    return TubeEstimate(method, seed, target, pose, T_camera_tube)


def _profile_estimates(scene: Scene, config: Config) -> tuple[tuple[TubeEstimate, ...], tuple[StageTime, ...]]:
    """The estimates of `profile`, and its time per tube."""
    if scene.rack_pose.T_camera_rack is None:
        return (), ()
    start = time.perf_counter_ns()
    found = fit_profiles(
        scene.frame,
        scene.intrinsics,
        scene.rack_pose.T_camera_rack,
        scene.rack,
        scene.tubes,
        config,
        rack_covariance=scene.rack_pose.covariance,
        allowed=allowed_types(scene),
    )
    share_ms = (time.perf_counter_ns() - start) / 1e6 / max(len(found), 1)
    estimates = tuple(_estimate(scene, DEFAULT_METHOD, None, _profile_target(tube), tube.pose) for tube in found)
    times = tuple(StageTime("tube", DEFAULT_METHOD, tube.slot or "", None, share_ms) for tube in found)
    return estimates, times


def _profile_target(tube: ProfileTube) -> TubeTarget:
    reason = "" if tube.tube is not None else tube.pose.reason
    return TubeTarget(None, tube.slot, tube.tube, tube.support, reason, tube.points_m)


def allowed_types(scene: Scene) -> NDArray[np.bool_] | None:
    """Which type may stand in which slot, shape (K, S), as far as a detector's classes say; None without a word.

    A box of a known class speaks for the slot whose tube's top, upright, is seen nearest to the box's middle.
    """
    T_camera_rack = scene.rack_pose.T_camera_rack
    named = {word: k for k, tube in enumerate(scene.tubes) for word in (tube.name, *tube.classes)}
    boxes = [box for box in scene.detections if box.class_name in named and np.isfinite(box.box_xyxy_px).all()]
    if not boxes or scene.intrinsics is None or T_camera_rack is None:
        return None
    may = np.ones((len(scene.tubes), len(scene.rack.all_slots)), bool)
    for box in boxes:
        k = named[box.class_name]
        top_m = np.column_stack(
            [scene.rack.slot_centers_m, np.full(may.shape[1], scene.rack.floor_m + scene.tubes[k].height_m)]
        )
        pixels = scene.intrinsics.project(transform_points(T_camera_rack, top_m))
        left, top, right, bottom = box.box_xyxy_px
        distance = np.hypot(*(pixels - np.array([left + right, top + bottom]) / 2).T)
        slot = int(np.argmin(distance))
        if distance[slot] < max(right - left, bottom - top):
            may[:, slot] = np.arange(len(scene.tubes)) == k
    return may


def best_rack(detections: Sequence[Detection]) -> Detection | None:
    """The rack that is registered: the one of the best score."""
    racks = [detection for detection in detections if detection.is_rack]
    return max(racks, key=lambda detection: detection.score, default=None)


def _rack_pose(
    frame: RgbdFrame,
    rack: RackModel,
    detections: Sequence[Detection],
    config: Config,
    hint: SlotHint | None,
    intrinsics: CameraIntrinsics | None,
) -> RackPose:
    best = best_rack(detections)
    if best is None:
        return RackPose(RackStatus.NOT_FOUND, "the detector found no rack")
    return register_rack(frame.points_m[rows_in_box(frame, best, RACK_MARGIN)], rack, config, hint, intrinsics)


def _may_be_helped(detector: Detector, detections: Sequence[Detection]) -> TypeGuard[AssistedDetector]:
    """Whether the cloud's geometry, which may find the network's rack, has not been asked yet."""
    asked = any(detection.is_rack and detection.source == "geometric" for detection in detections)
    return isinstance(detector, AssistedDetector) and not asked


def _targets(
    frame: RgbdFrame,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    detections: Sequence[Detection],
    T_camera_rack: FloatArray,
    config: Config,
) -> tuple[TubeTarget, ...]:
    T_rack_camera = invert_transform(T_camera_rack)
    indices = [i for i, detection in enumerate(detections) if not detection.is_rack]
    clouds = [transform_points(T_rack_camera, frame.points_m[rows_in_box(frame, detections[i])]) for i in indices]
    assigned = assign_slots(clouds, rack, config.slots)
    return tuple(
        _target(index, detections[index].class_name, entry, rack, tubes, config)
        for index, entry in zip(indices, assigned, strict=True)
    )


def _target(
    index: int, class_name: str, entry: SlotAssignment, rack: RackModel, tubes: Sequence[TubeModel], config: Config
) -> TubeTarget:
    points_m = entry.points_m
    if entry.slot is None:
        return TubeTarget(index, None, None, entry.share, entry.reason, points_m)
    if not tubes:
        return TubeTarget(index, entry.slot, None, entry.share, "no tube model given (--tubes)", points_m)
    slot = rack.slot(entry.slot)
    tube, reason = identify_tube(class_name, points_m, tubes, rack, config.slots)
    if tube is not None:
        points_m = crop_to_slot(points_m, slot, tube, rack, config.slots)
    return TubeTarget(index, entry.slot, tube, entry.share, reason, points_m)


__all__ = [
    "DEFAULT_METHOD",
    "METHODS",
    "STOCHASTIC",
    "TUBE_METHODS",
    "Scene",
    "StageTime",
    "TubeEstimate",
    "TubeTarget",
    "allowed_types",
    "best_rack",
    "estimate_tubes",
    "prepare_scene",
]
