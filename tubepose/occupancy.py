"""What a method's answers and the look at the slots say together: the state of every slot of a scene."""

from __future__ import annotations

from collections.abc import Sequence

from tubepose.scene import Scene, TubeEstimate
from tubepose.slots import Finding, StatedSlot, covered_slots, state_slot
from tubepose.tube import TubeStatus


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
    looks = {look.slot: look for look in scene.looks}
    return {slot.name: state_slot(looks.get(slot.name), _finding(held.get(slot.name))) for slot in scene.rack.all_slots}


def _finding(estimate: TubeEstimate | None) -> Finding:
    if estimate is None:
        return Finding.NONE
    return Finding.TUBE if estimate.pose.status is TubeStatus.OK else Finding.DOUBTFUL
