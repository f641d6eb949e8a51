"""Blur of depth edges wherever they are: how wide the ramps of a frame's depth steps are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tubepose.capture.frame import RgbdFrame
from tubepose.transforms import FloatArray

REACH_PX = 32
"""Pixels on each side of an edge: the outer ones tell the level of the side."""
SIDE_PX = 14
"""Pixels that tell the level of a side, the outermost ones."""
LEAST_STEP = 0.04
"""Least step, as a share of the depth: ten times the noise of REAL stereo cameras."""
MOST_SLOPED = 0.35
"""Sides that their own slopes bring nearer to each other by more than this share of the step are one sloped surface."""
LOW, HIGH, NEAR = 0.1, 0.9, 0.04
"""Shares of the step between which a ramp is told, and from which on a pixel is on its side."""
STRAIGHT = 0.7
"""Rows and columns that cross an edge at more than 45 deg are left out: columns and rows cross it straighter."""
ACROSS_PX = 5
"""How far off its middle the direction of an edge is told."""
SHARPER = 0.25
"""The quartile of the sharper edges is told: round and sloping things have ramps of their own."""
MOST_LINES = 4_000
LEAST_LINES = 20
NEAR_RANGE = 0.3
"""Sides farther apart than this share of the depth are another kind of edge: the ground behind is seldom matched."""


@dataclass(frozen=True, slots=True)
class FreeEdges:
    """Ramps of depth edges.

    Attributes:
        ramp_px: Lower quartile of the ramps' widths, 10 to 90 % of the step of inverse depth, pixels.
        ramp_std_px: Standard deviation of that quartile.
        blur_px: Lower quartile of the count of valid pixels between the two flat sides.
        n_lines: Lines across edges that were told.
    """

    ramp_px: float
    ramp_std_px: float
    blur_px: float
    n_lines: int


def free_edges(frame: RgbdFrame) -> FreeEdges | None:
    """Ramp of the depth edges of an organised frame, on its rows and columns; None with too few edges.

    An edge counts where both sides are flat, both are measured, and every pixel between them is, too.
    """
    if not frame.organised:
        return None
    inverse = 1.0 / np.asarray(frame.cloud_m[..., 2])
    along_u, along_v = _lines(inverse), _lines(inverse.T)
    lines = np.concatenate([along_u[0], along_v[0]])
    if len(lines) < LEAST_LINES:
        return None
    ramps, blurs = _ramps(lines, np.concatenate([along_u[1], along_v[1]]))
    if len(ramps) < LEAST_LINES:
        return None
    # Neighbouring lines share their edge: a tenth of them are counted as independent.
    known = 1.36 * float(np.std(ramps)) / np.sqrt(max(len(ramps) / 10, 1))
    return FreeEdges(float(np.quantile(ramps, SHARPER)), known, float(np.quantile(blurs, SHARPER)), len(ramps))


def _lines(inverse: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Pieces (L, 2 REACH_PX + 1) of rows about their steepest places, near side first, and how straight they cross it.

    That is the cosine (L,) of the angle between the row and the edge's normal.
    """
    width = inverse.shape[1]
    if width < 2 * REACH_PX + 2:
        return np.empty((0, 2 * REACH_PX + 1)), np.empty(0)
    near, far = inverse[:, : width - 2 * REACH_PX], inverse[:, 2 * REACH_PX :]
    with np.errstate(invalid="ignore"):
        step = np.abs(near / far - 1)
        ahead = inverse[:, REACH_PX + 4 : width - REACH_PX + 4]
        steep = np.abs(ahead - inverse[:, REACH_PX - 4 : width - REACH_PX - 4])
    steep = np.where((step > LEAST_STEP) & (step < NEAR_RANGE), steep, 0.0)
    places = np.argwhere((steep > 0) & (steep == _highest(steep)))
    places = places[:: max(1, len(places) // MOST_LINES)]
    pieces = np.array([inverse[v, u : u + 2 * REACH_PX + 1] for v, u in places]).reshape(-1, 2 * REACH_PX + 1)
    whole = np.isfinite(pieces).all(axis=1)
    pieces, (v, u) = pieces[whole], places[whole].T + np.array([[0], [REACH_PX]])
    rises = []
    for dv, du in ((0, ACROSS_PX), (ACROSS_PX, 0)):
        up, down = np.clip(v + dv, 0, len(inverse) - 1), np.clip(v - dv, 0, len(inverse) - 1)
        rises.append(np.abs(inverse[up, u + du] - inverse[down, u - du]))
    with np.errstate(invalid="ignore", divide="ignore"):
        straight = np.nan_to_num(rises[0] / np.hypot(*rises), nan=1.0)
    return np.where((pieces[:, :1] > pieces[:, -1:]), pieces, pieces[:, ::-1]), straight


def _highest(values: FloatArray) -> FloatArray:
    """Greatest value within `REACH_PX` / 2 along each row, shape of the values."""
    from scipy.ndimage import maximum_filter1d

    return np.asarray(maximum_filter1d(np.nan_to_num(values), REACH_PX + 1, axis=1))


def _ramps(lines: FloatArray, straight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """10 to 90 % widths (M,) and pixels between the sides (M,), of those lines that have two flat sides.

    Both are told across the edge.
    """
    near, far = lines[:, :SIDE_PX], lines[:, -SIDE_PX:]
    high, low = np.median(near, axis=1), np.median(far, axis=1)
    step = np.maximum(high - low, 1e-9)
    place = np.arange(SIDE_PX) - (SIDE_PX - 1) / 2
    slopes = np.array([side @ place / (place @ place) for side in (near, far)])
    flat = (straight > STRAIGHT) & (np.abs(slopes) * (lines.shape[1] - SIDE_PX) / 2 < MOST_SLOPED * step).all(axis=0)
    share = ((lines - low[:, None]) / step[:, None])[flat]
    last = share.shape[1] - 1
    # From the middle of the ramp to both sides: the noise of the sides crosses no limit on the way.
    middle, straight = np.argmax(share < 0.5, axis=1), straight[flat]
    ramps = [
        (_crossing(row[m:], LOW) + _crossing(1 - row[m::-1], 1 - HIGH)) * across
        for row, m, across in zip(share, middle, straight, strict=True)
        if 0 < m < last
    ]
    blurs = [
        (int(np.argmax(row[m:] < NEAR)) + int(np.argmax(row[m::-1] > 1 - NEAR)) - 1) * across
        for row, m, across in zip(share, middle, straight, strict=True)
        if 0 < m < last and (row[m:] < NEAR).any() and (row[m::-1] > 1 - NEAR).any()
    ]
    told = np.array(ramps)
    return told[np.isfinite(told)], np.array(blurs, float)


def _crossing(falling: FloatArray, level: float) -> float:
    """Where a falling row first goes below a level, between pixels linearly; NaN where it does not."""
    below = np.flatnonzero(falling < level)
    if not len(below):
        return float("nan")
    k = int(below[0])
    if k == 0:
        return 0.0
    return k - 1 + float((falling[k - 1] - level) / (falling[k - 1] - falling[k]))
