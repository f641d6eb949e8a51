"""Random scenes to learn from: racks with tubes, free tubes, clutter, light, and a camera that looks at them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from tubepose.capture.frame import CameraIntrinsics
from tubepose.detection.model import visible_class
from tubepose.labware import CapModel, RackModel, TubeModel
from tubepose.labware.tubes import RACK_CLASS
from tubepose.simulation.looks.appearance import NOTHING, Light, Part, Sensor, Surface
from tubepose.simulation.meshes import Mesh, merge
from tubepose.simulation.placement import lean
from tubepose.training import objects
from tubepose.training.variants import fits, matching_tubes, vary_rack, vary_tube
from tubepose.training.viewpoints import (
    SENSOR_CHANCE,
    SENSORS,
    any_camera,
    cut_to,
    random_light,
    scanner_camera,
)
from tubepose.transforms import FloatArray, invert_transform, make_transform, transform_points

View = Literal["any", "scanner", "rack"]
_KINDS, _KINDS_MIXED = (1, 4), (8, 20)
"""Kinds of tubes that a rack may hold, from the first number to below the second."""
STANDS_OUT_M = 1e-3
"""The box of a tube in a rack is for what stands out of the rack by more than this."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneObject:
    """An object that gets a box.

    Attributes:
        class_name: ``rack``, or what can be seen of a tube.
        shape_m: Vertices of what the box is for, camera frame, shape (N, 3): of a tube in a rack, what stands out.
        T_rack_camera: For a tube in a rack, maps camera points to its rack, shape (4, 4); None for anything else.
        above_m: Points of a tube in a rack count from this height on, rack frame.
    """

    class_name: str
    shape_m: FloatArray
    T_rack_camera: FloatArray | None = None
    above_m: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class LearningScene:
    """Everything that makes one picture.

    Attributes:
        sensor: What kind of picture it is.
        intrinsics: The camera.
        parts: All surfaces, camera frame; owners are rows of `objects`.
        objects: What gets boxes.
        light: Lamps and room.
    """

    sensor: Sensor
    intrinsics: CameraIntrinsics
    parts: tuple[Part, ...]
    objects: tuple[SceneObject, ...]
    light: Light


@dataclass(frozen=True, slots=True)
class Stock:
    """What pictures are drawn from.

    Attributes:
        racks: Racks.
        tubes: Tubes.
        caps: Printed caps; a few tubes wear them.
        variants: Share of the racks and tubes that are random variants of the given ones.
        held_out: Put them on grounds that no picture to train on has, to judge by.
        fill: Least and most share of a rack's slots that are tried to fill; None for anything from empty to full.
        mixed: Share of the racks in which hardly two tubes are of one kind; the others hold one to three kinds.
    """

    racks: tuple[RackModel, ...]
    tubes: tuple[TubeModel, ...]
    caps: tuple[CapModel, ...] = ()
    variants: float = 0.5
    held_out: bool = False
    fill: tuple[float, float] | None = None
    mixed: float = 0.0

    @property
    def items(self) -> tuple[RackModel | TubeModel | CapModel, ...]:
        """Every definition, by its name."""
        return tuple(sorted((*self.racks, *self.tubes, *self.caps), key=lambda item: item.name))


class _Builder:
    """Collects the parts and objects of one scene, table frame: z up, the table at 0."""

    def __init__(self, labware: Stock, rng: np.random.Generator) -> None:
        self.labware, self.rng = labware, rng
        self.parts: list[tuple[FloatArray, Mesh, Surface, int]] = []
        self.objects: list[tuple[str, FloatArray, FloatArray | None, float]] = []
        self.taken: list[tuple[FloatArray, float]] = []

    def add(self, T: FloatArray, parts: Sequence[objects.LocalPart], owner: int = NOTHING) -> None:
        """Put parts into the scene."""
        self.parts += [(T, mesh, surface, owner) for mesh, surface in parts]

    def free_place(self, radius_m: float, reach_m: float) -> FloatArray | None:
        """A place on the table that nothing of a given radius overlaps."""
        for _ in range(30):
            at = self.rng.uniform(-reach_m, reach_m, 2)
            if all(np.hypot(*(at - other)) > radius_m + size for other, size in self.taken):
                self.taken.append((at, radius_m))
                return np.asarray(at)
        return None

    def add_rack(self, reach_m: float) -> None:
        """A rack with any number of tubes."""
        rng, labware = self.rng, self.labware
        rack = labware.racks[int(rng.integers(len(labware.racks)))]
        if rng.uniform() < labware.variants:
            rack = vary_rack(rack, rng)
        at = self.free_place(0.5 * float(np.hypot(*rack.outline_m)), reach_m)
        if at is None:
            return
        turn = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
        T_table_rack = make_transform(turn, np.array([*at, 0.0]))
        owner = self._claim(RACK_CLASS, None, 0.0)
        parts = objects.rack_parts(rack, objects.rack_look(rng), rng)
        self.add(T_table_rack, parts, owner)
        shape = merge([mesh for mesh, _ in parts]).vertices_m
        self.objects[owner] = (RACK_CLASS, transform_points(T_table_rack, shape), None, 0.0)
        tubes = self._tubes_for(rack)
        if tubes and (self.labware.fill is not None or rng.uniform() < 0.88):
            self._fill(rack, T_table_rack, tubes)

    def _tubes_for(self, rack: RackModel) -> list[tuple[TubeModel, objects.TubeLook]]:
        rng, found = self.rng, []
        near = matching_tubes(rack, self.labware.tubes)
        mixed = self.labware.mixed > 0 and rng.uniform() < self.labware.mixed
        for _ in range(int(rng.integers(*(_KINDS_MIXED if mixed else _KINDS)))):
            pool = near if near and rng.uniform() < 0.8 else list(self.labware.tubes)
            tube = pool[int(rng.integers(len(pool)))]
            if rng.uniform() < self.labware.variants:
                tube = vary_tube(tube, rng)
            for _ in range(8):
                if fits(rack, tube):
                    break
                tube = vary_tube(self.labware.tubes[int(rng.integers(len(self.labware.tubes)))], rng)
            if fits(rack, tube):
                found.append((tube, self._look(tube)))
        return found

    def _look(self, tube: TubeModel) -> objects.TubeLook:
        caps = self.labware.caps
        printed = caps[int(self.rng.integers(len(caps)))] if caps and self.rng.uniform() < 0.04 else None
        return objects.tube_look(tube, self.rng, printed)

    def _fill(
        self, rack: RackModel, T_table_rack: FloatArray, tubes: Sequence[tuple[TubeModel, objects.TubeLook]]
    ) -> None:
        """Tubes in random slots; where caps would cut into each other a slot stays empty."""
        rng = self.rng
        if self.labware.fill is not None:
            share = rng.uniform(*self.labware.fill)
        else:
            share = rng.uniform(0, 1) if rng.uniform() < 0.75 else 1.0
        standing: list[tuple[FloatArray, float]] = []
        for k in rng.permutation(len(rack.all_slots))[: max(1, round(share * len(rack.all_slots)))]:
            tube, look = tubes[int(rng.integers(len(tubes)))]
            if k not in fits(rack, tube):
                continue
            pose = lean(rack, rack.all_slots[k], tube, rng)
            top = transform_points(pose, np.array([[0.0, 0.0, tube.height_m]]))[0, :2]
            radius = tube.max_radius_m if look.printed is None else look.printed.square_m * 0.7
            if any(np.hypot(*(top - other)) < radius + size for other, size in standing):
                continue
            standing.append((top, radius))
            self._add_tube(tube, look, T_table_rack @ pose, T_table_rack, rack.height_m + STANDS_OUT_M)

    def _add_tube(
        self,
        tube: TubeModel,
        look: objects.TubeLook,
        T_table_tube: FloatArray,
        T_table_rack: FloatArray | None,
        above_m: float,
    ) -> None:
        closed = look.printed is not None or not tube.is_open
        parts = list(objects.tube_parts(tube, look, self.rng))
        owner = self._claim(visible_class(closed=closed), T_table_rack, above_m)
        self.add(T_table_tube, parts, owner)
        shape = transform_points(T_table_tube, merge([mesh for mesh, _ in parts]).vertices_m)
        if T_table_rack is not None:
            shape = shape[transform_points(invert_transform(T_table_rack), shape)[:, 2] > above_m]
        name, _, rack, above = self.objects[owner]
        self.objects[owner] = (name, shape, rack, above)

    def _claim(self, class_name: str, T_table_rack: FloatArray | None, above_m: float) -> int:
        self.objects.append((class_name, np.empty((0, 3)), T_table_rack, above_m))
        return len(self.objects) - 1

    def add_free_tube(self, reach_m: float) -> None:
        """A tube that lies on the table."""
        rng = self.rng
        tube = self.labware.tubes[int(rng.integers(len(self.labware.tubes)))]
        if rng.uniform() < self.labware.variants:
            tube = vary_tube(tube, rng)
        at = self.free_place(0.6 * tube.height_m, reach_m)
        if at is None:
            return
        pose = objects.lying(tube, rng)
        pose[:2, 3] += at
        look = self._look(tube)
        self._add_tube(tube, replace(look, printed=None), pose, None, 0.0)

    def add_clutter(self, reach_m: float) -> None:
        """One thing of no interest, nearly always on the table."""
        parts = objects.clutter(self.rng)
        radius = max(float(np.abs(mesh.vertices_m[:, :2]).max()) for mesh, _ in parts)
        at = self.free_place(1.2 * radius, reach_m)
        if at is not None:
            turn = Rotation.from_euler("z", self.rng.uniform(0, 2 * np.pi)).as_matrix()
            self.add(make_transform(turn, np.array([*at, 0.0])), parts)


def random_scene(labware: Stock, long_side_px: int, rng: np.random.Generator, view: View = "any") -> LearningScene:
    """Draw a scene.

    Args:
        labware: What to draw from.
        long_side_px: Longer side of the picture.
        rng: Source of randomness.
        view: ``any``: up to four racks, free tubes and clutter, from anywhere. ``scanner``: how a fixed scanner looks
            at the one rack that a robot works at: all of it in view, from above, tilted by 20 degrees at most.
            ``rack``: of such a view what lies around the rack, as a detector sees it that looks at a rack alone.
    """
    sensor: Sensor = SENSORS[int(rng.choice(3, p=SENSOR_CHANCE))]
    builder = _Builder(labware, rng)
    if view != "any":
        while not builder.objects:
            builder.add_rack(0.0)
        for _ in range(int(rng.integers(0, 4))):
            builder.add_clutter(0.3)
        intrinsics, T_camera_table = scanner_camera(builder.objects[0][1], long_side_px, rng)
        if view == "rack":
            shapes = np.vstack([points for _, points, _, _ in builder.objects])
            intrinsics = cut_to(intrinsics, transform_points(T_camera_table, shapes), rng)
        builder.add(np.eye(4), _table(labware, rng))
        return _in_camera(builder, sensor, intrinsics, T_camera_table, random_light(sensor, T_camera_table, rng))
    racks = int(rng.choice([0, 1, 2, 3, 4], p=[0.04, 0.46, 0.25, 0.15, 0.10]))
    reach = 0.02 if racks == 1 and rng.uniform() < 0.5 else float(rng.uniform(0.10, 0.30)) * np.sqrt(max(racks, 1))
    for _ in range(racks):
        builder.add_rack(reach)
    around = max(reach, 0.15) * 1.5
    for _ in range(int(rng.integers(0, 5)) if rng.uniform() < 0.4 else 0):
        builder.add_free_tube(around)
    for _ in range(int(rng.integers(0, 12)) if rng.uniform() < 0.7 else 0):
        builder.add_clutter(around)
    targets = [points for name, points, _, _ in builder.objects if name == RACK_CLASS]
    intrinsics, T_camera_table = any_camera(targets, sensor, long_side_px, rng)
    builder.add(np.eye(4), _table(labware, rng))
    return _in_camera(builder, sensor, intrinsics, T_camera_table, random_light(sensor, T_camera_table, rng))


def _table(labware: Stock, rng: np.random.Generator) -> list[objects.LocalPart]:
    return objects.table_parts(rng, float(rng.choice([0.5, 1.0, 3.0])), held_out=labware.held_out)


def _in_camera(
    builder: _Builder, sensor: Sensor, intrinsics: CameraIntrinsics, T_camera_table: FloatArray, light: Light
) -> LearningScene:
    parts = []
    for T_table_part, mesh, surface, owner in builder.parts:
        T = T_camera_table @ T_table_part
        texture = surface.texture
        if texture is not None:
            moved = replace(texture, to_uv=texture.to_uv @ invert_transform(T))
            surface = replace(surface, texture=moved)
        parts.append(Part(mesh.transformed(T), surface, owner))
    listed = []
    for name, shape, T_table_rack, above in builder.objects:
        back = None if T_table_rack is None else invert_transform(T_camera_table @ T_table_rack)
        listed.append(SceneObject(name, transform_points(T_camera_table, shape), back, above))
    return LearningScene(sensor, intrinsics, tuple(parts), tuple(listed), light)
