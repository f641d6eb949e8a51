"""A scene with known poses: a rack on a table, tubes in its slots, with their own caps or with printed ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from tubepose.labware import CapModel, RackModel, TubeModel, WallOptics
from tubepose.simulation.bent_meshes import base_height_m, bent_shell, bent_wells
from tubepose.simulation.bow import FLAT, Bow
from tubepose.simulation.meshes import Mesh, box, flat_polygon, merge, rack_shell, rack_wells, revolve, wall_patch
from tubepose.transforms import FloatArray, make_transform

PROFILE_SPACING_M = 1.5e-3
TABLE_HALF_SIZE_M = 0.8
LABEL_OFFSET_M = 1e-4
"""The mesh of a label lies this far outside the wall."""


@dataclass(frozen=True, slots=True)
class Plastic:
    """What a see-through wall does to light.

    Attributes:
        refractive_index: 1.49 for the plastics of tubes.
        wall_transmission: Share of the light that crosses one wall without being absorbed or scattered (Fresnel apart).
    """

    refractive_index: float
    wall_transmission: float


@dataclass(frozen=True, slots=True)
class Material:
    """How a surface returns light.

    Attributes:
        albedo: Share of the light that is returned diffusely.
        ambient: Share of the room's light that reaches it (less in a well). Sensor `raycast` only.
        plastic: Set for a see-through wall; its `albedo` is then the wall's own weak return. Sensor `raycast` only.
        roughness: Roughness alpha of a glossy (GGX) coat of index 1.5; None for a matte surface. Sensor
            `structured-light` only.
    """

    albedo: float
    ambient: float = 1.0
    plastic: Plastic | None = None
    roughness: float | None = None


# Assumptions, chosen to look plausible: no published measurement of this labware is known to us.
TABLE = Material(0.15)
RACK = Material(0.50)
WELL_ALBEDO = 0.8
"""Albedo of wells and their ambient light, as shares of the rack's. Sensor `raycast` only."""
WELL_AMBIENT = 0.25
PRINTED_CAP = Material(0.80)
OPAQUE_BODY = Material(0.70)
TRANSLUCENT = Material(0.25, plastic=Plastic(1.49, 0.40))
TRANSPARENT = Material(0.02, plastic=Plastic(1.49, 0.92))
MATERIALS = {"opaque": OPAQUE_BODY, "translucent": TRANSLUCENT, "transparent": TRANSPARENT}


@dataclass(frozen=True, slots=True)
class Finishes:
    """How the opaque surfaces of a scene return light; the colour of a tube's own cap is the tube's.

    Attributes:
        table: What the rack stands on.
        rack: The rack's outside, wells and floors; `raycast` darkens the wells.
        printed_cap: The printed caps.
        opaque_body: Bodies of opaque tubes.
        cap_roughness: Gloss of the tubes' own caps, as `Material.roughness`.
        wall_roughness: Gloss of see-through walls for the projector's own light, as `Material.roughness`.
    """

    table: Material = TABLE
    rack: Material = RACK
    printed_cap: Material = PRINTED_CAP
    opaque_body: Material = OPAQUE_BODY
    cap_roughness: float | None = 0.35
    wall_roughness: float = 0.07


@dataclass(frozen=True, slots=True)
class Liquid:
    """What stands in a tube, up to a level surface.

    Attributes:
        level_m: Height of the surface on the tube's axis above the tube's origin.
        refractive_index: 1.33 for water.
        absorption_per_m: Absorption coefficient; it does not scatter.
    """

    level_m: float
    refractive_index: float = 1.33
    absorption_per_m: float = 5.0


@dataclass(frozen=True, slots=True)
class Label:
    """A matte paper label on the outside of the wall.

    Attributes:
        low_m: Height of its lower edge above the tube's origin.
        high_m: Height of its upper edge.
        start_rad: Where it begins around the tube's axis, from the tube's x axis towards y.
        span_rad: How far it goes around, at most a full turn.
        albedo: Share of the light that it returns, on both sides.
    """

    low_m: float
    high_m: float
    start_rad: float
    span_rad: float
    albedo: float = 0.8


@dataclass(frozen=True, slots=True)
class CapFit:
    """How a tube's own closed cap differs from its definition; an open flange is part of the body and does not.

    Attributes:
        tilt_rad: Turn about the tube's x and y axes, at the centre of the rim.
        radius_error_m: Added to the cap's radius.
        height_error_m: The whole cap sits higher by this.
    """

    tilt_rad: tuple[float, float] = (0.0, 0.0)
    radius_error_m: float = 0.0
    height_error_m: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class PlacedTube:
    """A tube that stands in a slot.

    Attributes:
        slot: Name of the slot.
        model: Its definition: what an estimator knows of it.
        T_rack_tube: Array of shape (4, 4); maps points of the body to rack points, metres. It is the body's.
        cap_spin_rad: Turn of its printed cap about the tube's axis, from the tube's x axis.
        cap_albedo: Brightness of its own cap.
        cap_fit: How its own cap differs from its definition.
        printed_tilt_rad: Turn of its printed cap about the tube's x and y axes, at the rim's centre.
        optics: The plastic of its wall, where it is not the definition's.
        liquid: What stands in it, if anything.
        label: The label on it, if any.
    """

    slot: str
    model: TubeModel
    T_rack_tube: FloatArray
    cap_spin_rad: float = 0.0
    cap_albedo: float = 0.6
    cap_fit: CapFit = CapFit()
    printed_tilt_rad: tuple[float, float] = (0.0, 0.0)
    optics: WallOptics | None = None
    liquid: Liquid | None = None
    label: Label | None = None

    @property
    def wall_optics(self) -> WallOptics | None:
        """The plastic of its wall in numbers; None for an opaque body."""
        own = self.model.body.wall_optics
        return own if own is None or self.optics is None else self.optics

    @property
    def T_tube_cap(self) -> FloatArray:  # noqa: N802
        """Pose of the printed cap that the tube wears, shape (4, 4); its heights count from the tube's origin."""
        spin = make_transform(Rotation.from_euler("z", self.cap_spin_rad).as_matrix(), np.zeros(3))
        return self._tilted_at_rim(self.printed_tilt_rad, 0.0) @ spin

    @property
    def T_tube_own_cap(self) -> FloatArray:  # noqa: N802
        """Pose of the tube's own closed cap, shape (4, 4); its heights count from the tube's origin."""
        return self._tilted_at_rim(self.cap_fit.tilt_rad, self.cap_fit.height_error_m)

    def own_cap_profile_m(self) -> FloatArray:
        """Profile (z, r) of its own cap as made, in the frame of `T_tube_own_cap`, metres."""
        profile = self.model.cap_profile_m()
        profile[1:3, 1] += self.cap_fit.radius_error_m
        return profile

    def _tilted_at_rim(self, tilt_rad: tuple[float, float], up_m: float) -> FloatArray:
        rotation = Rotation.from_rotvec([*tilt_rad, 0.0]).as_matrix()
        rim = np.array([0.0, 0.0, self.model.rim_height_m])
        return make_transform(rotation, rim - rotation @ rim + np.array([0.0, 0.0, up_m]))


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Everything that the sensor looks at.

    Attributes:
        rack: The rack; it stands on a table.
        T_camera_rack: Array of shape (4, 4); maps rack points to camera points, metres.
        tubes: The tubes in its slots.
        printed_cap: The cap that all tubes wear instead of their own, or None.
        materials: How the walls of bodies and flanges return light, by the material's name in the labware files. Sensor
            `raycast` only.
        finishes: How the opaque surfaces return light.
        bow: How the rack's face is bent. `T_camera_rack` is that of the rack without it, and the poses of `tubes` are
            where they stand with it.
    """

    rack: RackModel
    T_camera_rack: FloatArray
    tubes: tuple[PlacedTube, ...]
    printed_cap: CapModel | None = None
    materials: dict[str, Material] | None = None
    finishes: Finishes = Finishes()
    bow: Bow = FLAT

    def parts(self) -> Iterator[tuple[Mesh, Material]]:
        """Every solid of the scene with its material, camera frame."""
        base_m = 0.0 if self.bow.flat else base_height_m(self.rack, self.bow)
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * TABLE_HALF_SIZE_M
        yield flat_polygon([corners], base_m).transformed(self.T_camera_rack), self.finishes.table
        yield from self.rack_parts()
        materials = self.materials or MATERIALS | {"opaque": self.finishes.opaque_body}
        for tube in self.tubes:
            for mesh, material in tube_parts(tube, self.printed_cap, materials, self.finishes):
                yield mesh.transformed(self.T_camera_rack @ tube.T_rack_tube), material

    def rack_parts(self) -> Iterator[tuple[Mesh, Material]]:
        """Shell and wells of the rack with their materials, camera frame."""
        rack = self.finishes.rack
        well = replace(rack, albedo=WELL_ALBEDO * rack.albedo, ambient=WELL_AMBIENT)
        for mesh, material in zip(rack_meshes(self.rack, self.bow), (rack, well), strict=True):
            yield mesh.transformed(self.T_camera_rack), material


def rack_meshes(rack: RackModel, bow: Bow) -> tuple[Mesh, Mesh]:
    """Shell and wells of a rack, bent where it is bowed, rack frame, metres."""
    if bow.flat:
        return rack_shell(rack), rack_wells(rack)
    return bent_shell(rack, bow, base_height_m(rack, bow)), bent_wells(rack, bow)


def tube_parts(
    tube: PlacedTube, printed_cap: CapModel | None, materials: dict[str, Material], finishes: Finishes
) -> Iterator[tuple[Mesh, Material]]:
    """Solids of one tube, tube frame, as triangles: body, flange, label, then the cap that it wears.

    A flange is part of the tube and stays under a printed cap; a closed cap is taken off for it. A closed cap is
    opaque whatever its material: light inside a cap is not modelled. Liquids have no triangles.
    """
    model = tube.model
    body = materials[model.body.material]
    outer, cavity = model.body_profile_m(PROFILE_SPACING_M), model.cavity_profile_m(PROFILE_SPACING_M)
    flange = model.cap if model.cap is not None and model.cap.open else None
    if flange is not None and flange.material == model.body.material:
        outer = model.outer_profile_m(PROFILE_SPACING_M)
    yield revolve(np.vstack([outer, cavity])), body
    if flange is not None and flange.material != model.body.material:
        profile = model.cap_profile_m()
        bore = np.array([[profile[0, 0], profile[-1, 1]], profile[0]])
        yield revolve(np.vstack([profile, bore])), materials[flange.material]
    if tube.label is not None:
        yield label_mesh(tube.label, model), Material(tube.label.albedo)
    if printed_cap is not None:
        yield printed_cap_mesh(printed_cap, model).transformed(tube.T_tube_cap), finishes.printed_cap
    elif model.cap is not None and not model.cap.open:
        yield own_cap_mesh(tube), Material(tube.cap_albedo, roughness=finishes.cap_roughness)


def label_mesh(label: Label, model: TubeModel) -> Mesh:
    """A label as a patch just outside the wall, tube frame."""
    low, high = ((z, float(model.body_radius_m(z)) + LABEL_OFFSET_M) for z in (label.low_m, label.high_m))
    return wall_patch(low, high, label.start_rad, label.span_rad)


def own_cap_mesh(tube: PlacedTube) -> Mesh:
    """A tube's own closed cap as made and as seated, tube frame."""
    profile = tube.own_cap_profile_m()
    # A crooked cap leaves no slit around the wall that it sits on: its lower side ends inside that wall.
    profile[0, 1] -= tube.model.body.wall_mm * 0.5e-3
    return revolve(profile).transformed(tube.T_tube_own_cap)


def printed_cap_mesh(cap: CapModel, model: TubeModel) -> Mesh:
    """Square plate of a printed cap on its tube, tube frame; a round neck fills the gap between rim and plate."""
    top, thickness = cap.offset_m(model), cap.thickness_mm * 1e-3
    plate = box((cap.square_m, cap.square_m, thickness), (0.0, 0.0, top - thickness / 2))
    rim, radius = model.rim_height_m, float(model.body_radius_m(model.rim_height_m))
    if top - thickness - rim < 1e-6:
        return plate
    neck = revolve(np.array([[rim, 0.0], [rim, radius], [top - thickness, radius]]))
    return merge([plate, neck])
