"""Rims that the image shows and the cloud does not: those of clear plastic, which hardly returns a point.

Such a rim has one gray all around, of the light that it scatters or leads away, while what lies behind the tube shows
beside it: so it is brighter than that here, darker there, and has no edge where both are alike. The image is laid onto
the level of the rims, where all of them are circles of one size. About every slot each place that a rim can have is
judged by how even the ring is there, against its sides. The best place of a slot is believed if the ring is even
enough, differs from both sides nearly everywhere, nearly all of its circle is free to be seen, and it is not the edge
of a round opening; or if it looks like a bright or a dark ring, as one of which it is then measured. Elsewhere its
middle is where it is most even.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.config import ProfileConfig
from tubepose.profile.fit_kernels import edge_shares, even_rings, ring_heights, ring_sides
from tubepose.profile.outline import SECTORS, Circles, unknown_circles
from tubepose.profile.rims import RimView, fit_rims, ring_contrast
from tubepose.profile.standing import Standing
from tubepose.transforms import FloatArray

CELL_M = 0.3e-3
BLUR_CELLS = 0.7
COARSE_M, FINE_M = 0.6e-3, 0.15e-3
"""How far apart places are judged first, and then about the best of them."""
DIRECTIONS = 48
LEAST_SEEN = 0.75
"""Least share of the directions that are in the image."""
LEAST_FREE = 0.75
"""Least share of a circle that no other top is near to."""
ALONG_M, BESIDE_M, DEEPER_M = 0.25e-3, 0.5e-3, 1.2e-3
"""How far from the middle of its wall a ring is looked at, how far beside its two edges, and how far further inside."""
NOISE, DIFFERS, LEAST_SLOPE = 0.04, 0.02, 0.004
"""What grays differ by where they are alike, and where they are not, as shares of the picture's range; a slope that is
none, per cell."""
LEAST_EVENNESS = 0.5
LEAST_SIDES = 0.6
"""Least shares of directions in which the outside and the inside differ from the ring, and one of them by more than
the ring does from itself."""
MOST_EDGE = 0.6
"""A ring between both sides that varies by this much of what the outside does may be the edge of a disc or a hole."""
LIKELY = np.array([22.2, 44.4, 6.9])
UNLIKELY = 54.8
"""Log odds of a rim: per evenness, share of slopes along the radii, and unevenness further inside; less this."""
HOPELESS_ODDS = -3.0
"""Rings with smaller log odds are not measured."""
LEAST_CONTRAST = 0.65
"""Mean correlation of its sectors with a ring's from which a rim is a bright or a dark ring, and is measured as one."""
HOLE_M = 1.5e-3
"""A ring whose middle and radius are this near those of a round opening may be that opening."""
BIN_M = 1e-3
ONE_HEIGHT_SHARE, ALL_AROUND = 0.6, 0.6
"""Points on a ring are at one height where three bins hold this share of them, in this share of its sectors."""

LEAST_MATES, MATES_POINTS, BARE_SHARE = 2, 30.0, 0.1
"""So many rims of a type tell how many points one returns, if that is enough to be sure; with less than this share of
it a ring is none: a Poisson law of 30 points gives 3 or fewer once in 10^9."""


@dataclass(frozen=True, slots=True, eq=False)
class FaintRims:
    """What the image shows in slots, S of them.

    Attributes:
        center_m: Middle of each rim before it was measured, rack frame, shape (S, 2), metres.
        circles: The measured circles, about those middles.
        evenness: 1 less the variance of gray along the ring over that beside it, shape (S,); -inf without a rim.
    """

    center_m: FloatArray
    circles: Circles
    evenness: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class EvenRings:
    """The most even ring of each of some slots, S of them.

    Attributes:
        center_m: Its middle, rack frame, shape (S, 2), metres.
        evenness: 1 less the variance of gray along it over that beside it, shape (S,); -inf where none is in the image.
        facts: Evenness, share of the slopes at its edges that are along its radii, and how much less even it is further
            inside, shape (S, 3); NaN where its sides say that it is no rim.
    """

    center_m: FloatArray
    evenness: FloatArray
    facts: FloatArray

    @property
    def odds(self) -> FloatArray:
        """Log odds of being rims, shape (S,), -inf for none; by `python -m benchmarks.rims`."""
        return np.asarray(np.nan_to_num(self.facts @ LIKELY - UNLIKELY, nan=-np.inf))


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
        holes_m: Round openings as seen on the level of the rims: middle and radius, (H, 3), rack frame, metres.
        config: Limits, and noise of outlines.
    """

    view: RimView
    center_m: FloatArray
    reach_m: float
    level_m: float
    radii_m: FloatArray
    blocked_at: Callable[[FloatArray], NDArray[np.bool_]]
    standing: Standing
    holes_m: FloatArray
    config: ProfileConfig


def find_faint_rims(search: RimSearch) -> FaintRims:
    """Look for a rim in each of some slots."""
    rings = most_even(search)
    odds = rings.odds
    at = np.flatnonzero(odds >= HOPELESS_ODDS)
    circles, told = unknown_circles(len(rings.center_m)), np.full(len(rings.center_m), -np.inf)
    if len(at) == 0:
        return FaintRims(rings.center_m, circles, told)
    blocked = search.blocked_at(rings.center_m[at])
    measured, is_ring = _measured(rings.center_m[at], blocked, search)
    place = rings.center_m[at] + measured.offset_m
    seen = (odds[at] >= search.config.min_ring_odds) | is_ring
    seen &= ((~blocked).mean(axis=1) >= LEAST_FREE) & ~_at_another_height(place, search) & ~is_a_hole(place, search)
    told[at] = np.where(seen, rings.evenness[at], -np.inf)
    return FaintRims(rings.center_m, circles.put(at, measured), told)


def without_bare(found: FaintRims, known_m: FloatArray, search: RimSearch) -> FaintRims:
    """The same without rims that hardly return a point where others of their type return many: all are of one plastic.

    Args:
        found: Rims that the image shows.
        known_m: Middles of rims of that type that the cloud shows, rack frame, shape (N, 2), metres.
        search: Where they were looked for.
    """
    if len(known_m) < LEAST_MATES or not np.isfinite(found.evenness).any():
        return found
    usual = float(np.median(_returned(known_m, search)))
    if usual < MATES_POINTS:
        return found
    place_m = found.center_m + np.nan_to_num(found.circles.offset_m)
    bare = _returned(place_m, search) < BARE_SHARE * usual
    return replace(found, evenness=np.where(bare, -np.inf, found.evenness))


def _returned(center_m: FloatArray, search: RimSearch) -> FloatArray:
    """How many points lie on rims about some middles (N, 2), as a type's rims return them, shape (N,)."""
    inner, outer = search.radii_m
    z = search.standing.points_m[:, 2] - search.level_m
    near = (z > -search.config.rim_depth_m) & (z < search.config.top_band_m)
    flat_m = search.standing.take(near).on_level(search.level_m)
    apart = [np.hypot(*(flat_m - middle).T) for middle in center_m]
    return np.array([np.count_nonzero((r > inner - BESIDE_M) & (r < outer + BESIDE_M)) for r in apart], float)


def _measured(center_m: FloatArray, blocked: NDArray[np.bool_], search: RimSearch) -> tuple[Circles, NDArray[np.bool_]]:
    """Circles about even rings (N, 2) with blocked sectors (N, SECTORS); which look like bright or dark rings, (N,).

    Those are measured as any rim is, the others are where they are most even.
    """
    count, config = len(center_m), search.config
    even = np.tile(np.eye(2) * config.even_rim_m**2, (count, 1, 1))
    free, best = (~blocked).mean(axis=1), np.full(count, -np.inf)
    circles = Circles(np.zeros((count, 2)), even, np.zeros(count), free)
    size = (np.full(count, search.level_m), np.tile(search.radii_m, (count, 1)))
    for view in (search.view, search.view.negative()):
        found = fit_rims(view, center_m, *size, blocked, config, config.faint_rim_bias_m)
        place = center_m + np.nan_to_num(found.offset_m)
        contrast = ring_contrast(view, place, *size, search.blocked_at(place))
        better = np.isfinite(found.offset_m[:, 0]) & (contrast >= np.maximum(best, LEAST_CONTRAST))
        circles, best = found.where(better, circles), np.where(better, contrast, best)
    return circles, np.isfinite(best)


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


def is_a_hole(center_m: FloatArray, search: RimSearch) -> NDArray[np.bool_]:
    """Which rings may be the edge of a round opening of the rack, shape (N,)."""
    as_large = np.abs(search.holes_m[:, 2] - search.radii_m.mean()) < HOLE_M
    apart = np.linalg.norm(center_m[:, None] - search.holes_m[as_large, :2], axis=2)
    return np.asarray((apart < HOLE_M).any(axis=1))


def most_even(search: RimSearch) -> EvenRings:
    """Look for the most even ring within the reach of every slot."""
    inner, outer = search.radii_m
    edge_m = search.reach_m + COARSE_M + outer + BESIDE_M + 3 * CELL_M
    low, high = search.center_m.min(axis=0) - edge_m, search.center_m.max(axis=0) + edge_m
    picture = _of_unit_range(_laid_out(search.view, low, high, search.level_m))
    angles = (np.arange(DIRECTIONS) + 0.5) * (2 * np.pi / DIRECTIONS)
    around = np.column_stack([np.cos(angles), np.sin(angles)])
    ring = (np.array([-ALONG_M, 0.0, ALONG_M]) + (inner + outer) / 2) / CELL_M
    beside = np.array([outer + BESIDE_M, inner - BESIDE_M, inner - DEEPER_M]) / CELL_M
    place, shifts = (search.center_m - low) / CELL_M, _disc(search.reach_m, COARSE_M)
    # Half of the directions and one radius tell where to look.
    half = np.ascontiguousarray(around[::2])
    sides = (beside[0], beside[1])
    _, best = even_rings(picture, place, shifts, half, ring[1:2], *sides, LEAST_SEEN * len(half), NOISE**2)
    place, shifts = place + shifts[best], _disc(COARSE_M, FINE_M)
    evenness, best = even_rings(picture, place, shifts, around, ring, *sides, LEAST_SEEN * DIRECTIONS, NOISE**2)
    place = place + shifts[best]
    like = ring_sides(picture, place, around, ring, beside, DIFFERS, NOISE**2)
    maybe = (evenness >= LEAST_EVENNESS) & np.all(like[:, :3] >= LEAST_SIDES, axis=1) & (like[:, 4] <= MOST_EDGE)
    facts = np.full((len(place), len(LIKELY)), np.nan)
    if maybe.any():
        slopes = [cv2.Sobel(picture, cv2.CV_32F, dx, 1 - dx, ksize=3, scale=1 / 8) for dx in (0, 1)]
        edges = (np.array([inner, outer])[:, None] + np.array([-1, 0, 1]) * ALONG_M).ravel() / CELL_M
        along = edge_shares(slopes[0], slopes[1], place[maybe], around, edges, LEAST_SLOPE)
        facts[maybe] = np.column_stack([evenness[maybe], along, np.clip(like[maybe, 3], -1, 1)])
    return EvenRings(low + place * CELL_M, evenness, facts)


def _of_unit_range(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """A picture, a little blurred, over the range of most of its grays: a lamp's reflection is no part of it."""
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), BLUR_CELLS), np.float32)
    some = picture[::5, ::5]
    seen = some[np.isfinite(some)]
    lowest, dark, bright, highest = np.percentile(seen, (0, 1, 99, 100)) if len(seen) else (0.0, 0.0, 0.0, 1.0)
    return np.asarray(picture / np.float32(max(bright - dark, 0.2 * (highest - lowest), 1e-6)), np.float32)


def _disc(reach_m: float, step_m: float) -> FloatArray:
    """Places of a disc, `step_m` apart, (M, 2), cells, the middle among them."""
    axis = step_m * np.arange(-int(reach_m / step_m), int(reach_m / step_m) + 1)
    places = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    return np.asarray(places[np.hypot(*places.T) <= reach_m + 1e-9] / CELL_M)


def _laid_out(view: RimView, low_m: FloatArray, high_m: FloatArray, level_m: float) -> NDArray[np.float32]:
    """The image on a level of the rack, cells (X, Y) of `CELL_M`, the first at `low_m`; NaN where it ends."""
    rows, columns = (int(cells) for cells in np.ceil((high_m - low_m) / CELL_M) + 1)
    lens, R, t = view.intrinsics, view.T_camera_rack[:3, :3], view.T_camera_rack[:3, 3]
    K = np.array([[lens.fx, 0, lens.cx], [0, lens.fy, lens.cy], [0, 0, 1.0]])
    # A column of the picture goes along the rack's y, a row along its x.
    to_image = K @ np.column_stack([R[:, 1] * CELL_M, R[:, 0] * CELL_M, R @ [*low_m, level_m] + t])
    corners = to_image @ np.array([[0, columns, 0, columns], [0, 0, rows, rows], [1, 1, 1, 1.0]])
    size = view.picture.shape[1::-1]
    first, end = np.zeros(2, int), np.array(size)
    if np.all(corners[2] > 0):  # only this part of the image is read
        ends = corners[:2] / corners[2]
        first = np.clip(np.floor(ends.min(axis=1)).astype(int) - 1, 0, size)
        end = np.clip(np.ceil(ends.max(axis=1)).astype(int) + 2, 0, size)
    if np.any(end - first < 2):
        return np.full((rows, columns), np.nan, np.float32)
    return np.asarray(
        cv2.warpPerspective(
            np.asarray(view.picture[first[1] : end[1], first[0] : end[0]], np.float32),
            np.array([[1, 0, -first[0]], [0, 1, -first[1]], [0, 0, 1.0]]) @ to_image,
            (columns, rows),
            flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
            borderValue=float("nan"),
        ),
        np.float32,
    )
