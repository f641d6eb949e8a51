"""Independent and shared error of a surface's points, by a nested analysis of variance.

Points are put into square cells, and cells into cells of twice the side: the variance within cells grows with their
side from the independent error to that and the shared one. It needs no pixels, no pairs, and no surface without holes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erf

from tubepose.sensor import disc_kernels as kernels
from tubepose.sensor.discs import spread
from tubepose.sensor.surfaces import CLIP, LevelSurface
from tubepose.transforms import FloatArray

FIRST_CELL = 2.0
"""Side of the smallest cells in point spacings: four points, the fewest whose variance is worth having."""
STRAY_CELL = 4.0
"""Side, in point spacings, of the cells whose mean tells a stray point: sixteen points, which one moves by little."""
CLEANINGS = 2
SPREAD_POINTS = 10_000
"""Points that tell their spread about their neighbours' means to 1 %."""
DOUBLINGS = 6
LONGEST_M = 2.0e-2
"""Longer waves than this cannot be told from the low-order surface that was taken out (REAL stereo: 3 to 13 mm)."""
LENGTHS = 40
LEAST_FREE = 30
"""Degrees of freedom of a size of cell: fewer tell its variance to no better than 26 %."""


@dataclass(frozen=True, slots=True)
class ErrorParts:
    """Independent and shared error of the points of a surface.

    Attributes:
        independent_m: Standard deviation of a point's own error, metres.
        independent_relative_std: How well that is known, as a share of it.
        shared_m: Standard deviation of what neighbours share, metres.
        shared_relative_std: How well that is known, as a share of it.
        correlation_m: Distance at which its correlation is 1/e, metres.
        n_patches: Cells as wide as two correlation lengths, or two of the smallest cells, that were seen.
    """

    independent_m: float
    independent_relative_std: float
    shared_m: float
    shared_relative_std: float
    correlation_m: float
    n_patches: int


def error_parts(surface: LevelSurface, spacing_m: float) -> ErrorParts | None:
    """Fit the variances within nested cells; None where cells are too few.

    Args:
        surface: The surface.
        spacing_m: Distance of neighbouring points.
    """
    cell = FIRST_CELL * spacing_m
    sides, variances, free, cells = _within(surface, cell, _clean(surface, STRAY_CELL * spacing_m))
    if len(sides) < 2:
        return None
    lengths = np.geomspace(spacing_m, LONGEST_M, LENGTHS)
    own, shared, length = _split(sides, variances, lengths)
    area = cells[0] * cell**2
    patches = max(1, int(area / max(2 * length, 2 * cell) ** 2))
    known = 1 / np.sqrt(2 * free[0])
    # What is shared within the smallest cells is not known better than the shared error is.
    leak = shared * (1 - cell_correlation(cell / length)) / max(own, 1e-24)
    spread = 1 / np.sqrt(2 * patches)
    own_known = float(np.hypot(known * (1 + leak), leak * spread))
    return ErrorParts(float(np.sqrt(own)), own_known, float(np.sqrt(shared)), float(spread), length, patches)


def _clean(surface: LevelSurface, cell_m: float) -> FloatArray:
    """Distances (N,) from the surface, those that stray from their neighbours' mean infinite: edges and stray light.

    Both make a few points of a rack's ribs wild; on REAL ribs, 1 mm inside of them, they double the independent error.
    """
    low = surface.low_m
    shape = np.ceil((surface.high_m - low) / cell_m).astype(int) + 1
    off = np.asarray(surface.off_m)
    for _ in range(CLEANINGS):
        sums = kernels.cell_sums(surface.rows, off, surface.clip_m, low, cell_m, (int(shape[0]), int(shape[1])))
        left = np.abs(kernels.off_cells(surface.rows, off, surface.clip_m, low, cell_m, sums))
        with np.errstate(invalid="ignore"):
            some = left[:: max(1, len(left) // SPREAD_POINTS)]
            stray = left > CLIP * spread(some[some > 0])
        if not stray.any():
            break
        off = np.where(stray, np.inf, off)
    return off


def _within(
    surface: LevelSurface, cell_m: float, off_m: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, list[int]]:
    """Side, variance within cells, degrees of freedom and number of cells with points, for every size of cell."""
    low = surface.low_m
    size = surface.high_m - low
    count = 2**DOUBLINGS
    shape = (np.ceil(size / cell_m / count).astype(int) + 1) * count
    grid = (low, cell_m, (int(shape[0]), int(shape[1])))
    sums = kernels.cell_sums(surface.rows, off_m * surface.distance_m / surface.rows[:, 3], surface.clip_m, *grid)
    sides, variances, free, cells = [], [], [], []
    for k in range(DOUBLINGS):
        n, total, squares = sums.reshape(-1, 3)[sums[..., 0].ravel() > 1].T
        spare = float(np.sum(n - 1))
        if spare >= LEAST_FREE and len(n) >= LEAST_FREE / 3:
            sides.append(cell_m * 2**k)
            variances.append(float(np.sum(squares - total**2 / n)) / spare)
            free.append(spare)
            cells.append(len(n))
        sums = sums[::2, ::2] + sums[1::2, ::2] + sums[::2, 1::2] + sums[1::2, 1::2]
    return np.array(sides), np.maximum(variances, 1e-18), np.array(free), cells


def _split(sides: FloatArray, variances: FloatArray, lengths: FloatArray) -> tuple[float, float, float]:
    """Independent and shared variance, neither below 0, and correlation length: weighted least squares on a grid."""
    # Relative residuals: variances are known to a share of themselves.
    a = np.broadcast_to(1 / variances, (len(lengths), len(sides)))
    b = (1 - cell_correlation(sides / lengths[:, None])) / variances
    aa, ab, bb, a1, b1 = (np.sum(v, axis=1) for v in (a * a, a * b, b * b, a, b))
    bottom = np.maximum(aa * bb - ab**2, 1e-12 * aa * bb)
    both = np.stack([(bb * a1 - ab * b1) / bottom, (aa * b1 - ab * a1) / bottom], axis=-1)
    alone = np.zeros((2, len(lengths), 2))
    alone[0, :, 0], alone[1, :, 1] = a1 / aa, b1 / bb
    answers = np.concatenate([both[None], alone])
    left = answers[..., :1] * a + answers[..., 1:] * b - 1
    cost = np.where(answers.min(axis=-1) >= 0, np.sum(left**2, axis=-1), np.inf)
    kind, best = np.unravel_index(np.argmin(cost), cost.shape)
    own, shared = answers[kind, best]
    return float(own), float(shared), float(lengths[best])


def cell_correlation(side: FloatArray | float) -> FloatArray:
    """Mean correlation of two points in a square whose side is so many correlation lengths: of exp(-(d / l)^2)."""
    t = np.asarray(side, dtype=float)
    line = (np.sqrt(np.pi) * t * erf(t) - 1 + np.exp(-(t**2))) / t**2
    return np.asarray(line**2)
