"""Racks of other standards: Opentrons labware (schema 2 and 3) and PyLabRobot resources, both JSON in millimetres.

They give a rack's outline, its slots' centres and their names, from the left front corner of its base: x to the right,
y to the back. Their depths, diameters and heights are those of tubes, of their insides, or of boxes around them. What a
rack's definition needs beside is asked for in a side file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import Field

from tubepose.errors import LabwareError
from tubepose.labware.definition import Definition, Name, NonNegative, Positive
from tubepose.labware.racks import SlotShape

SIDE_SUFFIX = ".side.yaml"
"""`my_rack.json` is completed by `my_rack.side.yaml` beside it."""
_NO_RACKS = ("wellPlate", "tipRack", "reservoir", "trash", "adapter", "lid")
_NO_RESOURCES = ("Plate", "TipRack", "Trough", "Trash", "Lid")


class SideFile(Definition):
    """What the standards' files do not say of a rack, measured by the user.

    Attributes:
        height_mm: Height of the top above the base.
        floor_mm: Height of the slot floor above the base.
        slot: Opening of every slot that `slots` does not name.
        slots: Openings by the names of slots, with commas between several.
        floor_play_mm: As a rack's.
        floor_tolerance_mm: As a rack's.
        name: Instead of the file's own name.
        description: One line in words.
        source: Where the measures come from.
    """

    height_mm: Positive
    floor_mm: NonNegative
    slot: SlotShape | None = None
    slots: dict[str, SlotShape] = Field(default_factory=dict)
    floor_play_mm: NonNegative = 1.0
    floor_tolerance_mm: NonNegative = 0.1
    name: Name | None = None
    description: str = ""
    source: str = ""


@dataclass(frozen=True, slots=True)
class ForeignRack:
    """What a file of another standard says of a rack.

    Attributes:
        standard: Its name.
        name: The rack's.
        outline_mm: Along x and y.
        centers_mm: Centres of slots by name, from the left front corner, in the file's order.
    """

    standard: str
    name: str
    outline_mm: tuple[float, float]
    centers_mm: dict[str, tuple[float, float]]


def read_foreign_rack(data: Mapping[str, Any], where: str) -> ForeignRack:
    """The rack of a JSON file by its keys.

    Raises:
        LabwareError: Neither of the standards, no rack of tubes, or places that are missing or no numbers.
    """
    if "wells" in data and "dimensions" in data:
        return _opentrons(data, where)
    if "children" in data and "size_x" in data:
        return _pylabrobot(data, where)
    raise LabwareError(
        f"{where}: expected an Opentrons labware definition (keys dimensions, wells) or a PyLabRobot resource (keys "
        f"size_x, children), found {', '.join(map(str, data))[:120] or 'no keys'}"
    )


def side_words(rack: ForeignRack, side: str) -> str:
    """What to say where a rack's side file is missing: the file to write."""
    first = next(iter(rack.centers_mm))
    return (
        f"{rack.standard} gives outline, slot centres and names; the rest has to be measured: write {side} with "
        "'height_mm: ' (of the rack's top above its base), 'floor_mm: ' (of the slots' floor) and 'slot: {shape: "
        f"round, size_mm: [ , ]}}' (the opening; where slots differ 'slots: {{\"{first}, ...\": {{...}}}}' too)"
    )


def complete_rack(rack: ForeignRack, side: SideFile, where: str) -> dict[str, Any]:
    """Keys of a rack's definition, from what a file says and what its side file adds.

    Raises:
        LabwareError: An opening is missing, or one is given for a slot that is not there.
    """
    openings = {name.strip(): shape for names, shape in side.slots.items() for name in names.split(",")}
    if unknown := sorted(openings.keys() - rack.centers_mm.keys()):
        raise LabwareError(f"{where}: no slot {', '.join(unknown)[:120]}; known: {', '.join(rack.centers_mm)[:400]}")
    slots = []
    for name, (x, y) in rack.centers_mm.items():
        shape = openings.get(name, side.slot)
        if shape is None:
            raise LabwareError(f"{where}: no opening for slot {name}; add 'slot: {{shape: round, size_mm: [ , ]}}'")
        center = (round(x - rack.outline_mm[0] / 2, 6), round(y - rack.outline_mm[1] / 2, 6))
        slots.append({"name": name, "center_mm": center, **shape.model_dump()})
    kept = side.model_dump(include={"height_mm", "floor_mm", "floor_play_mm", "floor_tolerance_mm"})
    source = f"outline, slot centres and names: {rack.standard}, {rack.name}; the rest: {side.source or 'measured'}"
    return {
        "kind": "rack",
        "name": side.name or rack.name,
        "description": side.description,
        "source": source,
        "outline_mm": rack.outline_mm,
        **kept,
        "slots": slots,
    }


def _opentrons(data: Mapping[str, Any], where: str) -> ForeignRack:
    if data.get("schemaVersion") not in (2, 3):
        raise LabwareError(
            f"{where}: expected an Opentrons definition of schemaVersion 2 or 3, found "
            f"{data.get('schemaVersion')!r:.40}"
        )
    category = _part(data, "metadata").get("displayCategory")
    if category in _NO_RACKS:
        raise LabwareError(f"{where}: an Opentrons {category}; expected a rack of tubes (tubeRack)")
    dimensions, wells = _part(data, "dimensions"), _part(data, "wells")
    outline = (_number(dimensions, "xDimension", where), _number(dimensions, "yDimension", where))
    order = _ordered([name for column in _list(data.get("ordering")) for name in _list(column)], wells, where)
    centers = {name: (_number(wells[name], "x", where), _number(wells[name], "y", where)) for name in order}
    name = _part(data, "parameters").get("loadName")
    return _checked(ForeignRack("Opentrons", str(name or "opentrons-rack"), outline, centers), where)


def _pylabrobot(data: Mapping[str, Any], where: str) -> ForeignRack:
    kind = str(data.get("type"))
    if kind in _NO_RESOURCES:
        raise LabwareError(f"{where}: a PyLabRobot {kind}; expected a rack of tubes (TubeRack, ContainerRack)")
    children = [child for child in _list(data["children"]) if isinstance(child, Mapping)]
    if any(any(_part(part, "rotation").get(axis) for axis in "xyz") for part in (data, *children)):
        raise LabwareError(
            f"{where}: a PyLabRobot resource that is rotated; save the rack itself, not placed on a deck"
        )
    outline = (_number(data, "size_x", where), _number(data, "size_y", where))
    places = {}
    for child in children:
        location = _part(child, "location")
        places[str(child.get("name"))] = (
            _number(location, "x", where) + _number(child, "size_x", where) / 2,
            _number(location, "y", where) + _number(child, "size_y", where) / 2,
        )
    names = _pylabrobot_names(data.get("ordering"), list(places), where)
    centers = {slot: places[child] for slot, child in names.items()}
    return _checked(ForeignRack("PyLabRobot", str(data.get("model") or data.get("name")), outline, centers), where)


def _pylabrobot_names(ordering: Any, children: list[str], where: str) -> dict[str, str]:
    """Children by the names of slots: of a mapping, of a list in their order, else by the ends of their names."""
    if isinstance(ordering, Mapping) and set(map(str, ordering.values())) <= set(children):
        return {str(slot): str(child) for slot, child in ordering.items()}
    if isinstance(ordering, list) and len(ordering) == len(children):
        return dict(zip(map(str, ordering), children, strict=True))
    if ordering:
        raise LabwareError(f"{where}: 'ordering' does not name the {len(children)} children of the rack")
    return {child.rsplit("_", 1)[-1].rsplit("-", 1)[-1]: child for child in children}


def _checked(rack: ForeignRack, where: str) -> ForeignRack:
    if not rack.centers_mm:
        raise LabwareError(f"{where}: a rack of {rack.standard} without slots")
    return rack


def _ordered(names: list[Any], wells: Mapping[str, Any], where: str) -> list[str]:
    if sorted(map(str, names)) != sorted(wells):
        raise LabwareError(f"{where}: 'ordering' names other wells than 'wells' has")
    # Row by row, as our own racks are.
    return sorted(map(str, names), key=lambda name: (name[:1], len(name), name))


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else []


def _part(data: Any, key: str) -> Mapping[str, Any]:
    part = data.get(key) if isinstance(data, Mapping) else None
    return part if isinstance(part, Mapping) else {}


def _number(data: Any, key: str, where: str) -> float:
    value = data.get(key) if isinstance(data, Mapping) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e6:
        raise LabwareError(f"{where}: expected a number of millimetres at '{key}', found {value!r:.60}")
    return float(value)
