"""Lines of sight of a frame in the rack's frame: where each crosses the rack's face, and where it ended."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.labware import RackModel
from tubepose.preprocessing import TALLEST_TUBE_M
from tubepose.transforms import FloatArray, invert_transform, transform_points

LEAST_CELL_M = 1.0e-3
"""Smallest cell, metres: an opening of 10 mm has some eighty, and finer ones tell nothing more."""
CELL_STEP_M = 2.5e-4
"""Cells come in steps of this, metres, so that frames of one camera share their grid."""


@dataclass(frozen=True, slots=True, eq=False)
class LinesOfSight:
    """Lines from the camera's centre through the pixels, or through the points, that look at a rack.

    Attributes:
        camera_m: Centre of the camera, rack frame, shape (3,), metres.
        crossing_m: Where each crosses the rack's face, shape (N, 2), rack frame, metres; NaN where it does not.
        end_m: The point that it returned, shape (N, 3), rack frame, metres; NaN where nothing came back.
        spacing_m: Distance of neighbouring lines at the face, metres.
    """

    camera_m: FloatArray
    crossing_m: FloatArray
    end_m: FloatArray
    spacing_m: float

    @property
    def cell_m(self) -> float:
        """Side of cells that hold one or more lines each wherever there are any, metres."""
        return float(np.ceil(max(LEAST_CELL_M, 2 * self.spacing_m) / CELL_STEP_M) * CELL_STEP_M)


def lines_of_sight(
    frame: RgbdFrame, intrinsics: CameraIntrinsics | None, T_camera_rack: FloatArray, rack: RackModel
) -> LinesOfSight:
    """All lines of sight that can tell something of a rack's slots.

    Every pixel of an organised frame is one, returned or not. Without pixels or intrinsics only the lines that
    returned something are known: those from the origin through the points.

    Args:
        frame: The frame.
        intrinsics: Of its pixels, where known.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
        rack: The rack.
    """
    T_rack_camera = invert_transform(T_camera_rack)
    if not frame.organised or intrinsics is None:
        directions = frame.measured_m
        return _lines(directions, np.ones(len(directions), bool), T_rack_camera, rack, None)
    cloud_m, rays, spacing_m = _part(frame, intrinsics, T_camera_rack, rack)
    measured = np.isfinite(cloud_m[:, 2])
    return _lines(np.where(measured[:, None], cloud_m, rays), measured, T_rack_camera, rack, spacing_m)


def _lines(
    directions: FloatArray,
    measured: np.ndarray,
    T_rack_camera: FloatArray,
    rack: RackModel,
    spacing_m: float | None,
) -> LinesOfSight:
    """Lines from the origin of the camera frame along directions (N, 3), which are the points where `measured`."""
    camera = T_rack_camera[:3, 3]
    turned = directions @ T_rack_camera[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (rack.height_m - camera[2]) / turned[:, 2]
        # A line that goes up, or a camera below the face, looks into no opening.
        down = (turned[:, 2] < 0) & (camera[2] > rack.height_m)
        crossing = np.where(down[:, None], camera[:2] + turned[:, :2] * along[:, None], np.nan)
    ends = np.where(measured[:, None], turned + camera, np.nan)
    if spacing_m is None:
        on_face = (np.abs(crossing) < rack.outline_m / 2).all(axis=1)
        spacing_m = float(np.sqrt(np.prod(rack.outline_m) / max(int(on_face.sum()), 1)))
    return LinesOfSight(camera, crossing, ends, spacing_m)


def _part(
    frame: RgbdFrame, intrinsics: CameraIntrinsics, T_camera_rack: FloatArray, rack: RackModel
) -> tuple[FloatArray, FloatArray, float]:
    """Cloud (N, 3), directions (N, 3) and spacing at the face of the pixels that look at a rack and what stands in it.

    Pixels are left out evenly where they lie closer than half a cell.
    """
    height, width = frame.cloud_m.shape[:2]
    half = rack.outline_m / 2
    levels = (rack.height_m, rack.height_m + TALLEST_TUBE_M)
    corners = np.array([[x * half[0], y * half[1], z] for x in (-1, 1) for y in (-1, 1) for z in levels])
    local = transform_points(T_camera_rack, corners)
    uv = intrinsics.project(local)
    left, top, right, bottom = 0, 0, width, height
    if np.isfinite(uv).all():
        low, high = np.floor(uv.min(axis=0)), np.ceil(uv.max(axis=0)) + 1
        left, right = np.clip([low[0], high[0]], 0, width).astype(int)
        top, bottom = np.clip([low[1], high[1]], 0, height).astype(int)
    cosine = max(abs(float(T_camera_rack[2, 2])), 0.1)
    farthest = max(float(local[:, 2].max()), 1e-3)
    native = farthest / min(intrinsics.fx, intrinsics.fy) / cosine
    step = max(1, int(LEAST_CELL_M / 2 / native))
    v, u = np.mgrid[top:bottom:step, left:right:step].reshape(2, -1)
    rays = np.column_stack([(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones(len(u))])
    return frame.cloud_m[top:bottom:step, left:right:step].reshape(-1, 3), rays, native * step
