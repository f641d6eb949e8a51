"""From boxes to tubes: the slot and the type of every detection."""

from __future__ import annotations

from collections.abc import Sequence

from tubepose.capture.frame import RgbdFrame
from tubepose.checks import said
from tubepose.config import Config
from tubepose.detection import Detection, points_in_box
from tubepose.labware import RackModel, TubeModel
from tubepose.scene import TubeTarget
from tubepose.slots import SlotAssignment, assign_slots, crop_to_slot, identify_tube
from tubepose.transforms import FloatArray, invert_transform, transform_points


def find_targets(
    frame: RgbdFrame,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    detections: Sequence[Detection],
    T_camera_rack: FloatArray,
    config: Config,
) -> tuple[TubeTarget, ...]:
    """Every detected tube with its slot, type and points, in the order of the detections."""
    indices = [i for i, detection in enumerate(detections) if not detection.is_rack]
    assigned = assigned_slots(frame, rack, detections, indices, T_camera_rack, config)
    return tuple(
        _target(index, detections[index].class_name, entry, rack, tubes, config)
        for index, entry in zip(indices, assigned, strict=True)
    )


def _target(
    index: int, class_name: str, entry: SlotAssignment, rack: RackModel, tubes: Sequence[TubeModel], config: Config
) -> TubeTarget:
    points_m = entry.points_m
    if entry.slot is None:
        return TubeTarget(index, None, None, entry.hull_share, entry.why, points_m)
    if not tubes:
        return TubeTarget(index, entry.slot, None, entry.hull_share, said("no_types_given", ""), points_m)
    slot = rack.slot(entry.slot)
    tube, why = identify_tube(class_name, points_m, tubes, rack, config.slots)
    if tube is not None:
        points_m = crop_to_slot(points_m, slot, tube, rack, config.slots)
    return TubeTarget(index, entry.slot, tube, entry.hull_share, why, points_m)


def assigned_slots(
    frame: RgbdFrame,
    rack: RackModel,
    detections: Sequence[Detection],
    chosen: Sequence[int],
    T_camera_rack: FloatArray,
    config: Config,
) -> tuple[SlotAssignment, ...]:
    """Slots of some of the detections, given by their indices."""
    T_rack_camera = invert_transform(T_camera_rack)
    clouds = [transform_points(T_rack_camera, points_in_box(frame, detections[k])) for k in chosen]
    return assign_slots(clouds, rack, config.slots)
