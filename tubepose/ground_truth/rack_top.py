"""The rack's top in a frame: its plane, its outline, and all turns that the outline allows."""

from __future__ import annotations

from collections.abc import Iterator

import cv2
import numpy as np
import open3d as o3d
from scipy.ndimage import map_coordinates
from scipy.optimize import least_squares

from tubepose.ground_truth.model import GroundTruthConfig
from tubepose.ground_truth.planes import frame_about, plane_frame, plane_heights, segment_plane
from tubepose.labware import RackModel
from tubepose.transforms import FloatArray, invert_transform, make_transform, transform_points, translation

_FIT_POINTS = 4000
_FIELD_STEP_M = 5e-4
_FIELD_MARGIN_M = 10e-3
# A point farther off the solid part pulls no more: it belongs to something else.
_CLIP_M = 3e-3
_ON_SOLID_M = 5e-4


def find_rack(points_m: FloatArray, rack: RackModel, config: GroundTruthConfig) -> FloatArray | None:
    """Pose of the rack up to its turn about z: T_camera_rack, shape (4, 4), metres; None when no such top is seen.

    Args:
        points_m: Valid points of the frame, shape (N, 3), camera frame, metres.
        rack: The rack that the session names.
        config: Thresholds.
    """
    field = _TopField(rack)
    best, best_share = None, config.min_on_solid
    for T_camera_level in _levels(points_m, rack, config):
        T_camera_top, xy = _refine_level(points_m, T_camera_level, config)
        if len(xy) < config.min_points:
            continue
        if best_share > config.sure_on_solid:
            break
        for start in _outline_starts(xy, rack, config):
            pose, share = _fit_outline(xy, field, start)
            if share > best_share:
                best_share = share
                best = T_camera_top @ _planar(pose, z_m=-rack.height_m)
    return best


def turns_of(T_camera_rack: FloatArray, rack: RackModel, config: GroundTruthConfig) -> tuple[FloatArray, ...]:
    """All poses that show the same outline: half turns, and quarter turns of a nearly square rack."""
    width, depth = rack.outline_m
    quarters = (0, 1, 2, 3) if abs(width - depth) < config.outline_excess_m else (0, 2)
    return tuple(T_camera_rack @ _planar(np.array([0.0, 0.0, quarter * np.pi / 2])) for quarter in quarters)


def _planar(pose: FloatArray, z_m: float = 0.0) -> FloatArray:
    """Transform (4, 4) of a pose (x, y, turn) in a plane, metres and radians."""
    (x_m, y_m), c, s = pose[:2], np.cos(pose[2]), np.sin(pose[2])
    return make_transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([x_m, y_m, z_m]))


def _levels(points_m: FloatArray, rack: RackModel, config: GroundTruthConfig) -> Iterator[FloatArray]:
    """Planes that may be the rack's top: the dominant ones, and what lies one rack above each (it may be the table)."""
    rest = points_m[:: max(1, len(points_m) // config.level_points)]
    for _ in range(config.level_planes):
        if len(rest) < config.min_points:
            return
        T_camera_plane, inliers = segment_plane(rest, config.level_distance_m, 1000, config.seed)
        yield T_camera_plane
        yield T_camera_plane @ translation([0.0, 0.0, rack.height_m])
        rest = rest[~inliers]


def _refine_level(
    points_m: FloatArray, T_camera_level: FloatArray, config: GroundTruthConfig
) -> tuple[FloatArray, FloatArray]:
    """The level's frame moved onto its points by least squares, and those points without loners, shape (N, 2)."""
    for _ in range(3):
        band = points_m[np.abs(plane_heights(T_camera_level, points_m)) <= config.top_band_m]
        if len(band) < config.min_points:
            return T_camera_level, np.empty((0, 2))
        fitted = plane_frame(band)
        T_camera_level = make_transform(frame_about(fitted[:3, 2]), fitted[:3, 3])
    band = points_m[np.abs(plane_heights(T_camera_level, points_m)) <= config.top_band_m]
    flat = transform_points(invert_transform(T_camera_level), band)
    return T_camera_level, _without_loners(flat)[:, :2]


def _without_loners(points_m: FloatArray) -> FloatArray:
    """Points that have company within three spacings: mixed pixels beside the rack would stretch the outline."""
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m[:: max(1, len(points_m) // 40_000)]))
    spacing = float(np.median(np.asarray(cloud.compute_nearest_neighbor_distance())))
    kept, _ = cloud.remove_radius_outlier(nb_points=6, radius=3 * spacing)
    return np.asarray(kept.points)


def _outline_starts(xy_m: FloatArray, rack: RackModel, config: GroundTruthConfig) -> Iterator[FloatArray]:
    """Starts (x, y, turn) of the outline fit from the smallest rectangle; none if its size is not the rack's.

    A side may be short by a shadow: then the outline starts flush with either end.
    """
    if len(xy_m) < 4:
        return
    (u, v), size_mm, angle_deg = cv2.minAreaRect((xy_m * 1e3).astype(np.float32))
    for turn_deg, seen_mm in ((angle_deg, size_mm), (angle_deg + 90, size_mm[::-1])):
        short = rack.outline_m - np.array(seen_mm) * 1e-3
        if np.any(short < -config.outline_excess_m) or np.any(short > config.outline_loss_m):
            continue
        turn = np.deg2rad(turn_deg)
        axes = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        shifts = [(-s / 2, 0.0, s / 2) if s > config.top_band_m else (0.0,) for s in short]
        for along_x in shifts[0]:
            for along_y in shifts[1]:
                x, y = np.array([u, v]) * 1e-3 + np.array([along_x, along_y]) @ axes
                yield np.array([x, y, turn])


class _TopField:
    """Distance to the solid part of the defined top, tabulated: the fit asks for it a thousand times."""

    def __init__(self, rack: RackModel) -> None:
        self._low_m = -rack.outline_m / 2 - _FIELD_MARGIN_M
        steps = [np.arange(low, -low, _FIELD_STEP_M) for low in self._low_m]
        self._table_m = rack.top_signed_distance_m(np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1))

    def distances_m(self, xy_m: FloatArray, pose: FloatArray) -> FloatArray:
        """Signed distances of points (N, 2) to the top at a pose (x, y, turn), negative on the solid, metres."""
        T = _planar(pose)
        at = ((xy_m - T[:2, 3]) @ T[:2, :2] - self._low_m) / _FIELD_STEP_M
        return np.asarray(map_coordinates(self._table_m, at.T, order=1, mode="nearest"))


def _fit_outline(xy_m: FloatArray, field: _TopField, start: FloatArray) -> tuple[FloatArray, float]:
    """Move the defined top until the points lie on its solid part; also the share of points that do.

    Points need not cover the top: shadows take parts of it, but put no point outside it.
    """
    sample = xy_m[:: max(1, len(xy_m) // _FIT_POINTS)]

    def residuals(pose: FloatArray) -> FloatArray:
        return np.asarray(np.clip(field.distances_m(sample, pose), 0.0, _CLIP_M)) / _CLIP_M

    found = least_squares(residuals, start, x_scale=(1e-3, 1e-3, 1e-2), diff_step=[1e-5] * 3, max_nfev=25)
    return found.x, float(np.mean(field.distances_m(sample, found.x) < _ON_SOLID_M))
