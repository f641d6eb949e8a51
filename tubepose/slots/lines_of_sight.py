"""Lines of sight of a frame, followed to their ends: by pixels, or through the points of a cloud without pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.labware import RackModel
from tubepose.preprocessing import TALLEST_TUBE_M, thin
from tubepose.rack.fit import laid_flat
from tubepose.slots.cells import OpeningCells, empty_height_m, opening_cells
from tubepose.slots.sight_kernels import KINDS, PASSED, Heights, Pixels, follow_lines
from tubepose.transforms import FloatArray, invert_transform, parts, transform_points

LEAST_CELL_M = 1.0e-3
"""Smallest cell, metres: an opening of 10 mm has some eighty, and finer ones tell nothing more."""
CELL_STEP_M = 2.5e-4
"""Cells come in steps of this, metres, so that frames of one camera share their grid."""
SPACINGS = 1.5
"""Side of a cell in spacings of the lines: more than sqrt(2), so that none is without a line, whatever their turn."""
SAMPLE = 20_000
"""Points that tell how dense a cloud without pixels is."""
BOW_M = 2.5e-3
"""How far a rack's face may bow off its plane where its bow is not known, metres: real plastic racks."""
FACE_M = 1.0e-3
"""The same where it is known: the bow of higher order, and rounded ribs."""


@dataclass(frozen=True, slots=True, eq=False)
class FollowedLines:
    """What became of the lines of sight that cross a rack's face.

    Attributes:
        camera_m: Centre of the camera, rack frame, shape (3,), metres.
        cells: The grid on the face.
        kinds: Share of every opening cell's lines per kind (`sight_kernels`), shape (C, 6); zeros without a line.
        passing: Share of every grid place's lines that ended at the face or below it, shape (X, Y): on a rib, in a slot
            as an empty one returns it, on the table.
        highest_m: Height of the highest point above the face over each opening cell, seen along the rack's normal,
            shape (C,), metres; NaN without one.
        in_image: Which opening cells lie inside the image, shape (C,); all of a cloud without pixels.
    """

    camera_m: FloatArray
    cells: OpeningCells
    kinds: FloatArray
    passing: FloatArray
    highest_m: FloatArray
    in_image: NDArray[np.bool_]


def follow_sight(
    frame: RgbdFrame,
    intrinsics: CameraIntrinsics | None,
    T_camera_rack: FloatArray,
    rack: RackModel,
    depth_std_m: float,
    bow_m: FloatArray | None = None,
) -> FollowedLines | None:
    """Follow every line of sight that can tell something of a rack's slots.

    Every pixel of an organised frame is one, returned or not. Without pixels or intrinsics only the lines that
    returned something are known: those from the origin through the points.

    Args:
        frame: The frame.
        intrinsics: Of its pixels, where known.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
        rack: The rack.
        depth_std_m: Standard deviation of a point's depth, metres.
        bow_m: Bow of the rack's face, shape (3,), metres: points are laid flat by it. None where it is not known.

    Returns:
        What became of them; None where the camera is not above the rack's face.
    """
    rotation, camera_m = parts(invert_transform(T_camera_rack))
    if camera_m[2] <= rack.height_m:
        return None
    if frame.organised and intrinsics is not None:
        pixels, spacing_m = _pixels(frame, intrinsics, T_camera_rack, rack)
    else:
        measured_m = frame.measured_m
        pixels = Pixels(np.ascontiguousarray(measured_m[None]), (0, 0), 1, (0.0, 0.0, 0.0, 0.0))
        spacing_m = _spacing_m(measured_m, rotation, camera_m, rack)
        intrinsics = None
    if bow_m is not None and bow_m.any():
        flat_m = laid_flat(pixels.cloud_m.reshape(-1, 3), T_camera_rack, bow_m, rack)
        pixels = pixels._replace(cloud_m=flat_m.reshape(pixels.cloud_m.shape))
    cells = opening_cells(rack, _cell_m(spacing_m))
    empty_m = np.full(cells.cell.shape, np.nan)
    empty_m[cells.cell >= 0] = empty_height_m(cells, rack, camera_m)
    band_m = (BOW_M if bow_m is None else FACE_M) + 3 * depth_std_m
    heights = Heights(rack.height_m, band_m, band_m + 2e-3 * rack.floor_tolerance_mm)
    counts, highest_m = follow_lines(
        pixels, rotation, camera_m, heights, cells.low_m, cells.cell_m, cells.owner, empty_m
    )  # fmt: skip
    number = np.maximum(counts @ np.ones(KINDS), 1)
    openings = cells.cell >= 0
    kinds = counts[openings] / number[openings][:, None]
    in_image = np.ones(len(cells.slot), bool)
    if intrinsics is not None:
        in_image = _inside_image(cells, rack, intrinsics, T_camera_rack)
    return FollowedLines(camera_m, cells, kinds, counts[..., PASSED] / number, highest_m[openings], in_image)


def _cell_m(spacing_m: float) -> float:
    return float(np.ceil(max(LEAST_CELL_M, SPACINGS * spacing_m) / CELL_STEP_M) * CELL_STEP_M)


def _pixels(
    frame: RgbdFrame, intrinsics: CameraIntrinsics, T_camera_rack: FloatArray, rack: RackModel
) -> tuple[Pixels, float]:
    """Pixels that look at a rack and what stands in it, and their distance at the face, metres.

    Pixels are left out evenly where they lie closer than cells ask for.
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
        left, right = np.clip([low[0], high[0]], 0, width).astype(int).tolist()
        top, bottom = np.clip([low[1], high[1]], 0, height).astype(int).tolist()
    # Pixels lie apart by this on a face that is seen at this slant; at grazing sight nothing is seen of openings.
    slant = max(abs(float(T_camera_rack[2, 2])), 0.1)
    native_m = max(float(local[:, 2].max()), 1e-3) / min(intrinsics.fx, intrinsics.fy) / slant
    step = max(1, int(LEAST_CELL_M / SPACINGS / native_m))
    camera_px = (float(intrinsics.fx), float(intrinsics.fy), float(intrinsics.cx), float(intrinsics.cy))
    return Pixels(frame.cloud_m[top:bottom, left:right], (left, top), step, camera_px), native_m * step


def _spacing_m(points_m: FloatArray, rotation: FloatArray, camera_m: FloatArray, rack: RackModel) -> float:
    """Distance of neighbouring lines through points (N, 3), camera frame, at the rack's face, metres."""
    some = thin(points_m, SAMPLE) @ rotation.T
    with np.errstate(divide="ignore", invalid="ignore"):
        along = (rack.height_m - camera_m[2]) / some[:, 2]
        crossing = camera_m[:2] + some[:, :2] * along[:, None]
        on_face = (some[:, 2] < 0) & (np.abs(crossing) < rack.outline_m / 2).all(axis=1)
    count = max(float(on_face.sum()) * len(points_m) / max(len(some), 1), 1.0)
    return float(np.sqrt(np.prod(rack.outline_m) / count))


def _inside_image(
    cells: OpeningCells, rack: RackModel, intrinsics: CameraIntrinsics, T_camera_rack: FloatArray
) -> NDArray[np.bool_]:
    """Which opening cells lie inside the image, shape (C,)."""
    points = np.column_stack([cells.center_m, np.full(len(cells.slot), rack.height_m)])
    uv = intrinsics.project(transform_points(T_camera_rack, points))
    with np.errstate(invalid="ignore"):
        return np.asarray(
            (uv > -0.5).all(axis=1) & (uv < [intrinsics.width - 0.5, intrinsics.height - 0.5]).all(axis=1)
        )
