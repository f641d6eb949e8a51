"""Racks: an outline, a height, and slots with their own centres, shapes and sizes.

Rack frame: origin at the centre of the base, z up out of the slots, x along the columns (A1 to A2), y towards row A.
"""

from __future__ import annotations

import string
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from tubepose.labware.definition import MM, Definition, Name, NonNegative, Positive
from tubepose.transforms import FloatArray

LEAST_RACK_MM = 2.0
"""Smaller measures are metres."""
Shape = Literal["square", "round"]


class SlotModel(Definition):
    """One slot of a rack.

    Attributes:
        name: Unique in its rack, e.g. ``A1``.
        center_mm: Centre of the opening in the rack frame, (x, y).
        shape: ``square`` (rectangles too) or ``round``.
        size_mm: Opening along x and y; both are the diameter of a round slot.
        corner_radius_mm: Rounding of a square slot's corners.
    """

    name: Name
    center_mm: tuple[float, float]
    shape: Shape
    size_mm: tuple[Positive, Positive]
    corner_radius_mm: NonNegative = 0.0

    @model_validator(mode="after")
    def _check(self) -> SlotModel:
        if self.shape == "round" and self.size_mm[0] != self.size_mm[1]:
            raise ValueError(f"slot {self.name}: a round slot has one diameter, found {self.size_mm}")
        if self.shape == "round" and self.corner_radius_mm:
            raise ValueError(f"slot {self.name}: corner_radius_mm is of square openings, and this one is round")
        if 2 * self.corner_radius_mm > min(self.size_mm):
            raise ValueError(f"slot {self.name}: corner_radius_mm is more than half the opening")
        return self

    @property
    def center_m(self) -> FloatArray:
        """Centre of the opening in the rack frame, shape (2,), metres."""
        return np.array(self.center_mm) * MM

    @property
    def half_size_m(self) -> FloatArray:
        """Half of the opening along x and y (the paper's L and W), shape (2,), metres."""
        return np.array(self.size_mm) * (MM / 2)

    def boundary_m(self, spacing_m: float = 5e-4) -> FloatArray:
        """Outline of the opening, counter-clockwise, shape (N, 2), rack frame, metres."""
        half = self.half_size_m
        radius = half[0] if self.shape == "round" else self.corner_radius_mm * MM
        if radius == 0:
            corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half
            return np.asarray(corners + self.center_m)
        per_corner = max(4, int(np.ceil(radius * np.pi / 2 / spacing_m)))
        angles = np.linspace(0, np.pi / 2, per_corner, endpoint=self.shape == "square")
        arcs = []
        for quarter, sign in enumerate(([1, 1], [-1, 1], [-1, -1], [1, -1])):
            turned = angles + quarter * np.pi / 2
            arc = radius * np.column_stack([np.cos(turned), np.sin(turned)])
            arcs.append(arc + np.array(sign) * (half - radius))
        return np.asarray(np.concatenate(arcs) + self.center_m)

    def signed_distance_m(self, xy_m: FloatArray) -> FloatArray:
        """Distance of points (..., 2) in the rack frame to the opening's edge, negative inside, metres."""
        q = np.asarray(xy_m) - self.center_m
        half = self.half_size_m
        if self.shape == "round":
            return np.asarray(np.hypot(q[..., 0], q[..., 1]) - half[0])
        radius = self.corner_radius_mm * MM
        d = np.abs(q) - (half - radius)
        outside = np.hypot(np.maximum(d[..., 0], 0), np.maximum(d[..., 1], 0))
        return np.asarray(outside + np.minimum(np.maximum(d[..., 0], d[..., 1]), 0) - radius)


class SlotShape(Definition):
    """Opening shared by all slots of a grid."""

    shape: Shape
    size_mm: tuple[Positive, Positive]
    corner_radius_mm: NonNegative = 0.0


class SlotGrid(Definition):
    """Shorthand for slots in rows and columns, centred on the rack.

    Attributes:
        rows: Number of rows, along y; row A is the one with the largest y.
        columns: Number of columns, along x; column 1 has the smallest x.
        pitch_mm: Distance of neighbouring slots along x and y.
        slot: Opening of every slot.
        offset_mm: Shift of the whole grid from the rack's centre, (x, y).
    """

    rows: Annotated[int, Field(ge=1, le=26)]
    columns: Annotated[int, Field(ge=1, le=99)]
    pitch_mm: tuple[Positive, Positive]
    slot: SlotShape
    offset_mm: tuple[float, float] = (0.0, 0.0)

    def expand(self) -> tuple[SlotModel, ...]:
        """List the slots row by row: A1, A2, ..., B1, ..."""
        slots = []
        for row in range(self.rows):
            for column in range(self.columns):
                x = (column - (self.columns - 1) / 2) * self.pitch_mm[0] + self.offset_mm[0]
                y = ((self.rows - 1) / 2 - row) * self.pitch_mm[1] + self.offset_mm[1]
                name = f"{string.ascii_uppercase[row]}{column + 1}"
                slots.append(SlotModel(name=name, center_mm=(x, y), **self.slot.model_dump()))
        return tuple(slots)


class RackModel(Definition):
    """A rack: its outline, its height, and its slots as a list or as a grid.

    Attributes:
        name: Catalogue name.
        outline_mm: Size of the top along x and y.
        height_mm: Height of the top above the base.
        floor_mm: Height of the slot floor above the base, where a tube's bottom stands.
        floor_tolerance_mm: Standard deviation of the slot floor's height below the top; large for a rack that was found
            by its slots alone.
        floor_play_mm: How far a tube's bottom centre may stand off the slot's centre (a dent in the floor keeps it).
        slots: The slots, each with its own centre, shape and size; or
        grid: the shorthand for them. Exactly one of the two.
        source: Where the measures come from.
    """

    kind: Literal["rack"]
    name: Name
    description: str = ""
    source: str = ""
    outline_mm: tuple[Positive, Positive]
    height_mm: Positive
    floor_mm: NonNegative
    floor_play_mm: NonNegative = 1.0
    floor_tolerance_mm: NonNegative = 0.1
    grid: SlotGrid | None = None
    slots: tuple[SlotModel, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> RackModel:
        if (self.grid is None) == (not self.slots):
            raise ValueError("a rack needs either 'grid' or 'slots', and not both")
        if min(*self.outline_mm, self.height_mm) < LEAST_RACK_MM:
            measures = f"outline_mm {self.outline_mm}, height_mm {self.height_mm}"
            raise ValueError(f"a rack is {LEAST_RACK_MM:g} mm or more each way, found {measures}: are they metres?")
        if self.floor_mm >= self.height_mm:
            raise ValueError(f"floor_mm {self.floor_mm} is not below height_mm {self.height_mm}")
        names = [slot.name for slot in self.all_slots]
        doubled = sorted({name for name in names if names.count(name) > 1})
        if doubled:
            raise ValueError(f"slot names must be unique, found twice: {', '.join(doubled)}")
        widest = max(max(slot.size_mm) for slot in self.all_slots)
        if self.floor_play_mm > widest / 2:
            words = f"floor_play_mm {self.floor_play_mm} is more than half of the widest slot, {widest:g} mm"
            raise ValueError(f"{words}: is all of it in millimetres?")
        half = np.array(self.outline_mm) / 2
        for slot in self.all_slots:
            if np.any(np.abs(slot.center_mm) + np.array(slot.size_mm) / 2 >= half):
                raise ValueError(f"slot {slot.name} reaches over the outline {self.outline_mm}")
        for i, slot in enumerate(self.all_slots):
            for other in self.all_slots[i + 1 :]:
                if _overlap(slot, other):
                    raise ValueError(f"slots {slot.name} and {other.name} overlap")
        return self

    @cached_property
    def all_slots(self) -> tuple[SlotModel, ...]:
        """Every slot, in the order of the definition."""
        return self.grid.expand() if self.grid is not None else self.slots

    def has_slot(self, name: str) -> bool:
        """Whether a slot has that name."""
        return any(slot.name == name for slot in self.all_slots)

    @property
    def slot_words(self) -> str:
        """What to say of the names of the slots."""
        return f"its slots run from {self.all_slots[0].name} to {self.all_slots[-1].name}"

    def slot(self, name: str) -> SlotModel:
        """The slot of that name; KeyError if there is none."""
        for slot in self.all_slots:
            if slot.name == name:
                return slot
        raise KeyError(name)

    @property
    def outline_m(self) -> FloatArray:
        """Size of the top along x and y, shape (2,), metres."""
        return np.array(self.outline_mm) * MM

    @property
    def height_m(self) -> float:
        """Height of the top above the base, metres."""
        return self.height_mm * MM

    @property
    def floor_m(self) -> float:
        """Height of the slot floor above the base, metres."""
        return self.floor_mm * MM

    @property
    def depth_m(self) -> float:
        """Depth of a slot from the top to the floor (the paper's H), metres."""
        return (self.height_mm - self.floor_mm) * MM

    @property
    def slot_centers_m(self) -> FloatArray:
        """Centres of all openings in the rack frame, shape (S, 2), metres."""
        return np.array([slot.center_mm for slot in self.all_slots]) * MM

    @cached_property
    def pitches_m(self) -> FloatArray:
        """Distance of every slot's centre to the nearest other one, shape (S,), metres; a lone slot counts 20 mm."""
        centers = self.slot_centers_m
        if len(centers) == 1:
            return np.array([0.02])
        apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
        np.fill_diagonal(apart, np.inf)
        return np.asarray(apart.min(axis=1))

    @cached_property
    def min_rib_m(self) -> float:
        """Width of the narrowest rib between two slots, metres: what a sensor must resolve to see the slots."""
        widths = [
            min(np.array(self.outline_mm) / 2 - np.abs(s.center_mm) - np.array(s.size_mm) / 2) for s in self.all_slots
        ]
        slots = self.all_slots
        for i, slot in enumerate(slots):
            for other in slots[i + 1 :]:
                widths.append(_gap_mm(slot, other))
        return float(min(widths)) * MM

    def bottom_center_m(self, slot: SlotModel) -> FloatArray:
        """Centre of a slot's floor in the rack frame (the paper's o_i), shape (3,), metres."""
        return np.array([*slot.center_m, self.floor_m])

    def top_signed_distance_m(self, xy_m: FloatArray) -> FloatArray:
        """Distance of points (..., 2) to the solid part of the top, negative inside the solid, metres."""
        xy = np.asarray(xy_m)
        edge = np.abs(xy) - self.outline_m / 2
        distance = np.maximum(edge[..., 0], edge[..., 1])
        for slot in self.all_slots:
            distance = np.maximum(distance, -slot.signed_distance_m(xy))
        return np.asarray(distance)


def _gap_mm(a: SlotModel, b: SlotModel) -> float:
    delta = np.array(a.center_mm) - np.array(b.center_mm)
    if a.shape == b.shape == "round":
        return float(np.hypot(*delta) - (a.size_mm[0] + b.size_mm[0]) / 2)
    return float(np.max(np.abs(delta) - (np.array(a.size_mm) + np.array(b.size_mm)) / 2))


def _overlap(a: SlotModel, b: SlotModel) -> bool:
    if a.shape == b.shape:
        return _gap_mm(a, b) <= 0
    square, disc = (a, b) if a.shape == "square" else (b, a)
    return bool(float(square.signed_distance_m(disc.center_m)) <= disc.half_size_m[0])
