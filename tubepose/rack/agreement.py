"""How well points agree with a rack's pose, and why a pose is not believed (method `edges`).

A wrong rack, or one in a wrong place, has points in its openings, lines of sight through its ribs, or explains no
more than another place would. Points in openings are counted in a thin layer at the height of the top: it
has all of the ribs, and little of a tube's wall that crosses it or of light in a well.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tubepose.config import RackConfig
from tubepose.labware import RackModel
from tubepose.rack import view_kernels as view_kernels
from tubepose.rack.evidence import evidence_of
from tubepose.rack.field import GRID_M, PICTURE_M, picture, top_field
from tubepose.rack.fit import LEAST_POINTS, Fit, RoughFit, camera_place, label, rack_frame, top_frame
from tubepose.transforms import FloatArray, parts

# Half thickness of the layer that is judged: the standard deviation of heights, but at least that of a good sensor, and
# no more than the layer that a tube's wall fills with few points.
JUDGED_M = (0.3e-3, 0.6e-3)
# Points this near an edge are at the rim of an opening.
RIM_M = 0.7e-3
# Heights that tell how rough a scan is.
SCATTER_M = 2.5e-3
# The same where tops of tubes hold the rack: most of what shows between them is what stray light has lifted or sunk.
HELD_SCATTER_M = 1.0e-3
# A top that goes on across its outline is another; a rack that stands beside it may be this near.
BORDER_M = 3.5e-3
# Points nearer than this share their label's error: they count as one.
INDEPENDENT_M = 1.5e-3
# Lines of sight this far inside a rib pass through it.
THROUGH_MARGIN_M = 0.5e-3
STRIP_POINTS = 3000
SPACING_SAMPLE = 300
# So many reasons are told of: the others follow from them as a rule.
MOST_TOLD = 2
# A pose that is known no better than this is not known at all.
LOST_DEG = 45.0
# Degrees and millimetres, with their part of a covariance.
_UNITS = ((np.rad2deg(1.0), slice(0, 3)), (1e3, slice(3, 6)))


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """How well points agree with a pose.

    Attributes:
        rmse_m: RMS distance of the points near the top to its solid part, metres; the part along the normal from the
            median of all heights within `SCATTER_M`, so that it tells a rough scan from a good one with stray light;
            within `HELD_SCATTER_M` where tubes hold the rack: a rough scan has no tops that hold one.
        fitness: Share of the points at its height that are near its solid part.
        in_slot: Share of them that lie in its openings.
        through: Share of what is seen where the solid part should be that lies below it.
        rims: How many of the points on the solid part lie near its edges, over the share of its area that does: near 1
            where the openings are as wide as the template's, little where they are wider.
        coverage: Share of its solid part that has points.
        evidence: How much likelier the points are with the rack there than anywhere, nats of independent points.
        slot_margin: The same less that of the likeliest pose a slot farther along the rows, columns or diagonals.
        step_m: Where that pose's top lies, in the frame of this one's, shape (2,), metres.
        spacing_m: Median distance of neighbouring points at the top's height.
        outside: Share of the points at its height that lie just outside the outline.
        unseen: Share of the solid part near which there are no points at all, neither on, nor above, nor below it.
    """

    rmse_m: float = float("nan")
    fitness: float = 0.0
    in_slot: float = 1.0
    through: float = 1.0
    rims: float = 0.0
    coverage: float = 0.0
    evidence: float = 0.0
    slot_margin: float = 0.0
    step_m: tuple[float, float] = (0.0, 0.0)
    spacing_m: float = float("nan")
    outside: float = 0.0
    unseen: float = 0.0

    def evidence_at(self, spacing_m: float) -> float:
        """The evidence, had the points been measured to lie this far apart: to be compared with a fit that found so."""
        return self.evidence * _alike(spacing_m) / _alike(self.spacing_m) if self.evidence else 0.0


def measure_agreement(points_m: FloatArray, fit: Fit, rack: RackModel, config: RackConfig) -> Agreement:
    """Compare points (N, 3), camera frame, with a fit."""
    points_m = np.ascontiguousarray(points_m, float)
    window_m = float(np.clip(fit.scatter_m, *JUDGED_M))
    seen = label(points_m, fit.T_camera_rack, rack, window_m)
    top = top_field(rack)
    distance, _, known = top.look_up(seen.solid_m)
    solid, distance = seen.solid_m[known], distance[known]
    if len(solid) < LEAST_POINTS or not np.any(distance < 0):
        return Agreement()
    free_distance, _, free_known = top.look_up(seen.free_m)
    under = int(np.count_nonzero(free_distance[free_known] < -THROUGH_MARGIN_M))
    over = int(np.count_nonzero(distance < -THROUGH_MARGIN_M))
    near = distance < config.judge_distance_m
    beyond = np.max(np.abs(solid[:, :2]) - rack.outline_m / 2, axis=1)
    stray = distance > config.edge_margin_m
    height_m = SCATTER_M if fit.level is None else HELD_SCATTER_M
    ribs = top.on_solid(points_m, top_frame(fit.T_camera_rack, rack), height_m)
    spacing_m = _spacing(ribs[:, :2])
    scatter_m = float(1.4826 * np.median(np.abs(ribs[:, 2])))
    evidence, beside, step_m = evidence_of(seen, rack)
    alike = _alike(spacing_m)
    return Agreement(
        rmse_m=float(np.hypot(scatter_m, np.sqrt(np.mean(np.maximum(distance[near], 0) ** 2)))),
        fitness=float(np.mean(near)),
        in_slot=float(np.mean(stray[beyond <= 0])) if np.any(beyond <= 0) else 1.0,
        outside=float(np.mean(stray & (beyond > 0) & (beyond < BORDER_M))),
        through=under / max(under + over, 1),
        rims=_near_rims(solid[:, :2], distance, rack) / _rim_share(rack),
        coverage=coverage(solid, rack),
        unseen=_unseen(points_m, fit, rack),
        evidence=evidence * alike,
        slot_margin=(evidence - beside) * alike,
        step_m=step_m,
        spacing_m=spacing_m,
    )


def rough_evidence(points_m: FloatArray, rough: RoughFit, spacing_m: float, rack: RackModel) -> float:
    """The evidence of a rough fit among points (N, 3), camera frame, that lie `spacing_m` apart."""
    window_m = float(np.clip(rough.scatter_m, *JUDGED_M))
    evidence, _, _ = evidence_of(label(points_m, rack_frame(rough, rack), rack, window_m), rack)
    return evidence * _alike(spacing_m)


def _alike(spacing_m: float) -> float:
    """For how many independent points one stands, at most 1."""
    return min(1.0, (spacing_m / INDEPENDENT_M) ** 2)


def _unseen(points_m: FloatArray, fit: Fit, rack: RackModel) -> float:
    shape = np.ceil(rack.outline_m / (4 * PICTURE_M)).astype(int)
    T = top_frame(fit.T_camera_rack, rack)
    step = len(points_m) // 10_000 + 1
    hit = view_kernels.cells_crossed(points_m, step, *parts(T), camera_place(T), rack.outline_m, shape)
    return float(1 - hit.mean())


@lru_cache(maxsize=32)
def _rim_share(rack: RackModel) -> float:
    """Share of the solid part's area that is near an edge."""
    field = top_field(rack)
    cells = np.stack(np.unravel_index(np.arange(len(field.table)), field.shape), axis=1)
    return _near_rims(field.low_m + cells * GRID_M, field.table[:, 0], rack)


def _near_rims(xy_m: FloatArray, distance_m: NDArray[np.floating], rack: RackModel) -> float:
    """Share of the places (N, 2) on the solid part, away from the outline, that are near the edge of an opening."""
    inner = np.all(np.abs(xy_m) < rack.outline_m / 2 - 2 * RIM_M, axis=1) & (distance_m < 0)
    return float(np.mean(distance_m[inner] > -RIM_M)) if inner.any() else 0.0


def coverage(solid_m: FloatArray, rack: RackModel) -> float:
    """Share of the cells of a rack's solid part that have one of the points (N, 2 or more), frame of its top."""
    top = picture(rack)
    half = np.array(top.shape) // 2
    i, j = np.rint(solid_m[:, 0] / PICTURE_M) + half[0], np.rint(solid_m[:, 1] / PICTURE_M) + half[1]
    inside = (i >= 0) & (i < top.shape[0]) & (j >= 0) & (j < top.shape[1])
    cells = (i * top.shape[1] + j)[inside].astype(np.intp)
    return float(np.mean(np.bincount(cells, minlength=top.size)[top.ravel() > 0] > 0))


def _spacing(points_m: FloatArray) -> float:
    """Median distance to the nearest neighbour, in a strip of points (N, 2) through their middle."""
    if len(points_m) > STRIP_POINTS:
        first = (len(points_m) - STRIP_POINTS) // 2
        order = np.argpartition(points_m[:, 0], [first, first + STRIP_POINTS - 1])
        points_m = points_m[order[first : first + STRIP_POINTS]]
    tree = cKDTree(points_m, balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(points_m[:: len(points_m) // SPACING_SAMPLE + 1], k=2)
    return float(np.median(np.asarray(distance)[:, 1]))


def outline_fits(seen: Agreement, config: RackConfig) -> bool:
    """Whether the top ends where the rack's does, and is there as a whole; if not, the rack is not found."""
    return seen.outside <= config.max_outside_share and seen.unseen <= config.max_unseen_share


def contradiction(seen: Agreement, fit: Fit, rack: RackModel, config: RackConfig) -> str:
    """Why a fit is not the rack, in words; empty if it is."""
    checks = (*_misfits(seen, fit, rack, config), *_too_little(seen, fit, config))
    found = [text for failed, text in checks if failed]
    more = len(found) - MOST_TOLD
    return "; ".join(found[:MOST_TOLD]) + (f"; and {more} more like it" if more > 0 else "")


def _misfits(seen: Agreement, fit: Fit, rack: RackModel, config: RackConfig) -> tuple[tuple[bool, str], ...]:
    """What speaks for another rack, and whether it is so."""
    stretch = np.abs(fit.stretch) - 3 * fit.stretch_std
    rims = config.min_rims if fit.level is None else config.min_rims_held
    most = config.max_stretch if seen.coverage >= config.clear_seen else 2 * config.max_stretch
    return (
        (
            seen.rmse_m > config.max_inlier_rmse_m,
            f"inlier rmse {seen.rmse_m * 1e3:.2f} mm, at most {config.max_inlier_rmse_m * 1e3:.2f} mm expected",
        ),
        (
            seen.in_slot > config.max_stray_share,
            f"{seen.in_slot:.1%} of the top's points lie inside the openings of {rack.name}, "
            f"at most {config.max_stray_share:.1%} expected: another rack?",
        ),
        (
            seen.outside > config.max_outside_share,
            f"{seen.outside:.1%} of the top's points lie just outside the outline of {rack.name}, "
            f"at most {config.max_outside_share:.1%} expected: another rack?",
        ),
        (
            bool(np.any(stretch > most)),
            f"the slots lie {fit.stretch[0]:+.1%} and {fit.stretch[1]:+.1%} farther apart than those of {rack.name}, "
            f"at most {most:.1%} expected: another rack?",
        ),
        (
            seen.rims < rims,
            f"{seen.rims:.0%} of the points expected near the edges of the openings of {rack.name} are there, at least "
            f"{rims:.0%} expected: another rack, with wider openings?",
        ),
        (
            seen.through > config.max_through_share,
            f"{seen.through:.1%} of what is seen in place of the top's solid part lies below it, "
            f"at most {config.max_through_share:.0%} expected",
        ),
    )


def _too_little(seen: Agreement, fit: Fit, config: RackConfig) -> tuple[tuple[bool, str], ...]:
    """What is missing to say that it is the rack, and whether it is so."""
    most_mm = config.max_shift_std_mm if fit.level is None else config.max_shift_std_held_mm
    turn_deg, shift_mm = (float(scale * np.sqrt(np.diag(fit.covariance)[k].max())) for scale, k in _UNITS)
    least = config.min_seen if fit.level is None else config.min_seen_held
    return (
        (
            seen.coverage < least,
            f"{seen.coverage:.1%} of the top seen, at least {least:.0%} expected",
        ),
        (
            seen.unseen > config.max_unseen_share,
            f"no points at all on {seen.unseen:.0%} of the top, at most {config.max_unseen_share:.0%} expected: "
            "is the rack in the image as a whole?",
        ),
        (
            seen.slot_margin < config.min_slot_margin,
            "the rack could as well stand a slot farther: too little of its edge is seen "
            f"(margin {seen.slot_margin:.0f} nats, at least {config.min_slot_margin:.0f} expected)",
        ),
        (
            turn_deg > config.max_turn_std_deg or shift_mm > most_mm,
            "its pose cannot be told at all: too little is seen"
            if turn_deg > LOST_DEG
            else f"its pose is uncertain by {turn_deg:.2f} deg and {shift_mm:.2f} mm (standard deviations), "
            f"at most {config.max_turn_std_deg:g} deg, {most_mm:g} mm expected: too little is seen",
        ),
    )
