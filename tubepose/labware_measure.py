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
from tubepose.labware import RackModel
from tubepose.labware.definition import LONGEST_NAME
from tubepose.rack.alternatives import line_steps_m
from tubepose.rack.resizing import LEAST_RIB_MM, register_unsized
from tubepose.rack.rib_edges import RibStretch, measure_ribs
from tubepose.rack.settling import Registration
from tubepose.rack.size import FaceSize
from tubepose.sensor.surfaces import table_beside
from tubepose.standing_tops import TopKind, kinds_of_tops, measure_tops
from tubepose.transforms import FloatArray, invert_transform, transform_points

OPENING_SHIFT_MM = 0.48
"""By so much openings look narrower: right below the face their walls count as face (SIMULATED scans, racks of the
catalogue, two resolutions: 0.3 to 0.7)."""
OPENING_STD_MM = 0.14
OUTLINE_STD_MM = 0.24
"""What blur leaves of openings and outlines, standard deviations (the same scans)."""
BLUR_SIGMAS = 1.8
DEPTH_STD_MM = 0.3
"""The floor of a slot is seen past its walls, whose light lifts it."""
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
    best = register_unsized(points_m, config, like)
    if best is None:
        words = f"like {like.name}" if like is not None else "of slots in rows and columns"
        raise LabwareError(
            f"{frame.capture}: no rack {words} was found; expected a face that is seen from above, most of its slots "
            "empty; --like NAME|FILE measures one that is like another, whatever its slots"
        )
    return _described(frame, points_m, *best, config, like)


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
        sizes.append(
            MeasuredSize("slot_depth_mm", depth[0], float(np.linalg.norm([depth[1], face_mm, DEPTH_STD_MM])), nominal)
        )
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
    blur_mm, blur_std_mm = _blur(outline, std, like)
    spread_mm = float(np.hypot(2e3 * std[2], blur_std_mm))
    for axis, name in enumerate("xy" if slot.shape == "square" else "x"):
        value = slot.size_mm[axis] + 2e3 * found.size.openings_m + OPENING_SHIFT_MM + blur_mm
        quantity = f"opening_{name}_mm" if slot.shape == "square" else "opening_mm"
        told = float("nan") if kept is None else kept.size_mm[axis]
        yield MeasuredSize(quantity, value, float(np.hypot(spread_mm, OPENING_STD_MM)), told)
    for axis, name in enumerate("xy"):
        told = float("nan") if like is None else like.outline_mm[axis]
        spread = float(np.hypot(2e3 * std[3 + axis], OUTLINE_STD_MM))
        yield MeasuredSize(f"outline_{name}_mm", float(outline[axis]), spread, told)


def _blur(outline_mm: FloatArray, std_m: FloatArray, like: RackModel | None) -> tuple[float, float]:
    """By how much blur, or a loss of edges, makes a face larger, and its standard deviation, millimetres.

    It moves the edges of openings and outline alike, so that a known outline tells it, where it is significant.
    """
    if like is None:
        return 0.0, 0.0
    off = float(np.mean(outline_mm - like.outline_mm))
    std = float(np.linalg.norm(np.hypot(2e3 * std_m[3:5], OUTLINE_STD_MM))) / 2
    return (off, std) if abs(off) > BLUR_SIGMAS * std else (0.0, 0.0)


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
