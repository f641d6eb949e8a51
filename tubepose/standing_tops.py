"""Tops of whatever stands in a rack, measured without knowing what it is: height, diameter, open or closed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.labware import RackModel
from tubepose.transforms import FloatArray

ABOVE_M = 3e-3
"""What stands in a slot is higher than this above the face."""
TALLEST_M = 0.15
BIN_M = 1e-3
NEAR_M = (1.5e-3, 0.8e-3, 0.6e-3)
"""Half thickness of a top, round by round of its plane's fit: tops lean."""
LEAST_POINTS = 40
FILLED = 0.6
"""A closed top has at least this share of the points that a disc has within half of its radius."""
SIDES_M = (2.5e-3, 25e-3)
"""Radii that tops have."""
ROUND = 0.25
"""How much a disc's second moments may differ, as a share of their mean."""
SAME_MM, SAME_WIDE_MM = 1.0, 0.8
"""Tops of one kind differ by less from the next one in height and in diameter."""
LEAST_OF_A_KIND = 1


@dataclass(frozen=True, slots=True)
class StandingTop:
    """The top of what stands in a slot.

    Attributes:
        slot: Name of the slot.
        height_mm: Height of the top's centre above the rack's face, along the tube's own axis.
        diameter_mm: Diameter of the top; outer diameter of a rim.
        closed: Whether it is a disc; otherwise a ring.
        tilt_rad: Angle between the top's normal and the face's.
    """

    slot: str
    height_mm: float
    diameter_mm: float
    closed: bool
    tilt_rad: float


@dataclass(frozen=True, slots=True)
class TopKind:
    """Tops that are alike.

    Attributes:
        count: How many.
        closed: Whether they are discs.
        height_mm: Median height above the rack's face.
        height_std_mm: Robust standard deviation of one of them.
        diameter_mm: Median diameter.
        diameter_std_mm: Robust standard deviation of one of them.
    """

    count: int
    closed: bool
    height_mm: float
    height_std_mm: float
    diameter_mm: float
    diameter_std_mm: float


def measure_tops(local_m: FloatArray, rack: RackModel) -> tuple[StandingTop, ...]:
    """The tops in the slots of a rack; slots in which no flat one is seen are left out.

    Args:
        local_m: Points, shape (N, 3), rack frame, metres, without NaN.
        rack: The rack.
    """
    over = local_m[:, 2] - rack.height_m
    centers = rack.slot_centers_m
    reach = rack.pitches_m.max()
    some = (over > ABOVE_M) & (over < TALLEST_M) & np.all(np.abs(local_m[:, :2]) < rack.outline_m / 2 + reach, axis=1)
    points = np.column_stack([local_m[some, :2], over[some]])
    if len(points) < LEAST_POINTS:
        return ()
    apart = (
        np.linalg.norm(points[:, None, :2] - centers[None], axis=2) if len(points) < 20_000 else _apart(points, centers)
    )
    nearest = apart.argmin(axis=1)
    near = apart[np.arange(len(points)), nearest] < 0.75 * rack.pitches_m[nearest]
    found = []
    for index, slot in enumerate(rack.all_slots):
        top = _top(points[near & (nearest == index)], slot.name)
        if top is not None:
            found.append(top)
    return tuple(found)


def _apart(points: FloatArray, centers: FloatArray) -> FloatArray:
    """Distances (N, S) of many points, block by block."""
    return np.concatenate(
        [
            np.linalg.norm(part[:, None, :2] - centers[None], axis=2)
            for part in np.array_split(points, 1 + len(points) // 20_000)
        ]
    )


def _top(points: FloatArray, name: str) -> StandingTop | None:
    """The flat top among points of one slot: the fullest height, and a plane through what lies near it."""
    if len(points) < LEAST_POINTS:
        return None
    bins = np.floor(points[:, 2] / BIN_M).astype(int)
    counts = np.convolve(np.bincount(bins), np.ones(2), "full")
    plane = np.array([(int(counts.argmax())) * BIN_M, 0.0, 0.0])
    middle = np.median(points[np.abs(points[:, 2] - plane[0]) < NEAR_M[0], :2], axis=0)
    kept = np.zeros(len(points), bool)
    for near_m in NEAR_M:
        xy = points[:, :2] - middle
        kept = np.abs(points[:, 2] - plane[0] - xy @ plane[1:]) < near_m
        if kept.sum() < LEAST_POINTS:
            return None
        terms = np.column_stack([np.ones(kept.sum()), xy[kept]])
        plane = np.linalg.lstsq(terms, points[kept, 2], rcond=None)[0]
    return _disc(points[kept, :2], plane, middle, name)


def _disc(xy: FloatArray, plane: FloatArray, middle: FloatArray, name: str) -> StandingTop | None:
    """Radius by second moments: of a disc R^2 = 2 mean(r^2); of a ring by the outer edge of its radii."""
    centre = xy.mean(axis=0)
    moments = np.cov((xy - centre).T)
    spread = np.linalg.eigvalsh(moments)
    radii = np.linalg.norm(xy - centre, axis=1)
    radius = float(np.sqrt(2 * np.mean(radii**2)))
    inner = float(np.mean(radii < radius / 2))
    closed = inner > FILLED / 4
    if not closed:
        radius = float(np.quantile(radii, 0.98))
    if not SIDES_M[0] < radius < SIDES_M[1] or spread[1] - spread[0] > ROUND * spread.mean() * 2:
        return None
    tilt = float(np.arctan(np.hypot(*plane[1:])))
    height = float(plane[0] + (centre - middle) @ plane[1:])
    return StandingTop(name, 1e3 * height, 2e3 * radius, closed, tilt)


def kinds_of_tops(tops: Sequence[StandingTop]) -> tuple[TopKind, ...]:
    """Tops that are alike in height and diameter, the commonest kind first."""
    kinds = []
    for closed in (True, False):
        mine = [top for top in tops if top.closed == closed]
        for by_height in _split(mine, np.array([top.height_mm for top in mine]), SAME_MM):
            for group in _split(by_height, np.array([top.diameter_mm for top in by_height]), SAME_WIDE_MM):
                high, wide = (np.array([getattr(top, key) for top in group]) for key in ("height_mm", "diameter_mm"))
                kinds.append(
                    TopKind(
                        len(group), closed, float(np.median(high)), _spread(high), float(np.median(wide)), _spread(wide)
                    )
                )
    return tuple(sorted(kinds, key=lambda kind: -kind.count))


def _split(tops: Sequence[StandingTop], values: NDArray[np.float64], gap: float) -> list[list[StandingTop]]:
    if not len(tops):
        return []
    order = np.argsort(values)
    cuts = np.flatnonzero(np.diff(values[order]) > gap) + 1
    return [[tops[i] for i in part] for part in np.split(order, cuts)]


def _spread(values: FloatArray) -> float:
    """Robust standard deviation: of the median of absolute deviations."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))
