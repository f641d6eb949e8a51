"""The structured-light camera: geometry, noise, phase decoding, triangulation. Shared by every simulated sensor.

Light transport is linear, so a sensor only has to deliver, per pixel, the sums over all light paths of
``a * [1, cos(2 pi u / p), sin(2 pi u / p)]`` with the amplitude ``a`` and projector column ``u`` of each path, for
three periods ``p``. Any phase-shift image sequence follows from these sums; what is decoded from them is the scan.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.transforms import FloatArray

Float32Array = NDArray[np.float32]

PERIODS = (1024.0, 128.0, 16.0)
FULL_RESOLUTION = 1376
FULL_FOCAL_PX = 1564.0
MIN_BLUR_PX = 0.4
IMAGE_GAIN = 0.75
CHANNELS = 2 + 2 * len(PERIODS)
"""Rows of a sum image: projected light, room light, then cosine and sine of each period."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Imperfections of the camera. All numbers are assumptions; docs/simulation.md says what they were compared with.

    Attributes:
        blur_px: Standard deviation of the lens blur at 1376 pixels; it mixes the two sides of an edge.
        read: Standard deviation of the noise of a dark pixel, in units of a white surface's return.
        shot: Variance of the noise per unit of light.
        room_light: Room light on a white surface, in the same unit.
        smooth_depth_m: Standard deviation of the depth error that neighbouring pixels share.
        smooth_length_m: Distance at which that error's correlation has fallen to 1/e, at the working distance.
        min_modulation: A weaker pattern is not decoded.
        max_phase_jump: Largest disagreement of neighbouring periods, as a share of the finer period.
    """

    blur_px: float = 1.0
    read: float = 0.003
    shot: float = 0.8e-4
    room_light: float = 0.15
    smooth_depth_m: float = 2.0e-5
    smooth_length_m: float = 3.0e-3
    min_modulation: float = 0.03
    max_phase_jump: float = 0.35


NO_NOISE = NoiseModel(blur_px=0.0, read=0.0, shot=0.0, smooth_depth_m=0.0)


@dataclass(frozen=True, slots=True)
class StructuredLightCamera:
    """Camera at the origin, and a projector beside it along x that is aimed at the work volume.

    Attributes:
        intrinsics: Pinhole of the camera.
        baseline_m: Distance of camera and projector.
        working_distance_m: The projector's axis crosses the camera's axis here.
        projector_half_field: Tangent of half the projector's field.
        depth_range_m: Points nearer or farther than this are not reported.
        noise: The camera's imperfections.
    """

    intrinsics: CameraIntrinsics
    baseline_m: float = 0.27
    working_distance_m: float = 0.65
    projector_half_field: float = 0.5
    depth_range_m: tuple[float, float] = (0.35, 1.1)
    noise: NoiseModel = NoiseModel()

    @property
    def projector_m(self) -> FloatArray:
        """Place of the projector, camera frame, shape (3,)."""
        return np.array([self.baseline_m, 0.0, 0.0])

    @property
    def projector_axes(self) -> FloatArray:
        """Unit x and z axes of the projector as rows, camera frame, shape (2, 3)."""
        z = np.array([-self.baseline_m, 0.0, self.working_distance_m])
        z /= np.linalg.norm(z)
        return np.array([[z[2], 0.0, -z[0]], z])

    @property
    def columns_per_tangent(self) -> float:
        """Projector columns per unit of tangent."""
        return PERIODS[0] / 2 / self.projector_half_field

    def column(self, points_m: FloatArray) -> FloatArray:
        """Projector column that lights points (..., 3) along a straight line; NaN outside the projector's field."""
        x, z = np.moveaxis((points_m - self.projector_m) @ self.projector_axes.T, -1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            column = PERIODS[0] / 2 + self.columns_per_tangent * x / z
        return np.asarray(np.where((z > 0) & (column >= 0) & (column < PERIODS[0]), column, np.nan))

    def triangulate(self, column: FloatArray | Float32Array) -> FloatArray:
        """Depth (H, W) in metres where each pixel's ray meets the plane of its column; NaN stays NaN."""
        tangent = (np.asarray(column, dtype=float) - PERIODS[0] / 2) / self.columns_per_tangent
        x, z = self.projector_axes
        k = self.intrinsics
        ray_x = (np.arange(k.width) - k.cx) / k.fx
        # The plane holds the projector's y axis, which is the camera's: the ray's y does not matter.
        across = (x[0] - tangent * z[0]) * ray_x[None, :] + x[2] - tangent * z[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray((x[0] - tangent * z[0]) * self.baseline_m / across)

    def expose(self, sums: Float32Array, rng: np.random.Generator) -> Float32Array:
        """What the camera records of ideal sums of shape (CHANNELS, H, W): blurred, then with shot and read noise."""
        noise = self.noise
        seen = sums.copy()
        if noise.blur_px > 0:
            # A coarser image is the same camera with larger pixels.
            sigma_px = max(noise.blur_px * self.intrinsics.width / FULL_RESOLUTION, MIN_BLUR_PX)
            seen = np.stack([cv2.GaussianBlur(channel, (0, 0), sigma_px) for channel in sums])
        level = seen[0] + np.float32(noise.room_light) * seen[1]
        sigma = np.sqrt(np.float32(noise.read**2) + np.float32(noise.shot) * level)
        for channel in seen[2:]:
            channel += sigma * rng.standard_normal(sigma.shape, dtype=np.float32)
        return seen

    def decode(self, seen: Float32Array) -> Float32Array:
        """Projector column (H, W) of recorded sums; NaN where the pattern is too weak or its periods disagree."""
        noise = self.noise
        column = np.zeros(seen.shape[1:], dtype=np.float32)
        valid = np.ones(column.shape, dtype=bool)
        for i, period in enumerate(PERIODS):
            cosine, sine = seen[2 + 2 * i], seen[3 + 2 * i]
            wrapped = np.arctan2(sine, cosine) * np.float32(period / (2 * np.pi))
            valid &= np.hypot(sine, cosine) > noise.min_modulation
            if i == 0:
                column = np.where(wrapped < 0, wrapped + np.float32(period), wrapped)
                continue
            finer = wrapped + np.float32(period) * np.round((column - wrapped) / np.float32(period))
            valid &= np.abs(finer - column) < noise.max_phase_jump * period
            column = finer
        valid &= (column >= 0) & (column < PERIODS[0])
        return np.where(valid, column, np.float32(np.nan))

    def smooth_error_m(self, rng: np.random.Generator) -> Float32Array:
        """Depth error that neighbouring pixels share, shape (H, W), metres."""
        shape = (self.intrinsics.height, self.intrinsics.width)
        if self.noise.smooth_depth_m == 0:
            return np.zeros(shape, dtype=np.float32)
        # White noise behind a Gaussian of standard deviation s has the correlation exp(-(d / 2 s)^2).
        sigma_px = self.noise.smooth_length_m / 2 * self.intrinsics.fx / self.working_distance_m
        white = rng.standard_normal(shape, dtype=np.float32)
        smooth = cv2.GaussianBlur(white, (0, 0), max(sigma_px, 0.3))
        return np.asarray(smooth * np.float32(self.noise.smooth_depth_m / smooth.std()), dtype=np.float32)

    def capture(self, sums: Float32Array, rng: np.random.Generator) -> RgbdFrame:
        """Frame that this camera makes of ideal sums of shape (CHANNELS, H, W); its capture name is empty."""
        seen = self.expose(sums, rng)
        depth = self.triangulate(self.decode(seen)) + self.smooth_error_m(rng)
        low, high = self.depth_range_m
        with np.errstate(invalid="ignore"):
            depth = np.where((depth > low) & (depth < high), depth, np.nan)
        cloud = self.intrinsics.backproject(depth)
        return RgbdFrame(cloud, gray_image(seen, self.noise, rng), self.intrinsics, None, "", simulated=True)


def gray_image(seen: Float32Array, noise: NoiseModel, rng: np.random.Generator) -> NDArray[np.uint8]:
    """8-bit image (H, W) under the projector's white light and the room's, with a display gamma of 2."""
    light = seen[0] + np.float32(2 * noise.room_light) * seen[1]
    light += np.float32(noise.read) * rng.standard_normal(light.shape, dtype=np.float32)
    return np.asarray(np.round(255 * np.sqrt(np.clip(IMAGE_GAIN * light, 0, 1))), dtype=np.uint8)


def default_camera(resolution: int = 1376) -> StructuredLightCamera:
    """Square camera with the field of a PhoXi M: 1564 px focal length at 1376 px, 0.42 mm spacing at 0.65 m."""
    focal = FULL_FOCAL_PX * resolution / FULL_RESOLUTION
    center = (resolution - 1) / 2
    return StructuredLightCamera(CameraIntrinsics(resolution, resolution, focal, focal, center, center))
