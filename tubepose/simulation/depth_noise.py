"""Depth noise of a sensor, added to a simulated frame: what a camera of another make would have measured of a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.errors import ConfigError
from tubepose.transforms import FloatArray


@dataclass(frozen=True, slots=True)
class DepthNoise:
    """Errors of depth z, the same law at every pixel; points move along their line of sight.

    They come in the order of a real sensor: edges are blurred, noise is added, depth is counted in steps, pixels fail.

    Attributes:
        independent_m: Standard deviation of each pixel's own error, metres.
        shared_m: Standard deviation of the error that neighbouring pixels share, metres.
        correlation_m: Distance at which the correlation of that error has fallen to 1/e, metres at the frame's median
            depth. The error lives in pixels: nearer surfaces have it at a shorter length.
        blur_px: Depth is averaged over a square window of 1 + blur_px pixels: a step becomes a ramp of that width.
        missing: Share of the measured pixels, drawn one by one, that become invalid; 0 to 1.
        step_m: Depth is rounded to whole multiples of this, metres; 0 leaves it as it is.
    """

    independent_m: float = 0.0
    shared_m: float = 0.0
    correlation_m: float = 3.0e-3
    blur_px: float = 0.0
    missing: float = 0.0
    step_m: float = 0.0

    def __post_init__(self) -> None:
        """Refuse values that mean nothing."""
        found = (self.independent_m, self.shared_m, self.correlation_m, self.blur_px, self.missing, self.step_m)
        if not all(np.isfinite(found)) or min(found) < 0 or self.correlation_m == 0 or self.missing > 1:
            raise ConfigError(
                f"depth noise: expected numbers of 0 or more, a correlation_m above 0 and a missing of 1 at most, "
                f"found {self}; correct the number that is not"
            )

    def applied(self, frame: RgbdFrame, rng: np.random.Generator) -> RgbdFrame:
        """The frame with this noise; its image, its invalid pixels and the frame that is given stay as they are.

        Args:
            frame: An organised frame with intrinsics.
            rng: Source of randomness; the same state gives the same frame.

        Raises:
            ConfigError: The frame has no pixel grid or no intrinsics.
        """
        camera = frame.intrinsics
        if not frame.organised or camera is None:
            raise ConfigError(
                f"{frame.capture or 'frame'}: depth noise needs a pixel grid with intrinsics, found a cloud without; "
                "add the noise before the cloud is flattened"
            )
        depth = blurred_depth_m(frame.cloud_m[..., 2], self.blur_px)
        depth = depth + self.error_m(depth, camera, rng)
        if self.step_m > 0:
            depth = np.round(depth / self.step_m) * self.step_m
        lost = rng.random(depth.shape) < self.missing
        share = np.where(lost, np.nan, depth) / frame.cloud_m[..., 2]
        return replace(frame, cloud_m=frame.cloud_m * share[..., None])

    def error_m(self, depth_m: FloatArray, camera: CameraIntrinsics, rng: np.random.Generator) -> FloatArray:
        """A draw of the error of every pixel, independent and shared part, shape (H, W), metres."""
        own = rng.standard_normal(depth_m.shape)
        white = rng.standard_normal(depth_m.shape)
        error = self.independent_m * own
        valid = np.isfinite(depth_m)
        if self.shared_m > 0 and valid.any():
            length_px = self.correlation_m * np.sqrt(camera.fx * camera.fy) / float(np.median(depth_m[valid]))
            error = error + self.shared_m * _smooth(white, length_px)
        return np.asarray(error)


def _smooth(white: FloatArray, length_px: float) -> FloatArray:
    """White noise (H, W) made smooth: variance 1, correlation exp(-(d / length)^2) of pixels d apart."""
    # Behind a Gaussian of standard deviation s, white noise has the correlation exp(-(d / 2 s)^2).
    sigma_px = max(length_px / 2, 0.3)
    impulse = cv2.getGaussianKernel(2 * int(np.ceil(5 * sigma_px)) + 1, sigma_px).ravel()
    smooth = cv2.sepFilter2D(white, -1, impulse, impulse, borderType=cv2.BORDER_REFLECT_101)
    return np.asarray(smooth / np.sum(impulse**2))


def blurred_depth_m(depth_m: FloatArray, blur_px: float) -> FloatArray:
    """Mean of the valid depths (H, W) in a square window of 1 + blur_px pixels, metres; invalid pixels stay so."""
    if blur_px <= 0:
        return depth_m
    reach = int(np.ceil(blur_px / 2))
    places = np.arange(-reach, reach + 1)
    # A window's last pixels count as far as it covers them.
    kernel = np.clip((1 + blur_px) / 2 + 0.5 - np.abs(places), 0, 1)
    valid: NDArray[np.bool_] = np.isfinite(depth_m)
    total = cv2.sepFilter2D(np.where(valid, depth_m, 0.0), -1, kernel, kernel)
    weight = cv2.sepFilter2D(valid.astype(float), -1, kernel, kernel)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(valid, total / weight, np.nan))
