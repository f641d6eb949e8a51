"""Smooth random fields over an image: what the depth error of a stereo camera is made of."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.simulation.stereo.stereo_camera import StereoCamera
from tubepose.transforms import FloatArray

Float32Array = NDArray[np.float32]

COARSE_PX = 6.0
"""Longer fields are made on a grid of so many cells per length and interpolated: it shortens their kernels."""
LEAST_SIGMA_PX = 0.3


def smooth_field(shape: tuple[int, int], length_px: tuple[float, float], rng: np.random.Generator) -> Float32Array:
    """Gaussian random field of mean 0 and variance 1 by filtering white noise.

    Behind a Gaussian of standard deviation s, white noise has the correlation ``exp(-(d / 2 s)^2)``.

    Args:
        shape: Height and width.
        length_px: Distances along u and v at which the correlation is 1/e, pixels.
        rng: Source of randomness.
    """
    cells = [max(1, int(length / COARSE_PX)) for length in length_px]
    margin = 2  # cells beyond the border, which interpolation needs
    rows, columns = (-(-side // cell) + 2 * margin for side, cell in zip(shape, cells[::-1], strict=True))
    sigmas = [max(length / cell / 2, LEAST_SIGMA_PX) for length, cell in zip(length_px, cells, strict=True)]
    kernels = [cv2.getGaussianKernel(2 * int(np.ceil(4 * s)) + 1, s, cv2.CV_32F) for s in sigmas]
    reach_u, reach_v = (len(kernel) // 2 for kernel in kernels)
    white = rng.standard_normal((rows + 2 * reach_v, columns + 2 * reach_u), dtype=np.float32)
    field = cv2.sepFilter2D(white, cv2.CV_32F, kernels[0], kernels[1])
    field = field[reach_v : reach_v + rows, reach_u : reach_u + columns]
    field = field / np.float32(np.sqrt(np.prod([np.sum(kernel**2) for kernel in kernels])))
    if max(cells) > 1:
        field = cv2.resize(field, (columns * cells[0], rows * cells[1]), interpolation=cv2.INTER_CUBIC)
    top, left = margin * cells[1], margin * cells[0]
    return np.asarray(field[top : top + shape[0], left : left + shape[1]], np.float32)


def depth_error_m(camera: StereoCamera, depth_m: FloatArray, rng: np.random.Generator, *, temporal: bool) -> FloatArray:
    """A draw of the depth error (H, W) by all waves that are temporal, or by all that are not, metres.

    Args:
        camera: The camera.
        depth_m: Depth, shape (H, W), metres; NaN stays NaN.
        rng: Source of randomness.
        temporal: Which waves.
    """
    height, width = depth_m.shape
    error: FloatArray = np.where(np.isfinite(depth_m), 0.0, np.nan)
    for number, wave in enumerate(camera.waves):
        if wave.temporal == temporal:
            error += camera.wave_std_m(number, depth_m) * smooth_field((height, width), wave.length_px, rng)
    return error
