"""Slots of a rack: which tube stands in which, what was seen of every one, and its state."""

from tubepose.slots.assignment import (
    SlotAssignment,
    assign_slots,
    covered_slots,
    crop_to_slot,
    identify_tube,
    lean_reach_m,
    points_above,
    slot_shares,
)
from tubepose.slots.cells import slot_cores_m
from tubepose.slots.look import SlotLook, look_at_slots
from tubepose.slots.state import Finding, SlotState, StatedSlot, state_slot

__all__ = [
    "Finding",
    "SlotAssignment",
    "SlotLook",
    "SlotState",
    "StatedSlot",
    "assign_slots",
    "covered_slots",
    "crop_to_slot",
    "identify_tube",
    "lean_reach_m",
    "look_at_slots",
    "points_above",
    "slot_cores_m",
    "slot_shares",
    "state_slot",
]
