"""Things that can stand on a table before the camera: racks, tubes and clutter as parts with looks."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tubepose.labware import CapModel, RackModel, TubeModel
from tubepose.simulation.looks.appearance import Surface, Texture
from tubepose.simulation.looks.textures import SIZE, coded, collage, plain, random_color, random_ground
from tubepose.simulation.meshes import (
    Mesh,
    box,
    flat_polygon,
    merge,
    rack_shell,
    rack_wells,
    revolve,
    upright_walls,
    wall_patch,
)
from tubepose.simulation.random_scene import straight_wall_m
from tubepose.simulation.scene import printed_cap_mesh
from tubepose.training.variants import cap_outline
from tubepose.transforms import FloatArray, make_transform

_SEGMENTS = 32

LocalPart = tuple[Mesh, Surface]


def _matte(rng: np.random.Generator, vivid: float) -> Surface:
    return Surface(random_color(rng, vivid=vivid), float(rng.uniform(0, 0.6)), float(rng.choice([4, 12, 40, 120])))


def _darker(surface: Surface, share: float) -> Surface:
    r, g, b = surface.albedo
    return Surface((r * share, g * share, b * share), surface.gloss * 0.3, surface.sharpness)


# ---------------------------------------------------------------- racks


def rack_look(rng: np.random.Generator) -> Surface:
    """Plastic of any colour, white and gray most often."""
    return _matte(rng, 0.55)


def rack_parts(rack: RackModel, surface: Surface, rng: np.random.Generator) -> list[LocalPart]:
    """A rack in its own frame: a block with wells, or plates on legs or between end panels."""
    if rng.uniform() < 0.5:
        return [(rack_shell(rack), surface), (rack_wells(rack), _darker(surface, float(rng.uniform(0.6, 1.0))))]
    thick = min(float(rng.uniform(0.0015, 0.012)), 0.5 * rack.depth_m)
    plates = [_plate(rack, rack.height_m, thick)]
    if rack.depth_m > 0.03 and rng.uniform() < 0.5:
        plates.append(_plate(rack, rack.height_m - rack.depth_m * float(rng.uniform(0.35, 0.75)), thick))
    solids = [_base(rack), *_supports(rack, rng)]
    return [(merge(plates + solids), surface)]


def _plate(rack: RackModel, top_m: float, thick_m: float) -> Mesh:
    """A plate with the rack's openings."""
    outline = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * rack.outline_m / 2
    outlines = [slot.boundary_m(1.5e-3) for slot in rack.all_slots]
    holes = [loop[::-1] for loop in outlines]
    walls = [upright_walls(loop, top_m - thick_m, top_m) for loop in (outline, *holes)]
    return merge([flat_polygon([outline, *holes], z) for z in (top_m, top_m - thick_m)] + walls)


def _base(rack: RackModel) -> Mesh:
    high = max(rack.floor_m, 1e-3)
    return box((*rack.outline_m, high), (0.0, 0.0, high / 2))


def _supports(rack: RackModel, rng: np.random.Generator) -> Iterator[Mesh]:
    (x, y), high = rack.outline_m / 2, rack.height_m - 5e-4
    wide = float(rng.uniform(0.003, 0.010))
    if rng.uniform() < 0.5:
        for sign in (-1, 1):
            yield box((wide, 2 * y, high), (sign * (x - wide / 2), 0.0, high / 2))
    else:
        for sx in (-1, 1):
            for sy in (-1, 1):
                yield box((wide, wide, high), (sx * (x - wide / 2), sy * (y - wide / 2), high / 2))


# ---------------------------------------------------------------- tubes


@dataclass(frozen=True, slots=True, eq=False)
class TubeLook:
    """What the tubes of one kind in one picture have in common.

    Attributes:
        body: Wall of the body.
        cap: The closed cap, or the flange.
        outline: Profile (z, r) of the closed cap, metres; None without one.
        liquid: What stands in some of them, or None.
        label: Paper on some of them, or None.
        printed: A printed cap worn instead of the own one, or None.
    """

    body: Surface
    cap: Surface
    outline: FloatArray | None
    liquid: Surface | None
    label: Surface | None
    printed: CapModel | None


def tube_look(tube: TubeModel, rng: np.random.Generator, printed: CapModel | None = None) -> TubeLook:
    """Random plastic, colours and contents for one kind of tube."""
    see_through = tube.body.material != "opaque" or rng.uniform() < 0.1
    if see_through:
        low, high = (0.25, 0.8) if tube.body.material == "translucent" else (0.75, 0.97)
        gray = rng.uniform(low, high)
        tint = np.clip(gray + rng.uniform(-0.08, 0.08, 3), 0.02, 0.98)
        white = float(rng.uniform(0.3, 0.9))
        color = (white, white, white) if rng.uniform() < 0.6 else random_color(rng, vivid=0.3)
        body = Surface(color, float(rng.uniform(0.1, 0.7)), float(rng.uniform(40, 400)), _three(tint))
    else:
        body = _matte(rng, 0.3)
    fill = random_color(rng, vivid=0.8)
    thin = np.clip(np.array(fill) * rng.uniform(0.2, 1.0), 0.01, 0.9)
    liquid = Surface(fill, 0.0, 20.0, _three(thin)) if see_through and rng.uniform() < 0.5 else None
    label = Surface(random_color(rng, vivid=0.15), 0.05, 10.0) if rng.uniform() < 0.4 else None
    outline = cap_outline(tube, rng) if tube.cap is not None and not tube.cap.open else None
    cap = body if tube.cap is not None and tube.cap.open and rng.uniform() < 0.7 else _matte(rng, 0.65)
    return TubeLook(body, cap, outline, liquid, label, printed)


def _three(values: FloatArray) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])


def tube_parts(tube: TubeModel, look: TubeLook, rng: np.random.Generator) -> Iterator[LocalPart]:
    """One tube in its own frame; label and liquid come with some."""
    outer = tube.body_profile_m(2e-3)
    yield revolve(outer, _SEGMENTS), look.body
    rim, radius = tube.rim_height_m, float(tube.body_radius_m(tube.rim_height_m))
    inner = radius - tube.body.wall_mm * 1e-3
    if look.body.transmission is None:
        yield revolve(tube.cavity_profile_m(2e-3), _SEGMENTS), _darker(look.body, 0.6)
    yield revolve(np.array([[rim, radius], [rim, inner]]), _SEGMENTS), look.body
    if tube.cap is not None and tube.cap.open:
        yield revolve(tube.cap_profile_m(), _SEGMENTS), look.cap
    if look.liquid is not None and rng.uniform() < 0.8:
        yield _liquid(tube, float(rng.uniform(0.15, 0.95))), look.liquid
    if look.label is not None and rng.uniform() < 0.8:
        paper = _label(tube, rng)
        if paper is not None:
            yield paper, look.label
    if look.printed is not None:
        yield printed_cap_mesh(look.printed, tube), look.cap
    elif look.outline is not None:
        yield revolve(look.outline, _SEGMENTS), look.cap


def _liquid(tube: TubeModel, level: float) -> Mesh:
    """The outside of a column of liquid up to a share of the cavity, closed at its top."""
    cavity = tube.cavity_profile_m(2e-3)[::-1]
    low, high = cavity[0, 0], cavity[-1, 0]
    top = low + level * (high - low)
    inside = cavity[cavity[:, 0] < top]
    radius = float(np.interp(top, cavity[:, 0], cavity[:, 1]))
    profile = np.vstack([inside, [[top, radius], [top, 0.0]]])
    profile[:, 1] = np.maximum(profile[:, 1] - 2e-4, 0.0)
    return revolve(profile, _SEGMENTS)


def _label(tube: TubeModel, rng: np.random.Generator) -> Mesh | None:
    low, high = straight_wall_m(tube)
    if high - low < 0.012:
        return None
    size = float(rng.uniform(0.4, 0.95)) * (high - low)
    start = low + float(rng.uniform(0, 1)) * (high - low - size)
    ends = [(z, float(tube.body_radius_m(z)) + 2e-4) for z in (start, start + size)]
    return wall_patch(ends[0], ends[1], float(rng.uniform(0, 2 * np.pi)), float(rng.uniform(2.5, 2 * np.pi)))


# ---------------------------------------------------------------- table and clutter


def table_parts(rng: np.random.Generator, half_m: float, *, held_out: bool = False) -> list[LocalPart]:
    """A level table at z = 0 with any ground on it; how large a pattern is, is random."""
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half_m
    return [
        (
            flat_polygon([corners], 0.0),
            textured(random_ground(rng, held_out=held_out), float(rng.uniform(0.05, 0.6)), rng),
        )
    ]


def textured(image: np.ndarray, size_m: float, rng: np.random.Generator) -> Surface:
    """A surface with a picture of a given size laid over x and y of its own frame, turned at random."""
    turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()[:2]
    to_uv = np.hstack([turn, rng.uniform(0, 1, (2, 1)) * size_m]) * (SIZE / size_m)
    return Surface(
        (0.5, 0.5, 0.5), float(rng.uniform(0, 0.3)), float(rng.choice([5, 20, 80])), None, Texture(image, to_uv)
    )


def clutter(rng: np.random.Generator) -> list[LocalPart]:
    """Any one thing that is neither rack nor tube, standing at the origin of its own frame."""
    kind = rng.choice(
        ["box", "turned", "bolt", "sheet", "tray", "ring", "ball"], p=[0.22, 0.2, 0.16, 0.16, 0.1, 0.06, 0.1]
    )
    surface = _matte(rng, 0.5)
    if kind == "box":
        size = _three(np.exp(rng.uniform(np.log(0.015), np.log(0.25), 3)))
        printed = textured(collage(rng) if rng.uniform() < 0.5 else plain(rng), max(size), rng)
        return [(box(size, (0.0, 0.0, size[2] / 2)), printed if rng.uniform() < 0.5 else surface)]
    if kind == "turned":  # a bottle, beaker, cup or knob: much wider than a tube
        return [(_turned(rng), surface if rng.uniform() < 0.7 else _glass(rng))]
    if kind == "bolt":
        radius, high = float(rng.uniform(0.003, 0.012)), float(rng.uniform(0.001, 0.006))
        segments = int(rng.choice([6, 32]))
        return [(revolve(np.array([[0.0, radius], [high, radius], [high, 0.0]]), segments), surface)]
    if kind == "sheet":
        sheet = rng.uniform(0.02, 0.15, 2)
        picture = coded(rng) if rng.uniform() < 0.5 else collage(rng)
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * sheet / 2
        image_to = np.array([[SIZE / sheet[0], 0, 0, SIZE / 2], [0, SIZE / sheet[1], 0, SIZE / 2]])
        return [(flat_polygon([corners], 4e-4), Surface((0.5, 0.5, 0.5), 0.05, 20.0, None, Texture(picture, image_to)))]
    if kind == "tray":
        return [(_tray(rng), surface)]
    if kind == "ring":
        outer = float(rng.uniform(0.008, 0.05))
        inner, high = outer * float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.002, 0.01))
        return [(revolve(np.array([[0.0, outer], [high, outer], [high, inner], [0.0, inner]]), _SEGMENTS), surface)]
    radius = float(rng.uniform(0.01, 0.05))
    angles = np.linspace(-np.pi / 2, np.pi / 2, 12)
    return [(revolve(np.column_stack([radius + radius * np.sin(angles), radius * np.cos(angles)]), _SEGMENTS), surface)]


def _glass(rng: np.random.Generator) -> Surface:
    clear = rng.uniform(0.6, 0.95, 3)
    return Surface((0.6, 0.6, 0.6), float(rng.uniform(0.2, 0.8)), float(rng.uniform(40, 300)), _three(clear))


def _turned(rng: np.random.Generator) -> Mesh:
    count = int(rng.integers(2, 6))
    widest = float(rng.uniform(0.02, 0.08))
    z = np.concatenate([[0.0], np.sort(rng.uniform(0.01, 0.25, count))])
    r = widest * rng.uniform(0.3, 1.0, count + 1)
    profile = np.column_stack([z, r])
    return revolve(np.vstack([profile, [[profile[-1, 0], 0.0]]]), _SEGMENTS)


def _tray(rng: np.random.Generator) -> Mesh:
    """An open box with thin walls: a tray, a storage box, an empty frame."""
    (x, y), high = rng.uniform(0.06, 0.3, 2), float(rng.uniform(0.01, 0.12))
    thick = float(rng.uniform(0.002, 0.012))
    sides = [box((thick, y, high), (sign * x / 2, 0.0, high / 2)) for sign in (-1, 1)]
    sides += [box((x, thick, high), (0.0, sign * y / 2, high / 2)) for sign in (-1, 1)]
    return merge([box((x, y, thick), (0.0, 0.0, thick / 2)), *sides] if rng.uniform() < 0.7 else sides)


def lying(tube: TubeModel, rng: np.random.Generator) -> FloatArray:
    """Pose (4, 4) of a tube that lies on the table at the origin, seen from the table's frame."""
    radius = tube.max_radius_m
    tilt = Rotation.from_euler("y", np.pi / 2).as_matrix()
    turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
    rotation = turn @ tilt
    return make_transform(rotation, -rotation @ [0.0, 0.0, tube.height_m / 2] + np.array([0.0, 0.0, radius]))
