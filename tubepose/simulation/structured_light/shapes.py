"""A scene as flat arrays, as the compiled kernels need it. Everything is in the rack frame, metres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tubepose.labware import RackModel
from tubepose.simulation.scene import TABLE_HALF_SIZE_M, Material, Scene
from tubepose.simulation.structured_light.parts import BoxPart, Piece, RevolvedPart, scene_parts
from tubepose.transforms import FloatArray, invert_transform

IntArray = NDArray[np.int64]


TABLE_MATERIAL, RACK_MATERIAL = 0, 1
_CELL_M = 0.018
_MARGIN_M = 1e-6


class Shapes(NamedTuple):
    """Flat arrays of everything that light meets.

    Attributes:
        table: Half the table's side, shape (1,); 0 without a table.
        rack: Half outline x, y, height, floor height, shape (4,); 0 without a rack.
        slots: Rows of centre x, y, half size x, y, corner radius (half the size of a round slot), shape (K, 5).
        grid: Origin x, y and side of the square cells that items are looked up in, shape (3,).
        cells: Columns and rows of the grid, shape (2,).
        slot_start: Where each cell's slots begin in `slot_list`, shape (cells + 1,).
        slot_list: Slots whose opening reaches into each cell.
        item_start: Where each cell's items begin in `item_list`, shape (cells + 1,).
        item_list: Items that reach into each cell: solids of revolution first, then boxes.
        item_bounds: Least and most x, y, z of all items, shape (3, 2).
        solids: Solids of revolution, shape (S, 28): rotation (9) and translation (3) into the object frame; bounding
            radius, least and most z; refractive index, scattering and absorption per metre; then the liquid: 1 if there
            is one, its level on the axis, its normal (3), refractive index, absorption per metre, and the cavity's wall
            there: z, radius, slope.
        segment_start: First segment of each solid, shape (S + 1,).
        segments: Rows of kind, z0, r0, z1, r1, slope or sphere centre, sphere radius, normal r (or its sign), normal z,
            first angle and span of a label, shape (N, 11).
        segment_type: OPAQUE, OUTSIDE or CAVITY, shape (N,).
        segment_material: Row of `materials`, shape (N,).
        boxes: Rotation (9), translation (3) into the box's frame and half sizes (3), shape (B, 15).
        box_material: Row of `materials`, shape (B,).
        materials: Albedo and roughness (negative: matte), shape (M, 2); 0 is the table, 1 the rack.
        wall_roughness: GGX roughness of see-through walls, shape (1,).
        profile_start: First row of each solid's profile in `profiles`, shape (S + 1,); none for a cap.
        profiles: Outer and inner radius of see-through bodies at steps of `PROFILE_STEP_M` from z = 0, shape (R, 2).
    """

    table: FloatArray
    rack: FloatArray
    slots: FloatArray
    grid: FloatArray
    cells: IntArray
    slot_start: IntArray
    slot_list: IntArray
    item_start: IntArray
    item_list: IntArray
    item_bounds: FloatArray
    solids: FloatArray
    segment_start: IntArray
    segments: FloatArray
    segment_type: IntArray
    segment_material: IntArray
    boxes: FloatArray
    box_material: IntArray
    materials: FloatArray
    wall_roughness: FloatArray
    profile_start: IntArray
    profiles: FloatArray


def shapes_of(scene: Scene) -> Shapes:
    """Everything in a scene, in its rack's frame."""
    finishes = scene.finishes
    revolved, boxes = scene_parts(scene)
    return make_shapes(
        revolved, boxes, finishes.table, finishes.rack, scene.rack, TABLE_HALF_SIZE_M, finishes.wall_roughness
    )


def make_shapes(
    revolved: Sequence[RevolvedPart],
    boxes: Sequence[BoxPart],
    table: Material,
    rack: Material,
    rack_model: RackModel | None,
    table_half_m: float,
    wall_roughness: float,
) -> Shapes:
    """Flat arrays of parts, with a rack (or none) on a table (or none, at half size 0)."""
    materials = [table, rack]

    def number(material: Material) -> int:
        if material not in materials[2:]:
            materials.append(material)
        return 2 + materials[2:].index(material)

    slots = np.empty((0, 5)) if rack_model is None else _slots(rack_model)
    bounds = [_bounds_of(part) for part in revolved] + [_box_bounds(part) for part in boxes]
    segment_counts = [sum(len(piece.segments) for piece in part.pieces) for part in revolved]
    pieces = [piece for part in revolved for piece in part.pieces]
    grid, cells, slot_start, slot_list, item_start, item_list, item_bounds = _make_grid(slots, bounds)
    profiles = [np.empty((0, 2)) if part.profile_m is None else part.profile_m for part in revolved]
    material_of = [number(piece.material) for piece in pieces]
    box_material = [number(part.material) for part in boxes]
    return Shapes(
        table=np.array([table_half_m]),
        rack=np.zeros(4) if rack_model is None else _rack(rack_model),
        slots=slots,
        grid=grid,
        cells=cells,
        slot_start=slot_start,
        slot_list=slot_list,
        item_start=item_start,
        item_list=item_list,
        item_bounds=item_bounds,
        solids=np.array([_solid(part) for part in revolved]).reshape(-1, 28),
        segment_start=np.concatenate([[0], np.cumsum(segment_counts)]).astype(np.int64),
        segments=np.concatenate([np.empty((0, 11)), *(piece.segments for piece in pieces)]),
        segment_type=_spread([piece.kind for piece in pieces], pieces),
        segment_material=_spread(material_of, pieces),
        boxes=np.array([_box(part) for part in boxes]).reshape(-1, 15),
        box_material=np.array(box_material, dtype=np.int64),
        materials=np.array([[m.albedo, -1.0 if m.roughness is None else m.roughness] for m in materials]),
        wall_roughness=np.array([wall_roughness]),
        profile_start=np.concatenate([[0], np.cumsum([len(p) for p in profiles])]).astype(np.int64),
        profiles=np.concatenate([np.empty((0, 2)), *profiles]),
    )


def _spread(values: list[int], pieces: Sequence[Piece]) -> IntArray:
    counts = [len(piece.segments) for piece in pieces]
    return np.repeat(np.array(values, dtype=np.int64), counts)


def _rack(rack: RackModel) -> FloatArray:
    return np.array([*(rack.outline_m / 2), rack.height_m, rack.floor_m])


def _slots(rack: RackModel) -> FloatArray:
    def radius(shape: str, half: float, corner_mm: float) -> float:
        return half if shape == "round" else corner_mm * 1e-3

    return np.array(
        [
            [*slot.center_m, *slot.half_size_m, radius(slot.shape, slot.half_size_m[0], slot.corner_radius_mm)]
            for slot in rack.all_slots
        ]
    )


def _solid(part: RevolvedPart) -> FloatArray:
    segments = np.concatenate([piece.segments for piece in part.pieces])
    inverse = invert_transform(part.T_rack_object)
    radius, low, high = part_extent(segments)
    row = np.zeros(28)
    row[:9], row[9:12] = inverse[:3, :3].ravel(), inverse[:3, 3]
    row[12:15] = radius + _MARGIN_M, low - _MARGIN_M, high + _MARGIN_M
    row[15] = 1.0
    if part.optics is not None:
        optics = part.optics
        row[15:18] = optics.refractive_index, optics.scattering_per_mm * 1e3, optics.absorption_per_mm * 1e3
    if part.liquid is not None and part.cavity_at_level is not None:
        liquid = part.liquid
        # Its surface is level: the rack's z axis, seen from the tube.
        row[18:20], row[20:23] = (1.0, liquid.level_m), inverse[:3, 2]
        row[23:25], row[25:28] = (liquid.refractive_index, liquid.absorption_per_m), part.cavity_at_level
    return row


def part_extent(segments: FloatArray) -> tuple[float, float, float]:
    """Largest radius, least and most z of segments (N, 11) of a solid of revolution."""
    spheres = segments[segments[:, 0] == 2]
    radius = max(segments[:, [2, 4]].max(), spheres[:, 6].max(initial=0.0))
    return float(radius), float(segments[:, [1, 3]].min()), float(segments[:, [1, 3]].max())


def _bounds_of(part: RevolvedPart) -> FloatArray:
    radius, low, high = part_extent(np.concatenate([piece.segments for piece in part.pieces]))
    T = part.T_rack_object
    ends = np.array([T[:3, 3] + z * T[:3, 2] for z in (low, high)])
    reach = radius * np.sqrt(np.clip(1 - T[:3, 2] ** 2, 0.0, 1.0)) + _MARGIN_M
    return np.column_stack([ends.min(axis=0) - reach, ends.max(axis=0) + reach])


def _box(part: BoxPart) -> FloatArray:
    inverse = invert_transform(part.T_rack_box)
    return np.concatenate([inverse[:3, :3].ravel(), inverse[:3, 3], part.half_m])


def _box_bounds(part: BoxPart) -> FloatArray:
    reach = np.abs(part.T_rack_box[:3, :3]) @ part.half_m + _MARGIN_M
    return np.column_stack([part.T_rack_box[:3, 3] - reach, part.T_rack_box[:3, 3] + reach])


@dataclass(frozen=True, slots=True)
class _Cells:
    """Square cells over x and y."""

    origin: FloatArray
    size: IntArray

    def lists(self, bounds: Sequence[FloatArray]) -> tuple[IntArray, IntArray]:
        """Rows of `bounds` (each (2 or 3, 2)) that reach into each cell: starts and members."""
        columns, rows = (int(n) for n in self.size)
        members: list[list[int]] = [[] for _ in range(columns * rows)]
        for i, bound in enumerate(bounds):
            low = np.floor((bound[:2, 0] - self.origin) / _CELL_M).astype(int)
            high = np.floor((bound[:2, 1] - self.origin) / _CELL_M).astype(int)
            for row in range(max(low[1], 0), min(high[1], rows - 1) + 1):
                for column in range(max(low[0], 0), min(high[0], columns - 1) + 1):
                    members[row * columns + column].append(i)
        starts = np.concatenate([[0], np.cumsum([len(m) for m in members])])
        return starts.astype(np.int64), np.array([i for m in members for i in m], dtype=np.int64)


def _make_grid(
    slots: FloatArray, items: Sequence[FloatArray]
) -> tuple[FloatArray, IntArray, IntArray, IntArray, IntArray, IntArray, FloatArray]:
    """Fields `grid` to `item_bounds` of `Shapes`, in order."""
    openings = [np.column_stack([row[:2] - row[2:4], row[:2] + row[2:4]]) for row in slots]
    everything = [bound[:2] for bound in (*openings, *items)] or [np.zeros((2, 2))]
    low = np.min([bound[:, 0] for bound in everything], axis=0) - _MARGIN_M
    high = np.max([bound[:, 1] for bound in everything], axis=0) + _MARGIN_M
    cells = _Cells(low, np.floor((high - low) / _CELL_M).astype(np.int64) + 1)
    # Without items the bounds are empty: no ray enters them.
    bounds = np.array([[1.0, 0.0]] * 3)
    if items:
        bounds = np.column_stack([np.min([b[:, 0] for b in items], axis=0), np.max([b[:, 1] for b in items], axis=0)])
    return np.array([*low, _CELL_M]), cells.size, *cells.lists(openings), *cells.lists(items), bounds
