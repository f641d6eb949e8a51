"""Where tubes stand: the discs and rings of caps and rims, looked for above every slot, and their types."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from functools import lru_cache
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.config import ProfileConfig
from tubepose.labware import RackModel, SlotModel, TubeModel
from tubepose.profile.kernels import best_places, level_pictures
from tubepose.profile.outline import Circles
from tubepose.profile.standing import OUTSIDE_M, Standing
from tubepose.transforms import FloatArray

CELL_M = 1.0e-3
FEW_WINDOWS = 8
"""A picture is scored as a whole for more slots than these."""
PASSES = 3
PICTURE_POINTS = 40_000
CLOSE, NEAR = 0.03, 3.5
"""Scores that are as good as the best one, and how many cells from it they are the same place."""


@dataclass(frozen=True, slots=True, eq=False)
class Tops:
    """Tops of tubes, one entry each; T of them.

    Attributes:
        slot: Index of the slot that each stands in, shape (T,).
        tube: Index of its type among the candidates, shape (T,).
        center_m: Middle of its top circle on the level of its type's top, rack frame, shape (T, 2), metres.
        support: Share of the top that is seen less the share of its surroundings that is, 0 to 1, shape (T,).
        runner_up: The same of the next best type at that place, shape (T,); -inf without one.
    """

    slot: NDArray[np.intp]
    tube: NDArray[np.intp]
    center_m: FloatArray
    support: FloatArray
    runner_up: FloatArray

    def take(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> Tops:
        """The same of some of the tops."""
        return Tops(self.slot[keep], self.tube[keep], self.center_m[keep], self.support[keep], self.runner_up[keep])


PerTube = TypeVar("PerTube", Tops, Circles)


def joined(first: PerTube, second: PerTube) -> PerTube:
    """Entries of one, then those of the other."""
    names = [field.name for field in fields(first)]
    return type(first)(*(np.concatenate([getattr(first, name), getattr(second, name)]) for name in names))


def top_level_m(tube: TubeModel, rack: RackModel) -> float:
    """Height of an upright tube's top above the rack's base, metres."""
    return rack.floor_m + tube.height_m


def mouth_radius_m(tube: TubeModel) -> float:
    """Inner radius of an open tube's rim, metres; 0 for a closed one."""
    return float(tube.body_radius_m(tube.rim_height_m)) - tube.body.wall_mm * 1e-3 if tube.is_open else 0.0


def top_radius_m(tube: TubeModel) -> float:
    """Outer radius of a tube's top circle, metres: of its cap, flange or bare rim."""
    return tube.cap.diameter_mm * 0.5e-3 if tube.cap is not None else float(tube.body_radius_m(tube.rim_height_m))


def top_depth_m(tube: TubeModel, config: ProfileConfig) -> float:
    """How far below its height points can be of a tube's top, metres: light returns from below the surface of a rim."""
    return config.rim_depth_m if tube.is_open else config.top_band_m


def find_tops(
    standing: Standing,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    config: ProfileConfig,
    allowed: NDArray[np.bool_] | None = None,
) -> Tops:
    """Best top over every slot that has one.

    For each type the points near the height of its top become a picture of the rack from above, and each place gets the
    share of a disc (or of the ring of a rim) about it that is filled, less that of what should be empty, and less the
    more the points' mean height is off. Each slot takes the best place that a tube in it can reach, among all types.
    Tops that overlap are cut down to the better one; then the slots that are left look again, without the points of
    the tops that were found: a neighbour's cap hides the place of its own.

    Args:
        standing: Points above the rack's top.
        rack: The rack.
        tubes: Candidate types.
        config: Limits.
        allowed: Which type may stand in which slot, shape (K, S); all by default.
    """
    count = len(rack.all_slots)
    may = np.ones((len(tubes), count), bool) if allowed is None else allowed
    pictures = [_filled(standing, rack, tube, config) for tube in tubes]
    best = np.full(count, -1)
    place = np.full((count, 3), -np.inf)
    second = np.full(count, -np.inf)
    for _ in range(PASSES):
        left = best < 0
        left &= np.any([_may_hold(pictures[k][0], rack, tube, config) & may[k] for k, tube in enumerate(tubes)], axis=0)
        if not left.any():
            break
        found = np.full((len(tubes), count, 3), -np.inf)
        for k, tube in enumerate(tubes):
            windows = _windows(rack, tube, config.reach_m)
            score = _scores_in(windows, may[k] & left, *pictures[k], tube, config)
            found[k] = best_places(score, *windows, may[k] & left, CLOSE, NEAR)
            found[k, :, 1:] = found[k, :, 1:] * CELL_M - rack.outline_m / 2 - OUTSIDE_M
        ranked = np.sort(found[:, :, 0], axis=0)
        kind = found[:, :, 0].argmax(axis=0)
        least = np.array([least_support(tube, config) for tube in tubes])[kind]
        candidates = np.flatnonzero((best < 0) & (ranked[-1] > least))
        where = found[kind, np.arange(count)]
        taken = np.flatnonzero(best >= 0)
        new = without_overlaps(
            candidates, taken, np.where(best >= 0, best, kind), np.where((best >= 0)[:, None], place, where), tubes
        )
        if len(new) == 0:
            break
        best[new], place[new] = kind[new], where[new]
        second[new] = ranked[-2, new] if len(tubes) > 1 else -np.inf
        if np.all(best >= 0):
            break
        for k in range(len(tubes)):
            _erase(pictures[k], place[new, 1:], [top_radius_m(tubes[best[i]]) for i in new], rack)
    kept = np.flatnonzero(best >= 0)
    return Tops(kept, best[kept], place[kept, 1:], place[kept, 0], second[kept])


def least_support(tube: TubeModel, config: ProfileConfig) -> float:
    """Least support that makes a top; rims of clear plastic have few points, and are looked at in the image again."""
    return config.min_rim_support if tube.is_open else config.min_support


def _filled(
    standing: Standing, rack: RackModel, tube: TubeModel, config: ProfileConfig
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pictures from above of the points near a type's top: 1 in cells of `CELL_M` that have one; its height off it."""
    half = rack.outline_m / 2 + OUTSIDE_M
    size = np.ceil(2 * half / CELL_M).astype(int) + 1
    filled, off = np.zeros(size, np.float32), np.zeros(size, np.float32)
    # Some points a cell are enough.
    step = max(1, len(standing.points_m) // PICTURE_POINTS)
    below, level = top_depth_m(tube, config), top_level_m(tube, rack)
    level_pictures(
        standing.points_m, step, standing.camera_m, level, below, config.top_band_m, half, CELL_M, filled, off
    )
    return filled, off


def _may_hold(
    filled: NDArray[np.float32], rack: RackModel, tube: TubeModel, config: ProfileConfig
) -> NDArray[np.bool_]:
    """Slots (S,) in whose reach enough cells are filled for a type's least support, were they all of one top."""
    low, high = _windows(rack, tube, config.reach_m)
    reach = len(_top_kernels(tube)[0]) // 2
    low, high = (np.clip(ends, 0, filled.shape) for ends in (low - reach, high + reach))
    sums = cv2.integral(filled, sdepth=cv2.CV_64F)
    count = sums[high[:, 0], high[:, 1]] - sums[low[:, 0], high[:, 1]] - sums[high[:, 0], low[:, 1]]
    count += sums[low[:, 0], low[:, 1]]
    return np.asarray(count > least_support(tube, config) * _top_kernels(tube)[1].sum())


def _top_score(
    filled: NDArray[np.float32], off_m: NDArray[np.float32], tube: TubeModel, config: ProfileConfig
) -> NDArray[np.float32]:
    """Filled share of the top about every cell, less that of the ring around it and of the mouth in it."""
    kernel, top = _top_kernels(tube)
    score = _filter(filled, kernel)
    if tube.is_open:
        return score
    mean_off_m = _filter(off_m, top) / np.maximum(_filter(filled, top), 1.0)
    return np.asarray(score * np.exp(-0.5 * (mean_off_m / (2 * config.cap_height_m)) ** 2), np.float32)


def _scores_in(
    windows: tuple[NDArray[np.intp], NDArray[np.intp]],
    wanted: NDArray[np.bool_],
    filled: NDArray[np.float32],
    off_m: NDArray[np.float32],
    tube: TubeModel,
    config: ProfileConfig,
) -> NDArray[np.float32]:
    """`_top_score` of a picture where some windows, `low` (S, 2) to `high`, want it: of all of it, where many do."""
    if wanted.sum() > FEW_WINDOWS:
        return _top_score(filled, off_m, tube, config)
    score = np.full(filled.shape, -np.inf, np.float32)
    reach = len(_top_kernels(tube)[0]) // 2
    for low, high in zip(*(np.clip(ends[wanted], 0, filled.shape) for ends in windows), strict=True):
        first = np.maximum(low - reach, 0)
        near = _cells(first, high + reach)
        part = _top_score(filled[near], off_m[near], tube, config)
        score[_cells(low, high)] = part[_cells(low - first, high - first)]
    return score


def _cells(low: NDArray[np.intp], high: NDArray[np.intp]) -> tuple[slice, slice]:
    """A rectangle of cells, from one corner (2,) to before another."""
    return slice(low[0], high[0]), slice(low[1], high[1])


@lru_cache(maxsize=64)
def _top_kernels(tube: TubeModel) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """What a picture is filtered with: weights of the cells about the middle of a top, and which ones are the top."""
    radius, mouth = top_radius_m(tube), mouth_radius_m(tube)
    reach = int(np.ceil((radius + 2e-3) / CELL_M))
    offsets = np.arange(-reach, reach + 1) * CELL_M
    r = np.hypot(*np.meshgrid(offsets, offsets))
    top = (r <= radius - 0.3e-3) & (r >= mouth + (0.3e-3 if mouth else 0.0))
    around = (r > radius + 0.5e-3) & (r <= radius + 2e-3)
    kernel = top / top.sum() - around / around.sum()
    if mouth:
        core = r < mouth - 1.5e-3
        kernel = kernel - core / core.sum()
    return kernel.astype(np.float32), top.astype(np.float32)


def _filter(picture: NDArray[np.float32], kernel: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.asarray(cv2.filter2D(picture, cv2.CV_32F, kernel, borderType=cv2.BORDER_CONSTANT))


def _erase(
    pictures: tuple[NDArray[np.float32], NDArray[np.float32]],
    center_m: FloatArray,
    radius_m: Sequence[float],
    rack: RackModel,
) -> None:
    """Empty a type's own pictures where tops were found."""
    half = rack.outline_m / 2 + OUTSIDE_M
    for center, radius in zip(center_m, radius_m, strict=True):
        at = np.rint((center + half) / CELL_M).astype(int)
        for picture in pictures:
            cv2.circle(picture, (int(at[1]), int(at[0])), int(np.ceil((radius + 0.7e-3) / CELL_M)), 0.0, -1)


@lru_cache(maxsize=64)
def _windows(rack: RackModel, tube: TubeModel, reach_m: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First cells (S, 2) and those after the last (S, 2) of where the top of a tube can be, slot by slot."""
    reach = np.array([top_reach_m(slot, tube, rack) for slot in rack.all_slots])[:, None] + reach_m
    corner = rack.slot_centers_m + rack.outline_m / 2 + OUTSIDE_M
    low, high = np.floor((corner - reach) / CELL_M), np.ceil((corner + reach) / CELL_M) + 1
    return low.astype(np.intp), high.astype(np.intp)


@lru_cache(maxsize=1024)
def top_reach_m(slot: SlotModel, tube: TubeModel, rack: RackModel) -> float:
    """How far the middle of a tube's top can be from its slot's axis, metres: the floor's play, and the lean beyond."""
    play = rack.floor_play_mm * 1e-3
    room = float(np.max(np.maximum(slot.half_size_m - tube.body_radius_m(rack.depth_m), 0.0)))
    return play + (room + play) * tube.height_m / min(rack.depth_m, tube.height_m)


def without_overlaps(
    slots: NDArray[np.intp],
    taken: NDArray[np.intp],
    kind: NDArray[np.intp],
    place: FloatArray,
    tubes: Sequence[TubeModel],
) -> NDArray[np.intp]:
    """Slots in order, without those whose top overlaps a better one or one that was found before: discs cannot."""
    rows = np.concatenate([taken, slots[np.argsort(-place[slots, 0], kind="stable")]])
    radius, at = np.array([top_radius_m(tube) for tube in tubes])[kind[rows]], place[rows, 1:]
    clear = np.hypot(*(at[:, None] - at).T) > 0.75 * (radius[:, None] + radius)
    np.fill_diagonal(clear, True)
    if clear.all():
        return np.sort(slots)
    kept = np.arange(len(rows)) < len(taken)
    for row in range(len(taken), len(rows)):
        kept[row] = clear[row, kept].all()
    return np.sort(rows[len(taken) :][kept[len(taken) :]])
