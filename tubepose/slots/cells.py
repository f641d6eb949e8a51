"""Cells of the openings: where a line of sight that crosses the rack's face goes, and what an empty slot returns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tubepose.labware import RackModel, TubeModel
from tubepose.transforms import FloatArray

EDGE_M = 5.0e-4
"""Cells this near to an opening's edge are left out, metres: the error of a rack's pose (0.3 mm) and half a pixel."""
OUTSIDE_M = 0.04
"""The grid reaches this far over the outline, metres: what a tube that stands out by 50 mm hides from a camera 35 deg
off the normal, and half its cap."""
COLUMN_M = 0.015
"""Farther from its opening, metres, nothing is of a slot's own column: a cap's overhang, and the lean."""
SLENDER = 0.7
"""Least diameter of what stands in a slot where no type is given, as a share of the opening's width: a 12 mm tube in
an opening of 16.5 mm. Thinner things lean and need a rack of their own."""
LEAST_CORE = 0.1
"""Least radius of a slot's core, as a share of its width: smaller discs hold less than one cell."""
LEVELS = 5
"""Heights at which the core of a slot is looked for along a line of sight."""


class OpeningSizes(NamedTuple):
    """Sizes of a rack's openings, in the order of its slots.

    Attributes:
        half_m: Half of each opening along x and y, shape (S, 2), metres.
        width_m: Width across its narrow side, shape (S,), metres.
        is_round: Which are round, shape (S,).
    """

    half_m: FloatArray
    width_m: FloatArray
    is_round: NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class OpeningCells:
    """Square cells of the openings of a rack, on its face, as part of a grid over and around it.

    Attributes:
        cell_m: Side of a cell, metres.
        low_m: Corner of the grid, rack frame, shape (2,), metres.
        cell: Number of the cell of a grid place, shape (X, Y); -1 where the place is in no opening.
        owner: Index of the slot whose column a grid place is in, that of the nearest opening, shape (X, Y); -1 farther
            from all than `COLUMN_M`.
        center_m: Centres of the cells, shape (C, 2), rack frame, metres.
        slot: Index of every cell's slot, shape (C,).
    """

    cell_m: float
    low_m: FloatArray
    cell: NDArray[np.intp]
    owner: NDArray[np.intp]
    center_m: FloatArray
    slot: NDArray[np.intp]


@lru_cache(maxsize=16)
def opening_sizes(rack: RackModel) -> OpeningSizes:
    """Sizes of all openings of a rack."""
    half = np.array([slot.half_size_m for slot in rack.all_slots])
    return OpeningSizes(half, 2 * half.min(axis=1), np.array([slot.shape == "round" for slot in rack.all_slots]))


@lru_cache(maxsize=16)
def opening_cells(rack: RackModel, cell_m: float) -> OpeningCells:
    """Cells of all openings of a rack."""
    half = rack.outline_m / 2 + OUTSIDE_M
    counts = np.ceil(2 * half / cell_m).astype(int)
    axes = [(np.arange(n) + 0.5) * cell_m - h for n, h in zip(counts, half, strict=True)]
    xy = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    nearest = np.full(xy.shape[:2], np.inf)
    owner = np.full(xy.shape[:2], -1, np.intp)
    for i, slot in enumerate(rack.all_slots):
        distance = slot.signed_distance_m(xy)
        nearer = distance < nearest
        owner[nearer], nearest[nearer] = i, distance[nearer]
    inside = nearest < -EDGE_M
    owner[nearest > COLUMN_M] = -1
    cell = np.full(xy.shape[:2], -1, np.intp)
    cell[inside] = np.arange(int(inside.sum()))
    return OpeningCells(cell_m, -half, cell, owner, xy[inside], owner[inside])


def empty_height_m(cells: OpeningCells, rack: RackModel, camera_m: FloatArray) -> FloatArray:
    """Greatest height at which a line of sight through each cell ends in an empty slot, shape (C,), metres.

    A slot is its opening, carried straight down to the floor: a line of sight ends on the wall or on the floor. Nearly
    along the wall a small shift moves that end by much: the line of the cell that meets the wall first counts, with
    the error of the rack's pose. The rounding of corners is left out.

    Args:
        cells: Cells of the rack's openings.
        rack: The rack.
        camera_m: Place of the camera, rack frame, shape (3,), metres; above the face.
    """
    nearer = cells.cell_m / np.sqrt(2) + EDGE_M
    sizes = opening_sizes(rack)
    half, is_round = sizes.half_m[cells.slot] - nearer, sizes.is_round[cells.slot]
    q = cells.center_m - rack.slot_centers_m[cells.slot]
    # Shift to the side per metre of descent.
    g = (cells.center_m - camera_m[:2]) / (camera_m[2] - rack.height_m)
    with np.errstate(divide="ignore", invalid="ignore"):
        sides = np.where(g == 0, np.inf, (half - np.sign(g) * q) / np.abs(g)).min(axis=1)
        a, b, c = (g**2).sum(axis=1), (g * q).sum(axis=1), (q**2).sum(axis=1) - half[:, 0] ** 2
        circle = np.where(a == 0, np.inf, (-b + np.sqrt(np.maximum(b**2 - a * c, 0))) / a)
        circle = np.where(c > 0, 0.0, circle)
    descent = np.clip(np.where(is_round, circle, sides), 0.0, rack.depth_m)
    return np.asarray(rack.height_m - descent)


def core_radius_m(rack: RackModel, tubes: Sequence[TubeModel]) -> tuple[FloatArray, FloatArray]:
    """The disc about every slot's middle that whatever stands in it covers, however it stands.

    A body of diameter D in an opening of width W stands off the middle by up to (W - D) / 2 to each side, in a square
    opening by sqrt(2) of that over the corner; leaning from side to side over the slot's depth it goes on by as much
    above the face.

    Args:
        rack: The rack.
        tubes: Types that can stand in it; without any, bodies of `SLENDER` of the opening's width.

    Returns:
        Radius at the face, shape (S,), metres, at least `LEAST_CORE` of the width; and what it loses per metre above
        the face, shape (S,).
    """
    sizes = opening_sizes(rack)
    widths, diagonal = sizes.width_m, np.where(sizes.is_round, 1.0, np.sqrt(2.0))
    bodies = [2 * tube.body_radius_m(rack.depth_m) for tube in tubes]
    body = np.minimum(min(bodies), widths) if bodies else SLENDER * widths
    off = diagonal * (widths - body) / 2
    return np.maximum(body / 2 - off, LEAST_CORE * widths), 2 * off / rack.depth_m


def core_cells(cells: OpeningCells, rack: RackModel, tubes: Sequence[TubeModel]) -> NDArray[np.bool_]:
    """Cells of the slots' cores at the face (`core_radius_m`), shape (C,)."""
    radius, _ = core_radius_m(rack, tubes)
    return np.asarray(np.hypot(*(cells.center_m - rack.slot_centers_m[cells.slot]).T) < radius[cells.slot])


def telling_cells(
    cells: OpeningCells, rack: RackModel, tubes: Sequence[TubeModel], camera_m: FloatArray
) -> NDArray[np.bool_]:
    """Cells whose lines of sight must be stopped by an opaque thing in the slot, shape (C,).

    Such a line meets the slot's core at the face or above it, as high as the shortest of the given types stands out.
    A line through the other cells may pass beside a tube: it says nothing.

    Args:
        cells: Cells of the rack's openings.
        rack: The rack.
        tubes: Types that can stand in it; without any, only the core at the face counts.
        camera_m: Place of the camera, rack frame, shape (3,), metres; above the face.
    """
    radius, loss = core_radius_m(rack, tubes)
    out_m = max(min((rack.floor_m + tube.height_m - rack.height_m for tube in tubes), default=0.0), 0.0)
    q = cells.center_m - rack.slot_centers_m[cells.slot]
    rise = (camera_m[:2] - cells.center_m) / (camera_m[2] - rack.height_m)
    telling = np.zeros(len(q), bool)
    for height in np.linspace(0.0, out_m, LEVELS):
        telling |= np.hypot(*(q + rise * height).T) < (radius - loss * height)[cells.slot]
    return telling


def slot_cores_m(rack: RackModel, tubes: Sequence[TubeModel], cell_m: float = 1.0e-3) -> dict[str, FloatArray]:
    """Cells of every slot's core (`core_cells`), by its name, shape (K, 2) each, rack frame, metres.

    Args:
        rack: The rack.
        tubes: Types that can stand in it.
        cell_m: Side of a cell, metres.
    """
    cells = opening_cells(rack, cell_m)
    inside = core_cells(cells, rack, tubes)
    rows = cells.slot[inside]
    return {slot.name: cells.center_m[inside][rows == k] for k, slot in enumerate(rack.all_slots)}
