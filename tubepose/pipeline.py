"""The stages of a frame in the paper's order, each timed: detection, rack, noise, slots; then a method for tubes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.capture.hints import TurnHint
from tubepose.capture.registration import known_intrinsics, refuse_foreign_frame, refuse_mirrored
from tubepose.config import Config
from tubepose.detection import Detection, Detector, best_rack, points_in_box
from tubepose.labware import RackModel, TubeModel
from tubepose.methods import METHODS, MethodResult
from tubepose.rack import RackPose, RackStatus, register_rack
from tubepose.scene import Scene
from tubepose.sensor import measure_noise, prior_noise
from tubepose.slots import look_at_slots
from tubepose.stage_times import Clock
from tubepose.targets import find_targets
from tubepose.transforms import FloatArray

RACK_MARGIN = 0.10
"""A rack is looked for in a little more than its box: a box that is drawn too tight cuts its edges off."""


def prepare_scene(
    frame: RgbdFrame,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    detector: Detector,
    config: Config,
    hint: TurnHint | None = None,
    T_camera_rack: FloatArray | None = None,
    methods: Sequence[str] = tuple(METHODS),
) -> Scene:
    """Detect, register the rack, measure the sensor's noise, look at the slots, and assign detected tubes to them.

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
    if T_camera_rack is None:
        boxes, pose = _detect_and_register(frame, intrinsics, rack, detector, config, hint, clock)
    else:
        with clock.stage("detect"):
            boxes, pose = detector.detect(frame), RackPose(RackStatus.OK, "", T_camera_rack, resolved_by="given")
    unknown = prior_noise(config.sensor, "the rack's pose is not known")
    scene = Scene(frame, rack, tuple(tubes), intrinsics, boxes, pose, unknown)
    if pose.T_camera_rack is None:
        return replace(scene, times=clock.shared())
    with clock.stage("sensor"):
        scene = replace(scene, noise=measure_noise(frame, intrinsics, pose.T_camera_rack, rack, config.sensor))
    with clock.stage("slots"):
        depth_std_m = scene.noise.depth_std_m
        looks = look_at_slots(frame, intrinsics, pose.T_camera_rack, rack, tubes, depth_std_m, pose.bow_m)
        scene = replace(scene, looks=looks)
    if any(METHODS[name].needs_targets for name in methods):
        with clock.stage("detect"):
            scene = replace(scene, detections=detector.checked(frame, pose.T_camera_rack, boxes))
        with clock.stage("slots"):
            targets = find_targets(frame, rack, tubes, scene.detections, pose.T_camera_rack, config)
            scene = replace(scene, targets=targets)
    return replace(scene, times=clock.shared())


def estimate_tubes(scene: Scene, method: str, config: Config, seed: int | None = None) -> MethodResult:
    """Ask one method, by its name in `METHODS`, for every tube of a scene."""
    return METHODS[method].estimate(scene, config, seed)


def _detect_and_register(
    frame: RgbdFrame,
    intrinsics: CameraIntrinsics | None,
    rack: RackModel,
    detector: Detector,
    config: Config,
    hint: TurnHint | None,
    clock: Clock,
) -> tuple[tuple[Detection, ...], RackPose]:
    """Boxes and the pose of the best rack among them; where it has none, those of the detector's second opinion."""

    def registered(boxes: Sequence[Detection]) -> RackPose:
        with clock.stage("rack"):
            best = best_rack(boxes)
            if best is None:
                return RackPose(RackStatus.NOT_FOUND, "the detector found no rack", code="no_detection")
            return register_rack(points_in_box(frame, best, RACK_MARGIN), rack, config, hint, intrinsics)

    with clock.stage("detect"):
        boxes = detector.detect(frame)
    pose = registered(boxes)
    if pose.T_camera_rack is not None:
        return boxes, pose
    with clock.stage("detect"):
        others = detector.second_opinion(frame, boxes, pose.reason)
    other_pose = registered(others) if others else pose
    # Where that fails too, the first answer stays.
    return (boxes, pose) if other_pose.T_camera_rack is None else (others, other_pose)
