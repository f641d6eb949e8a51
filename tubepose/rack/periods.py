"""Pitch and openings of a rack that nothing is known of: periods of the picture of its face (autocorrelation)."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from tubepose.config import Config
from tubepose.labware import SlotShape
from tubepose.rack.edges import coarse_sample
from tubepose.rack.fit import to_frame
from tubepose.rack.lattice import SlotLattice
from tubepose.rack.pose import MIN_POINTS
from tubepose.rack.search import Band, levels
from tubepose.transforms import FloatArray

CELL_M = 0.5e-3
# Half thickness of a face, bow included, and how far beside a band's points it may go on.
THICK_M, BESIDE_M = 2.0e-3, 5e-3
# Openings are bridged so far where a face's patch is looked for; the widest that racks have are 35 mm.
BRIDGE_M = 18e-3
# Sides of a face, and pitches, that racks have.
FACE_M, PITCH_M = (0.03, 0.45), (8e-3, 60e-3)
# A period's peak reaches at least this share of what the picture has at lag 0, about its mean; and the first of several
# peaks is the period if it reaches this share of the best, or is a half or a third of one and reaches the last share.
LEAST_PEAK, FIRST_PEAK, PART_PEAK = 0.25, 0.8, 0.5
# Turns about the patch's rectangle that are tried.
TURNS_RAD = np.deg2rad(np.arange(-3.0, 3.01, 0.25))
# An opening that fills less of its box than this is round: a disc fills 0.785 of it.
ROUND_SHARE = 0.89
LEAST_OPENING_MM = 3.0
MOST_CELLS = 1_500_000
MOST_TRIED = 6


def propose_lattices(points_m: FloatArray, config: Config) -> Iterator[SlotLattice]:
    """Lattices that slots among points could make, the clearest first.

    Args:
        points_m: Array of shape (N, 3), camera frame, metres, without NaN.
        config: Section rack_top is used.
    """
    found = []
    for level in levels(coarse_sample(points_m, config.rack_top), config.rack_top):
        for band in level:
            made = _lattice(_face_points(points_m, band))
            if made is not None:
                found.append(made)
    for _, lattice in sorted(found, key=lambda pair: -pair[0])[:MOST_TRIED]:
        yield lattice


def _face_points(points_m: FloatArray, band: Band) -> FloatArray:
    """All points at a band's height where the band has some, shape (N, 2), frame of the band."""
    low, high = band.solid_m.min(axis=0) - BESIDE_M, band.solid_m.max(axis=0) + BESIDE_M
    if np.any(high - low > FACE_M[1] + 2 * BESIDE_M):
        return band.solid_m
    local = to_frame(points_m, band.T_camera_band)
    near = (np.abs(local[:, 2]) < THICK_M) & np.all((local[:, :2] > low) & (local[:, :2] < high), axis=1)
    return np.asarray(local[near, :2])


def _lattice(solid_m: FloatArray) -> tuple[float, SlotLattice] | None:
    """The lattice of the largest patch of a face and how clear it is; None where it has no periods."""
    patch = _patch(solid_m)
    if patch is None:
        return None
    angle = np.deg2rad(cv2.minAreaRect(patch.astype(np.float32))[2]) + TURNS_RAD
    turned = [_turned(patch, float(turn)) for turn in angle]
    # Ribs along an axis make its projections sharp.
    sharp = [sum(float(np.var(_picture(xy).mean(axis=axis))) for axis in range(2)) for xy in turned]
    xy = turned[int(np.argmax(sharp))]
    periods = [_period(_picture(xy), axis) for axis in range(2)]
    if any(period is None for period in periods):
        return None
    (x_m, x_peak), (y_m, y_peak) = (period for period in periods if period is not None)
    slot = _opening(xy, np.array([x_m, y_m]))
    return None if slot is None else (min(x_peak, y_peak), SlotLattice((1e3 * x_m, 1e3 * y_m), slot))


def _patch(solid_m: FloatArray) -> FloatArray | None:
    """Points of the largest patch that hangs together where openings are bridged; None if it is no rack's size."""
    if len(solid_m) < MIN_POINTS:
        return None
    low = solid_m.min(axis=0)
    cells = np.floor((solid_m - low) / (4 * CELL_M)).astype(np.intp)
    reach = int(np.ceil(BRIDGE_M / (4 * CELL_M)))
    shape = cells.max(axis=0) + 1 + 2 * reach
    if int(np.prod(shape)) > MOST_CELLS:
        return None
    raster = np.zeros(shape, np.uint8)
    raster[cells[:, 0] + reach, cells[:, 1] + reach] = 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (reach + 1, reach + 1))
    closed = cv2.morphologyEx(raster, cv2.MORPH_CLOSE, kernel)
    labels, count = ndimage.label(closed)
    if not count:
        return None
    label = labels[cells[:, 0] + reach, cells[:, 1] + reach]
    patch = solid_m[label == np.argmax(np.bincount(label[label > 0]))]
    size = np.ptp(patch, axis=0)
    return patch if size.min() > FACE_M[0] and size.max() < FACE_M[1] else None


def _turned(patch_m: FloatArray, angle_rad: float) -> FloatArray:
    """Points in a frame that is turned by an angle, from 0 on, shape (N, 2)."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    xy = patch_m @ np.array([[cos, -sin], [sin, cos]])
    return np.asarray(xy - xy.min(axis=0))


def _picture(xy_m: FloatArray) -> NDArray[np.float64]:
    """Which cells have points, a little blurred, shape (X, Y)."""
    cells = np.floor(xy_m / CELL_M).astype(np.intp)
    picture = np.zeros(cells.max(axis=0) + 1)
    picture[cells[:, 0], cells[:, 1]] = 1
    return np.asarray(ndimage.uniform_filter(picture, 3))


def _period(picture: NDArray[np.float64], axis: int) -> tuple[float, float] | None:
    """Period along an axis, metres, and its peak as a share of lag 0; None without one.

    The peaks of several periods are measured together: the last of them has the least error.
    """
    lines = np.moveaxis(picture, axis, 0) - picture.mean()
    padded = np.fft.rfft(lines, 2 * len(lines), axis=0)
    lags = np.fft.irfft(np.abs(padded) ** 2, axis=0).sum(axis=1)[: len(lines)]
    lags = lags / (len(lines) - np.arange(len(lines)))
    lags = lags / lags[0]
    first, last = int(PITCH_M[0] / CELL_M), min(int(PITCH_M[1] / CELL_M), 3 * len(lines) // 4)
    inner = np.arange(first, last)
    peaks = inner[(lags[inner] >= lags[inner - 1]) & (lags[inner] > lags[inner + 1 if last < len(lags) else inner])]
    peaks = peaks[lags[peaks] > LEAST_PEAK]
    if not len(peaks):
        return None
    high = lags[peaks] / lags[peaks].max()
    period = float(peaks[np.flatnonzero(high >= FIRST_PEAK)[0]])
    for part in (3, 2):
        # Where tubes hide slots, twice the period can have the higher peak.
        fits = peaks[(np.abs(peaks - period / part) <= 2) & (high >= PART_PEAK)]
        if len(fits):
            period = float(fits[0])
            break
    height = float(lags[round(period)])
    for times in range(2, int(0.75 * len(lines) / period) + 1):
        near = np.arange(round(times * period) - 3, round(times * period) + 4)
        near = near[near < len(lags)]
        period = float(near[np.argmax(lags[near])]) / times
    return period * CELL_M, height


def _opening(xy_m: FloatArray, pitch_m: FloatArray) -> SlotShape | None:
    """The opening in one cell of a lattice that all points are folded into: what has hardly half the points of ribs."""
    shape = np.rint(pitch_m / CELL_M).astype(int)
    cells = np.floor(np.mod(xy_m / pitch_m, 1) * shape).astype(np.intp) % shape
    counts = np.bincount(cells[:, 0] * shape[1] + cells[:, 1], None, int(shape.prod())).reshape(shape)
    low, high = np.percentile(counts, (10, 98))
    opened = counts < (low + high) / 2
    # The cell is cut where the ribs are: its fullest lines along both axes.
    cuts = [-int(np.argmax(counts.sum(axis=axis))) for axis in (1, 0)]
    opened = np.roll(opened, cuts, axis=(0, 1))
    labels, count = ndimage.label(opened)
    if not count:
        return None
    hole = ndimage.binary_fill_holes(labels == np.argmax(np.bincount(labels.ravel())[1:]) + 1)
    cell_mm = 1e3 * pitch_m / shape
    sides = [float(np.percentile(hole.sum(axis=axis)[hole.any(axis=axis)], 75)) * cell_mm[axis] for axis in range(2)]
    if min(sides) < LEAST_OPENING_MM:
        return None
    area = float(hole.sum() * cell_mm.prod())
    box = float(np.prod([np.ptp(np.nonzero(hole)[axis]) + 1 for axis in range(2)]) * cell_mm.prod())
    most = 0.97e3 * pitch_m
    if area / box < ROUND_SHARE and abs(sides[0] - sides[1]) < 0.2 * max(sides):
        diameter = float(min(2 * np.sqrt(area / np.pi), most.min()))
        return SlotShape(shape="round", size_mm=(diameter, diameter))
    return SlotShape(shape="square", size_mm=(float(min(sides[0], most[0])), float(min(sides[1], most[1]))))
