"""Whether two frames of a static recording show the same: the scene or the camera may have moved between them.

Pictures tell most: over small tiles, the shift that explains their difference (Lucas and Kanade 1981), with its
standard deviation from the noise of the pictures, and what of the difference no shift explains. Depth tells where
things came or went. Brightness of the picture as a whole may change: lamps flicker, cameras set their exposure.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import RgbdFrame
from tubepose.transforms import FloatArray

SCENE_MOVED, CAMERA_MOVED = "scene_moved", "camera_moved"

TILES = 40
"""Tiles across the longer side, half of each laid over the next: a cap is seen in several."""
SMOOTH_PX = 1.2
"""Gaussian that is laid over pictures first, pixels: noise of neighbours and of compression."""
NOISE = 1.0
"""Least that a difference of smoothed pictures may have of noise, gray levels: compression is noise, too."""
_NOISE_MASK = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
SHIFT_PX = 0.3
"""Smaller shifts are none: a REAL static camera repeats to 0.02 px, and 0.3 px blur nothing that is measured."""
SURE = 6.0
"""Standard deviations by which a shift must be one."""
LEAST_TEXTURE = 2.0
"""Gradient, gray levels per pixel, root mean square over a tile, with which a tile can tell a shift."""
LEVELS = 12.0
"""Difference, gray levels, root mean square over a tile, that is none of noise or compression."""
DEPTH_SHARE = 0.02
"""Change of a tile's median depth, as a share of it, that is no noise (REAL stereo: 0.3 % of a pixel)."""
DOUBTFUL = 3.0
"""Difference of a tile, in the noise of pictures, with which its change of depth is believed."""
DEPTH_SURE = 8.0
"""The same in spreads of the changes of all tiles."""
LEAST_VALID = 0.4
"""Share of a tile's pixels that must have depth in both frames."""
LEAST_TILES = 4
"""So many tiles that touch each other must have changed: whatever is as large as a tile lies in four or more."""
MOST_STILL = 0.5
"""If more than this share of the tiles with texture, or with depth, changed, the camera moved."""


@dataclass(frozen=True, slots=True, eq=False)
class Still:
    """A frame as others are compared with it.

    Attributes:
        gray: Its picture, smoothed, shape (H, W); None without one.
        depth_m: Its depth, shape (H, W), metres.
        tile_px: Side of a tile.
        noise: Most that its noise can make of a difference of smoothed pictures, gray levels.
    """

    gray: FloatArray | None
    depth_m: FloatArray
    tile_px: int
    noise: float


def still_of(frame: RgbdFrame) -> Still:
    """What a frame is compared by."""
    gray, noise = None, NOISE
    if frame.image is not None:
        picture = frame.image if frame.image.ndim == 2 else frame.image.mean(axis=2)
        picture = np.asarray(picture, np.float32)
        gray = np.asarray(cv2.GaussianBlur(picture, (0, 0), SMOOTH_PX), float)
        # Of the mask's response the square root of 36 is the noise of a pixel (Immerkaer 1996); edges are few.
        pixel = 1.4826 * float(np.median(np.abs(cv2.filter2D(picture, -1, _NOISE_MASK)))) / 6
        noise = max(NOISE, 2 * pixel * np.sqrt(2) / (2 * np.sqrt(np.pi) * SMOOTH_PX))
    depth = np.asarray(frame.cloud_m[..., 2])
    return Still(gray, depth, max(8, max(depth.shape[0], depth.shape[1]) // TILES), noise)


def motion_between(first: Still, second: Still) -> str:
    """What moved between two frames: `SCENE_MOVED`, `CAMERA_MOVED`, or empty if nothing did.

    Args:
        first: One frame.
        second: Another one of the same size.
    """
    changed, told = _depth_changed(first, second)
    share = float(np.mean(changed[told])) if told.any() else 0.0
    if first.gray is not None and second.gray is not None:
        look = _picture_changed(first.gray, second.gray, first.tile_px, max(first.noise, second.noise))
        textured = max(int(np.count_nonzero(look.textured)), 1)
        share = max(share, int(np.count_nonzero(look.shifted & look.textured)) / textured)
        # Far and at edges depth flickers by more than any limit: where it changed, the picture has to have changed.
        changed = look.shifted | look.otherwise | (changed & look.doubtful)
    if _largest_patch(changed) < LEAST_TILES:
        return ""
    return CAMERA_MOVED if share > MOST_STILL else SCENE_MOVED


def _largest_patch(changed: NDArray[np.bool_]) -> int:
    """Tiles of the largest connected patch."""
    _, _, stats, _ = cv2.connectedComponentsWithStats(changed.astype(np.uint8), connectivity=8)
    return int(stats[1:, cv2.CC_STAT_AREA].max(initial=0))


def _tiles(values: FloatArray, side: int) -> FloatArray:
    """Means (M, N) over tiles that overlap by half."""
    mean = cv2.blur(np.asarray(values, np.float64), (side, side), borderType=cv2.BORDER_REPLICATE)
    return np.asarray(mean[side // 2 :: max(side // 2, 1), side // 2 :: max(side // 2, 1)])


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """Tiles of two pictures, shape (M, N) each: shifted; otherwise changed; differing a little; with texture."""

    shifted: NDArray[np.bool_]
    otherwise: NDArray[np.bool_]
    doubtful: NDArray[np.bool_]
    textured: NDArray[np.bool_]


def _picture_changed(first: FloatArray, second: FloatArray, side: int, most_noise: float) -> _Look:
    """Tiles that shifted or look otherwise, and tiles that could tell a shift.

    The noise of the difference is what most tiles have, and no more than pictures have it: all tiles may have moved.
    """
    change = _same_exposure(first, second) - first
    du = cv2.Sobel(first, cv2.CV_64F, 1, 0, ksize=3) / 8
    dv = cv2.Sobel(first, cv2.CV_64F, 0, 1, ksize=3) / 8
    uu, uv, vv = (_tiles(a * b, side) for a, b in ((du, du), (du, dv), (dv, dv)))
    ut, vt, tt = _tiles(du * change, side), _tiles(dv * change, side), _tiles(change * change, side)
    noise = min(float(np.sqrt(np.median(tt))) + 1e-3, most_noise)
    # Along a single edge the shift across it is told, the one along it is held at nothing.
    ridge = 0.05 * (uu + vv) + 1e-6
    bottom = (uu + ridge) * (vv + ridge) - uv**2
    shift_u = ((vv + ridge) * ut - uv * vt) / bottom
    shift_v = ((uu + ridge) * vt - uv * ut) / bottom
    # Independent pixels of a tile: the pictures are smoothed.
    count = max(side**2 / (4 * np.pi * SMOOTH_PX**2), 1.0)
    std = noise / np.sqrt(count * np.maximum(uu + vv, 1e-9))
    textured = np.sqrt(uu + vv) > LEAST_TEXTURE
    shift = np.hypot(shift_u, shift_v)
    shifted = textured & (shift > np.maximum(SHIFT_PX, SURE * std))
    rms = np.sqrt(tt)
    return _Look(shifted, rms > max(LEVELS, SURE * noise), rms > DOUBTFUL * noise, textured)


def _same_exposure(first: FloatArray, second: FloatArray) -> FloatArray:
    """The second picture with the gain and offset that bring it nearest to the first (Huber weights)."""
    a, b = first[::4, ::4].ravel(), second[::4, ::4].ravel()
    weight = np.ones(len(a))
    gain, offset = 1.0, 0.0
    for _ in range(5):
        mean_a, mean_b = np.average(a, weights=weight), np.average(b, weights=weight)
        spread = np.average((b - mean_b) ** 2, weights=weight)
        gain = float(np.average((a - mean_a) * (b - mean_b), weights=weight) / spread) if spread > 1e-6 else 1.0
        offset = float(mean_a - gain * mean_b)
        off = np.abs(gain * b + offset - a)
        weight = 1 / np.maximum(off / (2 * np.median(off) + 0.5), 1.0)
    return np.asarray(gain * second + offset)


def _depth_changed(first: Still, second: Still) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Tiles whose depth changed by more than noise does, and tiles that have enough of it."""
    side = first.tile_px
    both = np.isfinite(first.depth_m) & np.isfinite(second.depth_m)
    with np.errstate(invalid="ignore"):
        change = np.where(both, second.depth_m / first.depth_m - 1, 0.0)
    # A few wild pixels of an edge are no change of a tile.
    change = np.clip(change, -0.3, 0.3)
    valid = _tiles(both.astype(float), side)
    mean = _tiles(change, side) / np.maximum(valid, 1e-9)
    told = valid > LEAST_VALID
    if not told.any():
        return told, told
    middle = float(np.median(mean[told]))
    spread = 1.4826 * float(np.median(np.abs(mean[told] - middle)))
    return told & (np.abs(mean) > max(DEPTH_SHARE, DEPTH_SURE * spread)), told
