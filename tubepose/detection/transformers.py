"""Telling detection transformers (RT-DETR, D-FINE, RF-DETR and the like) from YOLO models by what their files say.

Their outputs are queries, not grid cells; some have the shape of a YOLO output and other numbers in it.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tubepose.errors import DetectorError

_NAME = re.compile(r"\b(?:rt-?detr|d-?fine|rf-?detr|deim|dino|detr|deta)", re.IGNORECASE)
_SHARE_MARGIN = 1.5
"""Boxes as shares of the picture lie within it, or a little outside; boxes in pixels do not."""


def refuse_transformer(path: Path, inputs: Collection[str], outputs: Collection[str], notes: Mapping[str, str]) -> None:
    """Say so where a model is a transformer by the names of its inputs and outputs, or by its metadata.

    Args:
        path: The model file, for the message.
        inputs: Names of its inputs.
        outputs: Names of its outputs.
        notes: What the exporter wrote into the file.

    Raises:
        DetectorError: It is.
    """
    names = set(outputs)
    if "orig_target_sizes" in inputs or {"labels", "boxes", "scores"} <= names:
        raise _refusal(path, "an RT-DETR or D-FINE (outputs labels, boxes, scores)")
    if "pred_boxes" in names or ("logits" in names and "boxes" in " ".join(names)):
        raise _refusal(path, "an RT-DETR or D-FINE of the Transformers library (outputs logits, pred_boxes)")
    if "dets" in names and "labels" in names:
        raise _refusal(path, "an RF-DETR (outputs dets, labels)")
    said = next((found[0] for text in notes.values() if (found := _NAME.search(text))), None)
    if said is not None and notes.get("task", "detect") == "detect":
        raise _refusal(path, f"a transformer ({said.lower()}, by its metadata)")


def refuse_queries(path: Path, output: NDArray[np.floating]) -> None:
    """Say so where an output of six columns holds queries of an RT-DETR with two classes, not final boxes.

    Final boxes are edges in pixels, a score and the number of a class. Queries are centres and sizes as shares of the
    picture, and a score for each class: never whole numbers.

    Args:
        path: The model file, for the message.
        output: Array of shape (N, 6) of a real run.

    Raises:
        DetectorError: It does.
    """
    table = np.asarray(output, dtype=float)
    sized = (table[:, 2:4] > 0).all(axis=1).mean() > 0.5 if len(table) else False
    shares = sized and np.abs(table[:, :4]).max(initial=0.0) <= _SHARE_MARGIN
    whole = (table[:, 5] == np.round(table[:, 5])).all()
    if shares and not whole:
        raise _refusal(path, f"an RT-DETR (output {[1, *table.shape]} of shares and scores of two classes)")


def _refusal(path: Path, what: str) -> DetectorError:
    return DetectorError(
        f"{path}: {what}, which is not read; expected a YOLO model of a family in docs/detectors.md; or write its "
        "boxes to YOLO label files and give them by --detector recorded --boxes"
    )
