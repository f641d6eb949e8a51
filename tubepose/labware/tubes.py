"""Tubes as profiles of revolution with body and cap apart, and the printed caps that ground truth wears.

Tube frame: origin at the outermost point of the bottom on the axis, z towards the opening. Cap: as the tube that
wears it.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from tubepose.labware.definition import MM, Definition, Name, NonNegative, Positive
from tubepose.transforms import FloatArray

LEAST_TUBE_MM = 5.0
RACK_CLASS = "rack"
"""What detectors call a rack: no tube answers to it."""
Material = Literal["opaque", "translucent", "transparent"]


class WallOptics(Definition):
    """What the plastic of a see-through wall does to light.

    Attributes:
        refractive_index: Of the plastic; 1.49 is usual for tubes.
        scattering_per_mm: Scattering coefficient: 0 is clear, 1 is milky.
        absorption_per_mm: Absorption coefficient.
    """

    refractive_index: float = Field(default=1.49, ge=1.0, le=2.5)
    scattering_per_mm: NonNegative = 0.0
    absorption_per_mm: NonNegative = 0.0


# Assumptions: no published measurement of these walls is known to us; 0.4 per mm looks like polypropylene.
DEFAULT_OPTICS = {
    "translucent": WallOptics(scattering_per_mm=0.4, absorption_per_mm=0.005),
    "transparent": WallOptics(scattering_per_mm=0.01, absorption_per_mm=0.002),
}


class TubeBody(Definition):
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
        optics: The wall's plastic in numbers, where they are known; else what its material stands for.
    """

    height_mm: Positive
    bottom_diameter_mm: Positive
    top_diameter_mm: Positive
    wall_mm: Positive = 1.0
    bottom: Literal["round", "conical", "flat"] = "round"
    cone_height_mm: NonNegative = 0.0
    cone_tip_diameter_mm: NonNegative = 0.0
    material: Material
    optics: WallOptics | None = None

    @model_validator(mode="after")
    def _check(self) -> TubeBody:
        if self.height_mm < LEAST_TUBE_MM:
            high = self.height_mm
            raise ValueError(f"a tube is {LEAST_TUBE_MM:g} mm high or more, found height_mm {high}: is it in metres?")
        if self.optics is not None and self.material == "opaque":
            raise ValueError("optics are those of a see-through wall, but the body's material is opaque")
        if 2 * self.wall_mm >= min(self.bottom_diameter_mm, self.top_diameter_mm):
            raise ValueError(f"wall_mm {self.wall_mm} leaves no room inside the body")
        if (self.bottom == "conical") != (self.cone_height_mm > 0):
            raise ValueError("cone_height_mm goes with bottom: conical, and only with it")
        if self.bottom_height_mm >= self.height_mm:
            words = f"{self.bottom_height_mm:g} mm, is not below height_mm {self.height_mm:g}"
            raise ValueError(f"the {self.bottom} bottom's height, {words}: is all of it in millimetres?")
        return self

    @property
    def bottom_height_mm(self) -> float:
        """Height of the bottom, where the wall begins."""
        return {"round": self.bottom_diameter_mm / 2, "conical": self.cone_height_mm, "flat": 0.0}[self.bottom]

    @property
    def wall_optics(self) -> WallOptics | None:
        """The wall's plastic in numbers: as given, or as its material says; None for an opaque wall."""
        return self.optics if self.optics is not None else DEFAULT_OPTICS.get(self.material)


class TubeCap(Definition):
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
    material: Material = "opaque"

    @model_validator(mode="after")
    def _check(self) -> TubeCap:
        if self.top_mm > self.height_mm:
            raise ValueError(
                f"top_mm {self.top_mm} is more than height_mm {self.height_mm}: the cap floats over the rim"
            )
        if self.open and self.top_mm > 0:
            raise ValueError("an open flange ends with the rim: top_mm must be 0")
        return self


class TubeModel(Definition):
    """A tube as a profile of revolution, with body and cap radii apart.

    Attributes:
        name: Catalogue name.
        classes: Detector class names that mean this tube.
        body: Taper, wall and bottom.
        cap: Cap or flange, or null for a plain open tube.
        source: Where the measures come from.
    """

    kind: Literal["tube"]
    name: Name
    description: str = ""
    source: str = ""
    classes: tuple[str, ...] = ()
    body: TubeBody
    cap: TubeCap | None = None

    @model_validator(mode="after")
    def _check(self) -> TubeModel:
        if RACK_CLASS in (self.name, *self.classes):
            key = "classes" if RACK_CLASS in self.classes else "name"
            raise ValueError(f"{key}: '{RACK_CLASS}' is a detector's word for racks; give words for this tube")
        if self.cap is not None:
            if self.cap.height_mm >= self.height_mm - self.body.bottom_height_mm:
                room = f"{self.height_mm - self.body.bottom_height_mm:g} mm are above the body's bottom"
                raise ValueError(f"the cap is {self.cap.height_mm:g} mm high, and {room}: is all of it in millimetres?")
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
    def pivot_height_m(self) -> float:
        """Height above the origin of what a slot's floor holds, metres: a round bottom's centre, or the tip."""
        return self.body.bottom_height_mm * 1e-3 if self.body.bottom == "round" else 0.0

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


class CapModel(Definition):
    """A printed ground-truth cap: a square plate whose centre lies on the tube's axis.

    Attributes:
        name: Catalogue name.
        square_mm: Side of the square top.
        thickness_mm: Thickness of the plate.
        seat_mm: Height of the square's top above the rim of the tube that wears it.
    """

    kind: Literal["cap"]
    name: Name
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
