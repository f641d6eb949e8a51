"""One frame of a recorded capture, whatever it was recorded with (paper, assumption 3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.transforms import FloatArray

MOST_PIXELS = 1 << 26
"""No camera of racks has more; a file of a few bytes can claim any number."""
NEAREST_FOCAL, FARTHEST_FOCAL = 0.05, 1000.0
"""Focal lengths of pinhole cameras, as shares of the picture's longer side: 169 to 0.06 degrees."""


@dataclass(frozen=True, slots=True)
class CameraIntrinsics:
    """Pinhole camera without distortion, pixels; pixel centres are at whole numbers.

    Attributes:
        width: Image width in pixels.
        height: Image height in pixels.
        fx: Focal length along u.
        fy: Focal length along v.
        cx: Principal point, u.
        cy: Principal point, v.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    def project(self, points_m: FloatArray) -> FloatArray:
        """Project camera-frame points (..., 3) in metres to pixels (..., 2); NaN behind the camera."""
        points = np.asarray(points_m, dtype=float)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.where(points[..., 2] > 0, points[..., 2], np.nan)
            u = self.fx * points[..., 0] / z + self.cx
            v = self.fy * points[..., 1] / z + self.cy
        return np.stack([u, v], axis=-1)

    def rays(self) -> FloatArray:
        """Direction of every pixel with z = 1, camera frame, shape (H, W, 3)."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        return np.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy, np.ones(u.shape)], axis=-1)

    def backproject(self, depth_m: FloatArray) -> FloatArray:
        """Organised cloud (H, W, 3) in metres from a depth image (H, W) in metres; NaN depth gives NaN points."""
        return np.asarray(self.rays() * np.asarray(depth_m, dtype=float)[..., None])

    @property
    def fault(self) -> str:
        """What cannot be of these numbers, in words; empty where a camera can have them."""
        side = max(self.width, self.height)
        if not 0 < self.width * self.height <= MOST_PIXELS:
            return f"{self.width} x {self.height} pixels; expected at most {MOST_PIXELS} in all"
        for name, value in (("fx", self.fx), ("fy", self.fy)):
            if not NEAREST_FOCAL * side <= value <= FARTHEST_FOCAL * side:
                return f"{name} {value:g} for a picture of {side} pixels; expected a focal length in pixels"
        for name, value in (("cx", self.cx), ("cy", self.cy)):
            if not abs(value) <= FARTHEST_FOCAL * side:
                return f"{name} {value:g} for a picture of {side} pixels; expected the principal point in pixels"
        return ""


@dataclass(frozen=True, slots=True, eq=False)
class Averaging:
    """What a frame was fused of.

    Attributes:
        n_frames: Frames that were read.
        left_out: Numbers of those that show something else and are not in it.
        reason_code: Why they are not: ``scene_moved``, ``camera_moved``, or empty if none is left out.
        counts: Frames with depth at each pixel, shape (H, W).
    """

    n_frames: int
    left_out: tuple[int, ...]
    reason_code: str
    counts: NDArray[np.uint16]


@dataclass(frozen=True, slots=True, eq=False)
class RgbdFrame:
    """Image and cloud of one moment.

    Attributes:
        cloud_m: Array of shape (H, W, 3), camera frame (x right, y down, z forward), metres; NaN for an invalid pixel.
            An unorganised cloud has shape (1, N, 3) and `organised` False.
        image: Array of shape (H, W) or (H, W, 3), uint8, RGB order, pixel to pixel with the cloud, or None.
        intrinsics: Of the image that the cloud is organised by, where known.
        timestamp_ns: Integer nanoseconds, or None.
        capture: Name of the capture, as the tables show it.
        index: Number of the frame in its capture.
        organised: Whether neighbouring pixels are neighbours in space.
        sensor: What recorded it, as far as is known.
        simulated: True when the capture says that it is simulated.
        averaging: What it was fused of; None for a frame as it was recorded.
        notes: What was passed over or taken for granted when it was read, in words.
    """

    cloud_m: FloatArray
    image: NDArray[np.uint8] | None
    intrinsics: CameraIntrinsics | None
    timestamp_ns: int | None
    capture: str
    index: int = 0
    organised: bool = True
    sensor: str = "unknown"
    simulated: bool = False
    averaging: Averaging | None = None
    notes: tuple[str, ...] = ()

    @property
    def points_m(self) -> FloatArray:
        """The cloud flattened to (H * W, 3); row v * W + u is pixel (u, v). Invalid points stay, as NaN."""
        return self.cloud_m.reshape(-1, 3)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Which rows of `points_m` are measured, shape (H * W,)."""
        return np.isfinite(self.points_m[:, 2])

    @property
    def measured_m(self) -> FloatArray:
        """The valid points, shape (N, 3)."""
        return finite_points(self.cloud_m)


def finite_points(cloud_m: FloatArray) -> FloatArray:
    """The measured points of a part of an organised cloud (H, W, 3), row by row, shape (N, 3), metres."""
    if cloud_m.strides[2] != cloud_m.itemsize:
        cloud_m = np.ascontiguousarray(cloud_m)
    # A point is copied as one thing, which is sooner done than number by number.
    whole = cloud_m.view(np.dtype((np.void, 3 * cloud_m.itemsize)))[..., 0]
    return np.asarray(whole[np.isfinite(cloud_m[..., 2])].view(cloud_m.dtype).reshape(-1, 3))
