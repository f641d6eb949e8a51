"""The rack's top as a level band of points, before any registration: for `obb-icp` and the detector `geometric`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.config import RackTopConfig
from tubepose.labware import RackModel
from tubepose.preprocessing import TALLEST_TUBE_M, fit_plane, level_planes, thin
from tubepose.transforms import HALF_TURN, FloatArray, invert_transform, make_transform, transform_points

Rows = NDArray[np.intp]
OUTLINE_OF_INTEREST_M = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class RackTop:
    """The rack's top as a level band of points, before any registration.

    Attributes:
        T_camera_top: Frame of the outline's rectangle: origin at its centre on the top plane, z up (towards the
            camera), x and y along the rack's, but for a half turn; shape (4, 4), metres.
        size_m: Measured sides of the rectangle along x and y, metres.
        outline_error_m: Largest difference to the rack's defined outline, metres.
        in_slot_share: Share of the band that lies in the openings: small for a top, large for the slots' floor.
        band_rows: Rows of the given points that lie in the band and in the rectangle.
    """

    T_camera_top: FloatArray
    size_m: tuple[float, float]
    outline_error_m: float
    in_slot_share: float
    band_rows: Rows

    def fits(self, config: RackTopConfig) -> bool:
        """True when the outline is the defined one within the tolerance, and the band is solid where the rack is."""
        return self.outline_error_m <= config.outline_tolerance_m and self.in_slot_share <= config.max_in_slot_share

    def rank(self, config: RackTopConfig) -> tuple[bool, float]:
        """Larger is better: a fit before a misfit, then more points or a smaller error of the outline."""
        fits = self.fits(config)
        return fits, float(len(self.band_rows)) if fits else -self.outline_error_m - 0.01 * self.in_slot_share


def find_rack_top(points_m: FloatArray, rack: RackModel, config: RackTopConfig) -> RackTop | None:
    """Find the level band whose outline is closest to the rack's.

    Planes are taken as "level" in the order of their support; heights above them are binned; every peak is a candidate
    for the top, judged by the rectangle around it. Points above a candidate (tubes) are dropped onto it as a second
    try, so that a rack whose outline is hidden by tubes stays whole. A large cloud is searched thinned out, and the
    best candidate measured again with all of its points.

    Args:
        points_m: Array of shape (N, 3), camera frame, metres, without NaN.
        rack: The rack that is looked for.
        config: Tolerances.

    Returns:
        The best candidate, whether it fits or not, or None if nothing at all stands out.
    """
    sample = thin(points_m, config.search_points)
    best: RackTop | None = None
    for normal, origin in level_planes(sample, config):
        for candidate in _candidates(sample, normal, origin, rack, config):
            if best is None or candidate.rank(config) > best.rank(config):
                best = candidate
        if best is not None and best.fits(config):
            break
    if best is None or len(sample) == len(points_m):
        return best
    return _measure_again(points_m, best, rack, config)


def _measure_again(points_m: FloatArray, coarse: RackTop, rack: RackModel, config: RackTopConfig) -> RackTop:
    """The same top from all points near it."""
    T_top_camera = invert_transform(coarse.T_camera_top)
    local = transform_points(T_top_camera, points_m)
    near = np.all(np.abs(local[:, :2]) < np.array(coarse.size_m) / 2 + 2 * config.outline_tolerance_m, axis=1)
    band = np.flatnonzero(near & (np.abs(local[:, 2]) < config.band_m))
    normal = coarse.T_camera_top[:3, 2]
    found = _outline(points_m, band, band, normal, rack)
    if found is None or not found.fits(config):
        above = np.flatnonzero(near & (local[:, 2] > -config.band_m) & (local[:, 2] < TALLEST_TUBE_M))
        dropped = _outline(points_m, above, band, normal, rack)
        if dropped is not None and (found is None or dropped.rank(config) > found.rank(config)):
            found = dropped
    return found if found is not None else coarse


def _candidates(
    points_m: FloatArray, normal: FloatArray, origin: FloatArray, rack: RackModel, config: RackTopConfig
) -> Iterator[RackTop]:
    heights = (points_m - origin) @ normal
    low, high = np.percentile(heights, [0.1, 99.9])
    if (high - low) / config.bin_m > 20_000:
        return
    edges = np.arange(low - config.bin_m, high + 2 * config.bin_m, config.bin_m)
    counts = np.histogram(heights, edges)[0].astype(float)
    # Not mode "same": it returns five values for the three bins of a perfectly flat cloud.
    smooth = np.convolve(counts, [0.25, 0.5, 1.0, 0.5, 0.25])[2:-2]
    padded = np.pad(smooth, 1)
    peaks = np.flatnonzero((smooth >= padded[:-2]) & (smooth > padded[2:]) & (smooth >= 1e-3 * len(points_m)))
    for peak in peaks[np.argsort(-smooth[peaks], kind="stable")][:16]:
        top = float(edges[peak] + config.bin_m / 2)
        band = np.flatnonzero(np.abs(heights - top) < config.band_m)
        candidate = _outline(points_m, band, band, normal, rack)
        if candidate is None:
            continue
        yield candidate
        if not candidate.fits(config):
            above = np.flatnonzero((heights > top - config.band_m) & (heights < top + TALLEST_TUBE_M))
            dropped = _outline(points_m, above, band, normal, rack)
            if dropped is not None:
                yield dropped


def _outline(points_m: FloatArray, rows: Rows, band: Rows, normal: FloatArray, rack: RackModel) -> RackTop | None:
    """Rectangle around the largest connected patch of some rows, dropped onto the band's own plane."""
    if len(rows) < 50 or len(band) < 50:
        return None
    up, origin = fit_plane(points_m[band])
    if up @ normal < np.cos(np.deg2rad(5)):
        up = normal
    T_top_camera = _level_frame(up, origin)
    flat = transform_points(T_top_camera, points_m[rows])[:, :2]
    widest_slot = max(max(slot.size_mm) for slot in rack.all_slots) * 1e-3
    patch = _largest_patch(flat, gap_m=1.1 * widest_slot, area_m2=float(np.prod(rack.outline_m)))
    if patch is None:
        return None
    (cx, cy), (w, h), angle = cv2.minAreaRect((flat[patch] * 1e3).astype(np.float32))
    turns = [(np.deg2rad(angle), w * 1e-3, h * 1e-3), (np.deg2rad(angle) + np.pi / 2, h * 1e-3, w * 1e-3)]
    tops = [
        _rectangle(points_m, band, T_top_camera, np.array([cx, cy]) * 1e-3, turn, np.array(size), rack)
        for turn, *size in turns
    ]
    return min(tops, key=lambda top: top.outline_error_m + 0.01 * top.in_slot_share)


def _rectangle(
    points_m: FloatArray,
    band: Rows,
    T_level_camera: FloatArray,
    center_m: FloatArray,
    turn_rad: float,
    size_m: FloatArray,
    rack: RackModel,
) -> RackTop:
    """The band in one of the two frames along a rectangle's sides."""
    cos, sin = np.cos(turn_rad), np.sin(turn_rad)
    T_level_top = make_transform(np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]), np.array([*center_m, 0.0]))
    T_top_camera = invert_transform(T_level_top) @ T_level_camera
    local = transform_points(T_top_camera, points_m[band])[:, :2]
    inside = np.all(np.abs(local) <= size_m / 2 + 1e-3, axis=1)
    error_m = float(np.max(np.abs(size_m - rack.outline_m)))
    shares = [1.0, 1.0]
    if error_m < OUTLINE_OF_INTEREST_M and inside.any():
        # Half a turn matters only for racks whose slots are not the same after it.
        sample = thin(local[inside], 2000)
        shares = [float(np.mean(rack.top_signed_distance_m(k * sample) > 1e-3)) for k in (1, -1)]
    if shares[1] < shares[0]:
        T_top_camera = HALF_TURN @ T_top_camera
    size = (float(size_m[0]), float(size_m[1]))
    return RackTop(invert_transform(T_top_camera), size, error_m, min(shares), band[inside])


def _level_frame(up: FloatArray, origin: FloatArray) -> FloatArray:
    """T_level_camera of a frame at `origin` with z along `up`."""
    x = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [1.0, 0.0, 0.0], up)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(up, x), up])
    return make_transform(R, -R @ origin)


def _largest_patch(flat_m: FloatArray, gap_m: float, area_m2: float) -> Rows | None:
    """Rows of the points (N, 2) that hang together when openings up to `gap_m` are bridged; None for an absurd area."""
    cell = 2e-3
    low = flat_m.min(axis=0)
    cells = np.floor((flat_m - low) / cell).astype(np.intp)
    shape = cells.max(axis=0) + 1
    if shape.prod() > 4e6 or np.prod(np.ptp(flat_m, axis=0)) < 0.1 * area_m2:
        return None
    reach = int(np.ceil(gap_m / 2 / cell)) + 1
    raster = np.zeros(shape + 2 * reach, np.uint8)
    raster[cells[:, 0] + reach, cells[:, 1] + reach] = 255
    kernel = cv2.getStructuringElement(cv2.MORPH_RECT, (2 * reach + 1, 2 * reach + 1))
    closed = cv2.morphologyEx(raster, cv2.MORPH_CLOSE, kernel)
    # A loose pixel outside the outline would widen the rectangle: open by one cell.
    closed = cv2.morphologyEx(closed, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    _, labels = cv2.connectedComponents(closed)
    label = labels[cells[:, 0] + reach, cells[:, 1] + reach]
    counts = np.bincount(label, minlength=2)
    counts[0] = 0
    return np.flatnonzero(label == counts.argmax()) if counts.max() >= 50 else None
