"""Which slot holds which tube, and which slots are empty (paper, section IV-B, first part)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.spatial import ConvexHull, QhullError

from tubepose.checks import Check, said
from tubepose.config import SlotConfig
from tubepose.detection.model import CAPPED_CLASS, OPEN_CLASS, TUBE_CLASS, visible_class
from tubepose.labware import RackModel, SlotModel, TubeModel
from tubepose.transforms import FloatArray

COVER_CELL_M = 1.5e-3
CORE_PITCHES = 0.25
CORE_SHARE = 0.6
"""A slot's middle, a disc of so many pitches, is covered where this share of its cells has points."""


@dataclass(frozen=True, slots=True, eq=False)
class SlotAssignment:
    """What one detected tube's points say about its slot.

    Attributes:
        detection: Index of the detection.
        slot: Name of the slot, or None if the tube stands on none.
        hull_share: Share of the projected hull's area that lies in that slot's opening.
        why: Why there is no slot; None where there is one.
        points_m: The tube's points above the rack's top, rack frame, shape (N, 3), metres.
    """

    detection: int
    slot: str | None
    hull_share: float
    why: Check | None
    points_m: FloatArray


def points_above(points_m: FloatArray, rack: RackModel, config: SlotConfig) -> FloatArray:
    """Points (N, 3) in the rack frame that stand above the rack's top, metres."""
    return points_m[points_m[:, 2] > rack.height_m + config.clearance_m]


def slot_shares(points_m: FloatArray, rack: RackModel) -> FloatArray:
    """Share of the area of the points' convex hull, projected onto the top, in every slot's opening; shape (S,).

    All zeros where the points span no area.
    """
    shares = np.zeros(len(rack.all_slots))
    try:
        hull = points_m[ConvexHull(points_m[:, :2]).vertices, :2] if len(points_m) >= 3 else np.empty((0, 2))
    except QhullError:
        return shares
    if len(hull) < 3:
        return shares
    outline = (hull * 1e3).astype(np.float32)
    area = cv2.contourArea(outline)
    low, high = outline.min(axis=0), outline.max(axis=0)
    for i, opening in enumerate(_openings_mm(rack)):
        if area > 0 and np.all(opening.max(axis=0) > low) and np.all(opening.min(axis=0) < high):
            shares[i] = cv2.intersectConvexConvex(outline, opening)[0] / area
    return shares


@lru_cache(maxsize=16)
def _openings_mm(rack: RackModel) -> list[np.ndarray]:
    return [(slot.boundary_m() * 1e3).astype(np.float32) for slot in rack.all_slots]


def assign_slots(tubes_m: Sequence[FloatArray], rack: RackModel, config: SlotConfig) -> tuple[SlotAssignment, ...]:
    """Give every tube the slot with the largest share of its projected hull.

    Two tubes on one slot: the one with the larger share keeps it, the other takes its next best free slot if its share
    there is large enough, or ends without a slot.

    Args:
        tubes_m: Per detected tube its points, rack frame, shape (N, 3), metres.
        rack: The rack.
        config: Thresholds.
    """
    above = [points_above(points, rack, config) for points in tubes_m]
    shares = np.array([slot_shares(points, rack) for points in above]).reshape(len(above), len(rack.all_slots))
    names = [slot.name for slot in rack.all_slots]
    taken: dict[int, int] = {}
    reasons = [Check("no_points_above", 0, 1, False) if len(points) == 0 else None for points in above]
    candidates = [
        (tube, int(slot)) for tube in range(len(above)) for slot in np.flatnonzero(shares[tube] >= config.min_share)
    ]
    for tube, slot in sorted(candidates, key=lambda pair: (-shares[pair], pair)):
        if tube in taken:
            continue
        if slot in taken.values():
            reasons[tube] = said("slot_taken", names[slot])
            continue
        taken[tube] = slot
    found = []
    for tube, points in enumerate(above):
        chosen = taken.get(tube)
        if chosen is None:
            most = float(shares[tube].max(initial=0.0))
            why = reasons[tube] or Check("in_no_slot", 100 * most, 100 * config.min_share, False)
            found.append(SlotAssignment(tube, None, most, why, points))
        else:
            found.append(SlotAssignment(tube, names[chosen], float(shares[tube, chosen]), None, points))
    return tuple(found)


def covered_slots(points_m: FloatArray, rack: RackModel) -> frozenset[str]:
    """Slots whose middle is covered by points (N, 3), rack frame, as seen from above: nothing can be put in there."""
    cells = np.unique(np.floor(points_m[:, :2] / COVER_CELL_M), axis=0) * COVER_CELL_M + COVER_CELL_M / 2
    core_m = CORE_PITCHES * rack.pitches_m
    apart = np.linalg.norm(rack.slot_centers_m[:, None] - cells[None], axis=2)
    filled_m2 = (apart < core_m[:, None]).sum(axis=1) * COVER_CELL_M**2
    covered = filled_m2 > CORE_SHARE * np.pi * core_m**2
    return frozenset(slot.name for slot, is_covered in zip(rack.all_slots, covered, strict=True) if is_covered)


def lean_reach_m(z_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel) -> FloatArray:
    """How far the tube's axis can be from the slot's axis at heights z above the base, metres: play plus lean."""
    play = rack.floor_play_mm * 1e-3
    clearance = np.hypot(*np.maximum(slot.half_size_m - tube.body_radius_m(rack.depth_m), 0.0))
    return np.asarray(play + (clearance + play) * (np.asarray(z_m) - rack.floor_m) / rack.depth_m)


def crop_to_slot(
    points_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel, config: SlotConfig
) -> FloatArray:
    """Points (N, 3), rack frame, that a tube in this slot can own; the rest of its box is another tube's."""
    lateral = np.hypot(*(points_m[:, :2] - slot.center_m).T)
    limit = tube.max_radius_m + lean_reach_m(points_m[:, 2], slot, tube, rack) + config.reach_m
    below_top = points_m[:, 2] < rack.floor_m + tube.height_m + 2 * config.reach_m
    return np.asarray(points_m[(lateral < limit) & below_top])


def identify_tube(
    class_name: str, points_m: FloatArray, candidates: Sequence[TubeModel], rack: RackModel, config: SlotConfig
) -> tuple[TubeModel | None, Check | None]:
    """The tube model of a detection, by its class where the detector gives one, else by the height of its points.

    Args:
        class_name: The detector's word; a tube model answers to its name, to its `classes`, and to whether it is
            capped or open.
        points_m: The tube's points, rack frame, shape (N, 3), metres.
        candidates: The tubes that can be in this rack.
        rack: For the floor that the tube stands on.
        config: Tolerance of the height.

    Returns:
        The model and None, or None and the check that says why.
    """
    named = [tube for tube in candidates if class_name == tube.name or class_name in tube.classes]
    if named:
        return named[0], None
    if class_name in (CAPPED_CLASS, OPEN_CLASS):
        seen = [tube for tube in candidates if visible_class(closed=not tube.is_open) == class_name]
        # A cap is easily taken for an opening from above: where no such tube is there, height alone decides.
        candidates = seen or candidates
    elif class_name != TUBE_CLASS:
        known = sorted({word for tube in candidates for word in (tube.name, *tube.classes)})
        words = f"'{class_name}' belongs to none of the tubes given (they answer to {', '.join(known)})"
        return None, said("unknown_class", words)
    height_m = float(np.percentile(points_m[:, 2], 95)) - rack.floor_m
    differences = [abs(tube.height_m - height_m) for tube in candidates]
    order = np.argsort(differences)
    nearest = candidates[order[0]]
    sunk = nearest.is_open and height_m < nearest.height_m
    if differences[order[0]] > (config.open_depth_m if sunk else config.height_tolerance_m):
        heights = ", ".join(f"{tube.name} {tube.height_mm:g}" for tube in candidates)
        return None, said("unknown_type", f"unknown type: {height_m * 1e3:.1f} mm high, expected (mm): {heights}")
    if len(candidates) > 1 and differences[order[1]] - differences[order[0]] < 0.4 * config.height_tolerance_m:
        alike = f"{candidates[order[0]].name} and {candidates[order[1]].name}"
        return None, said("types_alike", alike, 1e3 * height_m)
    return candidates[order[0]], None
