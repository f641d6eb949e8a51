"""Labware measured from a scan: a rack's pitch, openings, outline and heights, and the tops of what stands in it.

The rack's face is registered with a definition, its sizes are measured against it (`rack.size`), the definition takes
them over, and so on until nothing changes: what is found does not depend on where it began.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from tubepose.capture.frame import RgbdFrame
from tubepose.config import Config
from tubepose.errors import LabwareError
from tubepose.labware import RackModel, SlotGrid, SlotShape
from tubepose.labware.definition import LONGEST_NAME
from tubepose.rack.alternatives import line_steps_m
from tubepose.rack.edges import best_registration, coarse_sample
from tubepose.rack.grid import coarse_racks
from tubepose.rack.lattice import SlotLattice
from tubepose.rack.periods import propose_lattices
from tubepose.rack.rib_edges import RibStretch, measure_ribs
from tubepose.rack.search import levels
from tubepose.rack.settling import Registration, register_at
from tubepose.rack.size import FaceSize
from tubepose.sensor.surfaces import table_beside
from tubepose.standing_tops import TopKind, kinds_of_tops, measure_tops
from tubepose.transforms import QUARTER_TURN, FloatArray, invert_transform, transform_points

ROUNDS = 6
SETTLED_MM = 0.01
ODD_MM = 1.5
"""Openings that are longer than wide by less are taken for squares: one edge is told no better."""
OPENING_SHIFT_MM = 0.48
"""By so much openings look narrower: right below the face their walls count as face (SIMULATED scans, racks of the
catalogue, two resolutions: 0.3 to 0.7)."""
OPENING_STD_MM = 0.14
OUTLINE_STD_MM = 0.24
"""What blur leaves of openings and outlines, standard deviations (the same scans)."""
LEAST_RIB_MM = 0.8
PITCH_STD = 8e-4
"""A camera's scale, as a share of every pitch."""
RIB_WINDOW_M = 1.0e-3
HEIGHT_STD_MM = 0.04
"""What stray light leaves of the height between face and table, standard deviation."""
TOP_STD_MM = 0.1
"""The same of a closed top."""
RIM_STD_MM = 1.0
"""Rims of see-through plastic are seen too deep by up to so much."""
DIAMETER_STD_MM = 0.2


@dataclass(frozen=True, slots=True)
class MeasuredSize:
    """One size.

    Attributes:
        quantity: What it is, with its unit: ``pitch_x_mm``, ``opening_mm``, ``top_height_mm``, ...
        value: The measurement.
        std: Its standard deviation.
        nominal: What the definition that it is compared with says; NaN without one.
        count: On how many tubes it was measured; 0 for the rack's sizes.
    """

    quantity: str
    value: float
    std: float
    nominal: float = float("nan")
    count: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredRack:
    """A rack as a scan shows it.

    Attributes:
        rack: Its definition, with every measure that was taken. Height and floor are those of `sizes` where they are
            among them, else those of the definition that it was measured like.
        sizes: Every measured size.
        kinds: The kinds of tops in its slots.
        known_height: Whether the height was measured: a table was seen beside the rack.
        known_floor: Whether the slots' floor was.
    """

    rack: RackModel
    sizes: tuple[MeasuredSize, ...]
    kinds: tuple[TopKind, ...]
    known_height: bool
    known_floor: bool


def measure_rack(frame: RgbdFrame, config: Config, like: RackModel | None = None) -> MeasuredRack:
    """Measure the rack of a frame.

    Args:
        frame: The frame.
        config: Sections rack_top, rack and sensor are used.
        like: A definition to begin with and to compare with; without it the rack's slots have to lie in rows and
            columns.

    Raises:
        LabwareError: No rack is found.
    """
    points_m = frame.measured_m
    if like is not None:
        few_m = coarse_sample(points_m, config.rack_top)
        found = best_registration(points_m, few_m, levels(few_m, config.rack_top), like, config)
        starts = [] if found is None or found.size is None else [(like, found)]
    else:
        starts = [_upright(points_m, *one, config) for one in _unknown(points_m, config)]
    settled = [_settled(points_m, *start, config) for start in starts]
    best = max(settled, key=lambda pair: pair[1].log_likelihood, default=None)
    if best is None:
        words = f"like {like.name}" if like is not None else "of slots in rows and columns"
        raise LabwareError(
            f"{frame.capture}: no rack {words} was found; expected a face that is seen from above, most of its slots "
            "empty; --like NAME|FILE measures one that is like another, whatever its slots"
        )
    return _described(frame, points_m, *best, config, like)


def _unknown(points_m: FloatArray, config: Config) -> Iterator[tuple[RackModel, Registration]]:
    """Racks that slots of unknown pitch could make, each with its registration; openings square and round."""
    for lattice in propose_lattices(points_m, config):
        found = False
        for shape in _shapes(lattice):
            for T_camera_rack, rack in coarse_racks(points_m, shape, config):
                registration = register_at(points_m, T_camera_rack, rack, config.rack)
                if registration.size is not None:
                    yield rack, registration
                    found = True
                    break
        if found:
            return


def _shapes(lattice: SlotLattice) -> Iterator[SlotLattice]:
    size = lattice.slot.size_mm
    if lattice.slot.shape == "square" and abs(size[0] - size[1]) < ODD_MM:
        size = (sum(size) / 2, sum(size) / 2)
        lattice = replace(lattice, slot=SlotShape(shape="square", size_mm=size))
    yield lattice
    if lattice.slot.shape == "round":
        side = size[0] * float(np.sqrt(np.pi) / 2)
        yield replace(lattice, slot=SlotShape(shape="square", size_mm=(side, side)))
    elif abs(size[0] - size[1]) < 0.3 * max(size):
        wide = float(min(np.sqrt(size[0] * size[1] * 4 / np.pi), 0.97 * min(lattice.pitch_mm)))
        yield replace(lattice, slot=SlotShape(shape="round", size_mm=(wide, wide)))


def _settled(
    points_m: FloatArray, rack: RackModel, found: Registration, config: Config
) -> tuple[RackModel, Registration]:
    """Measure, take the sizes over, register again, until nothing changes."""
    for _ in range(ROUNDS):
        assert found.size is not None
        better = _resized(rack, found)
        if better is None:
            break
        again = register_at(points_m, found.fit.T_camera_rack, better, config.rack)
        if again.size is None:
            break
        moved = max(
            float(np.abs(np.array(better.outline_mm) - rack.outline_mm).max()),
            float(np.abs(np.array(better.all_slots[0].size_mm) - rack.all_slots[0].size_mm).max()),
            1e3 * float(np.abs(better.slot_centers_m - rack.slot_centers_m).max()),
        )
        rack, found = better, again
        if moved < SETTLED_MM:
            break
    return rack, found


def _resized(rack: RackModel, found: Registration) -> RackModel | None:
    """The rack with the sizes that its registration measured; None where that is no rack."""
    size = found.size
    assert size is not None
    stretch = 1 + size.stretch
    # A sensor that loses the edges of ribs must not lose the ribs.
    narrowest_mm = 1e3 * rack.min_rib_m
    wider_mm = min(2e3 * size.openings_m, max(0.0, narrowest_mm - LEAST_RIB_MM))
    outline = tuple(float(side) for side in np.array(rack.outline_mm) + 2e3 * size.outline_m)
    try:
        if rack.grid is not None:
            slot = rack.grid.slot
            grid = SlotGrid(
                rows=rack.grid.rows, columns=rack.grid.columns,
                pitch_mm=_pair(np.array(rack.grid.pitch_mm) * stretch),
                slot=SlotShape(
                    shape=slot.shape, size_mm=_pair(np.array(slot.size_mm) + wider_mm),
                    corner_radius_mm=slot.corner_radius_mm,
                ),
                offset_mm=_pair(np.array(rack.grid.offset_mm) * stretch),
            )  # fmt: skip
            return RackModel(**{**rack.model_dump(), "outline_mm": outline, "grid": grid.model_dump()})
        slots = [
            {
                **slot.model_dump(),
                "center_mm": _pair(np.array(slot.center_mm) * stretch),
                "size_mm": _pair(np.array(slot.size_mm) + wider_mm),
            }
            for slot in rack.slots
        ]
        return RackModel(**{**rack.model_dump(), "outline_mm": outline, "slots": slots})
    except ValueError:
        return None


def _pair(values: FloatArray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _upright(
    points_m: FloatArray, rack: RackModel, found: Registration, config: Config
) -> tuple[RackModel, Registration]:
    """The same with the longer side along x, as racks are named: rows A, B, ... of many columns."""
    if rack.grid is None or rack.outline_mm[0] >= rack.outline_mm[1]:
        return rack, found
    grid = rack.grid
    slot = SlotShape(shape=grid.slot.shape, size_mm=grid.slot.size_mm[::-1])
    turned = SlotGrid(rows=grid.columns, columns=grid.rows, pitch_mm=grid.pitch_mm[::-1], slot=slot)
    name = f"grid-{turned.rows}x{turned.columns}"
    keys = {**rack.model_dump(), "name": name, "outline_mm": rack.outline_mm[::-1], "grid": turned.model_dump()}
    other = RackModel(**keys)
    again = register_at(points_m, found.fit.T_camera_rack @ QUARTER_TURN, other, config.rack)
    return (other, again) if again.size is not None else (rack, found)


def _described(
    frame: RgbdFrame, points_m: FloatArray, rack: RackModel, found: Registration, config: Config, like: RackModel | None
) -> MeasuredRack:
    T_camera_rack = found.fit.T_camera_rack
    flat = transform_points(invert_transform(T_camera_rack), found.fit.laid_flat(points_m, rack))
    face = (*_face_sizes(rack, found, measure_ribs(flat, rack, RIB_WINDOW_M), like),)
    table = table_beside(frame, T_camera_rack, rack, config.sensor)
    face_mm = 1e3 * float(np.sqrt(found.fit.covariance[5, 5]))
    sizes = list(face)
    height = None
    if table is not None:
        height = rack.height_mm - 1e3 * float(table.height_m(np.zeros(2)))
        std = float(np.hypot(face_mm, HEIGHT_STD_MM))
        sizes.append(MeasuredSize("height_mm", height, std, _of(like, "height_mm")))
    depth = None if found.floor_m is None else (rack.height_mm - 1e3 * found.floor_m[0], 1e3 * found.floor_m[1])
    if depth is not None:
        nominal = float("nan") if like is None else like.height_mm - like.floor_mm
        sizes.append(MeasuredSize("slot_depth_mm", depth[0], float(np.hypot(depth[1], face_mm)), nominal))
    elif like is not None:
        depth = (like.height_mm - like.floor_mm, like.floor_tolerance_mm)
    local = transform_points(invert_transform(T_camera_rack), points_m)
    tops = measure_tops(local, rack)
    if depth is not None:
        tops = tuple(replace(top, height_mm=(top.height_mm + depth[0]) / float(np.cos(top.tilt_rad))) for top in tops)
    kinds = kinds_of_tops(tops)
    shared = float(np.hypot(face_mm, depth[1] if depth is not None else 0.0))
    sizes += [size for kind in kinds for size in _kind_sizes(kind, shared, depth is not None)]
    return MeasuredRack(
        _definition(rack, face, height, depth, like), tuple(sizes), kinds, height is not None, found.floor_m is not None
    )


def _of(rack: RackModel | None, key: str) -> float:
    return float("nan") if rack is None else float(getattr(rack, key))


def _face_sizes(
    rack: RackModel, found: Registration, ribs: RibStretch, like: RackModel | None
) -> Iterator[MeasuredSize]:
    """Pitch, openings and outline: what the definition took over, with the last round's rest and its errors."""
    assert found.size is not None
    std = found.size.std
    nominal_steps = line_steps_m(like) if like is not None else (None, None)
    for axis, (name, step, nominal) in enumerate(zip("xy", line_steps_m(rack), nominal_steps, strict=True)):
        if step is not None:
            share, share_std = _stretch(found.size, ribs, axis)
            told = float("nan") if nominal is None else 1e3 * nominal
            step_mm = 1e3 * step
            yield MeasuredSize(f"pitch_{name}_mm", step_mm * (1 + share), step_mm * share_std, told)
    outline = np.array(rack.outline_mm) + 2e3 * found.size.outline_m
    slot, kept = rack.all_slots[0], None if like is None else like.all_slots[0]
    # Blur moves the edges of openings and outline alike: a known outline tells by how much.
    blur_mm = 0.0 if like is None else float(np.mean(outline - like.outline_mm))
    spread_mm = 2e3 * (float(std[2]) if like is None else found.size.wider_openings_m()[1])
    for axis, name in enumerate("xy" if slot.shape == "square" else "x"):
        value = slot.size_mm[axis] + 2e3 * found.size.openings_m + OPENING_SHIFT_MM + blur_mm
        quantity = f"opening_{name}_mm" if slot.shape == "square" else "opening_mm"
        told = float("nan") if kept is None else kept.size_mm[axis]
        yield MeasuredSize(quantity, value, float(np.hypot(spread_mm, OPENING_STD_MM)), told)
    for axis, name in enumerate("xy"):
        told = float("nan") if like is None else like.outline_mm[axis]
        spread = float(np.hypot(2e3 * std[3 + axis], OUTLINE_STD_MM))
        yield MeasuredSize(f"outline_{name}_mm", float(outline[axis]), spread, told)


def _stretch(size: FaceSize, ribs: RibStretch, axis: int) -> tuple[float, float]:
    """Stretch by the face's cells and by its ribs, weighed by inverse variances, and its standard deviation."""
    shares, stds = (
        np.array(pair) for pair in ((size.stretch[axis], ribs.stretch[axis]), (size.std[axis], ribs.std[axis]))
    )
    known = np.isfinite(shares) & np.isfinite(stds)
    weights = np.maximum(stds[known], PITCH_STD) ** -2.0
    return float(weights @ shares[known] / weights.sum()), float(np.hypot(weights.sum() ** -0.5, PITCH_STD))


def _kind_sizes(kind: TopKind, shared_mm: float, from_floor: bool) -> Iterator[MeasuredSize]:
    """Height and diameter of a kind of tops, above the slots' floor where it is known, else above the face."""
    what = "top" if kind.closed else "rim"
    place = "height" if from_floor else "above_face"
    own = TOP_STD_MM if kind.closed else RIM_STD_MM
    std = float(np.hypot(max(kind.height_std_mm, TOP_STD_MM) / np.sqrt(kind.count), np.hypot(shared_mm, own)))
    yield MeasuredSize(f"{what}_{place}_mm", kind.height_mm, std, count=kind.count)
    std = float(np.hypot(max(kind.diameter_std_mm, DIAMETER_STD_MM) / np.sqrt(kind.count), DIAMETER_STD_MM))
    yield MeasuredSize(f"{what}_diameter_mm", kind.diameter_mm, std, count=kind.count)


def _definition(
    rack: RackModel,
    sizes: tuple[MeasuredSize, ...],
    height_mm: float | None,
    depth: tuple[float, float] | None,
    like: RackModel | None,
) -> RackModel:
    """The measured definition; height and floor that were not seen are those of the one that it was measured like."""
    high = height_mm if height_mm is not None else (like or rack).height_mm
    floor = max(0.0, high - depth[0]) if depth is not None else (like or rack).floor_mm
    told = "; ".join(f"{size.quantity} {size.value:.2f} +- {size.std:.2f}" for size in sizes)
    by_name = {size.quantity: size.value for size in sizes}
    wider = by_name.get("opening_mm", by_name.get("opening_x_mm", 0.0)) - rack.all_slots[0].size_mm[0]
    wider = min(wider, 1e3 * rack.min_rib_m - LEAST_RIB_MM / 2)
    keys = rack.model_dump()
    if rack.grid is not None:
        pitch = [by_name.get(f"pitch_{name}_mm", kept) for name, kept in zip("xy", rack.grid.pitch_mm, strict=True)]
        slot = {**keys["grid"]["slot"], "size_mm": _rounded(np.array(rack.grid.slot.size_mm) + wider)}
        keys["grid"] |= {"pitch_mm": _rounded(np.array(pitch)), "slot": slot}
        keys["grid"]["offset_mm"] = _rounded(np.array(rack.grid.offset_mm))
    else:
        for slot in keys["slots"]:
            slot["size_mm"] = _rounded(np.array(slot["size_mm"]) + wider)
            slot["center_mm"] = _rounded(np.array(slot["center_mm"]))
    keys["outline_mm"] = _rounded(np.array([by_name["outline_x_mm"], by_name["outline_y_mm"]]))
    return RackModel(
        **{
            **keys,
            "name": f"measured-{(like or rack).name}"[:LONGEST_NAME],
            "description": "",
            "height_mm": round(high, 2),
            "floor_mm": round(min(floor, high - 0.1), 2),
            "floor_tolerance_mm": round(max(0.1, depth[1]), 2) if depth is not None else rack.floor_tolerance_mm,
            "source": f"Measured from a scan: {told}.",
        }
    )


def _rounded(values: FloatArray) -> tuple[float, float]:
    """Two millimetres, to hundredths."""
    return round(float(values[0]), 2), round(float(values[1]), 2)
