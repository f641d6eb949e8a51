"""Exact boxes of simulated sessions, what a detector's boxes cost the poses, and how long a detector takes.

    python -m benchmarks.detection boxes data/dev OUT
    tubepose detector evaluate --images OUT/images --labels OUT/labels --classes OUT/classes.txt --out RESULTS
    tubepose bench data/dev --detector recorded --boxes OUT/labels --exact-truth --out EXACT
    tubepose bench data/dev --detector yolo --exact-truth --out YOLO
    python -m benchmarks.detection compare EXACT YOLO
    python -m benchmarks.detection speed OUT/images

Exact boxes come from the exact truth: the pixels that show a tube above the rack's top, by casting a ray through each.
They are the labels that pictures to learn from have, on pictures that another simulator made.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pandas as pd

from tubepose.batch import session_jobs
from tubepose.capture.frame import CameraIntrinsics
from tubepose.capture.session import Session, load_session
from tubepose.detection.box_writing import write_yolo_txt
from tubepose.detection.bundled import bundled_model
from tubepose.detection.model import RACK_CLASS, visible_class
from tubepose.detection.yolo import YoloDetector
from tubepose.errors import CaptureError
from tubepose.report import write_aside, write_text
from tubepose.simulation import read_exact_truth
from tubepose.simulation.looks.appearance import Light, Part, Surface
from tubepose.simulation.looks.render import render
from tubepose.simulation.meshes import Mesh, merge, rack_shell, rack_wells
from tubepose.simulation.scene import MATERIALS, Finishes, PlacedTube, tube_parts
from tubepose.simulation.truth import ExactTruth
from tubepose.training.images import CLASSES, detections
from tubepose.training.labels import Label, label_objects
from tubepose.training.scenes import STANDS_OUT_M, LearningScene, SceneObject
from tubepose.transforms import invert_transform, transform_points

WALLS = {"transparent": 0.9, "translucent": 0.5}
"""Share of light that crosses a wall, to decide what is seen through it."""


def exact_labels(session: Session, truth: ExactTruth, intrinsics: CameraIntrinsics) -> list[Label]:
    """Boxes of the rack and of every tube of a simulated capture with its own caps."""
    opaque = Surface((0.5, 0.5, 0.5))
    T_rack_camera = invert_transform(truth.T_camera_rack)
    rack = merge([rack_shell(session.rack), rack_wells(session.rack)]).transformed(truth.T_camera_rack)
    parts = [Part(rack, opaque, 0)]
    objects = [SceneObject(RACK_CLASS, rack.vertices_m)]
    for slot, (name, T_camera_tube) in truth.tubes.items():
        model, made = session.tubes[name], truth.as_made[slot]
        tube = PlacedTube(slot, model, T_rack_camera @ T_camera_tube, label=made.label)
        meshes: list[Mesh] = []
        for mesh, material in tube_parts(tube, None, MATERIALS, Finishes()):
            moved = mesh.transformed(T_camera_tube)
            clear = WALLS[model.body.material] if material.plastic is not None else None
            wall = Surface((0.5,) * 3, transmission=(clear,) * 3) if clear is not None else opaque
            parts.append(Part(moved, wall, len(objects)))
            meshes.append(moved)
        shape, above = merge(meshes).vertices_m, session.rack.height_m + STANDS_OUT_M
        shape = shape[transform_points(T_rack_camera, shape)[:, 2] > above]
        objects.append(SceneObject(visible_class(closed=not model.is_open), shape, T_rack_camera, above))
    dark = Light([], (1.0, 1.0, 1.0), np.array([0.0, 0.0, -1.0]), np.zeros((2, 2, 3), np.float32))
    scene = LearningScene("projector", intrinsics, tuple(parts), tuple(objects), dark)
    # A rack under fifty caps shows a tenth of itself, and is there all the same.
    return label_objects(scene, render(scene.parts, dark, intrinsics, np.random.default_rng(0)), least_visible=0.0)


def write_boxes(folder: Path, out: Path) -> int:
    """Pictures and exact labels of a session's captures with original caps; how many there are."""
    session = load_session(folder)
    write_text(out / "classes.txt", "".join(f"{name}\n" for name in CLASSES))
    (out / "labels").mkdir(parents=True, exist_ok=True)
    jobs, _ = session_jobs(session)
    for job in jobs:
        frame = next(iter(job.capture.frames()))
        if frame.image is None or frame.intrinsics is None:
            raise CaptureError(f"{frame.capture}: expected an image and intrinsics, as the simulator writes them")
        labels = exact_labels(session, read_exact_truth(session.folder, job.trial), frame.intrinsics)
        size = (frame.intrinsics.width, frame.intrinsics.height)
        with write_aside(out / "images" / f"{frame.capture}.png") as aside:
            cv2.imwrite(str(aside), frame.image if frame.image.ndim == 2 else frame.image[:, :, ::-1])
        write_yolo_txt(out / "labels" / f"{frame.capture}.txt", detections(labels, size), size, CLASSES)
    return len(jobs)


def compared(exact: Path, other: Path) -> Iterator[str]:
    """Lines of a table: mean errors with exact boxes and with others, per method, tube and axis, and what is lost."""
    yield "| method | tube | expected | kept, exact boxes | kept | worse by at most | on |"
    yield "|---|---|---|---|---|---|---|"
    columns = ("rx_deg", "ry_deg", "tilt_deg", "tx_mm", "ty_mm", "tz_mm")
    tables = [pd.read_csv(folder / "errors.csv") for folder in (exact, other)]
    keys = ["method", "tube"]
    groups = [dict(iter(table[table["tube"].notna()].groupby(keys))) for table in tables]
    for key, first in groups[0].items():
        second = groups[1].get(key, first.iloc[:0])
        kept = [int((table["outcome"] == "ok").sum()) for table in (first, second)]
        means = [table.loc[table["outcome"] == "ok", list(columns)].abs().mean() for table in (first, second)]
        growth = (means[1] / means[0] - 1).dropna()
        worst = str(growth.idxmax()) if len(growth) else ""
        share = f"{growth.max() * 100:+.1f} %" if len(growth) else ""
        expected = int((first["outcome"] != "false").sum())
        yield f"| {key[0]} | {key[1]} | {expected} | {kept[0]} | {kept[1]} | {share} | {worst} |"


def timed(images: Path, model: Path, threads: int) -> Iterator[str]:
    """Lines on how long a detector takes a picture: all of it, and the network alone."""
    detector = YoloDetector(model, threads=threads)
    cv2.setNumThreads(threads)
    pictures = [cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) for path in sorted(images.glob("*.png"))[:20]]
    whole = []
    for picture in pictures * 3:
        start = time.perf_counter()
        detector.detect_image(picture)
        whole.append((time.perf_counter() - start) * 1e3)
    low, middle, high = np.percentile(whole[len(pictures) :], [5, 50, 95])
    shape = " x ".join(str(side) for side in pictures[0].shape[::-1])
    looks = detector.looks
    size = (
        f"{detector.net_size[0]}" if looks is None else f"{looks.whole_px} for the whole, {looks.rack_px} for each rack"
    )
    yield f"{len(pictures)} pictures of {shape}, input of {size}, {threads} threads:"
    yield f"median {middle:.0f} ms"
    yield f"(5 to 95 %: {low:.0f} to {high:.0f} ms); the paper's network took 96 ms on an RTX 4090"


def main() -> int:
    """Read the arguments and run one of the three."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    boxes = commands.add_parser("boxes")
    boxes.add_argument("session", type=Path)
    boxes.add_argument("out", type=Path)
    compare = commands.add_parser("compare")
    compare.add_argument("exact", type=Path)
    compare.add_argument("other", type=Path)
    speed = commands.add_parser("speed")
    speed.add_argument("images", type=Path)
    speed.add_argument("--model", type=Path)
    speed.add_argument("--threads", type=int, default=2)
    given = parser.parse_args()
    if given.command == "boxes":
        print(f"{given.out}: {write_boxes(given.session, given.out)} pictures with exact boxes")
    elif given.command == "compare":
        print("\n".join(compared(given.exact, given.other)))
    else:
        print("\n".join(timed(given.images, given.model or bundled_model(), given.threads)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
