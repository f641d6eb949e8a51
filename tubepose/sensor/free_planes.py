"""Noise of a camera without a rack: on the planes of a capture, wherever they lie."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import RgbdFrame
from tubepose.config import SensorConfig
from tubepose.sensor.measuring import noise_on_surface
from tubepose.sensor.noise import SensorNoise
from tubepose.sensor.surfaces import fitted_surface
from tubepose.transforms import FloatArray

PLANE = "plane"
"""Source of a noise that was measured on any plane."""
BAND_SHARE = 0.012
"""Points this near a plane can be of it, as a share of their depth: three times the noise of REAL stereo cameras."""
DRAWS = 800
"""Planes that are drawn: of a fifth of the points, one in 600 searches misses it."""
DRAWN_FROM = 1_500
FITTED = 6_000
LEAST_SHARE = 0.05
"""A plane has this share of the points of a frame at least."""
MARGIN_PX = 12
"""Pixels so near the border of a plane are left out: ramps of REAL stereo cameras are 8 to 17 px wide."""
MOST_PLANES = 3
CELL_M = 5.0e-3
"""Cells whose mean distances from a plane tell the covariance of the long waves, at the reference depth."""
REFERENCE_M = 0.5
CELL_PX_LEAST = 4.0
LAGS = 24
"""Distances of cells for which the covariance is told, the first one nothing."""
LEAST_PAIRS = 60


@dataclass(frozen=True, slots=True, eq=False)
class PlaneNoise:
    """Noise on one plane.

    Attributes:
        noise: As of every surface.
        total_std_m: Standard deviation about the plane, waves of any length counted, metres.
        lag_m: Distances, shape (L,), metres.
        covariance_m2: Covariance of the mean errors of small cells so far apart, shape (L,), square metres.
        missing_share: Share of the pixels within the plane's outline that have no depth; NaN without pixels.
        n_points: Points of the plane.
        slant_rad: Angle of the plane's normal off the line of sight to its middle.
    """

    noise: SensorNoise
    total_std_m: float
    lag_m: FloatArray
    covariance_m2: FloatArray
    missing_share: float
    n_points: int
    slant_rad: float


def planes_of(frame: RgbdFrame, config: SensorConfig) -> tuple[PlaneNoise, ...]:
    """Noise on the largest planes of a frame (RANSAC, then least squares), the largest first; none without any.

    Args:
        frame: The frame, with pixels or without.
        config: How noise is measured.
    """
    left = frame.valid.copy()
    least = max(config.least_points, int(LEAST_SHARE * left.sum()))
    found: list[PlaneNoise] = []
    for _ in range(MOST_PLANES):
        near = _plane_points(frame.points_m, left, least)
        if near is None:
            break
        left &= ~near
        inside, missing = _inside(frame, near)
        measured = _measured(frame.points_m[inside], missing, config)
        if measured is not None:
            found.append(measured)
    return tuple(sorted(found, key=lambda plane: -plane.n_points))


def _plane_points(points_m: FloatArray, left: NDArray[np.bool_], least: int) -> NDArray[np.bool_] | None:
    """Rows near the plane that holds most of the points that are left; None where that are too few."""
    rows = np.flatnonzero(left)
    if len(rows) < least:
        return None
    rng = np.random.default_rng(0)  # the same frame has the same answer
    some = points_m[rng.choice(rows, min(DRAWN_FROM, len(rows)), replace=False)]
    corners = some[rng.integers(len(some), size=(DRAWS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    sound = length > 1e-6
    normals = normals[sound] / length[sound, None]
    off = np.abs(some @ normals.T - np.sum(corners[sound, 0] * normals, axis=1))
    counts = np.sum(off < BAND_SHARE * some[:, 2:], axis=0)
    if not len(counts) or counts.max() * len(rows) / len(some) < least:
        return None
    best = int(np.argmax(counts))
    normal, middle = normals[best], corners[sound][best, 0]
    for _ in range(4):
        near = np.abs((some - middle) @ normal) < BAND_SHARE * some[:, 2]
        middle = some[near].mean(axis=0)
        normal = np.linalg.eigh(np.cov((some[near] - middle).T))[1][:, 0]
    with np.errstate(invalid="ignore"):
        close = left & (np.abs((points_m - middle) @ normal) < BAND_SHARE * points_m[:, 2])
    return close if np.count_nonzero(close) >= least else None


def _inside(frame: RgbdFrame, near: NDArray[np.bool_]) -> tuple[NDArray[np.bool_], float]:
    """Rows of the largest patch of a plane away from its border, and the share of its pixels without depth."""
    if not frame.organised:
        return near, float("nan")
    shape = frame.cloud_m.shape[:2]
    # Single pixels without depth do not cut a patch.
    filled = cv2.morphologyEx(near.reshape(shape).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8))
    core = cv2.erode(filled, np.ones((2 * MARGIN_PX + 1, 2 * MARGIN_PX + 1), np.uint8), borderValue=0)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(core)
    if len(stats) < 2:
        return np.zeros_like(near), float("nan")
    patch = (labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))).ravel()
    missing = float(np.mean(~frame.valid[patch]))
    return patch & near, missing


def _measured(points_m: FloatArray, missing: float, config: SensorConfig) -> PlaneNoise | None:
    """The noise of the points of a plane; None where they are too few."""
    if len(points_m) < config.least_points:
        return None
    middle = points_m.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((points_m[:: max(1, len(points_m) // FITTED)] - middle).T))
    normal = axes[:, 0] * -np.sign(axes[:, 0] @ middle)
    first = np.cross([0.0, 1.0, 0.0], normal)
    first = first / np.linalg.norm(first) if np.linalg.norm(first) > 1e-6 else np.array([1.0, 0.0, 0.0])
    rotation = np.stack([first, np.cross(normal, first), normal])
    rows = np.column_stack([(points_m - middle) @ rotation.T, points_m[:, 2]])
    surface = fitted_surface(rows, rows[:: max(1, len(rows) // FITTED)], config)
    noise = None if surface is None else noise_on_surface(PLANE, surface, config)
    if surface is None or noise is None:
        return None
    terms = np.column_stack([np.ones(len(rows)), rows[:, :2]])
    kept = np.abs(surface.off_m) <= surface.clip_m
    flat = np.linalg.lstsq(terms[kept], rows[kept, 2], rcond=None)[0]
    off = (rows[kept, 2] - terms[kept] @ flat) * surface.distance_m / rows[kept, 3]
    cell_m = max(CELL_M * surface.distance_m / REFERENCE_M, CELL_PX_LEAST * noise.spacing_m)
    lag_m, covariance = _covariance(rows[kept, :2], off, cell_m)
    slant = float(np.arccos(np.clip(-normal @ middle / np.linalg.norm(middle), -1, 1)))
    return PlaneNoise(noise, float(np.std(off)), lag_m, covariance, missing, int(kept.sum()), slant)


def _covariance(xy_m: FloatArray, off_m: FloatArray, cell_m: float) -> tuple[FloatArray, FloatArray]:
    """Covariance (L,) of the mean errors of square cells at distances (L,) along both axes, square metres."""
    cell = np.floor((xy_m - xy_m.min(axis=0)) / cell_m).astype(int)
    shape = cell.max(axis=0) + 1
    place = cell[:, 0] * shape[1] + cell[:, 1]
    size = int(shape[0] * shape[1])
    count = np.bincount(place, minlength=size).reshape(shape)
    total = np.bincount(place, off_m, minlength=size).reshape(shape)
    full = count >= max(3, np.median(count[count > 0]) / 2)
    mean = np.where(full, total / np.maximum(count, 1), 0.0)
    lags, found = [], []
    for lag in range(min(LAGS, int(shape.min()))):
        pairs, products = 0, 0.0
        for axis in (0, 1):
            n = shape[axis] - lag
            ahead, behind = (np.take(full, np.arange(a, a + n), axis=axis) for a in (lag, 0))
            both = ahead & behind
            pairs += int(both.sum())
            values = [np.take(mean, np.arange(a, a + n), axis=axis) for a in (lag, 0)]
            products += float(np.sum(values[0] * values[1] * both))
        if pairs < LEAST_PAIRS:
            break
        lags.append(lag * cell_m)
        found.append(products / pairs)
    return np.array(lags), np.array(found)
