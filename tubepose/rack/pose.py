"""What a registration of a rack says, and which way round a rack stands that looks the same after half a turn."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from tubepose.capture.frame import CameraIntrinsics
from tubepose.capture.session import SlotHint
from tubepose.config import RackConfig
from tubepose.labware import RackModel
from tubepose.transforms import FloatArray, transform_points

MIN_POINTS = 50


class RackStatus(StrEnum):
    """What became of a rack."""

    OK = "ok"
    NOT_FOUND = "not_found"
    INSUFFICIENT = "insufficient"
    REFUSED = "refused"
    UNIT = "wrong_unit"


@dataclass(frozen=True, slots=True, eq=False)
class RackPose:
    """Pose of a rack in the camera frame.

    Attributes:
        status: OK, or the kind of failure.
        reason: In words, empty when OK.
        T_camera_rack: Array of shape (4, 4); maps rack points to camera points, metres. None unless status is OK.
        inlier_rmse_m: RMS distance of the top's points to the solid part of the template, metres; NaN without a
            registration.
        fitness: Share of the top's points that are near the solid part; NaN without a registration.
        in_slot_share: Share of the top's points that lie inside the template's openings; NaN without a registration.
        coverage: Share of the template that the scan covers; NaN without a registration.
        ambiguous: True when neither geometry nor a hint tells the rack from itself turned by 180 degrees.
        resolved_by: ``geometry``, ``hint``, or ``rule`` (rack x points to the bottom right of the image), or ``given``;
            empty without a pose.
        turn_margin_m: Inlier rmse of the other turn minus that of this one, metres; NaN without a registration.
        spacing_m: Median point spacing of the top, metres; NaN without points.
        covariance: Of the pose's error, shape (6, 6): rotation vector about x, y, z (rad), then translation along x, y,
            z (metres), in the rack frame about the centre of the rack's top. None without a pose, and from a method
            that does not state it.
        rack: The rack that was found where it was not given but looked for; None otherwise.
        level_tops: How many tops of what stands in it hold it level; 0 where its own top tells.
        hint_note: Why a hint that was given decided nothing, where one was needed; empty otherwise.
        named_by_margin: By how much the rack's agreement beats the next one's of the catalogue, where the rack was
            named by that: 0 is no difference; NaN otherwise.
    """

    status: RackStatus
    reason: str = ""
    T_camera_rack: FloatArray | None = None
    inlier_rmse_m: float = float("nan")
    fitness: float = float("nan")
    in_slot_share: float = float("nan")
    coverage: float = float("nan")
    ambiguous: bool = False
    resolved_by: str = ""
    turn_margin_m: float = float("nan")
    spacing_m: float = float("nan")
    covariance: FloatArray | None = None
    rack: RackModel | None = None
    named_by_margin: float = float("nan")
    hint_note: str = ""
    level_tops: int = 0


def choose_turn(
    T_camera_best: FloatArray,
    T_camera_turned: FloatArray,
    margin_m: float,
    rack: RackModel,
    config: RackConfig,
    hint: SlotHint | None,
    intrinsics: CameraIntrinsics | None,
) -> tuple[int, str]:
    """Which of two turns to report (0 or 1), and what decided.

    Args:
        T_camera_best: The turn that agrees better, T_camera_rack of shape (4, 4), metres.
        T_camera_turned: The other one.
        margin_m: Rmse of the other one minus that of the better one, metres.
        rack: The rack.
        config: What margin decides.
        hint: Where a slot is seen.
        intrinsics: Of the image that the hint speaks of.
    """
    if margin_m > config.ambiguous_margin_m:
        return 0, "geometry"
    if hint is not None and intrinsics is not None:
        pixels = _hinted(T_camera_best, T_camera_turned, rack, hint, intrinsics)
        distances = np.hypot(*(pixels - np.array(hint.pixel)).T)
        # A hint far from both places says nothing: swapped coordinates, or a pixel of another image.
        near = 0.25 * float(np.hypot(*(pixels[0] - pixels[1])))
        if distances.min() < near < abs(distances[0] - distances[1]):
            return int(distances.argmin()), "hint"
    # Decided by the image's diagonal: racks stand along the image's sides more often than along its diagonal.
    return (0 if T_camera_best[:2, 0].sum() > 0 else 1), "rule"


def unused_hint(
    T_camera_given: FloatArray,
    T_camera_other: FloatArray,
    rack: RackModel,
    hint: SlotHint | None,
    intrinsics: CameraIntrinsics | None,
) -> str:
    """Why a hint has not decided between the turn that is given and the other one, in words; empty without a hint."""
    if hint is None:
        return ""
    if intrinsics is None:
        return f"the hint for {hint.slot} is a pixel, and this cloud has none: give an organised cloud or an image"
    (u, v), (other_u, other_v) = _hinted(T_camera_given, T_camera_other, rack, hint, intrinsics)
    return (
        f"the hint says that {hint.slot} is seen at {hint.pixel[0]:.0f},{hint.pixel[1]:.0f}, but it is at "
        f"{u:.0f},{v:.0f} in the pose given or, the rack turned, at {other_u:.0f},{other_v:.0f}: point nearer to one "
        "of them, in pixels of the capture's image (an overlay is cut and scaled)"
    )


def _hinted(
    T_camera_best: FloatArray,
    T_camera_turned: FloatArray,
    rack: RackModel,
    hint: SlotHint,
    intrinsics: CameraIntrinsics,
) -> FloatArray:
    """Pixels (2, 2) where the hint's slot is seen in either turn."""
    point = np.array([*rack.slot(hint.slot).center_m, rack.height_m])
    return np.stack([intrinsics.project(transform_points(T, point)) for T in (T_camera_best, T_camera_turned)])
