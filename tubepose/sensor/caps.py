"""Noise that the caps of a frame show about their own planes: restricted maximum likelihood (REML) over all of them.

A plane that is fitted to a cap absorbs most of the long waves of its error: 82 % of their variance where they are as
long as its radius. So the likelihood is that of what planes leave: the points' means in the cells of a grid, projected
onto what no plane explains (Patterson and Thompson 1971).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tubepose.sensor.noise import CAPS, PRIOR, TABLE, SensorNoise, slope_gain
from tubepose.transforms import FloatArray

CELLS = 4
"""Cells of a grid along a cap's radius: some 32 cells lie inside of it."""
LEAST_SPACINGS = 2.0
"""Cells are at least so many point spacings wide: four points each."""
LEAST_CELLS = 8
"""Fewer cells than this have hardly anything that a plane does not explain."""
LENGTHS = 12
LONGEST = 1.5
"""Correlation lengths above so many radii cannot be told from a plane and the cap's own form."""
SHARED_STEPS = 48
LEAST_SHARED = 0.02
"""Smallest shared error that is tried, as a share of the error within cells."""
MOST_SHARED = 10.0
COMPARED_M = 6.5e-3
"""Radius of the discs that two witnesses are compared by: a cap's."""
SURE = 2.0
"""Standard deviations by which the caps' noise must be the smaller one."""
UNSURE = 0.5
"""Caps that tell their noise worse than to this share say less than a prior does."""
ALIKE = 0.2
"""Caps whose radii differ by less than this share have one grid, which fits the smallest: each one costs time."""


@dataclass(frozen=True, slots=True, eq=False)
class CapDisc:
    """The flat top of a cap.

    Attributes:
        xy_m: Its points about its middle, shape (N, 2), metres.
        off_m: Their distances from the cap's own plane, shape (N,), metres.
        radius_m: Radius of the disc that they lie in.
        depth_m: Its depth along the optical axis.
    """

    xy_m: FloatArray
    off_m: FloatArray
    radius_m: float
    depth_m: float


@dataclass(frozen=True, slots=True, eq=False)
class _Grid:
    """Means in the cells of caps of one radius, ready for the likelihood.

    Attributes:
        centers_m: Middles of the cells, shape (K, 2).
        off_planes: Orthonormal basis of what no plane explains, shape (K, K - 3).
        side_m: Side of a cell.
        means_m: Mean distance in every cell of every cap, shape (D, K).
        per_point: Mean over cells of one over its number of points.
        squares: Sum of squares about the means of cells.
        free: Its degrees of freedom.
    """

    centers_m: FloatArray
    off_planes: FloatArray
    side_m: float
    means_m: FloatArray
    per_point: float
    squares: float
    free: float


@dataclass(frozen=True, slots=True)
class CapsError:
    """Independent and shared error of the points of caps.

    Attributes:
        independent_m: Standard deviation of a point's own error, metres.
        shared_m: Standard deviation of what neighbours share, metres.
        correlation_m: Distance at which its correlation is 1/e, metres.
        relative_std: How well the slope error of planes through such caps is known, as a share of it: over all
            lengths and shared errors by their likelihood.
        independent_relative_std: How well the independent error is known.
        spacing_m: Distance of neighbouring points.
        n_caps: How many caps.
    """

    independent_m: float
    shared_m: float
    correlation_m: float
    relative_std: float
    independent_relative_std: float
    spacing_m: float
    n_caps: int


def seen_on_caps(noise: SensorNoise, discs: Sequence[CapDisc]) -> SensorNoise:
    """The caps' noise where it is surely smaller than that of the rack's top, which stray light makes an upper bound.

    A table may be darker than the caps, and its depth noisier: where the points of caps lie surely nearer to their own
    planes than the table's noise has them, all of it is scaled by that. Where no surface was seen at all, the caps'
    noise takes the place of what is assumed.

    Args:
        noise: Of the table, of the rack's top, or the prior.
        discs: Flat tops of caps of the same frame.

    Returns:
        The smaller of the two, at the same reference distance; `source` says which.
    """
    error = caps_error(discs, noise.distance_m)
    if error is None:
        return noise
    if noise.source == TABLE:
        radius_m = float(np.median([disc.radius_m * noise.distance_m / disc.depth_m for disc in discs]))
        (std_m, known), (told_m, told_known) = residual_std(error, radius_m), residual_std(noise, radius_m)
        share = std_m / told_m
        if not share * (1 + SURE * float(np.hypot(known, told_known))) < 1:
            return noise
        words = f"the table has {1 / share:.1f} times the noise of the caps' points; all of it is scaled"
        return replace(noise.scaled(share), note=words)
    caps = replace(
        noise,
        independent_m=error.independent_m,
        independent_relative_std=error.independent_relative_std,
        shared_m=error.shared_m,
        shared_relative_std=error.relative_std,
        correlation_m=error.correlation_m,
        spacing_m=error.spacing_m,
        discs=(),
        n_patches=error.n_caps,
        source=CAPS,
    )
    if noise.source == PRIOR:
        if error.relative_std > UNSURE:
            return noise
        return replace(caps, note="no level surface was seen; told by the caps alone, whose own form counts as noise")
    here, there = (one.slope_std(COMPARED_M, noise.distance_m) for one in (caps, noise))
    if here * (1 + SURE * error.relative_std) >= there:
        return noise
    words = f"the rack's top has {there / here:.1f} times the slope noise of the caps, whose noise is taken"
    return replace(caps, note=words)


def residual_std(error: SensorNoise | CapsError, radius_m: float) -> tuple[float, float]:
    """Standard deviation of points of a disc off its own plane, metres, and how well it is known, as a share of it.

    A plane absorbs q^2 / (1 + q^2) of the variance of what points share by its height and 2 G(q) by its slopes, q their
    correlation length over the radius, G `slope_gain`: 0.83 at q = 1.

    Args:
        error: Of the points.
        radius_m: Radius of the disc, metres.
    """
    q = error.correlation_m / radius_m
    left = max(1 - q**2 / (1 + q**2) - 2 * float(slope_gain(q)), 0.0)
    own, shared = error.independent_m**2, error.shared_m**2 * left
    shared_std = error.shared_relative_std if isinstance(error, SensorNoise) else error.relative_std
    # Of a standard deviation's two parts, each known to its share.
    known = np.hypot(own * error.independent_relative_std, shared * shared_std) / (own + shared)
    return float(np.sqrt(own + shared)), float(known)


def caps_error(discs: Sequence[CapDisc], distance_m: float) -> CapsError | None:
    """Independent and shared error over all caps; None where too few show enough.

    Args:
        discs: Flat tops.
        distance_m: Depth at which the errors shall hold: discs elsewhere are scaled, as the noise lives in pixels.
    """
    scaled = [
        CapDisc(d.xy_m * distance_m / d.depth_m, d.off_m * distance_m / d.depth_m, d.radius_m * distance_m / d.depth_m,
                distance_m)
        for d in discs if len(d.off_m) and d.radius_m > 0
    ]  # fmt: skip
    if not scaled:
        return None
    spacing = float(np.median([np.sqrt(np.pi * d.radius_m**2 / len(d.off_m)) for d in scaled]))
    by_radius: dict[int, list[CapDisc]] = {}
    for disc in scaled:
        by_radius.setdefault(round(np.log(disc.radius_m) / ALIKE), []).append(disc)
    grids = [grid for group in by_radius.values() if (grid := _grid(group, spacing)) is not None]
    if not grids:
        return None
    longest = LONGEST * max(disc.radius_m for disc in scaled)
    lengths = np.geomspace(min(grid.side_m for grid in grids) / 2, longest, LENGTHS)
    cost, own, shared = (
        np.array(values) for values in zip(*(_likelihood(grids, float(length)) for length in lengths), strict=True)
    )
    best = np.unravel_index(int(np.argmin(cost)), cost.shape)
    radius = float(np.median([disc.radius_m for disc in scaled]))
    gain = np.array([slope_gain(length / radius) for length in lengths])[:, None]
    slope = np.sqrt(own * spacing**2 / (np.pi * radius**2) + shared * gain)
    weight = np.exp(0.5 * (cost.min() - cost))
    mean = np.sum(weight * slope) / weight.sum()
    known = float(np.sqrt(np.sum(weight * (slope - mean) ** 2) / weight.sum()) / mean)
    free = sum(grid.free for grid in grids)
    n_caps = sum(len(grid.means_m) for grid in grids)
    return CapsError(
        float(np.sqrt(own[best])), float(np.sqrt(shared[best])), float(lengths[best[0]]), known,
        float(1 / np.sqrt(2 * free)), spacing, n_caps,
    )  # fmt: skip


def _grid(discs: Sequence[CapDisc], spacing_m: float) -> _Grid | None:
    """Cells of discs of about one radius; discs with an empty cell are left out."""
    radius = min(disc.radius_m for disc in discs)
    side = max(radius / CELLS, LEAST_SPACINGS * spacing_m)
    half = int(np.ceil(radius / side))
    corners = np.arange(-half, half)
    i, j = (index.ravel() for index in np.meshgrid(corners, corners, indexing="ij"))
    farthest = np.hypot(np.maximum(np.abs(i), np.abs(i + 1)), np.maximum(np.abs(j), np.abs(j + 1))) * side
    inside = farthest <= radius + 1e-9
    if inside.sum() < LEAST_CELLS:
        return None
    means, per_point, squares, free = [], [], 0.0, 0.0
    for disc in discs:
        at = np.floor(disc.xy_m / side).astype(int) + half
        kept = ((at >= 0) & (at < 2 * half)).all(axis=1)
        cell = at[kept, 0] * 2 * half + at[kept, 1]
        count, total, square = (
            np.bincount(cell, weights=w, minlength=4 * half * half)[inside]
            for w in (None, disc.off_m[kept], disc.off_m[kept] ** 2)
        )
        if (count < 1).any():
            continue
        means.append(np.asarray(total / count))
        per_point.append(float(np.mean(1 / count)))
        squares += float(np.sum(square - total**2 / count))
        free += float(np.sum(count - 1))
    if not means or free < LEAST_CELLS:
        return None
    centers: FloatArray = np.asarray((np.column_stack([i, j])[inside] + 0.5) * side)
    terms: FloatArray = np.column_stack([np.ones(len(centers)), centers / side])
    off_planes = np.linalg.qr(terms, mode="complete")[0][:, 3:]
    return _Grid(centers, np.asarray(off_planes), side, np.array(means), float(np.mean(per_point)), squares, free)


def _likelihood(grids: Sequence[_Grid], length_m: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Cost (-2 log likelihood), independent and shared variance, shape (M,) each, of the shared errors that are tried.

    The independent one is what is left of the variance within cells.
    """
    free = sum(grid.free for grid in grids)
    within = sum(grid.squares for grid in grids) / free
    shared = np.concatenate([[0.0], within * np.geomspace(LEAST_SHARED, MOST_SHARED, SHARED_STEPS) ** 2])
    # What neighbours share differs within a cell by this share of its variance.
    differs = sum(grid.free * (1 - _pooled(length_m, grid.side_m)) for grid in grids) / free
    own = np.maximum(within - shared * differs, 1e-3 * within)
    expected = own + shared * differs
    cost = free * (np.log(expected) + within / expected)
    for grid in grids:
        values, powers = _spectrum(grid, length_m)
        variance = own[:, None] * grid.per_point + shared[:, None] * values
        cost = cost + np.sum(len(grid.means_m) * np.log(variance) + powers / variance, axis=1)
    return np.asarray(cost), own, shared


def _spectrum(grid: _Grid, length_m: float) -> tuple[FloatArray, FloatArray]:
    """Eigenvalues (K - 3,) of the shared error's correlation off all planes, and the caps' squares along them, summed.

    Cells blur it: the correlation of means in squares of side a is that of points for a length of sqrt(l^2 + a^2 / 3).
    """
    apart2 = np.sum((grid.centers_m[:, None] - grid.centers_m) ** 2, axis=2)
    wide2 = length_m**2 + grid.side_m**2 / 3
    correlation = _pooled(length_m, grid.side_m) * np.exp(-apart2 / wide2)
    values, vectors = np.linalg.eigh(np.asarray(grid.off_planes.T @ correlation @ grid.off_planes))
    seen = grid.means_m @ grid.off_planes @ vectors
    return np.maximum(values, 0.0), np.asarray(np.sum(seen**2, axis=0))


def _pooled(length_m: float, side_m: float) -> float:
    """Mean correlation of two points in a cell, in the same form as that of two cells."""
    return length_m**2 / (length_m**2 + side_m**2 / 3)
