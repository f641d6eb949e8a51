"""How good boxes are: matching by overlap, precision, recall and average precision.

Definitions are those of COCO: detections are matched best score first, each to the unmatched truth that it overlaps
most; average precision is the mean of the interpolated precision at 101 recalls; ``ap50_95`` is the mean over overlaps
of 0.50 to 0.95 in steps of 0.05. There is no limit on boxes per picture, as racks hold many tubes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.transforms import FloatArray

OVERLAPS = np.round(np.arange(0.50, 0.96, 0.05), 2)
"""Overlaps (intersection over union) of ``ap50_95``; the first one is that of every other figure."""
_RECALLS = np.linspace(0.0, 1.0, 101)


@dataclass(frozen=True, slots=True, eq=False)
class ComparedBoxes:
    """Truth and detections of one kind in one picture.

    Attributes:
        truth: Continuous edges of the true boxes, shape (T, 4), pixels.
        found: Edges of the detections, shape (D, 4), pixels.
        scores: Scores of the detections, shape (D,).
        ignored: Edges of boxes that count neither as found nor as missed, shape (I, 4).
    """

    truth: FloatArray
    found: FloatArray
    scores: FloatArray
    ignored: FloatArray


@dataclass(frozen=True, slots=True)
class BoxAccuracy:
    """Figures of one kind of box over all pictures; NaN where there is nothing to divide by.

    Attributes:
        n_truth: True boxes.
        n_detected: Detections with the least score or more.
        precision: Share of those that are right.
        recall: Share of the true boxes that those find.
        ap50: Average precision at an overlap of 0.5, over all scores.
        ap50_95: Mean average precision over `OVERLAPS`.
    """

    n_truth: int
    n_detected: int
    precision: float
    recall: float
    ap50: float
    ap50_95: float


def overlaps(a: FloatArray, b: FloatArray) -> FloatArray:
    """Intersection over union of all pairs of boxes (A, 4) and (B, 4); shape (A, B)."""
    shared = _shared_area(a, b)
    union = _area(a)[:, None] + _area(b)[None] - shared
    return np.asarray(np.divide(shared, union, out=np.zeros_like(shared), where=union > 0))


def _area(boxes: FloatArray) -> FloatArray:
    return np.asarray(np.prod(boxes[:, 2:] - boxes[:, :2], axis=1))


def _shared_area(a: FloatArray, b: FloatArray) -> FloatArray:
    """Area of the intersection of all pairs of boxes (A, 4) and (B, 4); shape (A, B)."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    return np.asarray(np.prod(np.clip(high - low, 0, None), axis=2))


def match(boxes: ComparedBoxes, least_overlap: float) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Match detections to true boxes, best score first.

    A detection without a match that overlaps an ignored box, or lies in one by more than half, is ignored too.

    Args:
        boxes: One picture.
        least_overlap: Smallest intersection over union of a match.

    Returns:
        For every detection the row of the true box it finds, -1 for none (D,), and whether it is ignored (D,).
    """
    shares = overlaps(boxes.found, boxes.truth)
    rows = np.full(len(boxes.found), -1, np.intp)
    free = np.ones(len(boxes.truth), bool)
    for row in np.argsort(-boxes.scores, kind="stable"):
        candidates = np.where(free, shares[row], -1.0)
        best = int(np.argmax(candidates)) if candidates.size else -1
        if best >= 0 and candidates[best] >= least_overlap:
            rows[row], free[best] = best, False
    ignored = (rows < 0) & _in_ignored(boxes)
    return rows, ignored


def _in_ignored(boxes: ComparedBoxes) -> NDArray[np.bool_]:
    if not len(boxes.ignored):
        return np.zeros(len(boxes.found), bool)
    shared = _shared_area(boxes.found, boxes.ignored).max(axis=1)
    return np.asarray(shared > 0.5 * _area(boxes.found))


def box_accuracy(images: Sequence[ComparedBoxes], least_score: float) -> BoxAccuracy:
    """Figures of one kind of box over pictures.

    Args:
        images: One entry a picture.
        least_score: Score from which a detection counts for precision and recall; average precision takes all.
    """
    n_truth = sum(len(image.truth) for image in images)
    matched = [[match(image, float(least)) for image in images] for least in OVERLAPS]
    scores = np.concatenate([image.scores for image in images]) if images else np.empty(0)
    precisions = []
    for at_overlap in matched:
        right = np.concatenate([rows >= 0 for rows, _ in at_overlap]) if images else np.empty(0, bool)
        counted = ~np.concatenate([ignored for _, ignored in at_overlap]) if images else np.empty(0, bool)
        precisions.append(average_precision(scores[counted], right[counted], n_truth))
    right = np.concatenate([rows >= 0 for rows, _ in matched[0]]) if images else np.empty(0, bool)
    counted = ~np.concatenate([ignored for _, ignored in matched[0]]) if images else np.empty(0, bool)
    kept = counted & (scores >= least_score)
    hits, n_detected = int((right & kept).sum()), int(kept.sum())
    return BoxAccuracy(
        n_truth,
        n_detected,
        hits / n_detected if n_detected else float("nan"),
        hits / n_truth if n_truth else float("nan"),
        precisions[0],
        float(np.mean(precisions)),
    )


def average_precision(scores: FloatArray, right: NDArray[np.bool_], n_truth: int) -> float:
    """Mean interpolated precision at 101 recalls; NaN without true boxes.

    Args:
        scores: Scores of all detections, shape (D,).
        right: Whether each finds a true box, shape (D,).
        n_truth: Number of true boxes.
    """
    if n_truth == 0:
        return float("nan")
    order = np.argsort(-scores, kind="stable")
    hits = np.cumsum(right[order])
    precision = hits / np.arange(1, len(hits) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    at = np.searchsorted(hits / n_truth, _RECALLS, side="left")
    return float(np.append(envelope, 0.0)[np.minimum(at, len(envelope))].mean())
