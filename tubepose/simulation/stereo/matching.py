"""What matching windows of two images does to the depth of a scene.

A window sees one surface: the nearest one that holds a share of its texture. So depth edges lie outside of near
objects (foreground fattening), openings that are narrower than the window are filled, things that are much narrower
vanish, and where a window holds hardly any texture there is no depth. (Nishihara 1984; Fusiello, Roberto and Trucco
1997 describe these errors of window based stereo.) Everything is done in inverse depth, in which planes are linear in
the pixels and one pixel of disparity is the same everywhere.
"""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.compiled import compiler
from tubepose.simulation.stereo.stereo_camera import StereoCamera
from tubepose.simulation.stereo.waves import smooth_field
from tubepose.transforms import FloatArray

SAMPLES = 9
"""Samples across a window: 81 tell the shares of two surfaces to 5 %."""
SAME_SURFACE_PX = 0.5
"""Disparities that differ by less are one surface."""
LEAST_TEXTURE = 0.12
"""Mean texture of a window, 1 for a bright matte surface, below which nothing is matched."""
SHARE_SPREAD = 0.06
"""Standard deviation of the share that wins a window: edges lie farther out here than there."""
PER_WIDTH = 2.563
"""Distance of the 10 and 90 % points of a Gaussian edge in standard deviations."""
LEAST_BAND_PX = 5
"""Narrower bands that the second imager does not see are filled."""
UNEVEN_PX = 20.0
"""Length of what is uneven along edges and in the texture that is wanted."""

_kernel = compiler([Path(__file__)], error_model="numpy", nogil=True)


@_kernel
def windows(inverse, texture, share, least, half, step, same):
    """Inverse depth (H, W) that every window takes.

    Args:
        inverse: Exact inverse depth, shape (H, W); NaN where nothing is.
        texture: Weight of each pixel, shape (H, W).
        share: Share of a window's weight that a nearer surface must have, shape (H, W).
        least: Mean weight that a window must have, shape (H, W).
        half: Half of the window, pixels.
        step: Distance of the samples, pixels.
        same: Inverse depths that differ by less are one surface.
    """
    height, width = inverse.shape
    result = np.full((height, width), np.nan)
    most = (2 * half // step + 1) ** 2
    q, w, du, dv = np.empty(most), np.empty(most), np.empty(most), np.empty(most)
    for v in range(height):
        for u in range(width):
            count, total, places, low, high = 0, 0.0, 0, np.inf, -np.inf
            for y in range(-half, half + 1, step):
                if v + y < 0 or v + y >= height:
                    continue
                for x in range(-half, half + 1, step):
                    if u + x < 0 or u + x >= width:
                        continue
                    places += 1
                    here = inverse[v + y, u + x]
                    if math.isnan(here):
                        continue
                    q[count], w[count], du[count], dv[count] = here, texture[v + y, u + x], x, y
                    total += w[count]
                    low, high = min(low, here), max(high, here)
                    count += 1
            if count == 0 or total < least[v, u] * places:
                continue
            level = high
            if high - low > same:
                level = _level(q, w, count, share[v, u] * total)
            result[v, u] = _at_centre(q, w, du, dv, count, level, same)
    return result


@_kernel
def _level(q, w, count, wanted):
    """Inverse depth that the nearest samples of a given weight reach."""
    order = np.argsort(-q[:count])
    weight = 0.0
    for k in order:
        weight += w[k]
        if weight >= wanted:
            return q[k]
    return q[order[count - 1]]


@_kernel
def _at_centre(q, w, du, dv, count, level, same):
    """Plane through the samples of one surface (weighted least squares), at the window's centre."""
    n, x, y, xx, xy, yy, z, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    low, high = np.inf, -np.inf
    for k in range(count):
        if abs(q[k] - level) > same:
            continue
        n, x, y, z = n + w[k], x + w[k] * du[k], y + w[k] * dv[k], z + w[k] * (q[k] - level)
        xx, xy, yy = xx + w[k] * du[k] * du[k], xy + w[k] * du[k] * dv[k], yy + w[k] * dv[k] * dv[k]
        xz, yz = xz + w[k] * du[k] * (q[k] - level), yz + w[k] * dv[k] * (q[k] - level)
        low, high = min(low, q[k]), max(high, q[k])
    mx, my, mz = x / n, y / n, z / n
    sxx, sxy, syy = xx / n - mx * mx, xy / n - mx * my, yy / n - my * my
    sxz, syz = xz / n - mx * mz, yz / n - my * mz
    bottom = sxx * syy - sxy * sxy
    value = level + mz
    if bottom > 1e-3 * (sxx + syy) ** 2:
        value -= (mx * (syy * sxz - sxy * syz) + my * (sxx * syz - sxy * sxz)) / bottom
    # A plane through few samples of a round surface is not followed far beyond them.
    return min(max(value, low - 0.5 * same), high + 0.5 * same)


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
