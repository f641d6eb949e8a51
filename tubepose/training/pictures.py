"""What a training looks like: the curve of its loss, and what its network finds in pictures."""

from __future__ import annotations

import io
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.detection.evaluation import DetectionReport, Judged, is_kind
from tubepose.detection.labelled_images import LabelledFiles
from tubepose.detection.metrics import match

Picture = NDArray[np.uint8]
_TILE_PX = 480
_RIGHT, _MISSED, _WRONG, _IGNORED = (80, 220, 60), (50, 50, 240), (0, 150, 255), (160, 160, 160)
"""BGR: found, missed, found where nothing is, not counted."""


def loss_curve(losses: Sequence[Sequence[float]]) -> bytes:
    """PNG of the loss over the steps.

    Args:
        losses: Rows of step, total loss, and its parts for boxes, objectness and classes.
    """
    from matplotlib.figure import Figure

    table = np.array(losses, float).reshape(-1, 5)
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    width = max(1, len(table) // 60)
    kernel = np.ones(width) / width
    for column, name in ((1, "total"), (2, "boxes"), (3, "objectness"), (4, "classes")):
        smooth = np.convolve(table[:, column], kernel, mode="valid")
        axes.plot(table[width - 1 :, 0], smooth, label=name, linewidth=1.2)
    axes.set(xlabel="step", ylabel=f"loss, mean of {width} steps", yscale="log")
    axes.grid(alpha=0.3)
    figure.legend(frameon=False, loc="outside right upper")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=120, metadata={"Software": None})
    return buffer.getvalue()


def judged_picture(files: LabelledFiles, one: Judged, kinds: dict[str, str], least_score: float) -> Picture:
    """A picture with what is found, missed and wrong drawn over it, BGR, shape (H, W, 3).

    Green: a true box that is found, with the first letter of the class and the score of what found it. Red: a true box
    that is missed. Orange: a detection of nothing. Gray: not counted.
    """
    picture = np.ascontiguousarray(files.read_image(one.number)[:, :, ::-1])
    thick = max(1, round(max(picture.shape[:2]) / 640))
    for kind in ("rack", "tube"):
        kept = [found for found in one.found if found.score >= least_score and is_kind(found, kind)]
        boxes = one.of_kind(kind, kinds, least_score)
        rows, passed = match(boxes, 0.5)
        for box in boxes.ignored:
            _draw(picture, box, _IGNORED, thick, "")
        for row, box in enumerate(boxes.truth):
            if row not in rows:
                _draw(picture, box, _MISSED, thick, "")
        for detection, box, row, skip in zip(kept, boxes.found, rows, passed, strict=True):
            color = _RIGHT if row >= 0 else _IGNORED if skip else _WRONG
            name = detection.class_name.removeprefix("tube-")[0]
            _draw(picture, box, color, thick, f"{name}{detection.score * 100:.0f}")
    return picture


def _draw(picture: Picture, box: NDArray[np.floating], color: tuple[int, int, int], thick: int, text: str) -> None:
    left, top, right, bottom = (round(float(value)) for value in box)
    cv2.rectangle(picture, (left, top), (max(right - 1, left), max(bottom - 1, top)), color, thick)
    if text:
        place = (left, max(top - 2 * thick, 10 * thick))
        cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.32 * thick, color, thick, cv2.LINE_AA)


def worst_sheet(files: LabelledFiles, report: DetectionReport, kinds: dict[str, str], least_score: float) -> Picture:
    """The nine pictures with the most errors in one, BGR; fewer where fewer have any."""
    order = [int(k) for k in np.argsort(-report.errors, kind="stable")[:9] if report.errors[k] > 0]
    return sheet([judged_picture(files, report.judged[k], kinds, least_score) for k in order])


def sheet(pictures: Sequence[Picture]) -> Picture:
    """Pictures side by side in rows of three, each fitted into a square."""
    if not pictures:
        return np.full((_TILE_PX, _TILE_PX, 3), 30, np.uint8)
    tiles = []
    for picture in pictures:
        scale = _TILE_PX / max(picture.shape[:2])
        small = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)[:_TILE_PX, :_TILE_PX]
        tile = np.full((_TILE_PX, _TILE_PX, 3), 30, np.uint8)
        tile[: small.shape[0], : small.shape[1]] = small
        tiles.append(tile)
    columns = min(3, len(tiles))
    tiles += [np.full_like(tiles[0], 30)] * (-len(tiles) % columns)
    return np.vstack([np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)])
