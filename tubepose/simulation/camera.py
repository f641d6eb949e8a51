"""The structured-light camera: optics, exposure, phase decoding, triangulation. Shared by every simulated sensor.

Light transport is linear, so a sensor only has to deliver, per pixel, the sums over all light paths of
``a * [1, cos(2 pi u / p), sin(2 pi u / p)]`` with the amplitude ``a`` and projector column ``u`` of each path, for
three periods ``p``. Every image of a phase-shift sequence follows from these sums. The camera takes the images one by
one, with their noise, and what it decodes from them is the scan.
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
BLACK_LEVEL = 0.01
"""The converter reaches below zero by this share of saturation, so that noise in the dark keeps its mean."""
CALIBRATION_TERMS = {(2, 0): 1.0, (1, 1): -0.8, (0, 2): 0.7, (3, 0): 0.6, (1, 2): -0.5, (0, 3): 0.4}
"""Weights of products of Legendre polynomials in u and v. No term of degree 0 or 1: those move and tilt the whole
cloud, as another frame of reference would."""
CHANNELS = 2 + 2 * len(PERIODS)
"""Rows of a sum image: projected light, room light, then cosine and sine of each period."""


@dataclass(frozen=True, slots=True)
class NoiseModel:
    """Imperfections of the camera. All numbers are assumptions; docs/simulation.md says what they were compared with.

    The unit of light is the return of a white surface that faces the projector at the working distance.

    Attributes:
        blur_px: Standard deviation of the lens blur at 1376 pixels; it mixes the two sides of an edge.
        steps: Images per period, 3 or more.
        exposure: Unit light as a share of saturation; 1 / `exposure` is the light that saturates.
        full_well_e: Electrons at saturation. Shot noise is the square root of the electrons.
        read_noise_e: Standard deviation of the noise of a dark pixel, electrons.
        bits: Of the converter; 0 turns quantisation off.
        room_light: Room light on a white surface.
        smooth_depth_m: Standard deviation of the depth error that neighbouring pixels share, new in each capture.
        smooth_length_m: Distance at which that error's correlation has fallen to 1/e, at the working distance.
        calibration_error_m: RMS over the image of a smooth distortion of depth that is the same in all captures.
        min_modulation: A weaker pattern is not decoded.
        max_phase_jump: Largest disagreement of neighbouring periods, as a share of the finer period.
    """

    blur_px: float = 1.0
    steps: int = 4
    exposure: float = 0.5
    full_well_e: float = 27_000.0
    read_noise_e: float = 27.0
    bits: int = 10
    room_light: float = 0.15
    smooth_depth_m: float = 2.0e-5
    smooth_length_m: float = 3.0e-3
    calibration_error_m: float = 5.0e-5
    min_modulation: float = 0.03
    max_phase_jump: float = 0.35

    @property
    def quantum(self) -> float:
        """Light of one count of the converter; 0 without quantisation."""
        return (1 + BLACK_LEVEL) / (self.exposure * (2**self.bits - 1)) if self.bits else 0.0

    @property
    def electron(self) -> float:
        """Light that gives one electron: the variance of shot noise per unit of light."""
        return 1 / (self.exposure * self.full_well_e)

    @property
    def read(self) -> float:
        """Standard deviation of a dark pixel's noise, in units of light."""
        return self.read_noise_e * self.electron


NO_NOISE = NoiseModel(
    blur_px=0.0, full_well_e=np.inf, read_noise_e=0.0, bits=0, smooth_depth_m=0.0, calibration_error_m=0.0
)


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

    def blurred(self, sums: Float32Array) -> Float32Array:
        """Ideal sums of shape (CHANNELS, H, W) behind the lens. Blurring them is blurring every image made of them."""
        if self.noise.blur_px == 0:
            return sums
        # A coarser image is the same camera with larger pixels.
        sigma_px = max(self.noise.blur_px * self.intrinsics.width / FULL_RESOLUTION, MIN_BLUR_PX)
        return np.stack([cv2.GaussianBlur(channel, (0, 0), sigma_px) for channel in sums])

    def expose(self, light: Float32Array, rng: np.random.Generator) -> Float32Array:
        """One image (H, W) as recorded, in units of light: noise, quantisation; at most the light that saturates."""
        noise = self.noise
        # Shot noise is taken as normal: the faintest pattern that is decoded still gives hundreds of electrons.
        image = np.maximum(light, np.float32(0))
        image *= np.float32(noise.electron)
        image += np.float32(noise.read**2)
        np.sqrt(image, out=image)
        image *= rng.standard_normal(light.shape, dtype=np.float32)
        image += light
        if noise.bits:
            image /= np.float32(noise.quantum)
            np.rint(image, out=image)
            image *= np.float32(noise.quantum)
        low, high = np.float32(-BLACK_LEVEL / noise.exposure), np.float32(1 / noise.exposure)
        return np.clip(image, low, high, out=image)

    def phasors(self, seen: Float32Array, rng: np.random.Generator) -> Float32Array:
        """Cosine and sine of every period, shape (2 * len(PERIODS), H, W), from recorded images of blurred sums.

        Image k of a period shows the pattern ``(1 + cos(2 pi u / p - 2 pi k / steps)) / 2`` and the room's light.
        A pixel that saturates in any image is NaN.
        """
        steps = self.noise.steps
        full = np.float32(1 / self.noise.exposure)
        mean = seen[0] / 2
        mean += np.float32(self.noise.room_light) * seen[1]
        found = np.zeros((2 * len(PERIODS), *mean.shape), dtype=np.float32)
        saturated = np.zeros(mean.shape, dtype=bool)
        for period in range(len(PERIODS)):
            cosine, sine = seen[2 + 2 * period], seen[3 + 2 * period]
            for angle in 2 * np.pi * np.arange(steps) / steps:
                # Rounded: of four steps half the weights are zero, and should be exactly that.
                c, s = np.float32(np.round(np.cos(angle), 12)), np.float32(np.round(np.sin(angle), 12))
                image = self.expose(mean + (c / 2) * cosine + (s / 2) * sine, rng)
                saturated |= image >= full
                found[2 * period] += (4 / steps * c) * image
                found[2 * period + 1] += (4 / steps * s) * image
        found[:, saturated] = np.nan
        return found

    def decode(self, phasors: Float32Array) -> Float32Array:
        """Projector column (H, W) of phasors (2 * len(PERIODS), H, W).

        NaN where the pattern is too weak, where neighbouring periods disagree, and where a phasor is NaN.
        """
        noise = self.noise
        column = np.zeros(phasors.shape[1:], dtype=np.float32)
        valid = np.ones(column.shape, dtype=bool)
        for i, period in enumerate(PERIODS):
            cosine, sine = phasors[2 * i], phasors[2 * i + 1]
            wrapped = np.arctan2(sine, cosine) * np.float32(period / (2 * np.pi))
            valid &= cosine**2 + sine**2 > noise.min_modulation**2
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

    def calibration_error_m(self) -> Float32Array:
        """Distortion of depth (H, W) by an imperfect calibration, metres: a polynomial of degree 3 over the image."""
        k = self.intrinsics
        weights = np.zeros((4, 4))
        for degrees, weight in CALIBRATION_TERMS.items():
            weights[degrees] = weight
        shape = np.polynomial.legendre.leggrid2d(np.linspace(-1, 1, k.height), np.linspace(-1, 1, k.width), weights.T)
        return np.asarray(shape * (self.noise.calibration_error_m / np.sqrt(np.mean(shape**2))), dtype=np.float32)

    def gray_image(self, seen: Float32Array, rng: np.random.Generator) -> NDArray[np.uint8]:
        """8-bit image (H, W) of blurred sums under the projector's white light and the room's; display gamma of 2."""
        light = self.expose(seen[0] + np.float32(self.noise.room_light) * seen[1], rng)
        return np.asarray(np.round(255 * np.sqrt(np.clip(IMAGE_GAIN * light, 0, 1))), dtype=np.uint8)

    def capture(self, sums: Float32Array, rng: np.random.Generator) -> RgbdFrame:
        """Frame that this camera makes of ideal sums of shape (CHANNELS, H, W); its capture name is empty."""
        seen = self.blurred(sums)
        depth = self.triangulate(self.decode(self.phasors(seen, rng)))
        depth += self.smooth_error_m(rng) + self.calibration_error_m()
        low, high = self.depth_range_m
        with np.errstate(invalid="ignore"):
            depth = np.where((depth > low) & (depth < high), depth, np.nan)
        image = self.gray_image(seen, rng)
        return RgbdFrame(self.intrinsics.backproject(depth), image, self.intrinsics, None, "", simulated=True)


def default_camera(resolution: int = 1376) -> StructuredLightCamera:
    """Square camera with the field of a PhoXi M: 1564 px focal length at 1376 px, 0.42 mm spacing at 0.65 m."""
    focal = FULL_FOCAL_PX * resolution / FULL_RESOLUTION
    center = (resolution - 1) / 2
    return StructuredLightCamera(CameraIntrinsics(resolution, resolution, focal, focal, center, center))
