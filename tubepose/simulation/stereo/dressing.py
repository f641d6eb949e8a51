"""A scene as a colour camera sees it: every solid with a colour, under lamps.

Brightness is that of the scene's own finishes; hue, pattern and light are drawn from the scene's poses alone, so that
every capture of a scene shows the same things.
"""

from __future__ import annotations

import colorsys
import hashlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tubepose.simulation.bent_meshes import base_height_m
from tubepose.simulation.looks.appearance import Lamp, Light, Part, Surface, Texture
from tubepose.simulation.looks.textures import SIZE, random_ground, surroundings
from tubepose.simulation.meshes import Mesh, flat_polygon, revolve
from tubepose.simulation.scene import (
    PROFILE_SPACING_M,
    TABLE_HALF_SIZE_M,
    PlacedTube,
    Scene,
    label_mesh,
    own_cap_mesh,
    printed_cap_mesh,
    rack_meshes,
)
from tubepose.transforms import FloatArray, invert_transform, transform_points

WELL_SHARE = 0.8
"""Albedo of a rack's wells as a share of its outside's; that hardly any light reaches them is the renderer's work."""
TRANSMISSION = {"translucent": 0.35, "transparent": 0.92}
"""Light that crosses a wall straight on."""
SEE_THROUGH = 0.6
"""Depth is that of what lies behind a wall which lets more light through."""
SATURATION = {"rack": (0.0, 0.5), "cap": (0.3, 0.9)}
"""Least and most saturation of the colours of plastics."""
WHITE_RACK = 0.4
"""Share of racks without a hue: white, gray, black, metal."""
PATTERN_M = (0.05, 0.6)
"""Size of the pattern of the table."""


@dataclass(frozen=True, slots=True, eq=False)
class DressedScene:
    """A scene in colour.

    Attributes:
        parts: Every solid, camera frame.
        light: Lamps and room.
    """

    parts: tuple[Part, ...]
    light: Light

    @property
    def with_depth(self) -> list[Mesh]:
        """The solids that a depth camera measures: all but those that are seen through."""
        return [part.mesh for part in self.parts if max(part.surface.transmission or (0.0,)) <= SEE_THROUGH]


def dressed(scene: Scene) -> DressedScene:
    """Give every solid of a scene its colour, and light it."""
    rng = np.random.default_rng(look_seed(scene))
    light_rng, table_rng, rack_rng, cap_rng = rng.spawn(4)
    parts = [_table(scene, table_rng), *_rack(scene, rack_rng)]
    hues: dict[str, tuple[float, float]] = {}
    for name in sorted({tube.model.name for tube in scene.tubes}):
        hues[name] = (float(cap_rng.uniform()), float(cap_rng.uniform(*SATURATION["cap"])))
    for tube in scene.tubes:
        T = scene.T_camera_rack @ tube.T_rack_tube
        for mesh, surface in _tube(scene, tube, *hues[tube.model.name]):
            parts.append(Part(mesh.transformed(T), surface))
    return DressedScene(tuple(parts), _lamps(scene, light_rng))


def look_seed(scene: Scene) -> int:
    """The same for every capture of a scene, whatever caps are on."""
    digest = hashlib.sha256(np.round(scene.T_camera_rack, 9).tobytes())
    for tube in scene.tubes:
        digest.update(np.round(tube.T_rack_tube, 9).tobytes())
    return int.from_bytes(digest.digest()[:8], "little")


def _colour(brightness: float, hue: float, saturation: float) -> tuple[float, float, float]:
    """Red, green and blue of a hue with a given mean."""
    rgb = np.array(colorsys.hsv_to_rgb(hue, saturation, 1.0))
    return _three(np.clip(rgb * brightness / rgb.mean(), 0.0, 0.95))


def _three(values: FloatArray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def _table(scene: Scene, rng: np.random.Generator) -> Part:
    base_m = 0.0 if scene.bow.flat else base_height_m(scene.rack, scene.bow)
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * TABLE_HALF_SIZE_M
    picture = random_ground(rng)
    picture = np.asarray(np.clip(picture * (scene.finishes.table.albedo / max(picture.mean(), 1e-3)), 0.01, 0.95))
    size_m, turn = float(np.exp(rng.uniform(*np.log(PATTERN_M)))), float(rng.uniform(0, 2 * np.pi))
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0.0], [np.sin(turn), np.cos(turn), 0.0]])
    to_uv = np.hstack([rotation, rng.uniform(0, 1, (2, 1)) * size_m]) * (SIZE / size_m)
    texture = Texture(picture.astype(np.float32), to_uv @ invert_transform(scene.T_camera_rack))
    surface = Surface((0.5, 0.5, 0.5), float(rng.uniform(0.0, 0.3)), float(rng.choice([5, 20, 80])), None, texture)
    return Part(flat_polygon([corners], base_m).transformed(scene.T_camera_rack), surface)


def _rack(scene: Scene, rng: np.random.Generator) -> Iterator[Part]:
    gray, hue, saturation = rng.uniform() < WHITE_RACK, float(rng.uniform()), float(rng.uniform(*SATURATION["rack"]))
    albedo, roughness = scene.finishes.rack.albedo, scene.finishes.rack.roughness
    gloss = 0.1 if roughness is None else 0.1 + 0.3 * (1 - roughness)
    for mesh, share in zip(rack_meshes(scene.rack, scene.bow), (1.0, WELL_SHARE), strict=True):
        colour = _colour(albedo * share, hue, 0.0 if gray else saturation)
        yield Part(mesh.transformed(scene.T_camera_rack), Surface(colour, gloss * share, 30.0))


def _tube(scene: Scene, tube: PlacedTube, hue: float, saturation: float) -> Iterator[tuple[Mesh, Surface]]:
    """Solids of one tube with their colours, tube frame; liquids are left out."""
    model = tube.model
    see_through = TRANSMISSION.get(model.body.material)
    white = scene.finishes.opaque_body.albedo
    body = Surface((white, white, white), 0.2, 40.0)
    if see_through is not None:
        # What is not let through is scattered: a milky wall is white.
        body = Surface((0.8, 0.8, 0.8), 0.4, 120.0, (see_through, see_through, see_through))
    open_flange = model.cap is not None and model.cap.open
    outer = model.outer_profile_m(PROFILE_SPACING_M) if open_flange else model.body_profile_m(PROFILE_SPACING_M)
    yield revolve(np.vstack([outer, model.cavity_profile_m(PROFILE_SPACING_M)])), body
    if tube.label is not None:
        paper = tube.label.albedo
        yield label_mesh(tube.label, model), Surface((paper, paper, paper), 0.05, 10.0)
    roughness = scene.finishes.cap_roughness
    gloss = 0.05 if roughness is None else 0.05 + 0.25 * (1 - roughness)
    if scene.printed_cap is not None:
        printed = scene.finishes.printed_cap.albedo
        mesh = printed_cap_mesh(scene.printed_cap, model).transformed(tube.T_tube_cap)
        yield mesh, Surface((printed, printed, printed), 0.1, 20.0)
    elif model.cap is not None and not model.cap.open:
        yield own_cap_mesh(tube), Surface(_colour(tube.cap_albedo, hue, saturation), gloss, 40.0)


def _lamps(scene: Scene, rng: np.random.Generator) -> Light:
    """One to three ceiling lamps over a bright room."""
    up = scene.T_camera_rack[:3, 2]
    tint = rng.uniform(0.9, 1.1, 3)
    lamps = []
    for _ in range(int(rng.integers(1, 4))):
        way = np.array([*rng.normal(0, 0.7, 2), 1.0])
        far = float(rng.uniform(1.2, 2.5))
        at = transform_points(scene.T_camera_rack, (way / np.linalg.norm(way) * far)[None])[0]
        power = tint * rng.uniform(0.15, 0.5) * far**2
        lamps.append(Lamp(at, float(rng.uniform(0.01, 0.08)), _three(power)))
    room = tint * rng.uniform(0.35, 0.7)
    return Light(lamps, _three(room), up, surroundings(rng))
