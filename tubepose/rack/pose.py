"""What a registration of a rack says."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from tubepose.checks import Check, reason_code
from tubepose.labware import RackModel
from tubepose.rack.size import FaceSize
from tubepose.transforms import FloatArray

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
        ambiguous: True when neither geometry nor a hint tells the rack from itself turned by 180 degrees, or by 90.
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
        checks: What the registration had to pass; empty from a method that has none, and without a registration.
        size: What the sizes of its face are measured to be; None from a method that does not measure them.
        floor_m: Height at which the slots' floor is seen above the rack's base and its standard deviation, metres; None
            where it is not seen.
        bow_m: How much higher the face is than the plane at its centre, shape (3,), metres: at the ends of its x axis,
            of its y axis, and what its corners have besides: b(x, y) = bow_x u^2 + bow_y v^2 + bow_xy u v, u = 2 x /
            length, v = 2 y / width. None without a pose, and from a method that takes every face for flat.
        bow_std_m: Standard deviations of that, shape (3,).
        named_by_nats: By how much likelier the rack is than the next one of the catalogue that passes every check,
            where it was named by that; infinity where no other passes, NaN where a person named it.
        code: Why there is no pose where no check says it: ``too_few_points``, ``no_level_band``, ``too_coarse``,
            ``too_noisy``, ``wrong_unit``, ``no_detection``, ``other_outline``, ``other_fit`` (of `obb-icp`),
            ``none_fits``, ``several_fit`` (of `--rack auto`), ``no_slots`` (of `--rack grid`).
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
    named_by_nats: float = float("nan")
    hint_note: str = ""
    level_tops: int = 0
    checks: tuple[Check, ...] = ()
    size: FaceSize | None = None
    floor_m: tuple[float, float] | None = None
    bow_m: FloatArray | None = None
    bow_std_m: FloatArray | None = None
    code: str = ""

    @property
    def reason_code(self) -> str:
        """Why there is no pose, as a code: `code`, or else that of the first check that failed; empty when OK."""
        return "" if self.status is RackStatus.OK else self.code or reason_code(self.checks)
