"""Frames of `wrong_labware`: drawn scenes of every rack of the catalogue, simulated once and kept in files."""

from __future__ import annotations

import dataclasses
import json
import os
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from benchmarks.wrong_labware_judging import TrueTube, Truth
from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.errors import LabwareError
from tubepose.labware import RackModel, TubeModel, catalogue, load_cap, load_tube
from tubepose.simulation import SceneVariation
from tubepose.simulation.bow import Bow
from tubepose.simulation.camera import default_camera
from tubepose.simulation.placement import place_tubes
from tubepose.simulation.random_scene import random_scene
from tubepose.simulation.shooting import SENSORS

SETS = {"choose": 1, "report": 2}
"""First number of a frame's seed: frames for choosing and frames for reporting have none in common."""
RESOLUTIONS_PX = (700, 860, 1032)
EMPTY_SHARE, FULL_SHARE, FLAT_SHARE = 0.1, 0.1, 1 / 3
"""Shares of the frames with an empty rack, with a full one, and with a rack that is not bowed."""
LARGEST_BOW_MM = 2.5
MOST_TYPES = 3
LOOSEST_M = 3e-3
"""Assumption: nobody puts a tube into a slot that is wider than it by more than this on each side."""
CAP = "printed-square-16.7"


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One simulated frame, what was simulated, and the labware that is right for it.

    Attributes:
        name: Of the frame: set, seed and number, which draw it again.
        frame: The frame.
        truth: What stands there.
        types: Types of tube that were drawn from: a right `--tubes`.
    """

    name: str
    frame: RgbdFrame
    truth: Truth
    types: tuple[TubeModel, ...]


def racks() -> tuple[RackModel, ...]:
    """Every rack of the catalogue."""
    return tuple(item for item in catalogue().values() if isinstance(item, RackModel))


def tubes() -> tuple[TubeModel, ...]:
    """Every tube of the catalogue."""
    return tuple(item for item in catalogue().values() if isinstance(item, TubeModel))


def types_for(rack: RackModel) -> tuple[TubeModel, ...]:
    """Types of the catalogue that can stand in a rack without much play."""
    cap, found = load_cap(CAP), []
    for model in tubes():
        radius_m = float(model.outer_profile_m()[:, 1].max())
        loose = min(float(slot.half_size_m.min()) - radius_m for slot in rack.all_slots)
        try:
            place_tubes(rack, [model], 1, cap, np.random.default_rng(0))
        except LabwareError:
            continue
        if loose < LOOSEST_M:
            found.append(model)
    return tuple(found)


def frame_name(chosen: str, seed: int, number: int, sensor: str) -> str:
    """Name that says how to draw a frame again."""
    return f"{chosen}-{sensor}-seed{seed}-{number:04d}"


def view(chosen: str, seed: int, number: int, sensor: str, folder: Path | None) -> View:
    """One frame: read where it was simulated before, else simulated, and kept if there is a folder.

    Args:
        chosen: Key of `SETS`.
        seed: Of the set.
        number: Of the frame; racks take turns.
        sensor: A simulated sensor.
        folder: Where frames are kept, or None.
    """
    name = frame_name(chosen, seed, number, sensor)
    file = None if folder is None else folder / f"{name}.npz"
    if file is not None and file.is_file():
        return _read(file, name)
    made = _simulated(name, np.random.SeedSequence([SETS[chosen], seed, number]), number, sensor)
    if file is not None:
        _write(file, made)
    return made


def _simulated(name: str, seed: np.random.SeedSequence, number: int, sensor: str) -> View:
    drawing, placing, noise = (np.random.default_rng(child) for child in seed.spawn(3))
    all_racks = racks()
    rack = all_racks[number % len(all_racks)]
    fitting = types_for(rack)
    count = int(drawing.integers(1, min(MOST_TYPES, len(fitting)) + 1))
    types = tuple(fitting[i] for i in sorted(drawing.permutation(len(fitting))[:count]))
    kind, fill = drawing.uniform(), float(drawing.uniform())
    fill = 1.0 if kind > 1 - FULL_SHARE else fill
    largest_mm = 0.0 if drawing.uniform() < FLAT_SHARE else LARGEST_BOW_MM
    variation = SceneVariation(fill=(fill, fill), rack_bow_mm=(-largest_mm, largest_mm))
    camera = default_camera(int(drawing.choice(RESOLUTIONS_PX)))
    scene = random_scene(rack, types, load_cap(CAP), camera, placing, variation)
    if kind < EMPTY_SHARE:
        scene = dataclasses.replace(scene, tubes=())
    cv2.setNumThreads(1)
    with threadpool_limits(1, user_api="blas"):
        frame = SENSORS[sensor](scene, camera, noise, threads=1)
    frame = dataclasses.replace(frame, capture=name, sensor=f"simulated-{sensor}", simulated=True, timestamp_ns=number)
    placed = tuple(TrueTube(t.slot, t.model, scene.T_camera_rack @ t.T_rack_tube) for t in scene.tubes)
    return View(name, frame, Truth(rack, scene.T_camera_rack, placed, scene.bow), types)


def _write(file: Path, made: View) -> None:
    k, image, truth = made.frame.intrinsics, made.frame.image, made.truth
    assert k is not None
    assert image is not None
    assert truth.rack is not None
    notes = {
        "intrinsics": dataclasses.asdict(k),
        "sensor": made.frame.sensor,
        "number": made.frame.timestamp_ns,
        "rack": truth.rack.name,
        "T_camera_rack": truth.T_camera_rack.tolist(),
        "bow": dataclasses.asdict(truth.bow),
        "types": [model.name for model in made.types],
        "tubes": [[tube.slot, tube.model.name, tube.T_camera_tube.tolist()] for tube in truth.tubes],
    }
    aside = file.with_name(f".{file.stem}.{os.getpid()}.npz")
    aside.parent.mkdir(parents=True, exist_ok=True)
    depth = made.frame.cloud_m[..., 2].astype(np.float32)
    np.savez_compressed(aside, depth=depth, image=image, notes=np.array(json.dumps(notes)))
    aside.rename(file)


def _read(file: Path, name: str) -> View:
    with np.load(file) as kept:
        depth, image, notes = kept["depth"].astype(float), kept["image"], json.loads(str(kept["notes"]))
    k = CameraIntrinsics(**notes["intrinsics"])
    frame = RgbdFrame(
        k.backproject(depth), image, k, notes["number"], name, sensor=notes["sensor"], simulated=True
    )  # fmt: skip
    rack = next(rack for rack in racks() if rack.name == notes["rack"])
    placed = tuple(TrueTube(slot, load_tube(tube), np.array(T)) for slot, tube, T in notes["tubes"])
    truth = Truth(rack, np.array(notes["T_camera_rack"]), placed, Bow(**notes["bow"]))
    return View(name, frame, truth, tuple(load_tube(tube) for tube in notes["types"]))
