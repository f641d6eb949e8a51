"""Labware that could be: racks and tubes like those of the labware files, but of other sizes, shapes and caps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from pydantic import ValidationError

from tubepose.labware import RackModel, TubeModel
from tubepose.labware.definition import LONGEST_NAME
from tubepose.labware.racks import SlotGrid, SlotShape
from tubepose.labware.tubes import TubeBody, TubeCap
from tubepose.transforms import FloatArray

_TRIES = 20


def _variant_name(item: RackModel | TubeModel) -> str:
    ending = "-variant"
    return item.name[: LONGEST_NAME - len(ending)] + ending


def vary_tube(tube: TubeModel, rng: np.random.Generator) -> TubeModel:
    """A tube like the given one, with its height, diameters and cap changed by up to a third."""
    for _ in range(_TRIES):
        wide, high = rng.uniform(0.8, 1.25), rng.uniform(0.7, 1.3)
        body = tube.body
        bottom = body.bottom_diameter_mm * wide
        fields = body.model_dump() | {
            "height_mm": body.height_mm * high,
            "bottom_diameter_mm": bottom,
            "top_diameter_mm": max(body.top_diameter_mm * wide * rng.uniform(0.95, 1.05), bottom),
        }
        cap = tube.cap
        if cap is not None:
            cap_high = min(cap.height_mm * rng.uniform(0.6, 1.8), 0.35 * fields["height_mm"])
            cap = TubeCap(
                diameter_mm=fields["top_diameter_mm"] * rng.uniform(1.03, 1.4),
                height_mm=cap_high,
                top_mm=0.0 if cap.open else cap_high * rng.uniform(0.1, 0.7),
                open=cap.open,
            )
        try:
            return TubeModel(kind="tube", name=_variant_name(tube), body=TubeBody(**fields), cap=cap)
        except ValidationError:
            continue
    return tube


def vary_rack(rack: RackModel, rng: np.random.Generator) -> RackModel:
    """A rack whose slots are those of the given one, or a grid of any size about as wide; no two alike."""
    kind = "round" if rng.uniform() < 0.5 else "square"
    base = rack.all_slots[0]
    for _ in range(_TRIES):
        size = float(np.mean(base.size_mm)) * rng.uniform(0.75, 1.35)
        pitch = size + rng.uniform(1.2, 12.0, 2) * (1.0 if rng.uniform() < 0.6 else np.array([1.0, 0.3]))
        rows, columns = int(rng.integers(1, 8)), int(rng.integers(2, 13))
        margin = rng.uniform(1.5, 15.0, 2)
        height = rack.height_mm * rng.uniform(0.6, 1.4)
        slot = SlotShape(
            shape="round" if kind == "round" else "square",
            size_mm=(size, size),
            corner_radius_mm=0.0 if kind == "round" else float(rng.uniform(0, 0.2) * size),
        )
        outline = np.array([columns - 1, rows - 1]) * pitch + size + 2 * margin
        try:
            return RackModel(
                kind="rack",
                name=_variant_name(rack),
                outline_mm=(float(outline[0]), float(outline[1])),
                height_mm=height,
                floor_mm=float(np.clip(rack.floor_mm * rng.uniform(0.7, 1.5), 1.0, 0.6 * height)),
                grid=SlotGrid(rows=rows, columns=columns, pitch_mm=(float(pitch[0]), float(pitch[1])), slot=slot),
            )
        except ValidationError:
            continue
    return rack


def cap_outline(tube: TubeModel, rng: np.random.Generator) -> FloatArray:
    """Profile (z, r) of a closed cap, tube frame, metres.

    The definition's cylinder, or one with a step, a pit, a dome or a bevel; all keep its height and largest radius.
    """
    (skirt, body), (_, radius), (top, _), _ = tube.cap_profile_m()
    high = top - skirt
    kind = rng.choice(["plain", "pit", "step", "dome", "bevel"], p=[0.35, 0.2, 0.15, 0.15, 0.15])
    if kind == "pit":
        rim, deep = radius * rng.uniform(0.35, 0.8), high * rng.uniform(0.1, 0.6)
        tail = [[top, radius], [top, rim], [top - deep, rim * 0.9], [top - deep, 0.0]]
    elif kind == "step":
        at, inner = skirt + high * rng.uniform(0.2, 0.8), radius * rng.uniform(0.5, 0.92)
        tail = [[at, radius], [at, inner], [top, inner], [top, 0.0]]
    elif kind == "dome":
        angles = np.linspace(0, np.pi / 2, 7)
        rise = high * rng.uniform(0.15, 0.6)
        tail = [[top - rise + rise * np.sin(a), radius * np.cos(a)] for a in angles]
        tail[-1][1] = 0.0
    elif kind == "bevel":
        cut = min(radius, high) * rng.uniform(0.1, 0.4)
        tail = [[top - cut, radius], [top, radius - cut], [top, 0.0]]
    else:
        tail = [[top, radius], [top, 0.0]]
    return np.array([[skirt, body], [skirt, radius], *tail])


def fits(rack: RackModel, tube: TubeModel) -> tuple[int, ...]:
    """Numbers of the slots that a tube goes into and stands out of by 3 mm or more."""
    z, r = tube.outer_profile_m().T
    widest = float(r[z <= rack.depth_m].max())
    if tube.height_m < rack.depth_m + 3e-3:
        return ()
    slots = rack.all_slots
    return tuple(k for k, slot in enumerate(slots) if widest + 1e-4 < -float(slot.signed_distance_m(slot.center_m)))


def matching_tubes(rack: RackModel, tubes: Sequence[TubeModel]) -> list[TubeModel]:
    """The tubes that go into some slot of a rack."""
    return [tube for tube in tubes if fits(rack, tube)]
