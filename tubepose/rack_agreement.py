"""How well points agree with a rack's pose, and why a pose is not believed (method `edges`).

A wrong rack, or a rack in a wrong place, has points in its openings, lines of sight through its ribs, or explains no more
than another place would. Points in openings are counted in a thin layer at the height of the top: the ribs lie in it,
while of a tube's wall that crosses it, or of light in a well, it has little.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from tubepose.config import RackConfig
from tubepose.labware import RackModel
from tubepose.rack_acceptance import refusal
from tubepose.rack_field import PICTURE_M, picture, top_field
from tubepose.rack_fit import EDGE_SHIFT_M, WRONG_SHARE, Fit, Labels, label
from tubepose.transforms import FloatArray

# Heights that are judged: three standard deviations, but at least those of a good sensor, and no more than the layer
# that a tube's wall fills with few points.
JUDGED_M = (0.3e-3, 1.0e-3)
# Blur of an edge in what counts as evidence: it must forgive a pixel.
EVIDENCE_BLUR_M = 0.4e-3
# Points that evidence is counted on where it is counted several times.
EVIDENCE_POINTS = 6000
# Points nearer than this share their label's error: they count as one.
INDEPENDENT_M = 1.5e-3
# Lines of sight this far inside a rib pass through it.
THROUGH_MARGIN_M = 0.5e-3
SPACING_SAMPLE = 300


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """How well points agree with a pose.

    Attributes:
        rmse_m: RMS distance of the points near the top to its solid part, metres.
        fitness: Share of the points at its height that are near its solid part.
        in_slot: Share of them that lie in its openings.
        through: Share of what is seen where the solid part should be that lies below it.
        coverage: Share of its solid part that has points.
        evidence: How much likelier the points are with the rack there than anywhere, nats of independent points.
        slot_margin: The same less that of the likeliest pose a slot farther along the rows, columns or diagonals.
        step_m: Where that pose's top lies, in the frame of this one's, shape (2,), metres.
        spacing_m: Median distance of neighbouring points at the top's height.
    """

    rmse_m: float = float("nan")
    fitness: float = 0.0
    in_slot: float = 1.0
    through: float = 1.0
    coverage: float = 0.0
    evidence: float = 0.0
    slot_margin: float = 0.0
    step_m: tuple[float, float] = (0.0, 0.0)
    spacing_m: float = float("nan")


def measure_agreement(points_m: FloatArray, fit: Fit, rack: RackModel, config: RackConfig) -> Agreement:
    """Compare points (N, 3), camera frame, with a fit."""
    window_m = float(np.clip(3 * fit.scatter_m, *JUDGED_M))
    seen = label(points_m, fit.T_camera_rack, rack, window_m)
    field = top_field(rack)
    distance, _, known = field.look_up(seen.solid_m[:, :2])
    solid, distance = seen.solid_m[known], distance[known]
    if len(solid) < 20:
        return Agreement()
    free_distance, _, free_known = field.look_up(seen.free_m)
    under = np.count_nonzero(free_distance[free_known] < -THROUGH_MARGIN_M)
    over = np.count_nonzero(distance < -THROUGH_MARGIN_M)
    near = distance < config.judge_distance_m
    inside = np.all(np.abs(solid[:, :2]) <= rack.outline_m / 2, axis=1)
    spacing_m = _spacing(solid)
    evidence, beside, step_m = _evidence(seen, rack)
    alike = min(1.0, (spacing_m / INDEPENDENT_M) ** 2)
    return Agreement(
        float(np.sqrt(np.mean(solid[near, 2] ** 2 + np.maximum(distance[near], 0) ** 2))),
        float(np.mean(near)),
        float(np.mean(distance[inside] > config.edge_margin_m)),
        under / max(under + over, 1),
        _coverage(solid, rack),
        evidence * alike,
        (evidence - beside) * alike,
        step_m,
        spacing_m,
    )


def _evidence(seen: Labels, rack: RackModel) -> tuple[float, float, tuple[float, float]]:
    """Evidence of the pose, and the most of any pose a slot farther with its step, in nats of all points."""
    solid, free = seen.solid_m[:, :2], seen.free_m
    steps = len(solid) // EVIDENCE_POINTS + 1, len(free) // EVIDENCE_POINTS + 1
    solid, free = solid[:: steps[0]], free[:: steps[1]]

    def at(shift_m: FloatArray) -> float:
        total = 0.0
        for places, sign, step in ((solid - shift_m, 1, steps[0]), (free - shift_m, -1, steps[1])):
            distance, _, known = top_field(rack).look_up(places)
            chance = _chance(sign * (EDGE_SHIFT_M - distance[known]))
            total += step * float(np.log(chance / _mean_chance(rack, sign)).sum())
        return total

    beside = [(at(shift), (float(shift[0]), float(shift[1]))) for shift in slot_steps_m(rack)]
    return at(np.zeros(2)), *max(beside, default=(-np.inf, (0.0, 0.0)))


def _chance(inside_m: FloatArray) -> FloatArray:
    return WRONG_SHARE + (1 - 2 * WRONG_SHARE) / (1 + np.exp(-inside_m / EVIDENCE_BLUR_M))


@lru_cache(maxsize=64)
def _mean_chance(rack: RackModel, sign: int) -> float:
    """Mean over the field: what a point has that could as well lie anywhere."""
    return float(_chance(sign * (EDGE_SHIFT_M - top_field(rack).table[::7, 0].astype(float))).mean())


@lru_cache(maxsize=32)
def slot_steps_m(rack: RackModel) -> tuple[FloatArray, ...]:
    """Shifts that lay many slots onto others: one slot along rows, columns and diagonals; shape (2,) each, metres."""
    centers = rack.slot_centers_m
    apart = np.rint((centers[:, None] - centers[None]).reshape(-1, 2) * 1e4).astype(int)
    steps, counts = np.unique(apart, axis=0, return_counts=True)
    kept = (counts >= 0.4 * len(centers)) & (np.abs(steps).max(axis=1) > 0)
    steps = steps[kept]
    return tuple(steps[np.argsort(np.hypot(*steps.T), kind="stable")][:8] * 1e-4)


def _coverage(solid_m: FloatArray, rack: RackModel) -> float:
    top = picture(rack)
    half = np.array(top.shape) // 2
    cells = np.rint(solid_m[:, :2] / PICTURE_M).astype(np.intp) + half
    cells = cells[np.all((cells >= 0) & (cells < top.shape), axis=1)]
    hit = np.zeros(top.shape, bool)
    hit[cells[:, 0], cells[:, 1]] = True
    return float(hit[top > 0].mean())


def _spacing(points_m: FloatArray) -> float:
    tree = cKDTree(points_m, balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(points_m[:: len(points_m) // SPACING_SAMPLE + 1], k=2)
    return float(np.median(np.asarray(distance)[:, 1]))


def contradiction(seen: Agreement, rack: RackModel, config: RackConfig) -> str:
    """Why a fit is not the rack, in words; empty if it is."""
    reasons = [refusal(seen.fitness, seen.rmse_m, seen.in_slot, seen.coverage, rack, config, config.min_seen)]
    if seen.through > config.max_through_share:
        reasons.append(
            f"{seen.through:.1%} of what is seen in place of the top's solid part lies below it, "
            f"at most {config.max_through_share:.0%} expected"
        )
    if seen.slot_margin < config.min_slot_margin:
        reasons.append(
            "the rack could as well stand a slot farther: too little of its outline and edge is seen "
            f"(margin {seen.slot_margin:.0f} nats, at least {config.min_slot_margin:.0f} expected)"
        )
    return "; ".join(reason for reason in reasons if reason)
