"""Registration of the rack by its edges: search, refinement, and the tests that a pose has to pass (method `edges`)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace
from itertools import chain, islice

import numpy as np

from tubepose.capture.frame import CameraIntrinsics
from tubepose.capture.hints import TurnHint
from tubepose.checks import Check, reason
from tubepose.config import Config, RackConfig, RackTopConfig
from tubepose.labware import RackModel
from tubepose.preprocessing import point_spacing_m, thin
from tubepose.rack.agreement import outline_fits, rough_evidence
from tubepose.rack.alternatives import lookalikes
from tubepose.rack.field import top_field
from tubepose.rack.fit import RoughFit, filled, rack_frame, top_frame
from tubepose.rack.insufficient import outline_words, too_coarse
from tubepose.rack.looks import on_lattice, seen_near
from tubepose.rack.pose import MIN_POINTS, RackPose, RackStatus
from tubepose.rack.search import Band, Hypothesis, levels, search, search_by_tops
from tubepose.rack.settling import Registration, likelihood_at, settled
from tubepose.rack.turns import choose_turn, turns_of, unused_hint
from tubepose.transforms import FloatArray, translation

# Places whose coarse picture agrees less than this, compared with one that was accepted, are no rivals of it.
RIVAL_WORTH = 0.4
# The fine rounds add no more than this to a pose's evidence.
ROUGH_MARGIN = 1.05
# Places that are looked at where tubes hide a rack.
MOST_HIDDEN = 4
# Of a face of which so much is seen a rack that looks alike is told by its openings.
MUCH_SEEN = 0.4
# A rack that tubes in so many of its slots hold is nowhere else.
CLEAR_TOPS = 0.6


def register_edges(
    points_m: FloatArray, rack: RackModel, config: Config, hint: TurnHint | None, intrinsics: CameraIntrinsics | None
) -> RackPose:
    """One try of `register_rack` by this method, without the suspicions of unit and noise."""
    if len(points_m) < MIN_POINTS:
        few = f"{len(points_m)} valid points on the rack, expected at least {MIN_POINTS}"
        return RackPose(RackStatus.INSUFFICIENT, few, code="too_few_points")
    few_m = coarse_sample(points_m, config.rack_top)
    best = best_registration(points_m, few_m, levels(few_m, config.rack_top), rack, config)
    if best is not None and not best.reason:
        best = _against_lookalikes(best, points_m, few_m, rack, config.rack)
    return pose_of(best, points_m, rack, config, hint, intrinsics)


def _against_lookalikes(
    best: Registration, points_m: FloatArray, few_m: FloatArray, rack: RackModel, config: RackConfig
) -> Registration:
    """The same, refused where a rack of the catalogue with nearly its outline, registered there, is likelier.

    Where much of a face is seen, that was told in the rack's own pose already.
    """
    if best.agreement.coverage >= MUCH_SEEN:
        return best
    checks = list(best.checks)
    for other in lookalikes(rack):
        T_camera_other = top_frame(best.fit.T_camera_rack, rack) @ translation([0, 0, -other.height_m])
        gain = likelihood_at(points_m, few_m, T_camera_other, other, config) - best.log_likelihood
        if np.isfinite(gain):
            checks.append(Check("other_rack", gain, config.max_gain, gain <= config.max_gain, detail=other.name))
    return replace(best, checks=tuple(checks))


def pose_of(
    best: Registration | None,
    points_m: FloatArray,
    rack: RackModel,
    config: Config,
    hint: TurnHint | None,
    intrinsics: CameraIntrinsics | None,
) -> RackPose:
    """What to report of the best registration."""
    if best is None:
        return _not_found(points_m, rack, config.rack, "no level band", "no_level_band")
    spacing_m = best.agreement.spacing_m
    coarse = too_coarse(spacing_m, rack, config.rack)
    if coarse:
        return RackPose(RackStatus.INSUFFICIENT, coarse, spacing_m=spacing_m, code="too_coarse")
    if best.reason and not outline_fits(best.agreement, config.rack):
        return replace(_not_found(points_m, rack, config.rack, best.reason, ""), checks=best.checks)
    return _pose(best, points_m, rack, config, hint, intrinsics)


def best_registration(
    points_m: FloatArray,
    few_m: FloatArray,
    found_levels: Iterable[list[Band]],
    rack: RackModel,
    config: Config,
    most: int | None = None,
) -> Registration | None:
    """The registration with most evidence of those that nothing contradicts, else of all; None where no band is found.

    The first one that sees much of the top is taken: only where little is seen can another place look like the rack.
    Places that are worth much less than one that was accepted are not looked at, nor, if hardly a point contradicts it,
    those on other level directions than its own; and no more than `most`. Those that a rough look tells to be no rivals
    are looked at no further.

    Args:
        points_m: What a pose is refined with and judged by, camera frame, shape (N, 3), metres.
        few_m: Some of them, which the search and rough looks see: `coarse_sample`.
        found_levels: Bands of those, one level direction after the other.
        rack: The rack.
        config: All sections.
        most: Places that are looked at.
    """
    found: list[Registration] = []
    been: list[FloatArray] = []
    searched: list[list[Band]] = []
    worth = 0.0

    def until_settled() -> Iterator[list[Band]]:
        for level in found_levels:
            searched.append(level)
            yield level
            if any(not other.reason and _uncontradicted(other, config.rack) for other in found):
                return

    def hidden() -> Iterator[Hypothesis]:
        """Where nothing was accepted, tubes may hide the rack."""
        if all(other.reason for other in found):
            yield from islice(search_by_tops(searched, few_m, rack), MOST_HIDDEN)

    for hypothesis in chain(islice(search(until_settled(), rack), most), hidden()):
        if hypothesis.worth < RIVAL_WORTH * worth or _known(hypothesis.T_camera_rack, been, rack):
            continue
        near_m, rough = on_lattice(few_m, hypothesis.T_camera_rack, rack)
        if _no_rival(near_m, rough, len(points_m) / len(few_m), found, rack, config.rack):
            been.append(rack_frame(rough, rack))
            continue
        near_m = seen_near(points_m, rack_frame(rough, rack), rack)
        registration = settled(points_m, near_m, filled(rough, near_m, rack), rack, config.rack)
        if not registration.reason and _clear(registration, rack, config.rack):
            return registration
        if not registration.reason:
            worth = max(worth, hypothesis.worth)
        if not _known(registration.fit.T_camera_rack, been, rack):
            found.append(registration)
            been.append(registration.fit.T_camera_rack)
    return _likeliest(found, config.rack)


def _clear(registration: Registration, rack: RackModel, config: RackConfig) -> bool:
    """Whether no other place needs to be looked at: much is seen, or much stands in it; hardly a point contradicts."""
    seen, level = registration.agreement, registration.fit.level
    tubes = level is not None and level.count >= CLEAR_TOPS * len(rack.all_slots)
    return (seen.coverage >= config.clear_seen or tubes) and _uncontradicted(registration, config)


def _uncontradicted(registration: Registration, config: RackConfig) -> bool:
    return registration.agreement.in_slot <= config.max_stray_share / 2


def _likeliest(found: list[Registration], config: RackConfig) -> Registration | None:
    found = sorted(found, key=lambda r: (bool(r.reason), -r.agreement.evidence))
    if len(found) < 2 or found[1].reason:
        return found[0] if found else None
    spacing_m = found[0].agreement.spacing_m
    best, next_best = (registration.agreement.evidence_at(spacing_m) for registration in found[:2])
    if best >= config.min_rival_ratio * next_best:
        return found[0]
    ratio = best / max(next_best, 1e-9)
    check = Check("two_places", ratio, config.min_rival_ratio, False)
    return replace(found[0], checks=(*found[0].checks, check))


def _known(T_camera_rack: FloatArray, been: list[FloatArray], rack: RackModel) -> bool:
    return any(_same(T_camera_rack, other, rack) for other in been)


def _no_rival(
    near_m: FloatArray,
    rough: RoughFit,
    weight: float,
    found: list[Registration],
    rack: RackModel,
    config: RackConfig,
) -> bool:
    """Whether a rough fit has too little evidence to be a rival of the best pose that was accepted before it.

    Each of the points that it has seen stands for `weight` of those that the accepted pose was judged by.
    """
    accepted = [other.agreement for other in found if not other.reason]
    if not accepted:
        return False
    best = max(accepted, key=lambda agreement: agreement.evidence)
    most = ROUGH_MARGIN * weight * rough_evidence(near_m, rough, best.spacing_m, rack)
    return most * config.min_rival_ratio < best.evidence


def _same(T_a: FloatArray, T_b: FloatArray, rack: RackModel) -> bool:
    """Whether two poses are within 4 mm and 2 degrees, but for turns that leave the top as it is, and half turns."""
    top = np.array([0.0, 0.0, rack.height_m])
    apart = np.linalg.norm(T_a[:3, :3] @ top + T_a[:3, 3] - T_b[:3, :3] @ top - T_b[:3, 3])
    turned = T_a[:3, :3].T @ T_b[:3, :3]
    along = abs(turned[0, : 2 if top_field(rack).alike == 4 else 1]).max()
    return bool(apart < 4e-3 and turned[2, 2] > 0.9994 and along > 0.9994)


def coarse_sample(points_m: FloatArray, config: RackTopConfig) -> FloatArray:
    """What the search sees: all of a rack's points are too many, a rack in a whole frame needs more."""
    return thin(points_m, min(max(config.coarse_points, len(points_m) // 3), config.search_points))


def _pose(
    best: Registration,
    points_m: FloatArray,
    rack: RackModel,
    config: Config,
    hint: TurnHint | None,
    intrinsics: CameraIntrinsics | None,
) -> RackPose:
    turns = turns_of(best, points_m, rack, config.rack)
    margin_m = turns[1].agreement.rmse_m - turns[0].agreement.rmse_m
    T_turns = [turn.T_camera_rack for turn in turns]
    index, resolved_by = choose_turn(T_turns, margin_m, rack, config.rack, hint, intrinsics)
    T_given = T_turns.pop(index)
    chosen, why = turns[index], reason(turns[0].checks, rack.name)
    seen = chosen.agreement
    return RackPose(
        RackStatus.REFUSED if why else RackStatus.OK,
        why,
        None if why else T_given,
        seen.rmse_m,
        seen.fitness,
        seen.in_slot,
        seen.coverage,
        ambiguous=resolved_by == "rule" and not why,
        resolved_by="" if why else resolved_by,
        hint_note=unused_hint(T_given, T_turns, rack, hint, intrinsics) if resolved_by == "rule" and not why else "",
        turn_margin_m=margin_m if index == 0 else -margin_m,
        spacing_m=seen.spacing_m,
        level_tops=0 if why else chosen.level_tops,
        covariance=None if why else chosen.covariance,
        checks=turns[0].checks,
        size=chosen.size,
        floor_m=chosen.floor_m,
        bow_m=None if why else chosen.bow_m,
        bow_std_m=None if why else chosen.bow_std_m,
    )


def _not_found(points_m: FloatArray, rack: RackModel, config: RackConfig, closest: str, code: str) -> RackPose:
    spacing_m = point_spacing_m(points_m)
    coarse = too_coarse(spacing_m, rack, config)
    if coarse:
        return RackPose(RackStatus.INSUFFICIENT, coarse, spacing_m=spacing_m, code="too_coarse")
    return RackPose(
        RackStatus.NOT_FOUND,
        f"no top of {rack.name} ({outline_words(rack)} mm) among the points; closest: {closest}",
        spacing_m=spacing_m,
        code=code,
    )
