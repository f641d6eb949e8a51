"""From a rough fit to a registration: the fine rounds, what holds them level, and what agrees with them or does not."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tubepose.checks import Check, reason
from tubepose.config import RackConfig
from tubepose.labware import RackModel
from tubepose.rack.agreement import Agreement, coverage, measure_agreement
from tubepose.rack.alternatives import own_distance_m
from tubepose.rack.fit import HOPELESS_SHARE, Fit, RoughFit, at_the_top, leveled, refine, top_frame
from tubepose.rack.looks import SLOT_STEPS, look_at, on_lattice, seen_near
from tubepose.rack.proof import face_of, prove, quick_checks
from tubepose.rack.size import FaceSize
from tubepose.rack.tops import Level, level_by_tops
from tubepose.transforms import FloatArray, translation

# Tops of what stands in a rack are asked where less than this share of its own is seen. They hold it where hardly any
# is, and where its ribs lean by so many standard deviations of both.
HIDDEN_SHARE = 0.4
LEANS_SIGMAS = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """A refined pose and what became of it.

    Attributes:
        fit: The pose.
        agreement: How well the points agree with it.
        checks: What it had to pass.
        name: Of the rack.
        size: What the face's sizes are measured to be; None where a quick look had failed.
        floor_m: Height of the slots' floor and its standard deviation, metres; None where it was not seen.
        log_likelihood: Of the cells of the face, nats; minus infinity where a quick look had failed.
    """

    fit: Fit
    agreement: Agreement
    checks: tuple[Check, ...]
    name: str
    size: FaceSize | None = None
    floor_m: tuple[float, float] | None = None
    log_likelihood: float = float("-inf")

    @property
    def reason(self) -> str:
        """Why it is not believed, in words; empty if it is."""
        return reason(self.checks, self.name)


def register_at(points_m: FloatArray, T_camera_rack: FloatArray, rack: RackModel, config: RackConfig) -> Registration:
    """Refine a coarse pose and judge it; where one a slot farther has more evidence, go there first."""
    return settled(points_m, *on_lattice(points_m, T_camera_rack, rack), rack, config)


def settled(
    points_m: FloatArray, near_m: FloatArray, rough: RoughFit, rack: RackModel, config: RackConfig
) -> Registration:
    """The fine rounds and the judgement of a rough fit.

    Args:
        points_m: All points, camera frame, shape (N, 3), metres: where a slot farther is looked at.
        near_m: Those near the rack.
        rough: The fit.
        rack: The rack.
        config: What a registration has to pass.
    """
    best = _judged(near_m, rough, rack, config)
    for _ in range(SLOT_STEPS):
        # No step smooths what is rough, nor empties openings.
        seen = best.agreement
        stray = seen.in_slot > 2 * config.max_stray_share or seen.rmse_m > config.max_inlier_rmse_m
        if seen.slot_margin >= 0 or stray:
            break
        T_step = translation([*seen.step_m, 0.0])
        near_m, rough = look_at(points_m, best.fit.T_camera_rack @ T_step, rack)
        farther = _judged(near_m, rough, rack, config)
        if farther.agreement.evidence <= seen.evidence:
            break
        best = farther
    return _proved(best, near_m, rack, config)


def _judged(near_m: FloatArray, rough: RoughFit, rack: RackModel, config: RackConfig) -> Registration:
    """The fine rounds, held level by the tops of what stands in the rack where hardly any of its own top is seen.

    Or where little is, and leans. Ribs that pass every test are believed where a rack that is held does not.
    """
    hopeless = rough.stray > HOPELESS_SHARE
    free: Registration | None = None
    if hopeless or coverage(at_the_top(rough, rough.kept_m), rack) >= config.clear_seen:
        free = _refined(near_m, rough, rack, config)
        if hopeless or free.agreement.coverage >= HIDDEN_SHARE:
            return free
    level = level_by_tops(near_m, rough.kept_m, rough.T_camera_top, rack)
    if level is None:
        return free or _refined(near_m, rough, rack, config)
    if free is not None and free.agreement.coverage >= config.clear_seen and not _leans(free.fit, level, rack):
        return free
    held = _refined(near_m, leveled(rough, level), rack, config)
    if held.reason:
        free = free or _refined(near_m, rough, rack, config)
        return held if free.reason else free
    return held


def _leans(fit: Fit, level: Level, rack: RackModel) -> bool:
    """Whether a fit stands less level than its covariance and that of the tops allow."""
    R = top_frame(fit.T_camera_rack, rack)[:3, :3].T @ level.T_camera_top[:3, :3]
    turn = Rotation.from_matrix(R).as_rotvec()[:2]
    off = turn @ np.linalg.solve(fit.covariance[:2, :2] + level.covariance, turn)
    return bool(off > LEANS_SIGMAS**2)


def _refined(near_m: FloatArray, rough: RoughFit, rack: RackModel, config: RackConfig) -> Registration:
    fit = refine(rough, rack)
    agreement = measure_agreement(fit.laid_flat(near_m, rack), fit, rack, config)
    return Registration(fit, agreement, quick_checks(agreement, fit, config), rack.name)


def _proved(registration: Registration, near_m: FloatArray, rack: RackModel, config: RackConfig) -> Registration:
    """A registration that has passed the quick looks, with the other checks."""
    if registration.reason:
        return registration
    fit = registration.fit
    proof = prove(fit.laid_flat(near_m, rack), fit, registration.agreement, rack, config)
    return replace(
        registration, checks=(*registration.checks, *proof.checks), size=proof.size, floor_m=proof.floor_m,
        log_likelihood=proof.log_likelihood,
    )  # fmt: skip


def likelihood_at(
    points_m: FloatArray, few_m: FloatArray, T_camera_rack: FloatArray, rack: RackModel, config: RackConfig
) -> float:
    """Log likelihood of the cells of a rack's face, registered from a coarse pose, nats.

    Minus infinity where it does not fit. Arguments are those of `register_at`, and some of the points, (M, 3), that it
    is registered by: an edge is known better by them than cells are wide.
    """
    near_m, rough = on_lattice(few_m, T_camera_rack, rack)
    best = _judged(near_m, rough, rack, config)
    if best.reason:
        return float("-inf")
    near_m = seen_near(points_m, best.fit.T_camera_rack, rack)
    face = face_of(best.fit.laid_flat(near_m, rack), best.fit, best.agreement.spacing_m, rack)
    return face.log_likelihood(own_distance_m(rack, face.grid))
