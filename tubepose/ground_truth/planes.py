"""Planes: segmentation by RANSAC, least squares, and a frame on a plane."""

from __future__ import annotations

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from tubepose.transforms import FloatArray, make_transform

_BIN_M = 1e-3
_BINS = 12


def segment_plane(
    points_m: FloatArray, distance_m: float, iterations: int, seed: int
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Largest plane of points (N, 3) by RANSAC: the frame on it (see `plane_frame`) and its inliers, shape (N,).

    The plane is refined by least squares until its inliers stay the same, so that it does not depend on the draw.
    """
    o3d.utility.random.seed(seed)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(points_m)))
    _, rows = cloud.segment_plane(distance_threshold=distance_m, ransac_n=3, num_iterations=iterations)
    inliers = np.zeros(len(points_m), dtype=bool)
    inliers[rows] = True
    for _ in range(20):
        T_camera_plane = plane_frame(points_m[inliers])
        found = np.abs(plane_heights(T_camera_plane, points_m)) <= distance_m
        if found.sum() < 3 or np.array_equal(found, inliers):
            break
        inliers = found
    return plane_frame(points_m[inliers]), inliers


def plane_frame(points_m: FloatArray) -> FloatArray:
    """Frame (4, 4) on the least-squares plane of points (N, 3): origin at their mean, z towards the camera, metres."""
    mean = points_m.mean(axis=0)
    _, _, directions = np.linalg.svd(np.cov((points_m - mean).T))
    normal = directions[2] if directions[2] @ mean < 0 else -directions[2]
    return make_transform(frame_about(normal), mean)


def frame_about(normal: FloatArray) -> FloatArray:
    """A rotation (3, 3) whose third column is the given unit normal and whose first lies near the camera's x axis."""
    helper = np.eye(3)[0] if abs(normal[0]) < 0.9 else np.eye(3)[1]
    x = helper - (helper @ normal) * normal
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(normal, x), normal])


def plane_heights(T_camera_plane: FloatArray, points_m: FloatArray) -> FloatArray:
    """Signed distances of points (..., 3) to the x-y plane of a frame, metres, positive along its z; NaN stays NaN."""
    normal = T_camera_plane[:3, 2]
    return np.asarray(points_m @ normal - T_camera_plane[:3, 3] @ normal)


def tilt_std_rad(xy_m: FloatArray, heights_m: FloatArray) -> float:
    """Standard deviation of a plane's direction, both axes together, radians.

    The error of one point is partly its own and partly shared with its neighbours; the shared part does not average
    out. Its covariance by distance is read from the residuals, up to where it first vanishes.

    Args:
        xy_m: Points on the plane, shape (N, 2), metres.
        heights_m: Their residuals, shape (N,), metres.
    """
    if len(xy_m) < 2 * _BINS:
        return float("nan")
    thin = slice(None, None, max(1, len(xy_m) // 400))
    distances, shared = _shared_covariance(xy_m[thin], heights_m[thin])
    own = max(float(np.mean(heights_m**2)) - shared[0], 0.0)
    slopes = np.linalg.pinv(xy_m - xy_m.mean(axis=0))
    thin_slopes = np.linalg.pinv(xy_m[thin] - xy_m[thin].mean(axis=0))
    steps = np.arange(len(shared)) * _BIN_M
    covariance = own * slopes @ slopes.T + thin_slopes @ np.interp(distances, steps, shared, right=0.0) @ thin_slopes.T
    return float(np.sqrt(max(np.trace(covariance), 0.0)))


def _shared_covariance(xy_m: FloatArray, heights_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Distances of all pairs (N, N), metres, and the covariance of residuals per distance bin, square metres."""
    distances = np.linalg.norm(xy_m[:, None] - xy_m[None], axis=2)
    products = np.outer(heights_m, heights_m)
    # Rounded, so that a value of the table stands at the middle of its bin; a point is no neighbour of itself.
    bins = np.round(distances / _BIN_M).astype(int)
    np.fill_diagonal(bins, _BINS)
    known = bins < _BINS
    sums = np.bincount(bins[known], products[known], _BINS)
    counts = np.bincount(bins[known], minlength=_BINS)
    shared = sums / np.maximum(counts, 1)
    if counts[0] < len(xy_m):
        shared[0] = shared[1]
    vanished = np.flatnonzero(shared <= 0)
    if len(vanished):
        shared[vanished[0] :] = 0.0
    return distances, shared
