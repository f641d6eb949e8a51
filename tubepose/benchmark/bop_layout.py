"""A session as a data set in the BOP layout, so that bop_toolkit can judge the same estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import yaml

from tubepose.batch import trial_capture
from tubepose.benchmark.measured import Progress, measure_sessions, silent
from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.capture.registration import known_intrinsics
from tubepose.capture.session import Session, Trial
from tubepose.errors import CaptureError, ConfigError, kept
from tubepose.foreign import write_bop_results
from tubepose.foreign.bop_models import models_info, ply_text, tube_mesh
from tubepose.labware import TubeModel
from tubepose.records import transform_of
from tubepose.report.writing import write_bytes, write_json, write_text

DEPTH_SCALE_MM = 0.1
_UNKNOWN = -1
_MOST_COUNTS = 65535


@dataclass(frozen=True, slots=True)
class BopExport:
    """What was written.

    Attributes:
        objects: Object number per tube.
        scenes: scene_id and im_id per session and trial.
        problems: One line per trial that could not be written.
    """

    objects: dict[str, int]
    scenes: dict[tuple[str, str], tuple[int, int]]
    problems: tuple[str, ...]


def export_bop(
    sessions: Sequence[Path | str],
    out: Path | str,
    *,
    exact_truth: bool = False,
    estimates: pd.DataFrame | None = None,
    progress: Progress = silent,
) -> BopExport:
    """Write sessions in the BOP layout: ``models``, ``test/SCENE``, camera, targets, and our mapping of names.

    A session is a scene, a trial an image; poses map model points (origin at the tube's bottom) to the camera, mm.
    Masks and visibility are not computed: ``scene_gt_info.json`` holds boxes, and -1 for what is not known.

    Args:
        sessions: Session folders.
        out: Folder that is made; it must not hold a data set.
        exact_truth: Take the exact poses of simulated sessions.
        estimates: Rows of estimates.csv, to be written as a BOP results file per method.
        progress: Shows how far it is.

    Raises:
        CaptureError: A session has no truth.
        ConfigError: The place cannot be written, or holds a data set already.
    """
    folder = Path(out)
    if (folder / "test").exists():
        raise ConfigError(f"{folder}: there is a data set already; choose another folder")
    measured = measure_sessions([Path(path) for path in sessions], None, exact=exact_truth, progress=progress)
    truth = measured.truth[measured.truth["status"] == "ok"]
    if truth.empty:
        raise CaptureError(f"no tube has a truth: {'; '.join(measured.problems) or 'no printed caps'}")
    tubes = {name: tube for session in measured.sessions for name, tube in sorted(session.types.items())}
    objects = {name: number for number, name in enumerate(sorted(tubes), start=1)}
    scenes: dict[tuple[str, str], tuple[int, int]] = {}
    problems = list(measured.problems)
    for scene, session in enumerate(measured.sessions):
        rows = truth[truth["session"] == session.name]
        scenes |= _write_scene(folder, scene, session, rows, objects, problems)
    _write_models(folder, {number: tubes[name] for name, number in objects.items()})
    _write_lists(folder, truth, scenes, objects)
    if estimates is not None:
        for method in estimates["method"].unique():
            text = write_bop_results(estimates[estimates["method"] == method], scenes, objects)
            write_text(folder / "results" / f"{method}_tubepose-test.csv", text)
    return BopExport(objects, scenes, tuple(problems))


def _write_models(folder: Path, tubes: dict[int, TubeModel]) -> None:
    for name in ("models", "models_eval"):
        for number, tube in tubes.items():
            write_text(folder / name / f"obj_{number:06d}.ply", ply_text(tube_mesh(tube)))
        write_json(folder / name / "models_info.json", models_info(tubes))


def _write_lists(
    folder: Path, truth: pd.DataFrame, scenes: dict[tuple[str, str], tuple[int, int]], objects: dict[str, int]
) -> None:
    """Targets, and the mapping file that `tubepose evaluate --mapping` takes."""
    targets = []
    for key, rows in truth.groupby(["session", "trial", "tube"]):
        session, trial, tube = map(str, key)
        if (session, trial) in scenes:
            scene, image = scenes[(session, trial)]
            entry = {"im_id": image, "inst_count": len(rows), "obj_id": objects[tube], "scene_id": scene}
            targets.append(entry)
    write_text(folder / "test_targets_bop19.json", _json_list(targets))
    mapping = {
        "scenes": {f"{scene}/{image}": f"{session}/{trial}" for (session, trial), (scene, image) in scenes.items()},
        "objects": {number: name for name, number in objects.items()},
        "origin": "bottom",
        "axis": "z",
        "unit": "mm",
    }
    write_text(folder / "tubepose_mapping.yaml", yaml.safe_dump(mapping, sort_keys=False))


def _json_list(rows: Sequence[dict[str, Any]]) -> str:
    import json

    return json.dumps(list(rows), indent=1) + "\n"


def _write_scene(
    folder: Path, scene: int, session: Session, truth: pd.DataFrame, objects: dict[str, int], problems: list[str]
) -> dict[tuple[str, str], tuple[int, int]]:
    """The images of one session; returns their numbers."""
    place = folder / "test" / f"{scene:06d}"
    cameras: dict[str, Any] = {}
    poses: dict[str, Any] = {}
    infos: dict[str, Any] = {}
    found: dict[tuple[str, str], tuple[int, int]] = {}
    for image, trial in enumerate(session.trials):
        rows = truth[truth["trial"] == trial.name]
        if rows.empty:
            continue
        with kept(problems):
            frame, camera = _frame(session, trial)
            _write_images(place, image, frame)
            K = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
            cameras[str(image)] = {"cam_K": K, "depth_scale": DEPTH_SCALE_MM}
            poses[str(image)] = [_pose(row, objects) for row in rows.to_dict("records")]
            infos[str(image)] = [_box(row, session.types[row["tube"]], camera) for row in rows.to_dict("records")]
            found[(session.name, trial.name)] = (scene, image)
            written = {"cx": camera.cx, "cy": camera.cy, "depth_scale": DEPTH_SCALE_MM, "fx": camera.fx}
            written |= {"fy": camera.fy, "height": camera.height, "width": camera.width}
            write_json(folder / "camera.json", written)
    for name, content in (("scene_camera", cameras), ("scene_gt", poses), ("scene_gt_info", infos)):
        write_json(place / f"{name}.json", content)
    return found


def _frame(session: Session, trial: Trial) -> tuple[RgbdFrame, CameraIntrinsics]:
    capture = trial_capture(session, trial, trial.original)
    frame = next(iter(capture.frames()), None)
    if frame is None:
        raise CaptureError(f"{capture.path}: no frame in it")
    camera = known_intrinsics(frame)
    if camera is None or not frame.organised:
        raise CaptureError(
            f"{capture.path}: its cloud is no depth image of a pinhole camera, which BOP needs; give the intrinsics"
        )
    return frame, camera


def _write_images(place: Path, image: int, frame: RgbdFrame) -> None:
    counts = np.rint(np.nan_to_num(frame.cloud_m[..., 2]) * 1e3 / DEPTH_SCALE_MM)
    write_bytes(place / "depth" / f"{image:06d}.png", _png(np.clip(counts, 0, _MOST_COUNTS).astype(np.uint16)))
    if frame.image is not None:
        colour = frame.image if frame.image.ndim == 3 else np.repeat(frame.image[..., None], 3, axis=2)
        write_bytes(place / "rgb" / f"{image:06d}.png", _png(colour[..., ::-1]))


def _png(picture: Any) -> bytes:
    _, data = cv2.imencode(".png", np.ascontiguousarray(picture))
    return bytes(data.tobytes())


def _pose(row: dict[Any, Any], objects: dict[str, int]) -> dict[str, Any]:
    T = transform_of(row)
    return {"cam_R_m2c": T[:3, :3].ravel().tolist(), "cam_t_m2c": (T[:3, 3] * 1e3).tolist(),
            "obj_id": objects[row["tube"]]}  # fmt: skip


def _box(row: dict[Any, Any], tube: TubeModel, camera: CameraIntrinsics) -> dict[str, Any]:
    T = transform_of(row)
    uv = camera.project(tube_mesh(tube).vertices_m @ T[:3, :3].T + T[:3, 3])
    low, high = np.floor(np.nanmin(uv, axis=0)), np.ceil(np.nanmax(uv, axis=0))
    box = [int(value) for value in (*low, *(high - low))]
    unknown = dict.fromkeys(("px_count_all", "px_count_valid", "px_count_visib", "visib_fract"), _UNKNOWN)
    return {"bbox_obj": box, "bbox_visib": [_UNKNOWN] * 4, **unknown}
