"""Samples for training: random crops of pictures at random scales, and several pictures in one."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.detection.evaluation import kinds_of
from tubepose.detection.labelled_images import LabelledFiles
from tubepose.detection.yolo_input import BORDER
from tubepose.transforms import FloatArray

Image = NDArray[np.uint8]
_KEPT_SHARE = 0.25
"""A box of which a crop leaves less than this is dropped."""
_MIN_SIDE_PX = 4.0
_LARGEST_SCALE = 2.5
"""Nothing is blown up by more than this."""


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """A picture and its boxes.

    Attributes:
        image: 8-bit RGB, shape (H, W, 3).
        class_ids: Array of shape (N,).
        edges_xyxy: Array of shape (N, 4): left, top, right, bottom, pixels.
    """

    image: Image
    class_ids: NDArray[np.intp]
    edges_xyxy: FloatArray


@dataclass(frozen=True, slots=True)
class Views:
    """How large a network is to see things.

    Attributes:
        whole_px: Longer side of a whole picture in the network's input.
        rack_px: Longer side of a rack when the network looks at that rack alone.
        rack_share: Chance of a sample at about the second scale, where a picture shows a rack.
    """

    whole_px: int
    rack_px: int
    rack_share: float


def draw_sample(
    files: LabelledFiles, side_px: int, mosaic_share: float, views: Views, rng: np.random.Generator
) -> Sample:
    """A square sample: a crop of one picture, or four crops of four pictures side by side.

    Args:
        files: Where to draw from.
        side_px: Side of the sample.
        mosaic_share: Chance of four pictures.
        views: How large things are.
        rng: Source of randomness.
    """
    racks = np.array([kind == "rack" for kind in kinds_of(files.classes, {}).values()])

    def crop(width: int, height: int) -> Sample:
        sample = _turned(_read(files, rng), rng)
        return _crop(sample, (width, height), _scale(sample, max(width, height), racks, views, rng), rng)

    if rng.uniform() >= mosaic_share:
        return look_other(crop(side_px, side_px), rng)
    at_x, at_y = (round(side_px * value) for value in rng.uniform(0.3, 0.7, 2))
    canvas = np.full((side_px, side_px, 3), BORDER, np.uint8)
    ids, edges = [], []
    for x0, x1 in ((0, at_x), (at_x, side_px)):
        for y0, y1 in ((0, at_y), (at_y, side_px)):
            tile = crop(x1 - x0, y1 - y0)
            canvas[y0:y1, x0:x1] = tile.image
            ids.append(tile.class_ids)
            edges.append(tile.edges_xyxy + np.array([x0, y0, x0, y0]))
    return look_other(Sample(canvas, np.concatenate(ids), np.concatenate(edges)), rng)


def _read(files: LabelledFiles, rng: np.random.Generator) -> Sample:
    number = int(rng.integers(len(files.images)))
    image = files.read_image(number)
    ids, edges = files.read_boxes(number, (image.shape[1], image.shape[0]))
    return Sample(image, ids, edges)


def _scale(sample: Sample, side_px: int, racks: NDArray[np.bool_], views: Views, rng: np.random.Generator) -> float:
    """Sample's pixels per picture's pixel: about those of a rack looked at alone, or of a whole picture."""
    longest = max(sample.image.shape[:2])
    sides = np.ptp(sample.edges_xyxy[racks[sample.class_ids]].reshape(-1, 2, 2), axis=1).max(axis=1)
    if len(sides) and rng.uniform() < views.rack_share:
        wanted = views.rack_px * float(np.exp(rng.uniform(np.log(0.6), np.log(1.2))))
        return float(min(wanted / rng.choice(sides), _LARGEST_SCALE))
    scale = views.whole_px / longest * float(np.exp(rng.uniform(np.log(0.5), np.log(1.4))))
    # Now and then the whole picture, so that large things are seen whole.
    return float(min(scale, side_px / longest)) if rng.uniform() < 0.25 else scale


def _crop(sample: Sample, size: tuple[int, int], scale: float, rng: np.random.Generator) -> Sample:
    """A part of a picture at about a scale, of a given width and height."""
    squeeze = float(np.exp(rng.normal(0.0, 0.06)))
    scales = np.array([scale * squeeze, scale / squeeze])
    free = np.array(sample.image.shape[1::-1]) * scales - np.array(size)
    middle = rng.uniform(0.0, 1.0, 2) * free
    if len(sample.edges_xyxy) and rng.uniform() < 0.85:  # around some object
        box = sample.edges_xyxy[int(rng.integers(len(sample.edges_xyxy)))].reshape(2, 2).mean(axis=0)
        middle = np.clip(box * scales - rng.uniform(0.1, 0.9, 2) * size, np.minimum(free, 0), np.maximum(free, 0))
    image = _shown(sample.image, scales, middle, size)
    edges = sample.edges_xyxy * np.tile(scales, 2) - np.tile(middle, 2)
    return _cut(Sample(image, sample.class_ids, edges), size)


def _shown(source: Image, scales: FloatArray, corner: FloatArray, size: tuple[int, int]) -> Image:
    """The part of a picture, scaled, whose left top corner is at `corner` of the scaled picture."""
    margin = np.ceil(4 / scales)
    low = np.maximum(np.floor(corner / scales - margin), 0).astype(int)
    high = np.maximum(np.ceil((corner + np.array(size)) / scales + margin).astype(int), low + 1)
    part = source[low[1] : high[1], low[0] : high[0]]
    if not part.size:
        return np.full((size[1], size[0], 3), BORDER, np.uint8)
    if scales.min() < 0.8:  # a picture that is warped down without this gets jagged edges
        part = np.asarray(cv2.GaussianBlur(part, (0, 0), 0.35 / float(scales.min())), np.uint8)
    shift = low * scales - corner
    matrix = np.array([[scales[0], 0, shift[0]], [0, scales[1], shift[1]]])
    return np.asarray(cv2.warpAffine(part, matrix, size, flags=cv2.INTER_LINEAR, borderValue=(BORDER,) * 3), np.uint8)


def _cut(sample: Sample, size: tuple[int, int]) -> Sample:
    """Boxes cut at the border; those of which little is left are dropped."""
    edges = sample.edges_xyxy
    clipped = np.clip(edges, 0, np.tile(size, 2))
    sides, whole = clipped[:, 2:] - clipped[:, :2], edges[:, 2:] - edges[:, :2]
    kept = (sides.min(axis=1, initial=np.inf) >= _MIN_SIDE_PX) & (
        sides.prod(axis=1) >= _KEPT_SHARE * np.maximum(whole.prod(axis=1), 1e-9)
    )
    return Sample(sample.image, sample.class_ids[kept], clipped[kept])


def _turned(sample: Sample, rng: np.random.Generator) -> Sample:
    image, edges = sample.image, sample.edges_xyxy
    if rng.uniform() < 0.5:
        image = image[:, ::-1]
        edges = np.column_stack([image.shape[1] - edges[:, 2], edges[:, 1], image.shape[1] - edges[:, 0], edges[:, 3]])
    if rng.uniform() < 0.25:
        for _ in range(int(rng.integers(1, 4))):
            image = np.rot90(image)
            height = image.shape[0]
            edges = np.column_stack([edges[:, 1], height - edges[:, 2], edges[:, 3], height - edges[:, 0]])
    return Sample(np.ascontiguousarray(image), sample.class_ids, edges.reshape(-1, 4))


def look_other(sample: Sample, rng: np.random.Generator) -> Sample:
    """The same boxes under other colours, contrast, blur and noise."""
    light = sample.image.astype(np.float32) / np.float32(255)
    if rng.uniform() < 0.5:
        hsv = cv2.cvtColor(light, cv2.COLOR_RGB2HSV)
        widest = 30 if rng.uniform() < 0.7 else 180
        hsv[..., 0] = np.mod(hsv[..., 0] + np.float32(rng.uniform(-widest, widest)), 360)
        hsv[..., 1] = np.clip(hsv[..., 1] * np.float32(rng.uniform(0.3, 1.5)), 0, 1)
        light = np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), np.float32)
    if rng.uniform() < 0.25:
        light = np.repeat(light @ rng.dirichlet(np.ones(3)).astype(np.float32)[:, None], 3, axis=2)
    if rng.uniform() < 0.6:
        light = np.clip(light, 0, 1) ** np.float32(np.exp(rng.normal(0, 0.3)))
        light = (light - 0.5) * np.float32(rng.uniform(0.6, 1.4)) + np.float32(0.5 + rng.normal(0, 0.1))
    if rng.uniform() < 0.15:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), float(rng.uniform(0.4, 1.5))), np.float32)
    if rng.uniform() < 0.2:
        light = light + rng.normal(0, rng.uniform(0.005, 0.04), (*light.shape[:2], 1)).astype(np.float32)
    image = np.round(np.clip(light, 0, 1) * 255).astype(np.uint8)
    return Sample(image, sample.class_ids, sample.edges_xyxy)
