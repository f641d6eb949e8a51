"""How much likelier points are with a rack's top where a pose has it than anywhere, and than a slot farther."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from tubepose.labware import RackModel
from tubepose.rack import view_kernels as view_kernels
from tubepose.rack.field import top_field
from tubepose.rack.fit import Labels, RoughFit, at_the_top
from tubepose.rack.fit_kernels import EDGE_SHIFT_M, WRONG_SHARE
from tubepose.transforms import FloatArray

# Blur of an edge in what counts as evidence: it must forgive a pixel.
EVIDENCE_BLUR_M = 0.4e-3
# Distances that its likelihood is tabled over: beyond them it is what wrong pixels leave.
CHANCE_STEP_M = 5e-6
CHANCE_STEPS = 1600
# Points that evidence is counted on where it is counted several times, and at a first look.
EVIDENCE_POINTS = 3000
LOOK_POINTS = 1500


def evidence_of(seen: Labels, rack: RackModel) -> tuple[float, float, tuple[float, float]]:
    """Evidence of the pose, and the most of any pose a slot farther with its step, in nats of all points."""
    here, steps = _evidence_at(seen.solid_m[:, :2], rack, 1, EVIDENCE_POINTS)
    free_here, free_steps = _evidence_at(seen.free_m, rack, -1, EVIDENCE_POINTS)
    beside = [
        (float(value), (float(x), float(y)))
        for value, (x, y) in zip(steps + free_steps, slot_steps_m(rack), strict=True)
    ]
    return here + free_here, *max(beside, default=(-np.inf, (0.0, 0.0)))


def _evidence_at(places_m: FloatArray, rack: RackModel, sign: int, count: int) -> tuple[float, FloatArray]:
    """Evidence of places (N, 2), frame of the top, that are solid (sign 1) or free (-1), here and a slot farther, (K,).

    In nats of all points, from `count` of them at most.
    """
    every = len(places_m) // count + 1
    shifts = np.array([(0.0, 0.0), *slot_steps_m(rack)])
    chances = _log_chances(rack, sign)
    found = view_kernels.table_sums(places_m[::every].copy(), shifts, *top_field(rack).grid, chances, CHANCE_STEP_M)
    return every * float(found[0]), every * found[1:]


def likelier_step_m(rough: RoughFit, rack: RackModel) -> FloatArray | None:
    """Where the top more likely is, a slot farther along rows, columns or diagonals, shape (2,); None where it is not.

    Told by the points at the top's height alone: a first look, before much work is put into a pose.
    """
    here, beside = _evidence_at(at_the_top(rough, rough.rough_m), rack, 1, LOOK_POINTS)
    return slot_steps_m(rack)[int(beside.argmax())] if len(beside) and beside.max() > here else None


def _chance(inside_m: FloatArray) -> FloatArray:
    return WRONG_SHARE + (1 - 2 * WRONG_SHARE) / (1 + np.exp(-inside_m / EVIDENCE_BLUR_M))


@lru_cache(maxsize=64)
def _mean_chance(rack: RackModel, sign: int) -> float:
    """Mean over the field: what a point has that could as well lie anywhere."""
    return float(_chance(sign * (EDGE_SHIFT_M - top_field(rack).table[::7, 0].astype(float))).mean())


@lru_cache(maxsize=64)
def _log_chances(rack: RackModel, sign: int) -> FloatArray:
    """How much likelier a point is here than anywhere, nats, over its distance from the solid part."""
    distance = CHANCE_STEP_M * np.arange(-CHANCE_STEPS, CHANCE_STEPS + 1, dtype=float)
    return np.log(_chance(sign * (EDGE_SHIFT_M - distance)) / _mean_chance(rack, sign))


@lru_cache(maxsize=32)
def slot_steps_m(rack: RackModel) -> tuple[FloatArray, ...]:
    """Shifts that lay many slots onto others: one slot along rows, columns and diagonals; shape (2,) each, metres."""
    centers = rack.slot_centers_m
    apart = np.rint((centers[:, None] - centers[None]).reshape(-1, 2) * 1e4).astype(int)
    steps, counts = np.unique(apart, axis=0, return_counts=True)
    kept = (counts >= 0.4 * len(centers)) & (np.abs(steps).max(axis=1) > 0)
    steps = steps[kept]
    return tuple(steps[np.argsort(np.hypot(*steps.T), kind="stable")][:8] * 1e-4)
