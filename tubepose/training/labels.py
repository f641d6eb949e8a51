"""Boxes from geometry: which pixels show an object, how much of it is hidden, and which boxes are worth learning."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics
from tubepose.simulation.looks.render import Rendered
from tubepose.training.scenes import LearningScene, SceneObject
from tubepose.transforms import FloatArray, transform_points

MIN_CLEAR = 0.3
"""A pixel shows what at least this share of its light comes from."""
MIN_PIXELS = 25
MIN_SIDE_PX = 4
MIN_VISIBLE = 0.2
MIN_INSIDE = 0.15
"""Less of an object's outline in the picture or to be seen there, and it has no box: no one could say what it is."""


@dataclass(frozen=True, slots=True)
class Label:
    """The box of one object.

    Attributes:
        class_name: Its class.
        box_xyxy_px: Continuous edges of its visible pixels: left, top, right, bottom.
        visible: Visible share of its outline in the picture.
        inside: Share of its outline that lies in the picture.
    """

    class_name: str
    box_xyxy_px: tuple[float, float, float, float]
    visible: float
    inside: float


def label_objects(scene: LearningScene, rendered: Rendered, least_visible: float = MIN_VISIBLE) -> list[Label]:
    """Labels of all objects of which enough can be seen, in the scene's order.

    Args:
        scene: What was rendered.
        rendered: Which pixel shows what.
        least_visible: Share of its outline in the picture that must be seen of an object.
    """
    masks = _visible(scene, rendered)
    labels = []
    for found, mask in zip(scene.objects, masks, strict=True):
        pixels = int(mask.sum()) if mask is not None else 0
        if mask is None or pixels < MIN_PIXELS:
            continue
        rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
        box = (float(columns[0]), float(rows[0]), float(columns[-1] + 1), float(rows[-1] + 1))
        whole, inside = _outline_px(found, scene.intrinsics)
        visible, share = min(1.0, pixels / max(inside, 1.0)), inside / max(whole, 1.0)
        large = min(box[2] - box[0], box[3] - box[1]) >= MIN_SIDE_PX
        if large and visible >= least_visible and share >= MIN_INSIDE:
            labels.append(Label(found.class_name, box, visible, share))
    return labels


def _visible(scene: LearningScene, rendered: Rendered) -> list[NDArray[np.bool_] | None]:
    """Pixels that show each object; None for an object that is not met at all."""
    masks: list[NDArray[np.bool_] | None] = [None] * len(scene.objects)
    for owners, points, clear in zip(rendered.seen, rendered.points_m, rendered.clear, strict=True):
        shown = np.where(clear >= MIN_CLEAR, owners, -1)
        for number in np.unique(shown[shown >= 0]):
            found = scene.objects[number]
            mask = shown == number
            if found.T_rack_camera is not None:
                v, u = np.nonzero(mask)
                out = transform_points(found.T_rack_camera, points[v, u].astype(float))[:, 2] > found.above_m
                mask = np.zeros_like(mask)
                mask[v[out], u[out]] = True
            known = masks[number]
            masks[number] = mask if known is None else known | mask
    return masks


def _outline_px(found: SceneObject, intrinsics: CameraIntrinsics) -> tuple[float, float]:
    """Pixels of the convex hull of an object's shape: of all of it, and of what lies in the picture."""
    points = found.shape_m[found.shape_m[:, 2] > 0.02]
    if len(points) < 3:
        return 0.0, 0.0
    hull = cv2.convexHull(intrinsics.project(points).astype(np.float32))[:, 0]
    whole = float(cv2.contourArea(hull))
    width, height = intrinsics.width, intrinsics.height
    frame: FloatArray = np.array([[0, 0], [width, 0], [width, height], [0, height]])
    inside, _ = cv2.intersectConvexConvex(hull, frame.astype(np.float32))
    return whole, float(inside)
