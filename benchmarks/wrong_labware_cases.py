"""Cases of `wrong_labware`: what is asked about a frame, by kind; each is the right file with one thing wrong."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from benchmarks.wrong_labware_judging import Truth
from benchmarks.wrong_labware_scenes import View, racks, tubes
from tubepose.capture.frame import RgbdFrame
from tubepose.labware import RackModel, TubeModel
from tubepose.transforms import FloatArray, invert_transform, make_transform, transform_points

PITCH_PERCENT = (-3.0, -2.0, -1.5, -1.0, 1.0, 1.5, 2.0, 3.0)
OPENING_MM = (-2.0, -1.0, -0.5, 0.5, 1.0, 2.0)
HEIGHT_MM = tuple(sign * size for size in (1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 40.0) for sign in (-1, 1))
CAP_MM = (-3.0, -2.0, -1.0, 1.0, 2.0, 3.0)
SCALE_PERCENT = (-2.0, -1.0, -0.5, 0.5, 1.0, 2.0)
WALL_HEIGHT_M, WALL_GAP_M = 0.25, (0.002, 0.02)
FLAT_NOISE_M = 5e-5
"""Noise of surfaces that are drawn into a cloud: what the simulated camera has on level ones."""
PLATE_GRAY = 120


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One question.

    Attributes:
        kind: Row of the table that it counts in.
        name: What is wrong, with its size.
        rack: The rack that is asked for.
        tubes: The types that are given.
        frame: The frame that is asked about.
        truth: What stands there, in the frame's axes and scale.
        same_rack: Whether the rack is the one that stands there, however well its file describes it.
        face_truth: What the rack's pose is judged by, where that is not `truth`.
    """

    kind: str
    name: str
    rack: RackModel
    tubes: tuple[TubeModel, ...]
    frame: RgbdFrame
    truth: Truth
    same_rack: bool = True
    face_truth: Truth | None = None


Make = Callable[[View, np.random.Generator], Iterator[Case]]


def changed(rack: RackModel, **changes: object) -> RackModel | None:
    """A rack with other values; None where no rack can be like that (its slots overlap, or leave the outline)."""
    try:
        return RackModel.model_validate(rack.model_dump() | changes)
    except ValidationError:
        return None


def listed(rack: RackModel, scale: FloatArray, wider_mm: float = 0.0) -> RackModel | None:
    """A rack with its slots' centres scaled along x and y (2,), and its openings wider."""
    slots = []
    for slot in rack.all_slots:
        center_mm = tuple(float(v) for v in np.array(slot.center_mm) * scale)
        size_mm = tuple(size + wider_mm for size in slot.size_mm)
        slots.append(slot.model_dump() | {"center_mm": center_mm, "size_mm": size_mm})
    return changed(rack, grid=None, slots=slots)


def is_same_rack(a: RackModel, b: RackModel) -> bool:
    """Whether two racks have the same outline, slots and depth, whatever they are called."""
    shapes = [[(slot.center_mm, slot.shape, slot.size_mm) for slot in rack.all_slots] for rack in (a, b)]
    return a.outline_mm == b.outline_mm and a.depth_m == b.depth_m and shapes[0] == shapes[1]


def _plain(view: View, kind: str, name: str, rack: RackModel | None, same_rack: bool = True) -> Iterator[Case]:
    if rack is not None:
        yield Case(kind, name, rack, view.types, view.frame, view.truth, same_rack)


def _right(view: View, _: np.random.Generator) -> Iterator[Case]:
    yield from _plain(view, "right", "right", _rack(view))


def _other_racks(view: View, _: np.random.Generator) -> Iterator[Case]:
    for rack in racks():
        if not is_same_rack(rack, _rack(view)):
            yield from _plain(view, "other rack", rack.name, rack, same_rack=False)


def _rows_columns(view: View, _: np.random.Generator) -> Iterator[Case]:
    rack = _rack(view)
    if rack.grid is None:
        return
    for axis, word in ((0, "columns"), (1, "rows")):
        for step in (-1, 1):
            grid = rack.grid.model_dump()
            grid[word] += step
            grown = list(rack.outline_mm)
            grown[axis] += step * rack.grid.pitch_mm[axis]
            offset = [0.0, 0.0]
            offset[axis] = step * rack.grid.pitch_mm[axis] / 2
            ways = {
                "centred": changed(rack, grid=grid),
                "low side": changed(rack, grid=grid | {"offset_mm": offset}),
                "high side": changed(rack, grid=grid | {"offset_mm": [-value for value in offset]}),
                "outline too": changed(rack, grid=grid, outline_mm=grown),
            }
            for way, other in ways.items():
                yield from _plain(view, "rows, columns", f"{word} {step:+d} {way}", other, same_rack=False)


def _pitch(view: View, _: np.random.Generator) -> Iterator[Case]:
    for axes, along in (("x", np.array([1.0, 0.0])), ("y", np.array([0.0, 1.0])), ("xy", np.ones(2))):
        for percent in PITCH_PERCENT:
            rack = listed(_rack(view), 1 + along * percent / 100)
            yield from _plain(view, "pitch", f"pitch {axes} {percent:+g} %", rack)


def _openings(view: View, _: np.random.Generator) -> Iterator[Case]:
    for wider_mm in OPENING_MM:
        rack = listed(_rack(view), np.ones(2), wider_mm)
        yield from _plain(view, "openings", f"openings {wider_mm:+g} mm", rack)


def _floor(view: View, _: np.random.Generator) -> Iterator[Case]:
    rack = _rack(view)
    for up_mm in HEIGHT_MM:
        yield from _plain(view, "floor", f"floor {up_mm:+g} mm", changed(rack, floor_mm=rack.floor_mm + up_mm))


def _heights(view: View, _: np.random.Generator) -> Iterator[Case]:
    """The floor stays where it is above the base; the face does not."""
    rack = _rack(view)
    for up_mm in HEIGHT_MM:
        yield from _plain(view, "height", f"height {up_mm:+g} mm", changed(rack, height_mm=rack.height_mm + up_mm))


def _types(view: View, _: np.random.Generator) -> Iterator[Case]:
    """A type that stands there is not given: another one is in its place, or the rest of them alone."""
    there = {tube.model.name for tube in view.truth.tubes}
    for model in (model for model in view.types if model.name in there):
        rest = tuple(other for other in view.types if other.name != model.name)
        if rest:
            yield Case("type missing", f"without {model.name}", _rack(view), rest, view.frame, view.truth)
        for other in tubes():
            if other.name not in {known.name for known in view.types}:
                given = (*rest, other)
                name = f"{other.name} for {model.name}"
                yield Case("type replaced", name, _rack(view), given, view.frame, view.truth)


def _caps(view: View, _: np.random.Generator) -> Iterator[Case]:
    for up_mm in CAP_MM:
        given = tuple(_with_cap(model, up_mm) for model in view.types)
        if given != view.types:
            yield Case("cap height", f"caps {up_mm:+g} mm", _rack(view), given, view.frame, view.truth)


def _with_cap(model: TubeModel, up_mm: float) -> TubeModel:
    """The type with its body higher or lower by so much, the cap on it as before; open types stay."""
    if model.is_open:
        return model
    data = model.model_dump()
    data["body"]["height_mm"] += up_mm
    return TubeModel.model_validate(data)


def _scale(view: View, _: np.random.Generator) -> Iterator[Case]:
    """Rack by the true pose, slots and tubes by what the cloud shows: all of it farther away by so much."""
    for percent in SCALE_PERCENT:
        factor = 1 + percent / 100
        frame = dataclasses.replace(view.frame, cloud_m=view.frame.cloud_m * factor)
        name = f"scale {percent:+g} %"
        yield Case("cloud scale", name, _rack(view), view.types, frame, _scaled(view.truth, factor), True, view.truth)


def _scaled(truth: Truth, factor: float) -> Truth:
    """Truth with the origins of rack and tubes farther away by a factor; the parts keep their sizes."""

    def farther(T: FloatArray) -> FloatArray:
        return make_transform(T[:3, :3], factor * T[:3, 3])

    placed = tuple(dataclasses.replace(tube, T_camera_tube=farther(tube.T_camera_tube)) for tube in truth.tubes)
    return dataclasses.replace(truth, T_camera_rack=farther(truth.T_camera_rack), tubes=placed)


def _robot(view: View, rng: np.random.Generator) -> Iterator[Case]:
    """The cloud in a robot's frame: z up, its origin on the table beside the rack, or above its face."""
    rack, to_rack = _rack(view), invert_transform(view.truth.T_camera_rack)
    yaw = Rotation.from_euler("z", rng.uniform(0, 2 * np.pi)).as_matrix()
    for where, up_m in (("below", 0.0), ("above", rack.height_m + 0.3)):
        origin = np.array([rack.outline_m[0] / 2 + rng.uniform(0.2, 0.5), rng.uniform(-0.3, 0.3), up_m])
        T = make_transform(yaw, -yaw @ origin) @ to_rack
        cloud = transform_points(T, view.frame.cloud_m.reshape(-1, 3)).reshape(view.frame.cloud_m.shape)
        frame = dataclasses.replace(view.frame, cloud_m=cloud, intrinsics=None)
        loose = dataclasses.replace(frame, cloud_m=cloud[np.isfinite(cloud[..., 2])][None], image=None, organised=False)
        for form, asked in (("organised", frame), ("points", loose)):
            name = f"origin {where} the face, {form}"
            yield Case("robot's frame", name, rack, view.types, asked, view.truth.moved(T))


def _wall(view: View, rng: np.random.Generator) -> Iterator[Case]:
    """An upright wall on the table behind one side of the rack."""
    rack = _rack(view)
    side, axis = int(rng.choice([-1, 1])), int(rng.integers(2))
    normal = np.zeros(3)
    normal[axis] = side
    offset_m = float(rack.outline_m[axis] / 2 + rng.uniform(*WALL_GAP_M))
    hit = _on_plane(view, normal, offset_m, rng)
    local = transform_points(invert_transform(view.truth.T_camera_rack), hit)
    on_wall = (local[..., 2] > 0) & (local[..., 2] < WALL_HEIGHT_M)
    frame = _with_surface(view.frame, hit, on_wall)
    yield Case("clutter", f"wall at {'xy'[axis]} {side:+d}", rack, view.types, frame, view.truth)


def _plate(view: View, rng: np.random.Generator) -> Iterator[Case]:
    """No rack: a plate of its outline and height, or nothing on the table at all."""
    rack = _rack(view)
    nothing = Truth(None, view.truth.T_camera_rack, ())
    table, plate = (_on_plane(view, np.array([0.0, 0.0, 1.0]), z, rng) for z in (0.0, rack.height_m))
    shape = table.shape[:2]
    empty = _with_surface(view.frame, table, np.ones(shape, dtype=bool), everywhere=True)
    local = transform_points(invert_transform(view.truth.T_camera_rack), plate)
    inside = np.all(np.abs(local[..., :2]) < rack.outline_m / 2, axis=-1)
    full = _with_surface(empty, plate, inside)
    for name, frame in (("plate", full), ("table alone", empty)):
        yield Case("no rack", name, rack, view.types, frame, nothing, same_rack=False)


def _on_plane(view: View, normal: FloatArray, offset_m: float, rng: np.random.Generator) -> FloatArray:
    """Points (H, W, 3), camera frame, where the pixels' rays meet a plane of the rack's frame; NaN behind."""
    k = view.frame.intrinsics
    assert k is not None
    T, rays = view.truth.T_camera_rack, k.rays()
    across = rays @ (T[:3, :3] @ normal)
    with np.errstate(divide="ignore"):
        depth = (offset_m + T[:3, 3] @ T[:3, :3] @ normal) / across
    depth = np.where(depth > 0, depth, np.nan) + rng.normal(0, FLAT_NOISE_M, depth.shape)
    return np.asarray(rays * depth[..., None])


def _with_surface(
    frame: RgbdFrame, points_m: FloatArray, where: NDArray[np.bool_], everywhere: bool = False
) -> RgbdFrame:
    """The frame with a surface drawn into it where that is nearer than what was there, or everywhere."""
    with np.errstate(invalid="ignore"):
        nearer = everywhere | ~(frame.cloud_m[..., 2] < points_m[..., 2])
    drawn = where & nearer & np.isfinite(points_m[..., 2])
    image = None if frame.image is None else np.where(drawn, np.uint8(PLATE_GRAY), frame.image)
    return dataclasses.replace(frame, cloud_m=np.where(drawn[..., None], points_m, frame.cloud_m), image=image)


def _rack(view: View) -> RackModel:
    assert view.truth.rack is not None
    return view.truth.rack


KINDS: dict[str, Make] = {
    "right": _right,
    "other-rack": _other_racks,
    "rows-columns": _rows_columns,
    "pitch": _pitch,
    "openings": _openings,
    "floor": _floor,
    "height": _heights,
    "types": _types,
    "caps": _caps,
    "scale": _scale,
    "robot": _robot,
    "wall": _wall,
    "plate": _plate,
}
"""What `--cases` names."""


def cases(view: View, kinds: tuple[str, ...], per_kind: int, seed: int) -> list[Case]:
    """Cases of one frame: all of each kind, or so many of each, drawn anew for every frame (0: all)."""
    found: list[Case] = []
    for number, kind in enumerate(KINDS):
        if kind not in kinds:
            continue
        rng = np.random.default_rng([seed, number, *view.name.encode()])
        made = list(KINDS[kind](view, rng))
        chosen = list(range(len(made)))
        if 0 < per_kind < len(made):
            chosen = sorted(rng.permutation(len(made))[:per_kind].tolist())
        found += [made[i] for i in chosen]
    return found
