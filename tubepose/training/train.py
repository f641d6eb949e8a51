"""From labware to a detector: pictures, training, the ONNX file, and what there is to look at."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import yaml

from tubepose.detection.closer_look import Looks
from tubepose.detection.evaluation import DetectionReport, evaluate_detector, kinds_of
from tubepose.detection.labelled_images import LabelledFiles
from tubepose.detection.yolo import YoloDetector
from tubepose.detection.yolo_session import SIZE_STEP
from tubepose.errors import DetectorError
from tubepose.report import write_aside, write_bytes, write_json
from tubepose.training.export import export_onnx
from tubepose.training.images import RECIPE_FILE
from tubepose.training.loop import Recipe, Trainer
from tubepose.training.pictures import judged_picture, loss_curve, sheet

LOSS_FILE, SAMPLES_FILE, RECORD_FILE = "loss.png", "samples.png", "training.json"
SAMPLES = 9
LOW_SCORE = 0.01
"""Detections down to this score are asked for where average precision is wanted."""
SCORE = 0.3
"""Score from which a box counts as an answer."""


@dataclass(frozen=True, slots=True)
class TrainingJob:
    """What `train_detector` needs.

    Attributes:
        files: Pictures to learn from.
        out: The .onnx file.
        work: Folder for the checkpoint and for what there is to look at.
        recipe: How to train.
        looks: How large the trained network is to see whole pictures and racks.
        threads: Processor threads.
        start: Checkpoint or model of another training to start from; None for the photographs' weights alone.
    """

    files: LabelledFiles
    out: Path
    work: Path
    recipe: Recipe
    looks: Looks
    threads: int
    start: Path | None = None


def train_detector(
    job: TrainingJob,
    unseen: LabelledFiles | None,
    on_step: Callable[[int, float], None] = lambda _step, _loss: None,
) -> DetectionReport | None:
    """Train, or go on, and write the model; then its loss curve and what it finds in pictures that it never saw.

    Args:
        job: What to do.
        unseen: Pictures to judge it by; None for none.
        on_step: Called with the number of steps done and the loss.

    Raises:
        DetectorError: A package is missing, the pictures cannot be read, or the checkpoint belongs to another training.
    """
    for side in (job.looks.whole_px, job.looks.rack_px):
        if side % SIZE_STEP or side < 96:
            raise DetectorError(f"side {side}: expected a multiple of {SIZE_STEP}, 96 or more")
    trainer = Trainer(job.recipe, job.files, job.work, threads=job.threads, start=job.start)
    trainer.run(on_step)
    record = {
        "recipe": job.recipe.model_dump(),
        "images": _sources(job.files),
        "looks_px": [job.looks.whole_px, job.looks.rack_px],
    }
    if trainer.start_sha256:
        record["start_sha256"] = trainer.start_sha256
    export_onnx(
        trainer.average.module,
        job.out,
        job.files.classes,
        job.looks,
        record,
        sha256=hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest(),
    )
    write_json(job.work / RECORD_FILE, record)
    write_bytes(job.work / LOSS_FILE, loss_curve(trainer.losses))
    return None if unseen is None else judge(job.out, unseen, job.work, threads=job.threads)


def judge(model: Path, files: LabelledFiles, work: Path, *, threads: int) -> DetectionReport:
    """Figures of a model over pictures; `SAMPLES_FILE` shows the first few."""
    detector = YoloDetector(model, score_threshold=LOW_SCORE, threads=threads)
    kinds = kinds_of(files.classes, {})
    report = evaluate_detector(detector.detect_image, detector.words, files, kinds, SCORE)
    shown = sheet([judged_picture(files, one, kinds, SCORE) for one in report.judged[:SAMPLES]])
    with write_aside(work / SAMPLES_FILE) as aside:
        cv2.imwrite(str(aside), shown)
    return report


def _sources(files: LabelledFiles) -> list[dict[str, object]]:
    """What the pictures were drawn from, where they say it: one entry a folder."""
    counts = Counter(image.parent.parent for image in files.images)
    sources = []
    for folder, count in counts.items():
        said = folder / RECIPE_FILE
        drawn = yaml.safe_load(said.read_text(encoding="utf-8")) if said.is_file() else {"labelled_by": "the user"}
        sources.append({"count": count, **drawn})
    return sources
