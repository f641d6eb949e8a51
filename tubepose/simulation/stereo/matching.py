"""What matching windows of two images does to the depth of a scene.

A window sees one surface: the nearest one that holds a share of its texture. So depth edges lie outside of near
objects (foreground fattening), openings that are narrower than the window are filled, things that are much narrower
vanish, and where a window holds hardly any texture there is no depth. (Nishihara 1984; Fusiello, Roberto and Trucco
1997 describe these errors of window based stereo.) Everything is done in inverse depth, in which planes are linear in
the pixels and one pixel of disparity is the same everywhere.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.simulation.stereo.stereo_camera import StereoCamera
from tubepose.simulation.stereo.waves import smooth_field
from tubepose.simulation.stereo.window_kernels import windows
from tubepose.transforms import FloatArray

SAMPLES = 9
"""Samples across a window: 81 tell the shares of two surfaces to 5 %."""
SAME_SURFACE_PX = 0.5
"""Disparities that differ by less are one surface."""
LEAST_TEXTURE = 0.3
"""Mean texture of a window, 1 for a bright matte surface, below which nothing is matched."""
SHARE_SPREAD = 0.06
"""Standard deviation of the share that wins a window: edges lie farther out here than there."""
PER_WIDTH = 2.563
"""Distance of the 10 and 90 % points of a Gaussian edge in standard deviations."""
LEAST_BAND_PX = 5
"""Narrower bands that the second imager does not see are filled."""
UNEVEN_PX = 20.0
"""Length of what is uneven along edges and in the texture that is wanted."""


def matched_depth_m(
    camera: StereoCamera, depth_m: FloatArray, texture: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Depth (H, W) as the camera matches it, without the noise of its disparity, metres; NaN where there is none.

    Args:
        camera: The camera.
        depth_m: Exact depth, shape (H, W), metres; NaN where nothing is.
        texture: What a pixel gives to match by: 0 black or glaring, 1 bright and matte, shape (H, W).
        rng: Of the fields that make edges and borders of holes uneven.
    """
    shape = (depth_m.shape[0], depth_m.shape[1])
    half = max(camera.window_px // 2, 0)
    uneven = [smooth_field(shape, (UNEVEN_PX, UNEVEN_PX), rng).astype(float) for _ in range(2)]
    share = np.clip(camera.near_share + SHARE_SPREAD * uneven[0], 0.05, 0.5)
    least = LEAST_TEXTURE * np.clip(1 + 0.3 * uneven[1], 0.3, 2.0)
    step = max(1, round(2 * half / (SAMPLES - 1)))
    same = SAME_SURFACE_PX * camera.inverse_depth_per_px
    inverse = windows(1.0 / depth_m, texture, share, least, half // step * step, step, same)
    inverse = _wandering(inverse, camera.wander_px, rng)
    hidden = unseen_by_second(camera, inverse)
    inverse = np.where(hidden, np.nan, inverse)
    return np.asarray(1.0 / _ramped(inverse, camera.ramp_px / PER_WIDTH))


def _wandering(inverse: FloatArray, std_px: float, rng: np.random.Generator) -> FloatArray:
    """The map with its pixels moved about by a smooth field: edges wander."""
    if std_px == 0:
        return inverse
    shape = (inverse.shape[0], inverse.shape[1])
    v, u = np.mgrid[: shape[0], : shape[1]].astype(np.float32)
    u += np.float32(std_px) * smooth_field(shape, (UNEVEN_PX / 2, UNEVEN_PX / 2), rng)
    v += np.float32(std_px) * smooth_field(shape, (UNEVEN_PX / 2, UNEVEN_PX / 2), rng)
    return np.asarray(cv2.remap(inverse, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def unseen_by_second(camera: StereoCamera, inverse: FloatArray) -> NDArray[np.bool_]:
    """Pixels (H, W) whose point a nearer one hides from the second imager: bands at the left of near objects.

    The blind columns of the camera count as such.

    Args:
        camera: The camera.
        inverse: Inverse depth, shape (H, W), 1/m; NaN where there is none.
    """
    columns = np.arange(inverse.shape[1])
    shift_px = camera.intrinsics.fx * camera.baseline_m
    second = columns - shift_px * inverse
    # From the right, the farthest left that any point came to.
    reached = np.minimum.accumulate(np.where(np.isfinite(second), second, np.inf)[:, ::-1], axis=1)[:, ::-1]
    behind = np.full(second.shape, np.inf)
    behind[:, :-1] = reached[:, 1:]
    hidden = (second > behind).astype(np.uint8)
    kernel = np.ones((3, LEAST_BAND_PX), np.uint8)
    wide = cv2.morphologyEx(hidden, cv2.MORPH_OPEN, kernel).astype(bool)
    return wide | (second < 0) if camera.blind_columns else wide


def _ramped(inverse: FloatArray, sigma_px: float) -> FloatArray:
    """Mean of the valid pixels about each valid pixel, weighted by a Gaussian: a step becomes a ramp."""
    if sigma_px <= 0:
        return inverse
    valid = np.isfinite(inverse)
    total = cv2.GaussianBlur(np.where(valid, inverse, 0.0), (0, 0), sigma_px)
    weight = cv2.GaussianBlur(valid.astype(float), (0, 0), sigma_px)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(valid, total / weight, np.nan))
