"""Rims that the image shows and the cloud does not: those of clear plastic, which hardly returns a point.

Such a rim is a bright ring where it scatters some light back, and a dark one where it leads all of it away. The image
is laid onto the level of the rims, where all of them are circles of one size. About every slot each place that a rim
can have is judged by votes of directions: for a ring that is brighter than both of its sides, against one that is
darker, nothing for an edge; and the same in the negative. The best place of a slot that wins enough of them is then
measured as any rim is, and believed if nearly all of its circle is free to be seen and looks like a ring. Neither test
knows of the other: the votes see whether a side is brighter and not by how much, the correlation how a ring looks.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.config import ProfileConfig
from tubepose.profile.fit_kernels import ring_heights, ring_votes
from tubepose.profile.outline import SECTORS, Circles, unknown_circles
from tubepose.profile.rims import RimView, fit_rims, ring_contrast
from tubepose.profile.standing import Standing
from tubepose.transforms import FloatArray

CELL_M = 0.4e-3
COARSE = 2
"""Every so many cells a place is judged first; then those around the best of them."""
DIRECTIONS = 48
LEAST_FREE = 0.75
"""Least share of a circle that no other top is near to."""
EDGE_M = 20e-3
"""How far beyond the middles of slots the image is laid out."""
BIN_M = 1e-3
ONE_HEIGHT_SHARE, ALL_AROUND = 0.6, 0.6
"""Points on a ring are at one height where three bins hold this share of them, in this share of its sectors."""
LEAST_GRAY = 0.02
"""Differences under this share of the picture's range are noise."""


@dataclass(frozen=True, slots=True, eq=False)
class FaintRims:
    """What the image shows in slots, S of them.

    Attributes:
        center_m: Middle of each rim before it was measured, rack frame, shape (S, 2), metres.
        circles: The measured circles, about those middles.
        contrast: Mean correlation of the circle's sectors with a ring's, shape (S,); -inf where no ring was found.
    """

    center_m: FloatArray
    circles: Circles
    contrast: FloatArray

    def where(self, mine: NDArray[np.bool_], other: FaintRims) -> FaintRims:
        """These rims where `mine`, shape (S,), is True, the other's elsewhere."""
        return FaintRims(
            np.where(mine[:, None], self.center_m, other.center_m),
            self.circles.where(mine, other.circles),
            np.where(mine, self.contrast, other.contrast),
        )


@dataclass(frozen=True, slots=True, eq=False)
class RimSearch:
    """Where rims are looked for, and what they have to be.

    Attributes:
        view: The image, and where the rack is in it.
        center_m: Middles of the slots, rack frame, shape (S, 2), metres.
        reach_m: How far from there a rim's middle can be, metres.
        level_m: Height of the rims above the rack's base.
        radii_m: Inner and outer radius of the rims, shape (2,).
        blocked_at: From middles of rims, shape (N, 2), to the sectors that other tops are too near to, (N, SECTORS).
        standing: Points above the rack's top: a ring of them at another height is a rim of something else.
        config: Limits, and noise of outlines.
    """

    view: RimView
    center_m: FloatArray
    reach_m: float
    level_m: float
    radii_m: FloatArray
    blocked_at: Callable[[FloatArray], NDArray[np.bool_]]
    standing: Standing
    config: ProfileConfig


def find_faint_rims(search: RimSearch) -> FaintRims:
    """Look for a rim, bright or dark, in each of some slots."""
    bright, dark = (
        _measured(*likeliest, search, is_dark=is_dark)
        for likeliest, is_dark in zip(_likeliest(search), (False, True), strict=True)
    )
    return bright.where(bright.contrast >= dark.contrast, dark)


def _measured(middle: FloatArray, votes: FloatArray, search: RimSearch, *, is_dark: bool) -> FaintRims:
    """Rings of one kind about middles (S, 2) that won enough votes (S,), measured and judged."""
    circles, contrast = unknown_circles(len(middle)), np.full(len(middle), -np.inf)
    at = np.flatnonzero(votes >= search.config.min_ring_votes)
    if len(at) == 0:
        return FaintRims(middle, circles, contrast)
    view = search.view.negative() if is_dark else search.view
    size = (np.full(len(at), search.level_m), np.tile(search.radii_m, (len(at), 1)))
    found = fit_rims(
        view, middle[at], *size, search.blocked_at(middle[at]), search.config, search.config.faint_rim_bias_m
    )
    place = middle[at] + np.nan_to_num(found.offset_m)
    blocked = search.blocked_at(place)
    seen = np.isfinite(found.offset_m[:, 0]) & ((~blocked).mean(axis=1) >= LEAST_FREE)
    seen &= ~_at_another_height(place, search)
    contrast[at] = np.where(seen, ring_contrast(view, place, *size, blocked), -np.inf)
    return FaintRims(middle, circles.put(at, found), contrast)


def _at_another_height(center_m: FloatArray, search: RimSearch) -> NDArray[np.bool_]:
    """Where most points that are seen on a ring, all around it, lie at one height that is not a rim's: shape (N,).

    Clear plastic leaves hardly a point there, or some at all heights.
    """
    standing, (inner, outer) = search.standing, search.radii_m
    z = standing.points_m[:, 2]
    if len(z) == 0:
        return np.zeros(len(center_m), bool)
    low = float(z.min())
    bins = int((float(z.max()) - low) / BIN_M) + 1
    counts = ring_heights(
        standing.points_m, standing.camera_m, search.level_m, center_m, inner, outer, low, BIN_M, bins, SECTORS
    )
    window = sum(np.roll(counts, shift, axis=1) for shift in (-1, 0, 1))  # three bins; low and high ends are far apart
    total, best = counts.sum(axis=(1, 2)), window.sum(axis=2).argmax(axis=1)
    most = window[np.arange(len(center_m)), best]
    above = low + (best + 0.5) * BIN_M - search.level_m
    expected = (above > -search.config.rim_depth_m) & (above < search.config.top_band_m)
    one_height = (most.sum(axis=1) >= ONE_HEIGHT_SHARE * np.maximum(total, 1)) & (total > 0)
    return np.asarray(one_height & ((most > 0).mean(axis=1) >= ALL_AROUND) & ~expected)


def _likeliest(search: RimSearch) -> list[tuple[FloatArray, FloatArray]]:
    """Place of each slot with most votes, (S, 2), metres, and the votes, (S,), -1 to 1: for bright, then dark rings."""
    low, high = search.center_m.min(axis=0) - EDGE_M, search.center_m.max(axis=0) + EDGE_M
    picture = _laid_out(search.view, low, high, search.level_m)
    angles = (np.arange(DIRECTIONS) + 0.5) * (2 * np.pi / DIRECTIONS)
    around = np.column_stack([np.cos(angles), np.sin(angles)])
    middle_m, width_m = float(np.mean(search.radii_m)), float(np.ptp(search.radii_m))
    ring, inside, outside = (
        np.rint((middle_m + step) / CELL_M * around).astype(np.intp) for step in (0.0, -width_m, width_m)
    )
    seen = picture[np.isfinite(picture)]
    circles = (ring, inside, outside, LEAST_GRAY * float(np.ptp(seen) if len(seen) else 0.0) + 1e-6)
    middle, near = _disc(search.reach_m, COARSE), _disc(COARSE * CELL_M, 1)
    start = np.rint((search.center_m - low) / CELL_M).astype(np.intp)
    _, best = ring_votes(picture, start, middle, *circles)
    found = []
    for kind in range(2):
        cells = start + middle[best[:, kind]]
        votes, better = ring_votes(picture, cells, near, *circles)
        found.append((low + (cells + near[better[:, kind]]) * CELL_M, votes[:, kind]))
    return found


def _disc(reach_m: float, step: int) -> NDArray[np.intp]:
    """Every `step`-th cell of a disc, (M, 2), the middle among them."""
    axis = step * np.arange(-int(reach_m / CELL_M / step), int(reach_m / CELL_M / step) + 1)
    cells = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return np.asarray(cells[np.hypot(*cells.T) * CELL_M <= reach_m + 1e-9], np.intp)


def _laid_out(view: RimView, low_m: FloatArray, high_m: FloatArray, level_m: float) -> NDArray[np.float32]:
    """The image on a level of the rack, cells (X, Y) of `CELL_M`, the first at `low_m`; NaN where it ends."""
    rows, columns = (int(cells) for cells in np.ceil((high_m - low_m) / CELL_M) + 1)
    lens, R, t = view.intrinsics, view.T_camera_rack[:3, :3], view.T_camera_rack[:3, 3]
    K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
    # A column of the picture goes along the rack's y, a row along its x.
    to_camera = np.column_stack([R[:, 1] * CELL_M, R[:, 0] * CELL_M, R @ [*low_m, level_m] + t])
    return np.asarray(
        cv2.warpPerspective(
            np.asarray(view.picture, np.float32),
            K @ to_camera,
            (columns, rows),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderValue=float("nan"),
        ),
        np.float32,
    )
