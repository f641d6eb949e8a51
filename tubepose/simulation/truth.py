"""What a simulated session was made from, kept apart from everything that an estimator may read."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import TypeAdapter

from tubepose.capture.source import TRUTH_FOLDER
from tubepose.errors import CaptureError
from tubepose.labware import WallOptics
from tubepose.labware.reading import read_yaml
from tubepose.simulation.bow import FLAT, Bow
from tubepose.simulation.scene import CapFit, Finishes, Label, Liquid, PlacedTube, Scene
from tubepose.transforms import FloatArray, invert_transform, tilt_rad, transform_points


@dataclass(frozen=True, slots=True)
class TubeAsMade:
    """How a simulated tube differs from its definition, and what is in and on it.

    Attributes:
        cap_fit: How its own closed cap sits; None without such a cap.
        printed_cap_tilt_rad: Turn of its printed cap about the tube's x and y axes, at the rim's centre.
        wall_optics: The plastic of its wall; None for an opaque body, and in files that do not say.
        liquid: What stands in it, if anything.
        label: The label on it, if any.
    """

    cap_fit: CapFit | None = None
    printed_cap_tilt_rad: tuple[float, float] = (0.0, 0.0)
    wall_optics: WallOptics | None = None
    liquid: Liquid | None = None
    label: Label | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ExactTruth:
    """What a trial was simulated with.

    Attributes:
        T_camera_rack: Array of shape (4, 4); maps rack points to camera points, metres.
        tubes: Per slot the tube's name in the session and its T_camera_tube, shape (4, 4), metres: the body's pose.
        as_made: Per slot how the tube differs from its definition.
        finishes: How the opaque surfaces return light; None in files that do not say.
        bow: How the rack's face is bent. `T_camera_rack` is the pose without it, at the centre of the face the same.
    """

    T_camera_rack: FloatArray
    tubes: dict[str, tuple[str, FloatArray]]
    as_made: dict[str, TubeAsMade] = field(default_factory=dict)
    finishes: Finishes | None = None
    bow: Bow = FLAT


_AS_MADE = TypeAdapter(TubeAsMade)
_FINISHES = TypeAdapter(Finishes)
_BOW = TypeAdapter(Bow)


def write_exact_truth(session_folder: Path, trial: str, scene: Scene, names: dict[str, str]) -> None:
    """Write what a scene is made of beside its session; `names` gives each slot's tube as the session names it."""
    slots = {tube.slot: _entry(scene, tube, names[tube.slot]) for tube in scene.tubes}
    data = {
        "format": 1,
        "trial": trial,
        "T_camera_rack": scene.T_camera_rack.tolist(),
        **({} if scene.bow.flat else {"rack_bow": _BOW.dump_python(scene.bow, mode="json")}),
        "finishes": _FINISHES.dump_python(scene.finishes, mode="json"),
        "slots": slots,
    }
    folder = session_folder / TRUTH_FOLDER
    folder.mkdir(exist_ok=True)
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120)
    (folder / f"{trial}.yaml").write_text(text, encoding="utf-8")


def as_made(tube: PlacedTube) -> TubeAsMade:
    """What the exact truth says of a tube besides its pose."""
    fit = None if tube.model.is_open else tube.cap_fit
    return TubeAsMade(fit, tube.printed_tilt_rad, tube.wall_optics, tube.liquid, tube.label)


def _entry(scene: Scene, tube: PlacedTube, name: str) -> dict[str, Any]:
    slot = scene.rack.slot(tube.slot)
    axis = tube.T_rack_tube[:3, 2]
    pivot = tube.T_rack_tube[:3, 3] + tube.model.pivot_height_m * axis
    if not scene.bow.flat:
        pivot = transform_points(invert_transform(scene.bow.slot_frame(scene.rack, slot)), pivot)
    return {
        "tube": name,
        "T_camera_tube": (scene.T_camera_rack @ tube.T_rack_tube).tolist(),
        "bottom_offset_m": (pivot[:2] - slot.center_m).tolist(),
        "tilt_rad": tilt_rad(axis, np.array([0.0, 0.0, 1.0])),
        **_AS_MADE.dump_python(as_made(tube), mode="json", exclude_none=True),
    }


def read_exact_truth(session_folder: Path, trial_name: str) -> ExactTruth:
    """Read what a trial of a simulated session was made from.

    Files written before caps, liquids, labels and finishes varied have poses alone: their caps are perfect.

    Raises:
        CaptureError: The session has no exact truth for that trial, or the file is not what the simulator writes.
    """
    file = session_folder / TRUTH_FOLDER / f"{trial_name}.yaml"
    data = read_yaml(file, CaptureError)
    try:
        slots = {str(slot): entry for slot, entry in data["slots"].items()}
        return ExactTruth(
            _transform(data["T_camera_rack"]),
            {slot: (str(entry["tube"]), _transform(entry["T_camera_tube"])) for slot, entry in slots.items()},
            {slot: _AS_MADE.validate_python(entry) for slot, entry in slots.items()},
            _FINISHES.validate_python(data["finishes"]) if "finishes" in data else None,
            _BOW.validate_python(data["rack_bow"]) if "rack_bow" in data else FLAT,
        )
    except (KeyError, TypeError, ValueError, AttributeError) as problem:
        # What pydantic raises is a ValueError of several lines.
        found = " ".join(repr(problem).split())
        raise CaptureError(f"{file}: not a truth file of the simulator: {found}; simulate the session again") from None


def _transform(rows: Any) -> FloatArray:
    T = np.array(rows, dtype=float)
    if T.shape != (4, 4):
        raise ValueError(f"expected 4 x 4 numbers, found shape {T.shape}")
    return T
