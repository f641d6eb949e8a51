"""What a method's answers and the look at the slots say together: the state of every slot of a scene."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tubepose.scene import Scene, TubeEstimate
from tubepose.slots import Finding, StatedSlot, covered_slots, slot_cores_m, state_slot
from tubepose.transforms import FloatArray, transform_points
from tubepose.tube import TubeStatus

DISC_MARGIN_M = 1.0e-3
"""A top reaches over what lies this near beside it, metres: the cells that cover is counted in."""


def held_slots(scene: Scene, estimates: Sequence[TubeEstimate]) -> dict[str, TubeEstimate]:
    """What a method found in slots, by their names: the first of a slot, else something that covers its middle.

    Args:
        scene: The scene.
        estimates: Answers of one method, those of a slot in the order of their importance.
    """
    held = {
        name: estimate
        for estimate in estimates
        if estimate.target.slot is None
        for name in covered_slots(estimate.target.points_m, scene.rack)
    }
    # The first of a slot counts: what was found in it besides comes after it.
    return held | {e.target.slot: e for e in reversed(estimates) if e.target.slot is not None}


def stated_slots(scene: Scene, estimates: Sequence[TubeEstimate]) -> dict[str, StatedSlot]:
    """State of every slot of the rack, by its name, in the rack's order; none without the rack's pose.

    Args:
        scene: The scene.
        estimates: Answers of one method.
    """
    if scene.rack_pose.T_camera_rack is None:
        return {}
    held = held_slots(scene, estimates)
    over = reached_over(scene, estimates)
    looks = {look.slot: look.explained(over[look.slot]) for look in scene.looks}
    return {slot.name: state_slot(looks.get(slot.name), _finding(held.get(slot.name))) for slot in scene.rack.all_slots}


def reached_over(scene: Scene, estimates: Sequence[TubeEstimate]) -> dict[str, float]:
    """Share of every slot's middle that the tops of accepted tubes of other slots reach over, by the slot's name.

    Args:
        scene: The scene.
        estimates: Answers of one method.
    """
    discs = [
        (e.target.slot, transform_points(T, np.array([0.0, 0.0, tube.height_m]))[:2], tube.max_radius_m)
        for e in estimates
        if e.pose.status is TubeStatus.OK and e.target.slot is not None
        if (tube := e.target.tube) is not None and (T := e.pose.T_rack_tube) is not None
    ]
    return {
        name: 1.0 - float(np.mean(_clear(core_m, [disc[1:] for disc in discs if disc[0] != name])))
        for name, core_m in slot_cores_m(scene.rack, scene.tubes).items()
    }


def _clear(places_m: FloatArray, discs: Sequence[tuple[FloatArray, float]]) -> NDArray[np.bool_]:
    """Which places (N, 2), rack frame, no disc lies over, shape (N,)."""
    clear = np.ones(len(places_m), bool)
    for center_m, radius_m in discs:
        clear &= np.hypot(*(places_m - center_m).T) > radius_m + DISC_MARGIN_M
    return clear


def _finding(estimate: TubeEstimate | None) -> Finding:
    if estimate is None:
        return Finding.NONE
    return Finding.TUBE if estimate.pose.status is TubeStatus.OK else Finding.DOUBTFUL
