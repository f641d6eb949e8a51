"""One picture per frame: boxes, slot names, and the projected tubes coloured by their status."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.detection import best_rack
from tubepose.occupancy import stated_slots
from tubepose.scene import Scene, TubeEstimate
from tubepose.slots import SlotState
from tubepose.transforms import FloatArray, transform_points
from tubepose.tube import TubeStatus

Picture = NDArray[np.uint8]
Project = Callable[[FloatArray], FloatArray]

WIDTH_PX = 1600
COLORS_BGR = {
    TubeStatus.OK.value: (80, 200, 60),
    TubeStatus.REJECTED.value: (0, 140, 255),
    TubeStatus.FAILED.value: (60, 60, 230),
}
_RACK_BGR = (230, 170, 40)
_BOX_BGR = (200, 200, 90)
_TEXT_BGR = (245, 245, 245)
STATE_MARKS = {SlotState.NOT_SEEN: "-", SlotState.UNCLEAR: "?"}
"""What stands behind the name of a slot that is not known to be empty or occupied."""
STATE_COLORS_BGR = {SlotState.NOT_SEEN: (150, 150, 150), SlotState.UNCLEAR: (60, 220, 250)}


def draw_overlay(scene: Scene, estimates: Sequence[TubeEstimate]) -> Picture:
    """Picture of a frame with what was found in it.

    Frames without a usable image show their depth; an unorganised cloud is seen along the rack's normal.

    Returns:
        Array of shape (H, W, 3), uint8, BGR.
    """
    picture, project = _background(scene)
    if isinstance(project, _ImageView):
        for detection in scene.detections:
            if np.isfinite(detection.box_xyxy_px).all() and (not detection.is_rack or detection.source != "geometric"):
                left_top, right_bottom = (project.pixel(detection.box_xyxy_px[i : i + 2]) for i in (0, 2))
                color = _RACK_BGR if detection.is_rack else _BOX_BGR
                cv2.rectangle(picture, left_top, right_bottom, color, 1, cv2.LINE_AA)
                if detection.source == "yolo":
                    place = (left_top[0] + 2, max(left_top[1] + 12, 12))
                    _text(picture, f"{detection.score:.2f}", place, 0.38, color)
    _draw_rack(picture, scene, project)
    for estimate in estimates:
        if estimate.T_camera_tube is not None:
            _draw_tube(picture, estimate, project)
    _draw_names(picture, scene, estimates, project)
    return np.vstack([_legend(picture.shape[1], scene, estimates), picture])


class _ImageView:
    """Camera image, cropped to the rack and enlarged."""

    def __init__(self, scene: Scene, shift: FloatArray, zoom: float) -> None:
        self.intrinsics = scene.intrinsics
        self.shift = shift
        self.zoom = zoom

    def __call__(self, points_m: FloatArray) -> FloatArray:
        if self.intrinsics is None:
            return np.full((*np.shape(points_m)[:-1], 2), np.nan)
        return self._drawn(self.intrinsics.project(points_m))

    def pixel(self, place: tuple[float, ...]) -> tuple[int, int]:
        """Pixel of the picture that shows a pixel of the image."""
        return _pixel(self._drawn(np.array(place)))

    def _drawn(self, places_px: FloatArray) -> FloatArray:
        """Where the enlarged picture shows pixels (..., 2) of the image, whose middles are whole numbers."""
        return np.asarray((places_px - self.shift + 0.5) * self.zoom - 0.5)


class _TopView:
    """Orthographic view along the rack's normal (or the camera's axis), for clouds without pixels."""

    def __init__(self, scene: Scene) -> None:
        T = scene.rack_pose.T_camera_rack
        points = scene.frame.measured_m
        self.R = np.diag([1.0, -1.0, -1.0]) if T is None else T[:3, :3].T
        flat = points @ self.R.T * [1, -1, 1]
        low, high = np.percentile(flat[:, :2], [0.5, 99.5], axis=0) if len(flat) else (np.zeros(2), np.ones(2))
        self.low = low - 0.05 * (high - low)
        self.zoom = WIDTH_PX / float(max((high - low)[0] * 1.1, 1e-6))
        self.size = (int(np.clip((high - low)[1] * 1.1 * self.zoom, 100, 2 * WIDTH_PX)), WIDTH_PX)
        self.flat = flat

    def __call__(self, points_m: FloatArray) -> FloatArray:
        flat = np.asarray(points_m) @ self.R.T * [1, -1, 1]
        return np.asarray((flat[..., :2] - self.low) * self.zoom)

    def render(self) -> Picture:
        gray = np.full(self.size, 30, np.uint8)
        if len(self.flat):
            u, v = ((self.flat[:, :2] - self.low) * self.zoom).astype(int).T
            inside = (u >= 0) & (u < self.size[1]) & (v >= 0) & (v < self.size[0])
            shade = np.interp(self.flat[:, 2], np.percentile(self.flat[:, 2], [2, 98]), [90, 230]).astype(np.uint8)
            np.maximum.at(gray, (v[inside], u[inside]), shade[inside])
            gray = np.asarray(cv2.dilate(gray, np.ones((3, 3), np.uint8)))
        return np.repeat(gray[..., None], 3, axis=2)


def _background(scene: Scene) -> tuple[Picture, Project]:
    if not scene.frame.organised:
        view = _TopView(scene)
        return view.render(), view
    image = _gray_or_depth(scene)
    height, width = image.shape[:2]
    low, high = np.zeros(2), np.array([width, height], float)
    racks = [d for d in scene.detections if d.is_rack and np.isfinite(d.box_xyxy_px).all() and d.score > 0]
    if racks:
        box = np.array([d.box_xyxy_px for d in scene.detections if np.isfinite(d.box_xyxy_px).all()])
        margin = 0.06 * (box[:, 2:].max(axis=0) - box[:, :2].min(axis=0)).max()
        low = np.maximum(np.floor(box[:, :2].min(axis=0) - margin), 0)
        high = np.minimum(np.ceil(box[:, 2:].max(axis=0) + margin), high)
    crop = image[int(low[1]) : int(high[1]), int(low[0]) : int(high[0])]
    zoom = WIDTH_PX / max(crop.shape[:2])
    size = (max(1, round(crop.shape[1] * zoom)), max(1, round(crop.shape[0] * zoom)))
    picture = cv2.resize(crop, size, interpolation=cv2.INTER_LINEAR if zoom < 2 else cv2.INTER_CUBIC)
    return np.ascontiguousarray(picture), _ImageView(scene, low, zoom)


def _gray_or_depth(scene: Scene) -> Picture:
    image = scene.frame.image
    if image is None:
        depth = scene.frame.cloud_m[..., 2]
        low, high = np.nanpercentile(depth, [2, 98]) if np.isfinite(depth).any() else (0.0, 1.0)
        image = np.nan_to_num(np.interp(depth, [low, max(high, low + 1e-6)], [230, 40])).astype(np.uint8)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR if image.ndim == 2 else cv2.COLOR_RGB2BGR), np.uint8)


def _pixel(place: FloatArray) -> tuple[int, int]:
    return round(float(place[0])), round(float(place[1]))


def _polyline(picture: Picture, places: FloatArray, color: tuple[int, int, int], width: int, closed: bool) -> None:
    if np.isfinite(places).all():
        cv2.polylines(picture, [np.round(places * 8).astype(np.int32)], closed, color, width, cv2.LINE_AA, 3)


def _draw_rack(picture: Picture, scene: Scene, project: Project) -> None:
    T = scene.rack_pose.T_camera_rack
    if T is None:
        return
    rack = scene.rack
    half = rack.outline_m / 2
    outline = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * half
    for shape in [outline, *(slot.boundary_m() for slot in rack.all_slots)]:
        points = np.column_stack([shape, np.full(len(shape), rack.height_m)])
        _polyline(picture, project(transform_points(T, points)), _RACK_BGR, 2 if shape is outline else 1, True)


def _draw_tube(picture: Picture, estimate: TubeEstimate, project: Project) -> None:
    tube, T = estimate.target.tube, estimate.T_camera_tube
    if tube is None or T is None:
        return
    color = COLORS_BGR[estimate.pose.status.value]
    turn = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    rings = [(tube.height_m, tube.max_radius_m)]
    if tube.cap is not None:
        rings.append((tube.height_m - tube.cap.height_mm * 1e-3, tube.max_radius_m))
    for z, r in rings:
        ring = np.column_stack([r * np.cos(turn), r * np.sin(turn), np.full(len(turn), z)])
        _polyline(picture, project(transform_points(T, ring)), color, 2, True)
    axis = np.array([[0, 0, 0.5 * tube.height_m], [0, 0, tube.height_m]])
    _polyline(picture, project(transform_points(T, axis)), color, 2, False)


def _text(picture: Picture, text: str, place: tuple[int, int], scale: float, color: tuple[int, int, int]) -> None:
    # A shadow by shifted copies: in OpenCV 5 the thickness of a text changes its width.
    for du, dv in ((-1, -1), (1, -1), (-1, 1), (1, 1)):
        shifted = (place[0] + du, place[1] + dv)
        cv2.putText(picture, text, shifted, cv2.FONT_HERSHEY_SIMPLEX, scale, (0, 0, 0), 1, cv2.LINE_AA)
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, color, 1, cv2.LINE_AA)


def _draw_names(picture: Picture, scene: Scene, estimates: Sequence[TubeEstimate], project: Project) -> None:
    T = scene.rack_pose.T_camera_rack
    if T is None:
        return
    heights = {e.target.slot: e.target.tube.height_m for e in estimates if e.target.slot and e.target.tube}
    colors = {e.target.slot: COLORS_BGR[e.pose.status.value] for e in estimates}
    tops = [place for e in estimates if (place := _top_circle(e, project)) is not None]
    states = {name: stated.state for name, stated in stated_slots(scene, estimates).items()}
    for slot in scene.rack.all_slots:
        z = scene.rack.floor_m + heights[slot.name] if slot.name in heights else scene.rack.height_m
        place = project(transform_points(T, np.array([*slot.center_m, z])))
        # The name of an empty slot on a tube that hides it would read as the tube's.
        hidden = slot.name not in heights and any(np.hypot(*(place - top[:2])) < top[2] for top in tops)
        if np.isfinite(place).all() and not hidden:
            u, v = _pixel(place)
            color = colors.get(slot.name, STATE_COLORS_BGR.get(states[slot.name], _TEXT_BGR))
            _text(picture, slot.name + STATE_MARKS.get(states[slot.name], ""), (u - 12, v + 5), 0.45, color)


def _top_circle(estimate: TubeEstimate, project: Project) -> FloatArray | None:
    """Where a tube's top is seen: u, v and radius in the picture's pixels; None without a pose."""
    tube, T = estimate.target.tube, estimate.T_camera_tube
    if tube is None or T is None:
        return None
    points = np.array([[0, 0, tube.height_m], [tube.max_radius_m, 0, tube.height_m]])
    center, edge = project(transform_points(T, points))
    return np.array([*center, np.hypot(*(edge - center))])


def _legend(width: int, scene: Scene, estimates: Sequence[TubeEstimate]) -> Picture:
    """A strip of text for the top of the picture, shape (h, width, 3)."""
    pose = scene.rack_pose
    rack = f"rack {scene.rack.name}: {pose.status.value}"
    if pose.reason:
        rack += f" ({pose.reason})"
    if pose.ambiguous:
        rack += ", may stand another way round (chosen by rule)"
    counts = {status: sum(e.pose.status.value == status for e in estimates) for status in COLORS_BGR}
    kind = "SIMULATED" if scene.frame.simulated else "recorded"
    lines = [(f"{scene.frame.capture} frame {scene.frame.index} ({kind})", _TEXT_BGR)]
    box = best_rack(scene.detections)
    if box is not None and box.note:
        rack += f"; boxes by the geometric detector: {box.note}"
    lines += [(part, _RACK_BGR) for part in textwrap.wrap(rack, max(20, width // 11))]
    strip = np.full((24 * (len(lines) + 1) + 12, width, 3), 30, np.uint8)
    for i, (text, color) in enumerate(lines):
        _text(strip, text, (12, 24 + 24 * i), 0.6, color)
    method = f"method {estimates[0].method}" if estimates else "no tubes"
    u, v = 12, 24 + 24 * len(lines)
    for text, color in [(method, _TEXT_BGR), *((f"{name}: {counts[name]}", COLORS_BGR[name]) for name in COLORS_BGR)]:
        _text(strip, text, (u, v), 0.6, color)
        u += 12 * len(text) + 24
    return strip
