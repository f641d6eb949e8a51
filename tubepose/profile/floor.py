"""How high the slots' floor is, from the tops of the tubes that stand on it, where a rack does not say."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tubepose.config import ProfileConfig
from tubepose.labware import RackModel, TubeModel
from tubepose.profile.standing import Standing
from tubepose.profile.tops import find_tops
from tubepose.transforms import FloatArray

BIN_M = 0.5e-3
MAX_LEVELS = 4
APART_M = 2.0e-3
SETTLED_MM = 1.5
"""How well the floor is known afterwards, standard deviation: light comes out of rims from as far below them."""


def settle_floor(standing: Standing, rack: RackModel, tubes: Sequence[TubeModel], config: ProfileConfig) -> RackModel:
    """A rack with its floor where most tops of the given types are explained.

    Tops are level: the heights that most points have are tried as the top of every type. The floor that gives the most
    support over all slots is taken; of equals, the one nearest to what the rack says.

    Args:
        standing: Points above the rack's top.
        rack: The rack; its `floor_tolerance_mm` says how far off its floor may be.
        tubes: Candidate types.
        config: Limits.
    """
    levels = _levels(standing.points_m[:, 2])
    shifts = np.unique(np.round([level - rack.floor_m - tube.height_m for level in levels for tube in tubes], 4))
    shifts = shifts[np.abs(shifts) <= 3e-3 * rack.floor_tolerance_mm]
    best, most = rack, 0.0
    for shift_m in shifts[np.argsort(np.abs(shifts), kind="stable")]:
        moved = rack.model_copy(update={"floor_mm": rack.floor_mm + float(shift_m) * 1e3})
        support = float(find_tops(standing, moved, tubes, config).support.sum())
        if support > 1.02 * most:
            best, most = moved, support
    return best.model_copy(update={"floor_tolerance_mm": min(rack.floor_tolerance_mm, SETTLED_MM)})


def _levels(heights_m: FloatArray) -> list[float]:
    """The heights of most points, best first, some millimetres apart, metres."""
    if len(heights_m) == 0:
        return []
    counts, edges = np.histogram(heights_m, np.arange(heights_m.min(), heights_m.max() + 2 * BIN_M, BIN_M))
    found: list[float] = []
    for k in np.argsort(-counts, kind="stable"):
        near = np.abs(heights_m - (edges[k] + BIN_M / 2)) < BIN_M
        level = float(np.median(heights_m[near])) if near.any() else 0.0
        if counts[k] and all(abs(level - other) > APART_M for other in found):
            found.append(level)
        if len(found) == MAX_LEVELS:
            break
    return found
