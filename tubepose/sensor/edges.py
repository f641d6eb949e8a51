"""Blur of depth edges, at the outline of the rack: how many pixels lie between its top and the table."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.labware import RackModel
from tubepose.sensor.surfaces import CLIP, LevelSurface
from tubepose.transforms import FloatArray, invert_transform, transform_points

PER_SIDE = 60
"""Lines across a side: as many as there are slots' openings, several times over."""
CORNER_M = 5e-3
"""A line stays this far from the corners, which are round."""
INSIDE_M = 3e-3
"""How far a line begins inside the outline: outlines of racks are wider than this before the first opening."""
REACH_PX = 40
"""How far a line goes out: more than the windows of stereo cameras (REAL ramps: 8 to 17 px)."""
FLAT_SHARE = 0.04
"""A point this near to a flat side, as a share of the step, is on it: less than a pixel of a ramp 17 px wide."""
LEAST_LINES = 20
"""With fewer lines the middle half has no mean."""


@dataclass(frozen=True, slots=True)
class EdgeBlur:
    """Blur of depth edges.

    Attributes:
        blur_px: Mean of the middle half of the counts of valid pixels between the two flat sides.
        std_px: Standard deviation of that mean.
        n_lines: Lines that were counted.
    """

    blur_px: float
    std_px: float
    n_lines: int


def edge_blur(
    frame: RgbdFrame,
    camera: CameraIntrinsics,
    T_camera_rack: FloatArray,
    rack: RackModel,
    table: LevelSurface,
    top_std_m: float,
) -> EdgeBlur | None:
    """Count valid pixels between the rack's top and the table, on lines across those sides whose wall is not seen.

    Args:
        frame: An organised frame.
        camera: Its intrinsics.
        T_camera_rack: Pose of the rack, shape (4, 4), metres.
        rack: The rack.
        table: The level surface beside it.
        top_std_m: Standard deviation of the points of the rack's top.

    Returns:
        None where fewer than `LEAST_LINES` lines show both sides.
    """
    T_rack_camera = invert_transform(T_camera_rack)
    starts, ends = _lines(rack, T_rack_camera[:3, 3])
    if not len(starts):
        return None
    pixels, inside = _pixels(camera.project(transform_points(T_camera_rack, np.stack([starts, ends]))))
    seen = (pixels >= 0).all(axis=-1) & (pixels[..., 0] < camera.width) & (pixels[..., 1] < camera.height)
    u, v = np.where(seen, pixels[..., 0], 0), np.where(seen, pixels[..., 1], 0)
    points = np.where(seen[..., None], frame.cloud_m[v, u], np.nan)
    local = transform_points(T_rack_camera, points)
    counts = _between(local, inside, table, max(top_std_m, table.std_m))
    found = np.isfinite(counts)
    if np.count_nonzero(found) < LEAST_LINES:
        return None
    blur = np.sort(counts[found])
    middle = blur[len(blur) // 4 : len(blur) - len(blur) // 4]
    return EdgeBlur(float(middle.mean()), float(blur.std() / np.sqrt(len(blur))), len(blur))


def _lines(rack: RackModel, camera_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (L, 3) on the outline, and 1 mm farther out, of sides that the camera is inside of: no wall is seen."""
    half = rack.outline_m / 2
    starts, ends = [], []
    for axis in (0, 1):
        for sign in (-1.0, 1.0):
            reach = half[1 - axis] - CORNER_M
            if sign * camera_m[axis] >= half[axis] or reach <= 0:
                continue
            place = np.full((PER_SIDE, 3), rack.height_m)
            place[:, axis] = sign * half[axis]
            place[:, 1 - axis] = np.linspace(-reach, reach, PER_SIDE)
            starts.append(place)
            ends.append(place + sign * 1e-3 * np.eye(3)[axis])
    empty = np.empty((0, 3))
    return np.concatenate([empty, *starts]), np.concatenate([empty, *ends])


def _pixels(ends_px: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pixels (L, S, 2) of lines, one step of their longer axis apart: so a square window counts the same at any angle.

    Returns:
        The pixels, from `INSIDE_M` inside of the outline, and the number of the step (L,) at which each crosses it.
    """
    start, across = ends_px[0], ends_px[1] - ends_px[0]
    length = np.linalg.norm(across, axis=1)
    direction = across / length[:, None]
    stretch = np.abs(direction).max(axis=1)
    inside = np.ceil(INSIDE_M / 1e-3 * length * stretch).astype(int)
    steps = np.arange(int(inside.max()) + REACH_PX)[None, :] - inside[:, None]
    places = start[:, None] + steps[..., None] * (direction / stretch[:, None])[:, None]
    return np.nan_to_num(np.rint(places), nan=-1).astype(np.intp), inside


def _between(local_m: FloatArray, inside: NDArray[np.intp], table: LevelSurface, std_m: float) -> FloatArray:
    """Valid pixels (L,) after the last one of the top and before the first one of the table; NaN without both."""
    height, order = local_m[..., 2], np.arange(local_m.shape[1])[None]
    valid = np.isfinite(height)
    within = valid & (order < inside[:, None])
    # An opening or a blurred pixel may be among those within: the higher ones are the top.
    falling = -np.sort(-np.where(within, height, -np.inf), axis=1)
    top = np.take_along_axis(falling, within.sum(axis=1)[:, None] // 4, axis=1)
    with np.errstate(invalid="ignore"):
        level = table.height_m(local_m[..., :2])
        near = np.maximum(CLIP * std_m, FLAT_SHARE * (top - level))
        on_table = valid & (np.abs(height - level) < near)
        first = np.argmax(on_table, axis=1)[:, None]
        on_top = valid & (height > top - near) & (order < first)
    last = len(order[0]) - 1 - np.argmax(on_top[:, ::-1], axis=1)[:, None]
    counts = np.sum(valid & (order > last) & (order < first), axis=1).astype(float)
    whole = on_table.any(axis=1) & on_top.any(axis=1) & (within.sum(axis=1) >= 2)
    return np.where(whole, counts, np.nan)
