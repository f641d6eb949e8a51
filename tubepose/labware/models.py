"""Labware as the definitions state it: racks with slots, tubes as profiles of revolution, printed caps.

Definitions are written in millimetres, and every such field says so in its name; the methods and properties that
the pipeline uses give metres. All models are frozen and strict: an unknown key is an error at every level.

Frames. Rack: origin at the centre of the base, z up out of the slots, x along the columns (A1 to A2), y towards row A.
Tube: origin at the outermost point of the bottom on the axis, z towards the opening. Cap: as the tube that wears it.
"""

from __future__ import annotations

import string
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from tubepose.transforms import FloatArray

MM = 1e-3
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]
Shape = Literal["square", "round"]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, ignored_types=(cached_property,))


class SlotModel(_Strict):
    """One slot of a rack.

    Attributes:
        name: Unique in its rack, e.g. ``A1``.
        center_mm: Centre of the opening in the rack frame, (x, y).
        shape: ``square`` (rectangles too) or ``round``.
        size_mm: Opening along x and y; both are the diameter of a round slot.
        corner_radius_mm: Rounding of a square slot's corners.
    """

    name: str = Field(min_length=1)
    center_mm: tuple[float, float]
    shape: Shape
    size_mm: tuple[Positive, Positive]
    corner_radius_mm: NonNegative = 0.0

    @model_validator(mode="after")
    def _check(self) -> SlotModel:
        if self.shape == "round" and self.size_mm[0] != self.size_mm[1]:
            raise ValueError(f"slot {self.name}: a round slot has one diameter, found {self.size_mm}")
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


class SlotShape(_Strict):
    """Opening shared by all slots of a grid."""

    shape: Shape
    size_mm: tuple[Positive, Positive]
    corner_radius_mm: NonNegative = 0.0


class SlotGrid(_Strict):
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


class RackModel(_Strict):
    """A rack: its outline, its height, and its slots as a list or as a grid.

    Attributes:
        name: Catalogue name.
        outline_mm: Size of the top along x and y.
        height_mm: Height of the top above the base.
        floor_mm: Height of the slot floor above the base, where a tube's bottom stands.
        floor_play_mm: How far a tube's bottom centre may stand off the slot's centre (a dent in the floor keeps it).
        slots: The slots, each with its own centre, shape and size; or
        grid: the shorthand for them. Exactly one of the two.
        source: Where the measures come from.
    """

    kind: Literal["rack"]
    name: str = Field(min_length=1)
    description: str = ""
    source: str = ""
    outline_mm: tuple[Positive, Positive]
    height_mm: Positive
    floor_mm: NonNegative
    floor_play_mm: NonNegative = 1.0
    grid: SlotGrid | None = None
    slots: tuple[SlotModel, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> RackModel:
        if (self.grid is None) == (not self.slots):
            raise ValueError("a rack needs either 'grid' or 'slots', and not both")
        if self.floor_mm >= self.height_mm:
            raise ValueError(f"floor_mm {self.floor_mm} is not below height_mm {self.height_mm}")
        names = [slot.name for slot in self.all_slots]
        doubled = sorted({name for name in names if names.count(name) > 1})
        if doubled:
            raise ValueError(f"slot names must be unique, found twice: {', '.join(doubled)}")
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
    return float(square.signed_distance_m(disc.center_m)) <= disc.half_size_m[0]


class TubeBody(_Strict):
    """The body of a tube: a tapered wall with a bottom.

    Attributes:
        height_mm: From the bottom to the rim of the opening, without cap.
        bottom_diameter_mm: Outer diameter where the wall leaves the bottom.
        top_diameter_mm: Outer diameter at the rim.
        wall_mm: Wall thickness.
        bottom: ``round`` (half a sphere), ``conical`` or ``flat``.
        cone_height_mm: Height of a conical bottom.
        cone_tip_diameter_mm: Diameter of the flat tip of a conical bottom.
        material: What light does to the wall.
    """

    height_mm: Positive
    bottom_diameter_mm: Positive
    top_diameter_mm: Positive
    wall_mm: Positive = 1.0
    bottom: Literal["round", "conical", "flat"] = "round"
    cone_height_mm: NonNegative = 0.0
    cone_tip_diameter_mm: NonNegative = 0.0
    material: Literal["opaque", "translucent", "transparent"]

    @model_validator(mode="after")
    def _check(self) -> TubeBody:
        if 2 * self.wall_mm >= min(self.bottom_diameter_mm, self.top_diameter_mm):
            raise ValueError(f"wall_mm {self.wall_mm} leaves no room inside the body")
        if (self.bottom == "conical") != (self.cone_height_mm > 0):
            raise ValueError("cone_height_mm goes with bottom: conical, and only with it")
        if self.bottom_height_mm >= self.height_mm:
            raise ValueError("the bottom is higher than the body")
        return self

    @property
    def bottom_height_mm(self) -> float:
        """Height of the bottom, where the wall begins."""
        return {"round": self.bottom_diameter_mm / 2, "conical": self.cone_height_mm, "flat": 0.0}[self.bottom]


class TubeCap(_Strict):
    """What sits on the rim: an opaque cap, or the flange (``open: true``) of a tube without one.

    Attributes:
        diameter_mm: Outer diameter.
        height_mm: Height of its side.
        top_mm: How far its top stands above the body's rim (0: the flange ends with the rim).
        open: The opening stays open, as under a flange; otherwise the top is a closed disc.
        material: As for the body; a cap is opaque unless it says otherwise.
    """

    diameter_mm: Positive
    height_mm: Positive
    top_mm: NonNegative
    open: bool = False
    material: Literal["opaque", "translucent", "transparent"] = "opaque"

    @model_validator(mode="after")
    def _check(self) -> TubeCap:
        if self.open and self.top_mm > 0:
            raise ValueError("an open flange ends with the rim: top_mm must be 0")
        return self


class TubeModel(_Strict):
    """A tube as a profile of revolution, with body and cap radii apart.

    Attributes:
        name: Catalogue name.
        classes: Detector class names that mean this tube.
        body: Taper, wall and bottom.
        cap: Cap or flange, or null for a plain open tube.
        source: Where the measures come from.
    """

    kind: Literal["tube"]
    name: str = Field(min_length=1)
    description: str = ""
    source: str = ""
    classes: tuple[str, ...] = ()
    body: TubeBody
    cap: TubeCap | None = None

    @model_validator(mode="after")
    def _check(self) -> TubeModel:
        if self.cap is not None:
            if self.cap.height_mm >= self.height_mm - self.body.bottom_height_mm:
                raise ValueError("the cap reaches below the body's wall")
            if self.cap.diameter_mm <= self.body.top_diameter_mm:
                raise ValueError(
                    f"cap diameter_mm {self.cap.diameter_mm} is not more than the body's {self.body.top_diameter_mm}"
                )
        return self

    @property
    def is_open(self) -> bool:
        """True when the opening is not closed by a cap."""
        return self.cap is None or self.cap.open

    @property
    def height_mm(self) -> float:
        """Height with cap."""
        return self.body.height_mm + (self.cap.top_mm if self.cap is not None else 0.0)

    @property
    def height_m(self) -> float:
        """Height with cap, metres."""
        return self.height_mm * MM

    @property
    def rim_height_m(self) -> float:
        """Height of the body's rim above the bottom, metres; a printed cap is seated on it."""
        return self.body.height_mm * MM

    @property
    def max_radius_m(self) -> float:
        """Largest outer radius (the cap's where there is one), metres: the cylinder that is fitted."""
        widest = max(self.body.bottom_diameter_mm, self.body.top_diameter_mm)
        return max(widest, self.cap.diameter_mm if self.cap is not None else 0.0) * MM / 2

    def body_radius_m(self, z_m: FloatArray | float) -> FloatArray:
        """Outer radius of the body's wall at heights z above the bottom, metres; in the bottom, the wall's start."""
        b = self.body
        fraction = (np.asarray(z_m) / MM - b.bottom_height_mm) / (b.height_mm - b.bottom_height_mm)
        diameter = b.bottom_diameter_mm + np.clip(fraction, 0, 1) * (b.top_diameter_mm - b.bottom_diameter_mm)
        return np.asarray(diameter * MM / 2)

    def body_profile_m(self, spacing_m: float = 5e-4) -> FloatArray:
        """Outer profile of the bare body from the bottom's centre to the rim: rows (z, r), shape (N, 2), metres."""
        return _outer_profile(self.body, 0.0, spacing_m)

    def cavity_profile_m(self, spacing_m: float = 5e-4) -> FloatArray:
        """Inner profile of the body from the rim down to the cavity's bottom: rows (z, r), shape (N, 2), metres."""
        return np.asarray(_outer_profile(self.body, self.body.wall_mm, spacing_m)[::-1])

    def cap_profile_m(self) -> FloatArray:
        """Profile of the cap or flange from the body to its top: rows (z, r), metres; shape (0, 2) without."""
        if self.cap is None:
            return np.empty((0, 2))
        top, radius = self.height_m, self.cap.diameter_mm * MM / 2
        skirt = top - self.cap.height_mm * MM
        inner = float(self.body_radius_m(top)) - self.body.wall_mm * MM if self.cap.open else 0.0
        return np.array([[skirt, float(self.body_radius_m(skirt))], [skirt, radius], [top, radius], [top, inner]])

    def outer_profile_m(self, spacing_m: float = 5e-4) -> FloatArray:
        """What is seen from outside, from the bottom's centre over the wall and cap to the top: rows (z, r), metres.

        Ends on the axis for a closed cap, on the inner edge of the rim for an open tube.
        """
        body = self.body_profile_m(spacing_m)
        if self.cap is None:
            inner = body[-1, 1] - self.body.wall_mm * MM
            return np.vstack([body, [[body[-1, 0], inner]]])
        cap = self.cap_profile_m()
        return np.vstack([body[body[:, 0] < cap[0, 0]], cap])


def _outer_profile(body: TubeBody, inset_mm: float, spacing_m: float) -> FloatArray:
    """Profile (z, r) of the body's outside (inset 0) or of its cavity (inset = wall), metres."""
    r0, r1 = body.bottom_diameter_mm / 2 - inset_mm, body.top_diameter_mm / 2 - inset_mm
    z0 = body.bottom_height_mm
    if body.bottom == "round":
        steps = max(8, int(np.ceil(r0 * MM * np.pi / 2 / spacing_m)))
        angles = np.linspace(0, np.pi / 2, steps + 1)
        bottom = np.column_stack([z0 - r0 * np.cos(angles), r0 * np.sin(angles)])
    elif body.bottom == "conical":
        tip = max(body.cone_tip_diameter_mm / 2 - inset_mm, 0.0)
        bottom = np.array([[inset_mm, 0.0], [inset_mm, tip], [z0 + inset_mm, r0]])
    else:
        bottom = np.array([[inset_mm, 0.0], [inset_mm, r0]])
    profile = np.vstack([bottom, [[body.height_mm, r1]]]) * MM
    keep = [0] + [i + 1 for i, (a, b) in enumerate(pairwise(profile)) if not np.array_equal(a, b)]
    return np.asarray(profile[keep])


class CapModel(_Strict):
    """A printed ground-truth cap: a square plate whose centre lies on the tube's axis.

    Attributes:
        name: Catalogue name.
        square_mm: Side of the square top.
        thickness_mm: Thickness of the plate.
        seat_mm: Height of the square's top above the rim of the tube that wears it.
    """

    kind: Literal["cap"]
    name: str = Field(min_length=1)
    description: str = ""
    source: str = ""
    square_mm: Positive
    thickness_mm: Positive
    seat_mm: Positive

    @model_validator(mode="after")
    def _check(self) -> CapModel:
        if self.thickness_mm > self.seat_mm:
            raise ValueError("thickness_mm is more than seat_mm: the plate would sink below the rim")
        return self

    @property
    def square_m(self) -> float:
        """Side of the square top, metres."""
        return self.square_mm * MM

    def offset_m(self, tube: TubeModel) -> float:
        """Distance from the square's centre down to the origin of the tube that wears the cap, metres."""
        return tube.rim_height_m + self.seat_mm * MM
