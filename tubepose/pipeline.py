"""The stages in the paper's order, each timed: detection, rack, slots, tube."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TypeGuard

from tubepose.baselines import fit_global_icp, fit_slot_icp, fit_upright
from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.capture.hints import TurnHint
from tubepose.capture.registration import known_intrinsics, refuse_foreign_frame, refuse_mirrored
from tubepose.checks import failed
from tubepose.config import Config
from tubepose.detection import Detection, Detector, points_in_box
from tubepose.detection.assisted import AssistedDetector
from tubepose.labware import RackModel, TubeModel
from tubepose.preprocessing import remove_outliers
from tubepose.profile import FaceBow, ProfileTube, fit_profiles
from tubepose.rack import RackPose, RackStatus, register_rack
from tubepose.rivals import fit_gicp, fit_kiss_matcher
from tubepose.scene import Scene, TubeEstimate, TubeTarget
from tubepose.sensor import measure_noise, prior_noise
from tubepose.slots import SlotLook, look_at_slots
from tubepose.stage_times import Clock, StageTime
from tubepose.targets import allowed_types, boxes_alone, find_targets
from tubepose.transforms import FloatArray
from tubepose.tube import TubeMethod, TubePose, fit_tube, refused

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


def prepare_scene(
    frame: RgbdFrame,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    detector: Detector,
    config: Config,
    hint: TurnHint | None = None,
    T_camera_rack: FloatArray | None = None,
    methods: Sequence[str] = tuple(TUBE_METHODS),
) -> Scene:
    """Detect, register the rack, measure the sensor's noise, and find the slot and the type of every detected tube.

    Args:
        frame: The frame.
        rack: The rack that stands in it.
        tubes: The kinds of tube that can stand in it.
        detector: Source of boxes.
        config: All sections.
        hint: Which way round the rack stands, if known.
        T_camera_rack: The rack's pose where it is known; its registration is then left out.
        methods: Methods that will be asked; slots of detected tubes are left out where none needs them.

    Raises:
        CaptureError: The cloud is mirrored, or not in the camera's frame.
        DetectorError: The detector cannot work on this frame.
    """
    clock = Clock()
    refuse_mirrored(frame)
    refuse_foreign_frame(frame)
    intrinsics = known_intrinsics(frame)

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
    noise = prior_noise(config.sensor, "the rack's pose is not known")
    if rack_pose.T_camera_rack is not None:
        with clock.stage("sensor"):
            noise = measure_noise(frame, intrinsics, rack_pose.T_camera_rack, rack, config.sensor)
    targets: tuple[TubeTarget, ...] = ()
    if rack_pose.T_camera_rack is not None and any(method in TUBE_METHODS for method in methods):
        if isinstance(detector, AssistedDetector):
            with clock.stage("detect"):
                detections = detector.checked(frame, rack_pose.T_camera_rack, detections)
        with clock.stage("slots"):
            targets = find_targets(frame, rack, tubes, detections, rack_pose.T_camera_rack, config)
    looks: tuple[SlotLook, ...] = ()
    if rack_pose.T_camera_rack is not None:
        with clock.stage("slots"):
            T, bow_m = rack_pose.T_camera_rack, rack_pose.bow_m
            looks = look_at_slots(frame, intrinsics, T, rack, tubes, noise.depth_std_m, bow_m)
    return Scene(frame, rack, tuple(tubes), intrinsics, detections, rack_pose, noise, targets, clock.shared(), looks)


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
            pose = _not_asked(target)
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
        bow=_bow(scene.rack_pose),
        noise=scene.noise,
    )
    share_ms = (time.perf_counter_ns() - start) / 1e6 / max(len(found), 1)
    targets = [(_profile_target(tube), tube.pose) for tube in found]
    targets += [(other, replace(_not_asked(other), n_points=0)) for other in boxes_alone(scene, found, config)]
    estimates = tuple(_estimate(scene, DEFAULT_METHOD, None, *target) for target in targets)
    times = tuple(StageTime("tube", DEFAULT_METHOD, tube.slot or "", None, share_ms) for tube in found)
    return estimates, times


def _bow(pose: RackPose) -> FaceBow | None:
    return None if pose.bow_m is None or pose.bow_std_m is None else FaceBow(pose.bow_m, pose.bow_std_m)


def _profile_target(tube: ProfileTube) -> TubeTarget:
    why = next(iter(failed(tube.pose.checks)), None) if tube.tube is None else None
    return TubeTarget(None, tube.slot, tube.tube, tube.support, why, tube.points_m)


def _not_asked(target: TubeTarget) -> TubePose:
    """The answer of every method for a target without a slot or a type."""
    assert target.why is not None
    return refused(target.why, n_points=len(target.points_m))


def best_rack(detections: Sequence[Detection]) -> Detection | None:
    """The rack that is registered: the one of the best score."""
    racks = [detection for detection in detections if detection.is_rack]
    return max(racks, key=lambda detection: detection.score, default=None)


def _rack_pose(
    frame: RgbdFrame,
    rack: RackModel,
    detections: Sequence[Detection],
    config: Config,
    hint: TurnHint | None,
    intrinsics: CameraIntrinsics | None,
) -> RackPose:
    best = best_rack(detections)
    if best is None:
        return RackPose(RackStatus.NOT_FOUND, "the detector found no rack", code="no_detection")
    return register_rack(points_in_box(frame, best, RACK_MARGIN), rack, config, hint, intrinsics)


def _may_be_helped(detector: Detector, detections: Sequence[Detection]) -> TypeGuard[AssistedDetector]:
    """Whether the cloud's geometry, which may find the network's rack, has not been asked yet."""
    asked = any(detection.is_rack and detection.source == "geometric" for detection in detections)
    return isinstance(detector, AssistedDetector) and not asked


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
