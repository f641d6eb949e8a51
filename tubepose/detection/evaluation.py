"""A detector against labelled pictures: figures by class, and the share of pictures that are all right."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from operator import eq

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tubepose.detection.boxes import edges_from_box
from tubepose.detection.labelled_images import LabelledFiles
from tubepose.detection.metrics import OVERLAPS, BoxAccuracy, ComparedBoxes, box_accuracy, match
from tubepose.detection.model import Detection
from tubepose.errors import DetectorError
from tubepose.transforms import FloatArray

KINDS = ("tube", "rack", "ignore")
ALL_TUBES, ALL_RACKS = "tubes", "racks"
"""Rows of the summary in which a box of any class of that kind is right."""


@dataclass(frozen=True, slots=True, eq=False)
class Judged:
    """One picture with its truth and what was found.

    Attributes:
        number: Which picture of the set.
        truth_names: Class names of the true boxes, (T,).
        truth: Their continuous edges, shape (T, 4), pixels.
        found: Detections of any score.
    """

    number: int
    truth_names: tuple[str, ...]
    truth: FloatArray
    found: tuple[Detection, ...]

    def compared(
        self, own: Callable[[str], bool], chosen: Callable[[Detection], bool], kinds: Mapping[str, str]
    ) -> ComparedBoxes:
        """True boxes of some classes and some detections, to be matched.

        Args:
            own: Whether a class of the labels is one of them.
            chosen: Whether a detection is one of them; those keep their order.
            kinds: As `evaluate_detector`; what is ``ignore`` counts neither as found nor as missed.
        """
        kept = [found for found in self.found if chosen(found)]
        truth, ignored = (
            self.truth[np.array([test(name) for name in self.truth_names], bool)]
            for test in (own, lambda name: kinds[name] == "ignore")
        )
        edges = np.array([edges_from_box(found.box_xyxy_px) for found in kept], float).reshape(-1, 4)
        return ComparedBoxes(truth, edges, np.array([found.score for found in kept], float), ignored)

    def of_kind(self, kind: str, kinds: Mapping[str, str], least_score: float = 0.0) -> ComparedBoxes:
        """All boxes of one kind, whatever their class, with detections of a least score."""
        return self.compared(
            lambda name: kinds[name] == kind, lambda found: is_kind(found, kind) and found.score >= least_score, kinds
        )


@dataclass(frozen=True, slots=True, eq=False)
class DetectionReport:
    """What `evaluate_detector` finds.

    Attributes:
        summary: One row per class and one each for `ALL_TUBES` and `ALL_RACKS`: class and `metrics.BoxAccuracy`.
        n_frames: Pictures with at least one tube.
        n_success: Those of them in which every labelled tube and rack is found with the right class.
        judged: Every picture, in order.
        errors: Misses and false alarms of each picture, class-agnostic, shape (P,).
    """

    summary: pd.DataFrame
    n_frames: int
    n_success: int
    judged: tuple[Judged, ...]
    errors: NDArray[np.intp]

    @property
    def success_rate(self) -> float:
        """Share of the pictures with tubes that are all right; NaN without any."""
        return self.n_success / self.n_frames if self.n_frames else float("nan")


def kinds_of(names: Sequence[str], given: Mapping[str, str]) -> dict[str, str]:
    """What each class of the labels is: as given, else a rack if its name says ``rack``, a tube if it says ``tube``.

    Raises:
        DetectorError: A mapped class does not exist, or is mapped to something else than `KINDS`.
    """
    for name, kind in given.items():
        if name not in names:
            raise DetectorError(f"--map {name}={kind}: no such class; the labels have: {', '.join(names)}")
        if kind not in KINDS:
            raise DetectorError(f"--map {name}={kind}: expected one of {', '.join(KINDS)}")

    def guess(name: str) -> str:
        word = name.lower()
        return "rack" if "rack" in word else "tube" if "tube" in word else "ignore"

    return {name: given.get(name, guess(name)) for name in names}


def evaluate_detector(
    detect: Callable[[NDArray[np.uint8]], Sequence[Detection]],
    words: Collection[str],
    files: LabelledFiles,
    kinds: Mapping[str, str],
    least_score: float,
    on_done: Callable[[int], None] = lambda _: None,
) -> DetectionReport:
    """Run a detector over labelled pictures.

    Args:
        detect: From an RGB picture to detections, those of low scores too.
        words: Every class that it can answer.
        files: The pictures and labels.
        kinds: ``tube``, ``rack`` or ``ignore`` for every class of the labels.
        least_score: Score from which a detection counts as an answer.
        on_done: Called with the number of pictures done.
    """
    judged = []
    for number in range(len(files.images)):
        image = files.read_image(number)
        ids, edges = files.read_boxes(number, (image.shape[1], image.shape[0]))
        judged.append(Judged(number, tuple(files.classes[k] for k in ids), edges, tuple(detect(image))))
        on_done(number + 1)
    rows: list[dict[str, object]] = []
    for name, kind in kinds.items():
        if kind != "ignore":
            rows.append({"class": name, **asdict(_class_scores(judged, name, kind, kinds, least_score, words))})
    for word, kind in ((ALL_TUBES, "tube"), (ALL_RACKS, "rack")):
        rows.append({"class": word, **asdict(box_accuracy([one.of_kind(kind, kinds) for one in judged], least_score))})
    with_tubes = [one for one in judged if any(kinds[name] == "tube" for name in one.truth_names)]
    success = sum(_all_right(one, kinds, words, least_score) for one in with_tubes)
    errors = np.array([_errors(one, kinds, least_score) for one in judged], np.intp)
    return DetectionReport(pd.DataFrame(rows), len(with_tubes), success, tuple(judged), errors)


def is_kind(found: Detection, kind: str) -> bool:
    """Whether a detection is a ``rack``, or a ``tube`` of any class."""
    return found.is_rack == (kind == "rack")


def _class_scores(
    judged: Sequence[Judged], name: str, kind: str, kinds: Mapping[str, str], least_score: float, words: Collection[str]
) -> BoxAccuracy:
    """Figures of one class of the labels; where the detector has no such class, only what it finds of it."""
    if name in words:
        pictures = [
            one.compared(lambda known: known == name, lambda found: found.class_name == name, kinds) for one in judged
        ]
        return box_accuracy(pictures, least_score)
    n_truth = n_found = 0
    for one in judged:
        boxes = one.of_kind(kind, kinds, least_score)
        own = np.array([known == name for known in one.truth_names if kinds[known] == kind], bool)
        rows, _ = match(boxes, float(OVERLAPS[0]))
        n_truth += int(own.sum())
        n_found += int(own[rows[rows >= 0]].sum())
    nan = float("nan")
    return BoxAccuracy(n_truth, 0, nan, n_found / n_truth if n_truth else nan, nan, nan)


def _all_right(one: Judged, kinds: Mapping[str, str], words: Collection[str], least_score: float) -> bool:
    """Whether every labelled tube and rack of a picture is found, with the right class where the detector has it."""
    for name in {known for known in one.truth_names if kinds[known] != "ignore"}:
        boxes = one.compared(partial(eq, name), partial(_answers_for, name, kinds[name], words, least_score), kinds)
        rows, _ = match(boxes, float(OVERLAPS[0]))
        if (rows >= 0).sum() < len(boxes.truth):
            return False
    return True


def _answers_for(name: str, kind: str, words: Collection[str], least_score: float, found: Detection) -> bool:
    """Whether a detection is an answer for a class of the labels: of that class, or of its kind where there is none."""
    return found.score >= least_score and (found.class_name == name if name in words else is_kind(found, kind))


def _errors(one: Judged, kinds: Mapping[str, str], least_score: float) -> int:
    count = 0
    for kind in ("tube", "rack"):
        boxes = one.of_kind(kind, kinds, least_score)
        rows, ignored = match(boxes, float(OVERLAPS[0]))
        hits = int((rows >= 0).sum())
        count += len(boxes.truth) - hits + int((~ignored).sum()) - hits
    return count
