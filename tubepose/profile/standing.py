"""What stands above a rack's top, in the rack's frame, with the place of the camera that saw it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.labware import RackModel
from tubepose.profile.kernels import points_over
from tubepose.transforms import FloatArray, invert_transform, parts, transform_points

OUTSIDE_M = 0.012
"""A cap of a leaning tube in an outer slot reaches this far over the rack's outline."""


@dataclass(frozen=True, slots=True, eq=False)
class Standing:
    """Points above a rack's top.

    Attributes:
        points_m: Array of shape (N, 3), rack frame, metres.
        camera_m: Place of the camera, rack frame, shape (3,), metres: every point was seen along a line from there.
    """

    points_m: FloatArray
    camera_m: FloatArray

    def on_level(self, height_m: float | FloatArray, points_m: FloatArray | None = None) -> FloatArray:
        """Where the lines of sight of points (N, 3) cross a level plane, shape (N, 2), rack frame, metres.

        A point's direction is known far better than its depth: light that comes out of plastic below its surface gives
        a point that is too deep, on the right line.

        Args:
            height_m: Height of the plane above the rack's base, one for all points or one each.
            points_m: Other points than those of this object.
        """
        p = self.points_m if points_m is None else points_m
        along = (height_m - self.camera_m[2]) / (p[:, 2] - self.camera_m[2])
        return np.asarray(self.camera_m[:2] + (p[:, :2] - self.camera_m[:2]) * along[:, None])

    def take(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> Standing:
        """The same of some of the points."""
        return Standing(self.points_m[keep], self.camera_m)


def gather_standing(
    frame: RgbdFrame,
    intrinsics: CameraIntrinsics | None,
    T_camera_rack: FloatArray,
    rack: RackModel,
    lowest_m: float,
    highest_m: float,
) -> Standing:
    """Points of a frame over a rack's outline, between two heights above its base.

    Args:
        frame: The frame.
        intrinsics: Of its image; only the rack's part of an organised cloud is then read.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
        rack: The rack.
        lowest_m: Least height, metres.
        highest_m: Most height, metres.
    """
    T_rack_camera = invert_transform(T_camera_rack)
    height, width = frame.cloud_m.shape[:2]
    half = rack.outline_m / 2 + OUTSIDE_M
    left, top, right, bottom = 0, 0, width, height
    if frame.organised and intrinsics is not None:
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (lowest_m, highest_m)])
        corners[:, :2] *= half
        uv = intrinsics.project(transform_points(T_camera_rack, corners))
        if np.isfinite(uv).all():
            low, high = np.floor(uv.min(axis=0)).astype(int), np.ceil(uv.max(axis=0)).astype(int) + 1
            left, right = np.clip([low[0], high[0]], 0, width)
            top, bottom = np.clip([low[1], high[1]], 0, height)
    points = points_over(frame.cloud_m[top:bottom, left:right], *parts(T_rack_camera), lowest_m, highest_m, half)
    return Standing(points, T_rack_camera[:3, 3])
