"""What boxes say to method `profile`: which type may stand in a slot, and where it has found nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tubepose.checks import said
from tubepose.config import Config
from tubepose.detection.assisted import SURE_SCORE
from tubepose.profile import ProfileTube
from tubepose.scene import Scene, TubeTarget
from tubepose.targets import assigned_slots
from tubepose.transforms import transform_points


def allowed_types(scene: Scene) -> NDArray[np.bool_] | None:
    """Which type may stand in which slot, shape (K, S), as far as a detector's classes say; None without a word.

    A box of a known class speaks for the slot whose tube's top, upright, is seen nearest to the box's middle.
    """
    T_camera_rack = scene.rack_pose.T_camera_rack
    named = {word: k for k, tube in enumerate(scene.tubes) for word in (tube.name, *tube.classes)}
    boxes = [box for box in scene.detections if box.class_name in named and np.isfinite(box.box_xyxy_px).all()]
    boxes.sort(key=lambda box: -box.score)
    if not boxes or scene.intrinsics is None or T_camera_rack is None:
        return None
    may = np.ones((len(scene.tubes), len(scene.rack.all_slots)), bool)
    heights_m = scene.rack.floor_m + np.array([tube.height_m for tube in scene.tubes])
    feet_m = np.column_stack([scene.rack.slot_centers_m, np.zeros(may.shape[1])])
    tops_m = feet_m + np.array([0.0, 0.0, 1.0]) * heights_m[:, None, None]
    pixels = scene.intrinsics.project(transform_points(T_camera_rack, tops_m))
    kind = np.array([named[box.class_name] for box in boxes])
    edges = np.array([box.box_xyxy_px for box in boxes], float)
    distance = np.linalg.norm(pixels[kind] - (edges[:, None, :2] + edges[:, None, 2:]) / 2, axis=2)
    near = distance.min(axis=1) < (edges[:, 2:] - edges[:, :2]).max(axis=1)
    # The better of two boxes has the last word.
    for k, slot in reversed([*zip(kind[near], distance.argmin(axis=1)[near], strict=True)]):
        may[:, slot] = np.arange(len(scene.tubes)) == k
    return may


def boxes_alone(scene: Scene, found: Sequence[ProfileTube], config: Config) -> list[TubeTarget]:
    """Slots in which a detector is sure of a tube, and `profile` has found nothing: they are not empty."""
    T_camera_rack = scene.rack_pose.T_camera_rack
    if T_camera_rack is None or scene.intrinsics is None:
        return []
    posed = [(tube.pose.T_rack_tube, tube.tube.height_m) for tube in found if tube.tube is not None]
    tops_m = np.array([T[:3, 3] + height_m * T[:3, 2] for T, height_m in posed if T is not None]).reshape(-1, 3)
    pixels = scene.intrinsics.project(transform_points(T_camera_rack, tops_m))
    sure = [k for k, box in enumerate(scene.detections) if not box.is_rack and box.score >= SURE_SCORE]
    boxes = np.array([scene.detections[k].box_xyxy_px for k in sure], float).reshape(-1, 1, 4)
    holds = np.any(np.all((pixels >= boxes[..., :2]) & (pixels <= boxes[..., 2:]), axis=2), axis=1)
    # A box without edges says nothing of where its tube is seen.
    rest = [k for k, told in zip(sure, ~holds & np.isfinite(boxes[:, 0]).all(axis=1), strict=True) if told]
    taken = {tube.slot for tube in found}
    none = "none of the given types was found in the slot" if scene.tubes else "no tube model is given (--tubes)"
    return [
        TubeTarget(k, entry.slot, None, entry.hull_share, said("tube_in_box_only", none), entry.points_m)
        for k, entry in zip(
            rest, assigned_slots(scene.frame, scene.rack, scene.detections, rest, T_camera_rack, config), strict=True
        )
        if entry.slot is not None and entry.slot not in taken
    ]
