"""What a method says of one tube."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from tubepose.checks import Check, reason_code, said, sentence
from tubepose.transforms import FloatArray


class TubeStatus(StrEnum):
    """What became of a tube."""

    OK = "ok"
    REJECTED = "rejected"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class TopMeasure:
    """What was measured of a tube's top, to compare with the labware's definitions.

    Attributes:
        height_m: Height of a closed top above the slot floor that the rack's file defines, along the tube's axis,
            metres; NaN where it was not measured.
        diameter_m: Diameter of a closed top's circle, metres; NaN where it was not measured.
        off_m: Where the axis that the top alone tells crosses the rack's face, less the slot's centre, along the rack's
            x and y, metres; NaN where it was not measured.
    """

    height_m: float
    diameter_m: float = float("nan")
    off_m: tuple[float, float] = (float("nan"), float("nan"))


@dataclass(frozen=True, slots=True, eq=False)
class TubePose:
    """Pose of a tube in the rack frame.

    Attributes:
        status: OK; REJECTED (the pose cannot be true, or the points do not allow one); FAILED (a baseline
            ended without).
        reason: In words, empty when OK.
        T_rack_tube: Array of shape (4, 4), metres; origin at the tube's bottom, z along its axis. None where
            there is no pose.
        confidence: Probability that the pose is within 2 mm and 2 deg of the truth (`tubepose.confidence`) and the type
            right; NaN where the method states no covariance.
        inlier_rmse_m: RMS distance to the template of the points that have a partner on it, metres; NaN where the
            method has no template.
        fitness: Share of the points that have such a partner; NaN where the method has no template.
        excess_rms_m: RMS of how far all points lie outside the fitted cylinder (0 inside of it), metres; of `paper`.
        inside_share: Share of the points that lie at most `tube.tolerance_m` outside of it; of `paper`.
        top_rms_m: RMS distance of the points of the tube's top to their plane, metres; of `profile`.
        top_seen_share: Share of the circle of the tube's top whose end is seen; of `profile`.
        n_points: Points that the fit saw.
        covariance: Of the pose, shape (5, 5), over small turns about the tube's x and y and shifts along its x, y and z
            at its bottom, rad and metres; None where the method does not say.
        checks: What the pose had to pass; empty from a method that has none.
        top: What was measured of the tube's top; None from methods that do not look at it.
    """

    status: TubeStatus
    reason: str = ""
    T_rack_tube: FloatArray | None = None
    confidence: float = float("nan")
    inlier_rmse_m: float = float("nan")
    fitness: float = float("nan")
    excess_rms_m: float = float("nan")
    inside_share: float = float("nan")
    top_rms_m: float = float("nan")
    top_seen_share: float = float("nan")
    n_points: int = 0
    covariance: FloatArray | None = None
    checks: tuple[Check, ...] = ()
    top: TopMeasure | None = None

    @property
    def reason_code(self) -> str:
        """Code of the first check for which it is not believed; empty when OK."""
        return "" if self.status is TubeStatus.OK else reason_code(self.checks)


def refused(check: Check, name: str = "", n_points: int = 0, status: TubeStatus = TubeStatus.REJECTED) -> TubePose:
    """No pose, and the check that says why.

    Args:
        check: The check.
        name: Of the tube or rack that its sentence speaks of.
        n_points: Points that there were.
        status: REJECTED, or FAILED.
    """
    return TubePose(status, sentence(check, name), n_points=n_points, checks=(check,))


def failed(reason: str, n_points: int) -> TubePose:
    """No pose from a registration that ended without one, and why."""
    return refused(said("no_pose", reason), n_points=n_points, status=TubeStatus.FAILED)
