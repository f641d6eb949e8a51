"""Racks, tubes and printed caps: definitions in YAML, a built-in catalogue, and the geometry that follows from them."""

from tubepose.labware.racks import RackModel, SlotGrid, SlotModel, SlotShape
from tubepose.labware.reading import (
    Labware,
    catalogue,
    labware_of,
    labware_sha256,
    load_cap,
    load_rack,
    load_tube,
    read_labware,
    unique_tubes,
)
from tubepose.labware.tubes import CapModel, TubeModel, WallOptics

__all__ = [
    "CapModel",
    "Labware",
    "RackModel",
    "SlotGrid",
    "SlotModel",
    "SlotShape",
    "TubeModel",
    "WallOptics",
    "catalogue",
    "labware_of",
    "labware_sha256",
    "load_cap",
    "load_rack",
    "load_tube",
    "read_labware",
    "unique_tubes",
]
