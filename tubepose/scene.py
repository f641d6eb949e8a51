"""What all methods share of one frame, and what each of them answers."""

from __future__ import annotations

from dataclasses import dataclass

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.checks import Check
from tubepose.detection import Detection
from tubepose.labware import RackModel, TubeModel
from tubepose.rack import RackPose
from tubepose.sensor import SensorNoise
from tubepose.slots import SlotLook
from tubepose.stage_times import StageTime
from tubepose.transforms import FloatArray
from tubepose.tube import TubePose


@dataclass(frozen=True, slots=True, eq=False)
class TubeTarget:
    """A detected tube, ready for any method.

    Attributes:
        detection: Index of the detection; None for a tube that `profile` found itself.
        slot: Name of the slot, or None.
        tube: The tube's model, or None where its type is unknown.
        hull_share: Share of its projected hull in the slot's opening; NaN for a tube that `profile` found itself.
        why: Why no method can be asked; None where one can.
        points_m: Points, rack frame, shape (N, 3), metres.
        top_support: Share of its top that was seen, less the share of its surroundings; NaN for a detected tube, and
            where there is no top.
    """

    detection: int | None
    slot: str | None
    tube: TubeModel | None
    hull_share: float
    why: Check | None
    points_m: FloatArray
    top_support: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What all methods share of one frame: boxes, rack, noise, slots.

    Attributes:
        frame: The frame.
        rack: The rack's model.
        tubes: The kinds of tube that can stand in it.
        intrinsics: Recorded or, for an organised cloud, estimated from it; None where there are none.
        detections: All boxes.
        rack_pose: The rack's pose, or why there is none.
        noise: The sensor's noise, measured in this frame; the prior without the rack's pose.
        targets: Every detected tube (empty without a rack's pose, and where no method needs them).
        times: Duration of the shared stages.
        looks: What was seen of every slot, in the order of the rack's slots (empty without a rack's pose).
    """

    frame: RgbdFrame
    rack: RackModel
    tubes: tuple[TubeModel, ...]
    intrinsics: CameraIntrinsics | None
    detections: tuple[Detection, ...]
    rack_pose: RackPose
    noise: SensorNoise
    targets: tuple[TubeTarget, ...] = ()
    times: tuple[StageTime, ...] = ()
    looks: tuple[SlotLook, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class TubeEstimate:
    """One method's answer for one detected tube.

    Attributes:
        method: Name in `tubepose.methods.METHODS`.
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
