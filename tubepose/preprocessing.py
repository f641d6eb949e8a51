"""Points before any pose: outlier removal, down-sampling, level planes, doubts of the unit (paper, section III)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tubepose.config import PreprocessConfig, RackTopConfig
from tubepose.labware import RackModel
from tubepose.transforms import FloatArray

TALLEST_TUBE_M = 0.15
PATCH_RADIUS_M = 0.03
PATCH_HALF_HEIGHT_M = 0.01
UNIT_FACTORS = (10.0, 0.1, 1000.0, 0.001)
PLAUSIBLE_M = (0.03, 30.0)
"""What a capture with a rack in it spans, whatever the rack."""


def to_o3d(points_m: FloatArray) -> o3d.geometry.PointCloud:
    """Open3D cloud of points of shape (N, 3)."""
    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(points_m, dtype=float)))


def remove_outliers(points_m: FloatArray, config: PreprocessConfig) -> FloatArray:
    """Statistical outlier removal of points of shape (N, 3), metres; very small clouds are returned as they are."""
    if len(points_m) <= config.outlier_neighbors:
        return points_m
    cloud, _ = to_o3d(points_m).remove_statistical_outlier(config.outlier_neighbors, config.outlier_std_ratio)
    return np.asarray(cloud.points)


def voxel_downsample(points_m: FloatArray, voxel_m: float) -> FloatArray:
    """Mean point of every occupied voxel, shape (M, 3), metres."""
    return np.asarray(to_o3d(points_m).voxel_down_sample(voxel_m).points)


def thin(points_m: FloatArray, count: int) -> FloatArray:
    """At most `count` of the points of shape (N, 3), evenly spaced in their order (so always the same ones)."""
    if len(points_m) <= count:
        return points_m
    return np.take(points_m, np.linspace(0, len(points_m) - 1, count).astype(np.intp), axis=0)


def point_spacing_m(points_m: FloatArray, sample: int = 500) -> float:
    """Median distance of a point to its nearest neighbour, metres; NaN for fewer than two points."""
    if len(points_m) < 2:
        return float("nan")
    distances, _ = cKDTree(points_m).query(thin(points_m, sample), k=2)
    return float(np.median(np.asarray(distances)[:, 1]))


def level_noise_m(points_m: FloatArray, config: RackTopConfig) -> float:
    """How far depth scatters on what should be flat, metres: median over patches of the scatter about their planes.

    The patches lie on the first level plane. Smooth waves, as stereo cameras make them, count: a patch is wide enough
    to hold a slot and its ribs. Tubes that stand in it do not. NaN where no patch has enough points.
    """
    sample = thin(points_m, config.search_points)
    plane = next(level_planes(sample, config), None)
    if plane is None:
        return float("nan")
    normal, origin = plane
    level = sample[np.abs((sample - origin) @ normal) < PATCH_HALF_HEIGHT_M]
    near = cKDTree(level)
    patches = [near.query_ball_point(center, PATCH_RADIUS_M) for center in thin(level, 100)]
    scatter = [_plane_scatter(level[patch]) for patch in patches if len(patch) >= 30]
    return float(np.median(scatter)) if scatter else float("nan")


def _plane_scatter(points_m: FloatArray) -> float:
    """Standard deviation about a plane, from the median deviation: walls of tubes must not count."""
    kept = points_m
    for _ in range(4):
        normal, origin = fit_plane(kept)
        off = np.abs((points_m - origin) @ normal)
        kept = points_m[off <= np.percentile(off, 70)]
    return float(1.4826 * np.median(off))


def _extent_m(points_m: FloatArray) -> float:
    """Longest side of what nearly all points span, metres."""
    return float(np.ptp(np.percentile(points_m, [1, 99], axis=0), axis=0).max())


def unit_doubt(points_m: FloatArray) -> str:
    """Why a cloud's unit cannot be right, in words, whatever the rack; empty if it can."""
    extent_m = _extent_m(points_m)
    low_m, high_m = PLAUSIBLE_M
    if low_m < extent_m < high_m:
        return ""
    return (
        f"the points span {extent_m:.3g} m, {low_m:g} to {high_m:g} m expected: "
        "is the unit (m or mm) of the capture declared right (--unit)?"
    )


def plausible_unit_factors(points_m: FloatArray, rack: RackModel) -> tuple[float, ...]:
    """Factors by which a cloud could be too large (10, 1000) or too small (0.1, 0.001): a rack fits in, and no hall."""
    extent_m = _extent_m(points_m)
    smallest, largest = 0.8 * float(rack.outline_m.min()), 6.0
    return tuple(factor for factor in UNIT_FACTORS if smallest < extent_m / factor < largest)


def level_planes(points_m: FloatArray, config: RackTopConfig) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Normal (towards the camera at the origin) and a point of the dominant planes, largest first."""
    rest = points_m
    for _ in range(config.max_planes):
        if len(rest) < 100:
            return
        o3d.utility.random.seed(config.seed)
        _, inliers = to_o3d(rest).segment_plane(config.plane_distance_m, 3, config.plane_iterations)
        support = rest[inliers]
        if len(support) < 50:
            return
        normal, origin = fit_plane(support)
        yield normal, origin
        rest = np.delete(rest, inliers, axis=0)


def fit_plane(points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Least-squares plane of points (N, 3), camera frame, metres: unit normal towards the camera, and the centroid."""
    centroid = points_m.mean(axis=0)
    centred = points_m - centroid
    normal = np.linalg.eigh(centred.T @ centred)[1][:, 0]
    return (-normal if normal @ centroid > 0 else normal), centroid


def fullest_level(
    of: NDArray[np.intp], heights_m: FloatArray, count: int, window_m: float, lowest_m: float
) -> NDArray[np.intp]:
    """How many heights of every group lie at one level, shape (count,): the most in two neighbouring bins.

    Args:
        of: Group of each height, shape (N,), below `count`.
        heights_m: Heights, shape (N,), metres.
        count: Number of groups.
        window_m: Both bins together, metres.
        lowest_m: Where the first bin begins: no height is lower.
    """
    if len(of) == 0:
        return np.zeros(count, np.intp)
    level = np.floor((heights_m - lowest_m) / (window_m / 2)).astype(np.intp)
    width = int(level.max()) + 2
    counts = np.bincount(of * width + level, minlength=count * width).reshape(count, width)
    return np.asarray((counts[:, :-1] + counts[:, 1:]).max(axis=1), np.intp)
