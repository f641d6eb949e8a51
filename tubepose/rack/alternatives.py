"""Named alternatives to a rack in a pose: another line of slots, other openings, another pitch, no rack at all.

Each is a hypothesis of which parts of the face are solid. What speaks for it is the difference of the log likelihoods
of the same cells, nats, maximised over its own parameter: a difference does not depend on how many other cells there
are, and tells in which respect the file of the rack is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from tubepose.labware import RackModel, SlotModel, catalogue
from tubepose.rack import view_kernels as view_kernels
from tubepose.rack.face import Face, Grid, solid_levels
from tubepose.transforms import FloatArray

# Fields that differ by less than this everywhere in a cell are the same there.
SAME_M = 1e-4
# Two places of slots are the same within this share of the pitch.
SAME_PITCH = 0.25
SIDES = {"+x": (1, 0), "-x": (-1, 0), "+y": (0, 1), "-y": (0, -1)}
# A margin at least so wide beside the outermost openings could hold another line of slots.
FAR_M = 1.0
# Racks whose sides differ by less look alike at a first look.
ALIKE_M = 6e-3
# Light that goes astray is alike over a slot and its ribs, and what returns nothing does so in whole patches: one of
# them speaks for an alternative by no more than this, nats.
CLUSTER_M = 20e-3
MOST_MISSED = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Alternative:
    """Another rack in the same place.

    Attributes:
        code: What kind of difference it is.
        words: What it is, to be read after "the scan shows".
        rows: Cells in which it differs, indices, shape (K,).
        levels: Their chance of being solid, `solid_levels`, shape (K,).
    """

    code: str
    words: str
    rows: NDArray[np.intp]
    levels: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Gain:
    """How much likelier an alternative is than the rack.

    Attributes:
        code: Of the alternative.
        words: What it is.
        nats: Difference of the log likelihoods, negative where the rack is likelier.
    """

    code: str
    words: str
    nats: float


def gains(face: Face, rack: RackModel) -> tuple[Gain, ...]:
    """What every alternative gains over a rack, the likeliest of each code.

    Args:
        face: What was seen, on a grid of the rack's.
        rack: The rack.
    """
    own_m = own_distance_m(rack, face.grid)
    tables, (square, count) = face.tables(face.rates(own_m)), squares(face.grid)
    own, best = _own_levels(rack, _key(face.grid)), dict[str, Gain]()
    for other in alternatives(rack, face.grid):
        missed = np.zeros(count)
        seen = view_kernels.gained(face.kinds, face.shares, other.rows, other.levels, own, *tables, square, missed)
        nats = float(seen + np.minimum(missed, MOST_MISSED).sum())
        if other.code not in best or nats > best[other.code].nats:
            best[other.code] = Gain(other.code, other.words, nats)
    return tuple(best.values())


def squares(grid: Grid) -> tuple[NDArray[np.intp], int]:
    """Which square of `CLUSTER_M` every cell of a grid is in, shape (X * Y,), and how many there are."""
    return _squares(_key(grid))


@lru_cache(maxsize=16)
def _squares(key: tuple[float, ...]) -> tuple[NDArray[np.intp], int]:
    """Which square of `CLUSTER_M` every cell of a grid is in, shape (X * Y,), and how many there are."""
    side = max(1, round(CLUSTER_M / key[2]))
    shape = (int(key[3]), int(key[4]))
    i, j = np.indices(shape) // side
    columns = shape[1] // side + 1
    return (i * columns + j).ravel(), (shape[0] // side + 1) * columns


@lru_cache(maxsize=64)
def _cached(rack: RackModel, key: tuple[float, ...]) -> tuple[Alternative, ...]:
    grid = Grid(np.array(key[:2]), key[2], (int(key[3]), int(key[4])))
    own_m = own_distance_m(rack, grid)
    found = []
    for code, words, distance_m in _distances(rack, grid):
        rows = np.flatnonzero(np.abs(distance_m - own_m) > SAME_M)
        found.append(Alternative(code, words, rows, solid_levels(distance_m[rows])))
    return tuple(found)


def alternatives(rack: RackModel, grid: Grid) -> tuple[Alternative, ...]:
    """The alternatives of a rack that have no parameter, on a grid."""
    return _cached(rack, _key(grid))


def _key(grid: Grid) -> tuple[float, ...]:
    return (*map(float, grid.low_m), grid.cell_m, *map(float, grid.shape))


@lru_cache(maxsize=64)
def _own(rack: RackModel, key: tuple[float, ...]) -> FloatArray:
    grid = Grid(np.array(key[:2]), key[2], (int(key[3]), int(key[4])))
    return np.maximum(_to_outline_m(rack, grid), _to_openings_m(rack.all_slots, grid))


@lru_cache(maxsize=64)
def _own_levels(rack: RackModel, key: tuple[float, ...]) -> NDArray[np.uint8]:
    return solid_levels(_own(rack, key))


def own_distance_m(rack: RackModel, grid: Grid) -> FloatArray:
    """Signed distance of a grid's cells from a rack's solid part, shape (X * Y,), metres."""
    return _own(rack, _key(grid))


def _distances(rack: RackModel, grid: Grid) -> Iterator[tuple[str, str, FloatArray]]:
    outline_m, slots = _to_outline_m(rack, grid), rack.all_slots
    yield "no_openings", "a plate without openings", outline_m
    for other in lookalikes(rack):
        for turned in (False, True):
            other_m = np.maximum(_to_outline_m(other, grid), _to_openings_m(other.all_slots, grid)).reshape(grid.shape)
            yield "other_rack", other.name, (other_m[::-1, ::-1] if turned else other_m).ravel()
    steps = line_steps_m(rack)
    for side, sign in SIDES.items():
        axis = 0 if sign[0] else 1
        step = steps[axis]
        if step is None:
            continue
        step_m = np.array(sign) * step
        edge = edge_slots(slots, step_m)
        what = "column" if axis == 0 else "row"
        moved = [_moved(slot, step_m) for slot in edge]
        grown_m = _to_outline_m(rack, grid, sign, step)
        with_more = _to_openings_m((*slots, *moved), grid)
        yield f"{what}_more", f"a {what} of slots more at {side}", np.maximum(grown_m, with_more)
        if _fits(rack, moved):
            yield f"{what}_more", f"a {what} of slots more at {side}", np.maximum(outline_m, with_more)
        fewer = tuple(slot for slot in slots if slot not in edge)
        if fewer:
            cut_m = _to_outline_m(rack, grid, sign, -step)
            without = _to_openings_m(fewer, grid)
            yield f"{what}_fewer", f"a {what} of slots fewer at {side}", np.maximum(cut_m, without)
            yield f"{what}_fewer", f"a {what} of slots fewer at {side}", np.maximum(outline_m, without)


def lookalikes(rack: RackModel) -> tuple[RackModel, ...]:
    """Racks of the catalogue whose outline is nearly a rack's own."""
    racks = (item for item in catalogue().values() if isinstance(item, RackModel) and item.name != rack.name)
    return tuple(item for item in racks if np.abs(item.outline_m - rack.outline_m).max() < ALIKE_M)


@lru_cache(maxsize=32)
def line_steps_m(rack: RackModel) -> tuple[float | None, float | None]:
    """Distance of neighbouring columns along x and of rows along y, metres; None where there is one line only."""
    centers = rack.slot_centers_m
    found: list[float | None] = []
    for axis in range(2):
        apart = np.abs(centers[:, None] - centers[None])
        beside = apart[(apart[..., 1 - axis] < 1e-3) & (apart[..., axis] > 1e-3)]
        found.append(float(beside[:, axis].min()) if len(beside) else None)
    return found[0], found[1]


def edge_slots(slots: tuple[SlotModel, ...], step_m: FloatArray) -> tuple[SlotModel, ...]:
    """Slots that have no neighbour a step farther, nor anything that a slot there would overlap."""
    centers = np.array([slot.center_m for slot in slots])
    reach = SAME_PITCH * float(np.linalg.norm(step_m))
    beyond = np.linalg.norm(centers[None] - (centers + step_m)[:, None], axis=2).min(axis=1)
    along = centers @ (step_m / np.linalg.norm(step_m))
    outermost = along > along.max() - 0.5 * float(np.linalg.norm(step_m))
    return tuple(slot for slot, far, out in zip(slots, beyond, outermost, strict=True) if far > reach and out)


def _moved(slot: SlotModel, step_m: FloatArray) -> SlotModel:
    center = (slot.center_mm[0] + 1e3 * float(step_m[0]), slot.center_mm[1] + 1e3 * float(step_m[1]))
    return slot.model_copy(update={"name": f"{slot.name}+", "center_mm": center})


def _fits(rack: RackModel, slots: list[SlotModel]) -> bool:
    half = np.array(rack.outline_mm) / 2
    return all(np.all(np.abs(slot.center_mm) + np.array(slot.size_mm) / 2 < half) for slot in slots)


def _to_outline_m(rack: RackModel, grid: Grid, side: tuple[int, int] = (0, 0), more_m: float = 0.0) -> FloatArray:
    """Signed distance of cells from the inside of the outline, shape (X * Y,); one side so much farther out."""
    xy, half = grid.centers_m, rack.outline_m / 2
    shift = np.array(side) * more_m / 2
    edge = np.abs(xy - shift) - (half + np.abs(shift) * np.sign(more_m))
    outside = np.hypot(*np.maximum(edge, 0).reshape(-1, 2).T)
    return np.asarray(outside + np.minimum(edge.max(axis=-1), 0).ravel())


def _to_openings_m(slots: tuple[SlotModel, ...], grid: Grid) -> FloatArray:
    """Signed distance of cells from the face beside its openings, shape (X * Y,), as if the face had no end."""
    xy = grid.centers_m
    distance = np.full(grid.shape, -FAR_M)
    for slot in slots:
        half = np.ceil((slot.half_size_m + 8e-3) / grid.cell_m)
        at = np.rint((slot.center_m - grid.low_m) / grid.cell_m)
        low = np.maximum(at - half, 0).astype(int)
        high = np.maximum(at + half + 1, 0).astype(int)
        near = slice(low[0], high[0]), slice(low[1], high[1])
        distance[near] = np.maximum(distance[near], -slot.signed_distance_m(xy[near]))
    return distance.ravel()
