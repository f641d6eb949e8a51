"""Middle of every open rim: the bright ring that it makes in the image, whatever the depth on it says."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.config import ProfileConfig
from tubepose.profile.fit_kernels import shift_scores
from tubepose.profile.kernels import radial_brightness
from tubepose.profile.outline import NORMALS, SECTORS, Circles, fit_circles
from tubepose.transforms import FloatArray, parts

BIN_M = 0.25e-3
WIDE_M = 1.75e-3
"""How far off its expected place a whole ring is looked for, before its sectors one by one."""
SEARCH_M = 0.9e-3
"""How far off its expected radius a sector of the ring is looked for."""
ROUNDS = 2
PER_SECTOR = 3
"""Radii along which a sector of the image is read."""
NEAR_RING_M = 0.3e-3
"""How far a sector of a ring may be from the circle that was fitted to all of them."""
MIN_CONTRAST = 0.35
"""Correlation of a sector's brightness with a ring's, below which the sector does not count."""


@dataclass(frozen=True, slots=True, eq=False)
class RimView:
    """What rims are looked at in.

    Attributes:
        picture: Gray values, shape (H, W); without an image 1 and 0 for pixels with and without depth.
        is_image: Whether it has one.
        intrinsics: Of its image.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
    """

    picture: NDArray[np.float32] | NDArray[np.uint8]
    is_image: bool
    intrinsics: CameraIntrinsics
    T_camera_rack: FloatArray

    def negative(self) -> RimView:
        """The same with bright and dark changed: a dark ring is a bright one there."""
        return replace(self, picture=np.subtract(self.picture.max(), self.picture))


def rim_view(frame: RgbdFrame, intrinsics: CameraIntrinsics, T_camera_rack: FloatArray) -> RimView:
    """How rims are seen in an organised frame whose rack has a pose (4, 4), metres."""
    return RimView(brightness(frame), frame.image is not None, intrinsics, T_camera_rack)


def fit_rims(
    view: RimView,
    center_m: FloatArray,
    level_m: FloatArray,
    radii_m: FloatArray,
    blocked: NDArray[np.bool_],
    config: ProfileConfig,
    bias_m: float,
) -> Circles:
    """Middle of rims in an image, or without one in the picture of where there is depth.

    For each sector of each rim the mean brightness over the radius is compared with that of a ring between the rim's
    two radii, moved inwards and outwards; the best move is the sector's radius.

    Args:
        view: The picture, and where the rack is in it.
        center_m: Middle of each rim as known so far, rack frame, shape (T, 2), metres.
        level_m: Height of each rim above the rack's base, shape (T,).
        radii_m: Inner and outer radius of each rim, shape (T, 2).
        blocked: Sectors that another top is too near to, shape (T, SECTORS).
        config: Noise of outlines.
        bias_m: Error of a whole rim's middle, along x and along y.
    """
    profile, steps_m = _radial_profiles(view, center_m, level_m, radii_m, WIDE_M)
    _, _, correlation = _ring_scores(profile, steps_m, radii_m, WIDE_M)
    shift = _whole_ring_shift(correlation, blocked)
    circles: Circles | None = None
    if not view.is_image:  # depth has no ring where it is too deep: its picture is worth less
        bias_m *= 3
    for _ in range(ROUNDS):
        profile, steps_m = _radial_profiles(view, center_m + shift, level_m, radii_m, SEARCH_M)
        move_m, contrast = _ring_moves(*_ring_scores(profile, steps_m, radii_m, SEARCH_M))
        circles = fit_circles(move_m, (contrast > MIN_CONTRAST) & ~blocked, config, config.rim_noise_m, bias_m)
        shift = shift + np.nan_to_num(circles.offset_m)
    assert circles is not None
    offset = np.where(np.isfinite(circles.offset_m), shift, np.nan)
    # Where some of what is free to be seen of a ring does not look like one, the rest is not sure to be its own.
    torn = 1 - np.clip(circles.sectors * SECTORS / np.maximum((~blocked).sum(axis=1), 1), 0, 1)
    covariance = circles.covariance_m2 + (config.torn_rim_m * torn)[:, None, None] ** 2 * np.eye(2)
    return Circles(offset, covariance, circles.widening_m, circles.sectors)


def ring_contrast(
    view: RimView, center_m: FloatArray, level_m: FloatArray, radii_m: FloatArray, blocked: NDArray[np.bool_]
) -> FloatArray:
    """Mean correlation of the sectors of circles, known to `NEAR_RING_M`, with a ring's; shape (T,), -1 to 1.

    Arguments are those of `fit_rims`; sectors that are blocked do not count.
    """
    profile, steps_m = _radial_profiles(view, center_m, level_m, radii_m, SEARCH_M)
    moves_m, _, correlation = _ring_scores(profile, steps_m, radii_m, SEARCH_M)
    near = correlation[:, :, np.abs(moves_m) <= NEAR_RING_M].max(axis=2)
    return np.asarray((near * ~blocked).sum(axis=1) / np.maximum((~blocked).sum(axis=1), 1))


def brightness(frame: RgbdFrame) -> NDArray[np.float32] | NDArray[np.uint8]:
    """Gray values of a frame, shape (H, W); 1 and 0 for pixels with and without depth where it has no image."""
    if frame.image is None:
        return np.isfinite(frame.cloud_m[..., 2]).astype(np.float32)
    gray = frame.image if frame.image.ndim == 2 else frame.image.mean(axis=2, dtype=np.float32)
    return np.ascontiguousarray(gray)


def _radial_profiles(
    view: RimView, center_m: FloatArray, level_m: FloatArray, radii_m: FloatArray, search_m: float
) -> tuple[FloatArray, FloatArray]:
    """Brightness of every rim by sector and radius, shape (T, SECTORS, B), and the radii off the ring's middle, (B,).

    The picture is read, between its pixels, at the places where points of the level plane are seen.
    """
    middle = radii_m.mean(axis=1)
    # The ring's own width on both sides of it is its background.
    reach = search_m + float(np.ptp(radii_m, axis=1).max()) + BIN_M
    steps = np.arange(-reach, reach + BIN_M / 2, BIN_M)
    lens, T = view.intrinsics, view.T_camera_rack
    camera = np.array([lens.fx, lens.fy, lens.cx, lens.cy])
    values = radial_brightness(view.picture, camera, *parts(T), center_m, level_m, middle, steps, SECTORS, PER_SECTOR)
    return np.asarray(values), steps


@dataclass(frozen=True, slots=True, eq=False)
class _Templates:
    """What sectors are compared with: rings of K widths, moved outwards by M steps, over B radii.

    Attributes:
        moves_m: How far each is moved, shape (M,), metres.
        ring: Brightness of a ring less that of its background, shape (K, B, M).
        window: Weights of the radii, shape (K, B, M).
        total: Sum of the weights, shape (K, 1, M).
        norm2: Squared length of the ring, shape (K, 1, M).
    """

    moves_m: FloatArray
    ring: FloatArray
    window: FloatArray
    total: FloatArray
    norm2: FloatArray


@lru_cache(maxsize=32)
def _templates(halves_m: tuple[float, ...], steps_m: tuple[float, ...], search_m: float) -> _Templates:
    """Rings of half widths, blurred by a bin, with a background as wide as each on either side."""
    half = np.array(halves_m)[:, None, None]
    moves = np.arange(-search_m, search_m + BIN_M / 4, BIN_M / 2)
    off = np.abs(np.array(steps_m)[None, None, :] - moves[None, :, None])
    ring = np.clip((half + BIN_M / 2 - off) / BIN_M, 0, 1)
    window = np.clip((2 * half + BIN_M / 2 - off) / BIN_M, 0, 1)
    total = window.sum(axis=2)
    template = window * (ring - ((ring * window).sum(axis=2) / total)[..., None])
    norm2 = (template**2 / np.maximum(window, 1e-9)).sum(axis=2)
    return _Templates(moves, template.swapaxes(1, 2), window.swapaxes(1, 2), total[:, None, :], norm2[:, None, :])


def _ring_scores(
    profile: FloatArray, steps_m: FloatArray, radii_m: FloatArray, search_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Moves outwards, shape (M,), metres; the contrast of every sector with a ring there, and its correlation.

    The last two have the shape (T, SECTORS, M).
    """
    if len(radii_m) and not np.ptp(radii_m, axis=0).any():
        radii_m = radii_m[:1]  # one template does for all
    halves_m = (radii_m[:, 1] - radii_m[:, 0]) / 2
    found = _templates(tuple(halves_m.tolist()), tuple(steps_m.tolist()), search_m)
    score = profile @ found.ring
    mean = profile @ found.window / found.total
    scatter = profile**2 @ found.window - mean**2 * found.total
    return found.moves_m, score, score / np.sqrt(np.maximum(found.norm2 * scatter, 1e-12))


def _whole_ring_shift(correlation: FloatArray, blocked: NDArray[np.bool_]) -> FloatArray:
    """Shift of every ring, shape (T, 2), metres, at which its sectors correlate best together.

    Correlations (T, SECTORS, M) are those of moves up to `WIDE_M`.
    """
    shifts, at = _whole_ring_shifts(correlation.shape[2])
    return np.asarray(shifts[shift_scores(correlation, blocked, at).argmax(axis=1)])


@lru_cache(maxsize=1)
def _whole_ring_shifts(count: int) -> tuple[FloatArray, NDArray[np.intp]]:
    """Shifts that are tried, shape (K, 2), metres, and which of `count` moves each one is in a sector, (K, SECTORS)."""
    axis = np.arange(-WIDE_M, WIDE_M + 1e-9, BIN_M)
    shifts = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    shifts = shifts[np.hypot(*shifts.T) <= WIDE_M]
    at = np.rint((shifts @ NORMALS.T + WIDE_M) / (BIN_M / 2)).astype(np.intp)
    return shifts, np.clip(at, 0, count - 1)


def _ring_moves(moves_m: FloatArray, score: FloatArray, correlation: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How far outwards a ring fits each sector best, shape (T, SECTORS), metres, and its correlation there.

    The correlation is 0 where it has no peak within the search.
    """
    best = score.argmax(axis=2)
    inner = np.clip(best, 1, len(moves_m) - 2)
    t, s = np.ogrid[: score.shape[0], : score.shape[1]]
    before, peak, after = (score[t, s, inner + k] for k in (-1, 0, 1))
    curve = before - 2 * peak + after
    with np.errstate(divide="ignore", invalid="ignore"):
        fraction = np.where(curve < 0, 0.5 * (before - after) / curve, 0.0)
    move = moves_m[inner] + np.clip(fraction, -0.5, 0.5) * (moves_m[1] - moves_m[0])
    return move, np.where(best == inner, correlation[t, s, inner], 0.0)
