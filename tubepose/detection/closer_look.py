"""A second look at each rack: tubes are small in a whole picture, and large in the picture of their own rack alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.detection.yolo_decoding import RawBoxes
from tubepose.transforms import FloatArray

MARGIN = 0.08
"""By how much the picture of a rack is wider than its box on every side, as a share of the box's longer side."""
LEAST_SCORE = 0.3
"""Score from which a rack is worth a look."""
LEAST_TUBE_SCORE = 0.2
"""Score from which something outside of racks may be a tube, and the whole picture is worth a larger look."""
MOST_RACKS = 8
"""More racks than this in one picture, the best first, are not looked at again."""

Look = Callable[[NDArray[np.uint8], int], RawBoxes]
"""From an RGB picture and the longer side of the network's input to boxes in pixels of that picture."""


@dataclass(frozen=True, slots=True)
class Looks:
    """How large a network that looks twice sees things, as its file says.

    Attributes:
        whole_px: Longer side of the input for a whole picture.
        rack_px: Longer side of the input for the picture of one rack.
    """

    whole_px: int
    rack_px: int


def look_twice(image: NDArray[np.uint8], look: Look, looks: Looks, is_rack: NDArray[np.bool_]) -> RawBoxes:
    """Boxes of a picture: racks and what lies outside of them from the whole, a rack's tubes from that rack's picture.

    A picture without a rack, or with something like a tube outside of its racks, is looked at as a whole again, as
    large as a rack would be.

    Args:
        image: RGB, shape (H, W, 3).
        look: Runs the network; boxes from `LEAST_TUBE_SCORE` on.
        looks: Sizes of its input.
        is_rack: For every class whether it is a rack, shape (C,).
    """
    whole = look(image, looks.whole_px)
    racks = np.flatnonzero(is_rack[whole.class_ids] & (whole.scores >= LEAST_SCORE))
    racks = _distinct(whole.edges_xyxy, racks[np.argsort(-whole.scores[racks], kind="stable")])[:MOST_RACKS]
    if not len(racks):
        return look(image, looks.rack_px)
    chosen = whole.edges_xyxy[racks]
    # What stands half way into the margin is seen whole in its rack's picture; the rest may be cut by its border.
    inner = [_widened(box, 0.5) for box in chosen]
    if (_outside(whole, inner, is_rack) & (whole.scores >= LEAST_TUBE_SCORE)).any():
        larger = look(image, looks.rack_px)
        whole = _joined([whole.take(is_rack[whole.class_ids]), larger.take(~is_rack[larger.class_ids])])
    kept = [whole.take(is_rack[whole.class_ids] | _outside(whole, inner, is_rack))]
    for box, own in zip(chosen, inner, strict=True):
        wide = _widened(box, 1.0)
        corner = np.maximum(np.floor(wide[:2]), 0).astype(int)
        end = np.minimum(np.ceil(wide[2:]), image.shape[1::-1]).astype(int)
        part = image[corner[1] : end[1], corner[0] : end[0]]
        if min(part.shape[:2]) < 2:  # a box in the border beside the picture
            continue
        found = look(part, looks.rack_px)
        moved = RawBoxes(found.edges_xyxy + np.tile(corner, 2), found.scores, found.class_ids)
        kept.append(moved.take(~is_rack[moved.class_ids] & _centred_in(moved.edges_xyxy, own)))
    return _joined(kept)


def _widened(box: FloatArray, share: float) -> FloatArray:
    """A box and a share of the margin around it."""
    more = share * MARGIN * float(np.ptp(box.reshape(2, 2), axis=0).max())
    return np.concatenate([box[:2] - more, box[2:] + more])


def _outside(boxes: RawBoxes, inner: Sequence[FloatArray], is_rack: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Which boxes are tubes that no rack's own picture tells of; `inner`: what each of those tells of."""
    inside = [_centred_in(boxes.edges_xyxy, box) for box in inner]
    return np.asarray(~is_rack[boxes.class_ids] & ~np.any(inside, axis=0))


def _distinct(edges_xyxy: FloatArray, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Rows whose box's middle lies in no box before it: one look at what is one rack."""
    chosen: list[int] = []
    for row in rows:
        if not any(_centred_in(edges_xyxy[[row]], edges_xyxy[k])[0] for k in chosen):
            chosen.append(int(row))
    return np.array(chosen, np.intp)


def _centred_in(edges_xyxy: FloatArray, box: FloatArray) -> NDArray[np.bool_]:
    middle = (edges_xyxy[:, :2] + edges_xyxy[:, 2:]) / 2
    return np.asarray(((middle >= box[:2]) & (middle <= box[2:])).all(axis=1))


def _joined(parts: Sequence[RawBoxes]) -> RawBoxes:
    return RawBoxes(
        np.concatenate([part.edges_xyxy for part in parts]),
        np.concatenate([part.scores for part in parts]),
        np.concatenate([part.class_ids for part in parts]),
    )
