"""The pitch of a rack's slots as the tubes in it tell, and the refusal of a rack whose file has another one."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from scipy.stats import norm, t

from tubepose.checks import Check, failed, reason, said, sentence
from tubepose.config import Config, RackConfig
from tubepose.labware import RackModel
from tubepose.rack import RackPose, RackStatus
from tubepose.rack.proof import pitch_checks
from tubepose.scene import Scene, TubeEstimate
from tubepose.statistics import weighted_mean
from tubepose.tube import TubeStatus

SIGMAS = 3.0
"""A size contradicts its file beyond so many standard deviations: 1 of 370 by chance, for one size of one run."""
MEASURED_CODES = frozenset(("", "height_off", "tilt_uncertain", "labware"))
"""A tube that is refused for these alone has a top that was measured and is of its type."""
LEAST_TOPS = 6
"""So many tops tell a pitch: fewer leave the scatter about a line of three numbers unknown."""


def refuse_by_tops(
    scene: Scene, estimates: Sequence[TubeEstimate], config: Config
) -> tuple[Scene, tuple[TubeEstimate, ...]]:
    """Refuse a rack and its tubes where the measured tops lie on slots of another pitch than its file's.

    `rack.proof` asks the same of ribs and of rough tops; where caps hide the ribs, the fitted circles and normals know
    better. The limit is the same: `rack.max_pitch_mm` at the outermost slot, beyond three standard deviations.

    Args:
        scene: The frame; one whose rack has no pose, or was given one, stays as it is.
        estimates: Answers of `profile`.
        config: Section rack is used.

    Returns:
        The scene with two checks more (`pitch_x`, `pitch_y`), its rack refused if one of them failed; and the
        estimates, all of them then rejected with the code `labware`.
    """
    pose, rack = scene.rack_pose, scene.rack
    if pose.T_camera_rack is None or pose.resolved_by == "given":
        return scene, tuple(estimates)
    checks = tuple(_pitch_checks(pose, rack, estimates, config.rack))
    wrong = failed(checks)
    pose = replace(pose, checks=(*pose.checks, *checks))
    if not wrong:
        return replace(scene, rack_pose=pose), tuple(estimates)
    why = reason(wrong, rack.name)
    pose = replace(
        pose, status=RackStatus.REFUSED, reason=why, T_camera_rack=None, covariance=None, ambiguous=False,
        resolved_by="", hint_note="", bow_m=None, bow_std_m=None,
    )  # fmt: skip
    return replace(scene, rack_pose=pose), tuple(_as_labware(estimate, why) for estimate in estimates)


def _as_labware(estimate: TubeEstimate, why: str) -> TubeEstimate:
    check = said("labware", why)
    if estimate.pose.status is not TubeStatus.OK:
        return estimate
    words = sentence(check, "")
    pose = replace(estimate.pose, status=TubeStatus.REJECTED, reason=words, checks=(*estimate.pose.checks, check))
    return replace(estimate, pose=pose)


def _pitch_checks(
    pose: RackPose, rack: RackModel, estimates: Sequence[TubeEstimate], config: RackConfig
) -> Iterator[Check]:
    reach_mm = 1e3 * np.abs(rack.slot_centers_m).max(axis=0)
    for axis, name in enumerate("xy"):
        tops = tops_stretch(rack, estimates, axis)
        if tops is None:
            continue
        share, std = joined(ribs_stretch(pose, axis), tops)
        off_mm, std_mm = float(share * reach_mm[axis]), float(std * reach_mm[axis])
        yield from pitch_checks(f"pitch_{name}", off_mm, std_mm, config)


def ribs_stretch(pose: RackPose, axis: int) -> tuple[float, float] | None:
    """By how much slots lie farther apart than defined, a share, and its std, as the rack's face says."""
    return None if pose.size is None else (float(pose.size.stretch[axis]), float(pose.size.std[axis]))


def tops_stretch(rack: RackModel, estimates: Sequence[TubeEstimate], axis: int) -> tuple[float, float] | None:
    """The same by least squares of where tubes' axes cross the face against their slots; None with too few tubes.

    Neighbours whose caps touch lean outwards together, as far as their slots let them: no number of tubes takes that
    away, so the standard deviation is never less than the scatter at the outermost slot.
    """
    found = [
        (rack.slot(e.target.slot).center_m, e.pose.top.off_m)
        for e in estimates
        if e.target.slot is not None and e.pose.top is not None and e.pose.reason_code in MEASURED_CODES
    ]
    kept = [(center, off) for center, off in found if np.isfinite(off).all()]
    if len(kept) < LEAST_TOPS:
        return None
    center, off = (np.array(column) for column in zip(*kept, strict=True))
    if len(np.unique(np.rint(center[:, axis] * 1e3))) < 2:
        return None
    design = np.column_stack([np.ones(len(center)), center])
    solution, _, rank, _ = np.linalg.lstsq(design, off[:, axis], rcond=None)
    dof = len(center) - int(rank)
    if dof < 2:
        return None
    scatter_m = float(np.sqrt(np.sum((off[:, axis] - design @ solution) ** 2) / dof))
    variance = scatter_m**2 * np.linalg.pinv(design.T @ design)[1 + axis, 1 + axis]
    leaning = scatter_m / float(np.abs(center[:, axis]).max())
    # Few tubes: Student's tails, so that three standard deviations are as sure as of a Gaussian.
    tails = float(t.ppf(norm.cdf(SIGMAS), dof)) / SIGMAS
    return float(solution[1 + axis]), tails * float(np.hypot(np.sqrt(variance), leaning))


def joined(first: tuple[float, float] | None, second: tuple[float, float] | None) -> tuple[float, float]:
    """Two measurements of one number by inverse variances; at least one is there."""
    both = [one for one in (first, second) if one is not None]
    return weighted_mean(np.array([one[0] for one in both]), np.array([one[1] for one in both]))
