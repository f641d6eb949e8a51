"""Exact poses of a simulated session, kept apart from everything that an estimator may read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tubepose.capture.source import TRUTH_FOLDER
from tubepose.errors import CaptureError
from tubepose.labware.reading import read_yaml
from tubepose.simulation.placement import pivot_height_m
from tubepose.simulation.scene import PlacedTube, Scene
from tubepose.transforms import FloatArray, tilt_rad


@dataclass(frozen=True, slots=True, eq=False)
class ExactTruth:
    """Poses that a trial was simulated with.

    Attributes:
        T_camera_rack: Array of shape (4, 4); maps rack points to camera points, metres.
        tubes: Per slot the tube's name in the session and its T_camera_tube, shape (4, 4), metres.
    """

    T_camera_rack: FloatArray
    tubes: dict[str, tuple[str, FloatArray]]


def write_exact_truth(session_folder: Path, trial: str, scene: Scene, names: dict[str, str]) -> None:
    """Write the poses of a scene beside its session; `names` gives each slot's tube as the session names it."""
    slots = {tube.slot: _entry(scene, tube, names[tube.slot]) for tube in scene.tubes}
    data = {"format": 1, "trial": trial, "T_camera_rack": scene.T_camera_rack.tolist(), "slots": slots}
    folder = session_folder / TRUTH_FOLDER
    folder.mkdir(exist_ok=True)
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120)
    (folder / f"{trial}.yaml").write_text(text, encoding="utf-8")


def _entry(scene: Scene, tube: PlacedTube, name: str) -> dict[str, Any]:
    slot = scene.rack.slot(tube.slot)
    axis = tube.T_rack_tube[:3, 2]
    pivot = tube.T_rack_tube[:3, 3] + pivot_height_m(tube.model) * axis
    return {
        "tube": name,
        "T_camera_tube": (scene.T_camera_rack @ tube.T_rack_tube).tolist(),
        "bottom_offset_m": (pivot[:2] - slot.center_m).tolist(),
        "tilt_rad": tilt_rad(axis, np.array([0.0, 0.0, 1.0])),
    }


def read_exact_truth(session_folder: Path, trial_name: str) -> ExactTruth:
    """Read the exact poses of a trial of a simulated session.

    Raises:
        CaptureError: The session has no exact truth for that trial, or the file is not what the simulator writes.
    """
    file = session_folder / TRUTH_FOLDER / f"{trial_name}.yaml"
    data = read_yaml(file, CaptureError)
    try:
        tubes = {
            str(slot): (str(entry["tube"]), _transform(entry["T_camera_tube"])) for slot, entry in data["slots"].items()
        }
        return ExactTruth(_transform(data["T_camera_rack"]), tubes)
    except (KeyError, TypeError, ValueError, AttributeError) as problem:
        raise CaptureError(
            f"{file}: not a truth file of the simulator: {problem!r}; simulate the session again"
        ) from None


def _transform(rows: Any) -> FloatArray:
    T = np.array(rows, dtype=float)
    if T.shape != (4, 4):
        raise ValueError(f"expected 4 x 4 numbers, found shape {T.shape}")
    return T
