"""Printed caps in a frame: candidates by height and connection, then plane and square of each (paper, section V-A)."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from tubepose.capture.frame import RgbdFrame
from tubepose.ground_truth.model import GroundTruthConfig
from tubepose.ground_truth.planes import plane_heights, segment_plane, tilt_std_rad
from tubepose.ground_truth.square import SquareFit, fit_square, point_spacing_m
from tubepose.transforms import FloatArray, invert_transform, make_transform, transform_points

Rows = NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Cap:
    """One measured square.

    Attributes:
        T_camera_square: Array of shape (4, 4): origin at the square's centre, z its normal, x along an edge, metres.
        plane_rms_m: RMS distance of its points to the plane, metres.
        icp_rms_m: RMS distance of its edge points to the template's edges, metres.
        coverage: Share of the square with points.
        loss_m: Missing width that stays unexplained, metres.
        n_points: Points that the plane was fitted to.
        tilt_std_rad: See `tubepose.ground_truth.model.TubeTruth`.
    """

    T_camera_square: FloatArray
    plane_rms_m: float
    icp_rms_m: float
    coverage: float
    loss_m: float
    n_points: int
    tilt_std_rad: float

    def refusal(self, config: GroundTruthConfig) -> str:
        """Why this square is no truth; empty when it is."""
        if self.n_points < config.min_points:
            return f"too few points: {self.n_points}, expected {config.min_points} or more"
        if not self.plane_rms_m <= config.max_plane_rms_m:
            return f"plane rms {self.plane_rms_m * 1e3:.2f} mm is above {config.max_plane_rms_m * 1e3:.2f} mm"
        if not self.coverage >= config.min_coverage:
            return f"coverage {self.coverage:.2f} of the square is below {config.min_coverage:.2f}"
        if not self.loss_m <= config.max_width_loss_m:
            return (
                f"the square is {self.loss_m * 1e3:.2f} mm too narrow and no neighbour explains it: an edge is hidden"
            )
        if not self.icp_rms_m <= config.max_icp_rms_m:
            return f"square icp rms {self.icp_rms_m * 1e3:.2f} mm is above {config.max_icp_rms_m * 1e3:.2f} mm"
        return ""


def find_caps(
    frame: RgbdFrame, T_camera_rack: FloatArray, band_m: tuple[float, float], side_m: float, config: GroundTruthConfig
) -> tuple[Cap, ...]:
    """All squares of a frame between two heights above the rack's base.

    Args:
        frame: The frame with printed caps.
        T_camera_rack: Array of shape (4, 4), metres; any of the rack's turns.
        band_m: Lowest and highest height of a square's points above the rack's base, metres.
        side_m: Side of the square, metres.
        config: Thresholds.
    """
    heights = plane_heights(T_camera_rack, frame.points_m)
    with np.errstate(invalid="ignore"):
        in_band = (heights >= band_m[0]) & (heights <= band_m[1])
        above = frame.points_m[heights >= band_m[0]]
    split = _split_organised if frame.organised else _split_unorganised
    caps = []
    for rows in split(frame, heights, in_band, config):
        for points in _split_merged(frame.points_m[rows], side_m, config):
            caps.append(_measure_cap(points, above, side_m, config))
    return tuple(caps)


def _split_organised(
    frame: RgbdFrame, heights_m: FloatArray, in_band: NDArray[np.bool_], config: GroundTruthConfig
) -> list[Rows]:
    """Connected pieces of the mask, cut at height steps, and where less than three pixels hold two pieces together."""
    shape = frame.cloud_m.shape[:2]
    mask = in_band.reshape(shape)
    height = _fill_pinholes(np.where(mask, heights_m.reshape(shape), np.nan))
    core = np.isfinite(height)
    with np.errstate(invalid="ignore"):
        down, right = (np.abs(np.diff(height, axis=axis)) > config.jump_m for axis in (0, 1))
    for near, far, step in ((core[:-1], core[1:], down), (core[:, :-1], core[:, 1:], right)):
        near &= ~step
        far &= ~step
    count, labels = cv2.connectedComponents(cv2.erode(core.astype(np.uint8), np.ones((3, 3), np.uint8)), connectivity=8)
    if count <= 1:
        return []
    cores, pixels = np.argwhere(labels > 0), np.argwhere(mask)
    distance, nearest = (np.asarray(found) for found in cKDTree(cores).query(pixels, distance_upper_bound=2.5))
    known = np.isfinite(distance)
    pixels, owners = pixels[known], cores[nearest[known]]
    # A pixel beyond a height step belongs to nobody: its nearest core may be the neighbour's.
    level = np.abs(height[tuple(pixels.T)] - height[tuple(owners.T)]) <= 2 * config.jump_m
    rows, label_of_row = pixels[:, 0] * shape[1] + pixels[:, 1], labels[tuple(owners.T)]
    return [rows[level & (label_of_row == label)] for label in range(1, count)]


def _fill_pinholes(height_m: FloatArray) -> FloatArray:
    """Fill single pixels in the middle of eight others: dropped pixels, but never the gap between two caps."""
    inside = height_m[1:-1, 1:-1]
    around = [np.roll(height_m, (v, u), axis=(0, 1))[1:-1, 1:-1] for v in (-1, 0, 1) for u in (-1, 0, 1) if v or u]
    filled = height_m.copy()
    filled[1:-1, 1:-1] = np.where(np.isnan(inside), np.mean(around, axis=0), inside)
    return filled


def _split_unorganised(
    frame: RgbdFrame, heights_m: FloatArray, in_band: NDArray[np.bool_], config: GroundTruthConfig
) -> list[Rows]:
    """Euclidean clusters: points closer than 1.6 spacings and without a height step belong together."""
    rows = np.flatnonzero(in_band)
    if len(rows) < config.min_points:
        return []
    points = frame.points_m[rows]
    tree = cKDTree(points)
    distances, _ = tree.query(points, k=[2])
    pairs = tree.query_pairs(1.6 * float(np.median(distances)), p=2.0, eps=0.0, output_type="ndarray")
    pairs = pairs[np.abs(np.diff(heights_m[rows][pairs], axis=1)[:, 0]) <= config.jump_m]
    graph = coo_array((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(len(rows), len(rows)))
    count, labels = connected_components(graph, directed=False)
    return [rows[labels == label] for label in range(count)]


def _split_merged(points_m: FloatArray, side_m: float, config: GroundTruthConfig) -> list[FloatArray]:
    """Cut a piece of several squares' area into that many: caps that nearly touch, in a coarse scan."""
    if len(points_m) < config.min_points // 2:
        return []
    count = round(len(points_m) * point_spacing_m(points_m) ** 2 / side_m**2)
    if count <= 1:
        return [points_m]
    _, label = kmeans2(points_m, count, minit="++", rng=config.seed)
    return [points_m[label == k] for k in range(count) if np.sum(label == k) >= config.min_points // 2]


def _measure_cap(points_m: FloatArray, above_m: FloatArray, side_m: float, config: GroundTruthConfig) -> Cap:
    """Plane by RANSAC and least squares, square by ICP, then the plane again without the square's border."""
    T_camera_plane, inliers = segment_plane(points_m, config.plane_distance_m, config.plane_iterations, config.seed)
    T_plane_camera = invert_transform(T_camera_plane)
    flat = transform_points(T_plane_camera, points_m)
    near = above_m[np.linalg.norm(above_m - T_camera_plane[:3, 3], axis=1) < 2 * side_m]
    near = transform_points(T_plane_camera, near)
    square = fit_square(flat[inliers, :2], near[near[:, 2] > config.higher_m, :2], side_m, config)
    in_square = np.max(np.abs(square.to_square(flat[:, :2])), axis=1) <= side_m / 2 - config.edge_inset_m
    top = flat[inliers & in_square]
    if len(top) < 4:
        return _no_cap(T_camera_plane)
    slopes, *_ = np.linalg.lstsq(np.column_stack([np.ones(len(top)), top[:, :2]]), top[:, 2], rcond=None)

    def heights(points: FloatArray) -> FloatArray:
        return np.asarray(points[:, 2] - slopes[0] - points[:, :2] @ slopes[1:])

    # The rms is taken over all points there, not over the inliers: a bent cap always has a flat part.
    all_heights = heights(flat[in_square])
    all_heights = all_heights[np.abs(all_heights) <= config.outlier_m]
    return Cap(
        T_camera_square=T_camera_plane @ _square_frame(square, slopes),
        plane_rms_m=float(np.sqrt(np.mean(all_heights**2))),
        icp_rms_m=square.icp_rms_m,
        coverage=square.coverage,
        loss_m=square.loss_m,
        n_points=len(top),
        tilt_std_rad=tilt_std_rad(top[:, :2], heights(top)),
    )


def _square_frame(square: SquareFit, slopes: FloatArray) -> FloatArray:
    """Frame of the square in the plane frame, from z = slopes[0] + slopes[1] x + slopes[2] y, shape (4, 4), metres."""
    normal = np.array([-slopes[1], -slopes[2], 1.0])
    normal /= np.linalg.norm(normal)
    x = np.array([np.cos(square.turn_rad), np.sin(square.turn_rad), 0.0])
    x -= (x @ normal) * normal
    x /= np.linalg.norm(x)
    center = np.array([*square.center_m, slopes[0] + square.center_m @ slopes[1:]])
    return make_transform(np.column_stack([x, np.cross(normal, x), normal]), center)


def _no_cap(T_camera_plane: FloatArray) -> Cap:
    nan = float("nan")
    return Cap(T_camera_plane, nan, nan, 0.0, nan, 0, nan)
