"""A scene with known poses: a rack on a table, tubes in its slots, with their own caps or with printed ones."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tubepose.labware import CapModel, RackModel, TubeModel
from tubepose.simulation.meshes import Mesh, box, flat_polygon, merge, rack_shell, rack_wells, revolve
from tubepose.transforms import FloatArray, make_transform

PROFILE_SPACING_M = 1.5e-3
TABLE_HALF_SIZE_M = 0.8


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
        ambient: Share of the room's light that reaches it (less in a well).
        plastic: Set for a see-through wall; its `albedo` is then the wall's own weak return.
    """

    albedo: float
    ambient: float = 1.0
    plastic: Plastic | None = None


# Assumptions, chosen to look plausible: no published measurement of this labware is known to us.
TABLE = Material(0.15)
RACK = Material(0.50)
RACK_WELL = Material(0.40, ambient=0.25)
PRINTED_CAP = Material(0.80)
OPAQUE_BODY = Material(0.70)
TRANSLUCENT = Material(0.25, plastic=Plastic(1.49, 0.40))
TRANSPARENT = Material(0.02, plastic=Plastic(1.49, 0.92))
MATERIALS = {"opaque": OPAQUE_BODY, "translucent": TRANSLUCENT, "transparent": TRANSPARENT}


@dataclass(frozen=True, slots=True, eq=False)
class PlacedTube:
    """A tube that stands in a slot.

    Attributes:
        slot: Name of the slot.
        model: Its definition.
        T_rack_tube: Array of shape (4, 4); maps tube points to rack points, metres.
        cap_spin_rad: Turn of its printed cap about the tube's axis, from the tube's x axis.
        cap_albedo: Brightness of its own cap.
    """

    slot: str
    model: TubeModel
    T_rack_tube: FloatArray
    cap_spin_rad: float = 0.0
    cap_albedo: float = 0.6

    @property
    def T_tube_cap(self) -> FloatArray:  # noqa: N802
        """Pose of the printed cap that the tube wears, shape (4, 4)."""
        return make_transform(Rotation.from_euler("z", self.cap_spin_rad).as_matrix(), np.zeros(3))


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Everything that the sensor looks at.

    Attributes:
        rack: The rack; it stands on a table.
        T_camera_rack: Array of shape (4, 4); maps rack points to camera points, metres.
        tubes: The tubes in its slots.
        printed_cap: The cap that all tubes wear instead of their own, or None.
        materials: How the walls of bodies and flanges return light, by the material's name in the labware files.
    """

    rack: RackModel
    T_camera_rack: FloatArray
    tubes: tuple[PlacedTube, ...]
    printed_cap: CapModel | None = None
    materials: dict[str, Material] | None = None

    def parts(self) -> Iterator[tuple[Mesh, Material]]:
        """Every solid of the scene with its material, camera frame."""
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * TABLE_HALF_SIZE_M
        yield flat_polygon([corners], 0.0).transformed(self.T_camera_rack), TABLE
        yield rack_shell(self.rack).transformed(self.T_camera_rack), RACK
        yield rack_wells(self.rack).transformed(self.T_camera_rack), RACK_WELL
        for tube in self.tubes:
            for mesh, material in tube_parts(tube, self.printed_cap, self.materials or MATERIALS):
                yield mesh.transformed(self.T_camera_rack @ tube.T_rack_tube), material


def tube_parts(
    tube: PlacedTube, printed_cap: CapModel | None, materials: dict[str, Material]
) -> Iterator[tuple[Mesh, Material]]:
    """Solids of one tube, tube frame.

    A flange is part of the tube and stays under a printed cap; a closed cap is taken off for it. A closed cap is
    opaque whatever its material: light inside a cap is not modelled.
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
    if printed_cap is not None:
        yield printed_cap_mesh(printed_cap, model).transformed(tube.T_tube_cap), PRINTED_CAP
    elif model.cap is not None and not model.cap.open:
        yield revolve(model.cap_profile_m()), Material(tube.cap_albedo)


def printed_cap_mesh(cap: CapModel, model: TubeModel) -> Mesh:
    """Square plate of a printed cap on its tube, tube frame; a round neck fills the gap between rim and plate."""
    top, thickness = cap.offset_m(model), cap.thickness_mm * 1e-3
    plate = box((cap.square_m, cap.square_m, thickness), (0.0, 0.0, top - thickness / 2))
    rim, radius = model.rim_height_m, float(model.body_radius_m(model.rim_height_m))
    if top - thickness - rim < 1e-6:
        return plate
    neck = revolve(np.array([[rim, 0.0], [rim, radius], [top - thickness, radius]]))
    return merge([plate, neck])
