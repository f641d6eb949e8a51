"""Simulated sessions: folders like recorded ones, with exact truth beside them."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np
import yaml

from tubepose.capture.manifest import tree_sha256
from tubepose.capture.session import SESSION_FILE
from tubepose.errors import CaptureError, ConfigError
from tubepose.labware import CapModel, Labware, RackModel, TubeModel, catalogue
from tubepose.simulation.camera import default_camera
from tubepose.simulation.parallel import in_processes
from tubepose.simulation.placement import DISTANCE_M
from tubepose.simulation.random_scene import DEFAULT_VARIATION, random_scene
from tubepose.simulation.scene import Scene
from tubepose.simulation.shooting import FRAME_NS, SENSORS, Camera, CaptureFormat, Shooting, Shot, sensor_label
from tubepose.simulation.stereo.stereo_camera import StereoCamera
from tubepose.simulation.truth import write_exact_truth
from tubepose.simulation.variation import SceneVariation

CLICK_ERROR_PX = 3.0
# Counted from a fixed moment, so that they depend on the seed and the trial alone.
_FIRST_STAMP_NS = 1_700_000_000_123_456_789
_TRIAL_NS = 60_000_000_000
_RECAP_NS = 25_000_000_000
_SESSION_NS = 86_400_000_000_000
MAX_FRAMES = _RECAP_NS // FRAME_NS
"""A recording ends before the caps are changed."""
# Which run the captures of an interrupted one belong to.
_RUN_FILE = ".run"
_PACKAGE = Path(__file__).parents[1]


@dataclass(frozen=True, slots=True)
class _Plan:
    """One trial before its scene is drawn."""

    name: str
    number: int
    types: tuple[TubeModel, ...]
    seeds: tuple[np.random.SeedSequence, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Trial:
    """One trial before it is captured: its entry in the session file, its scene, its captures."""

    entry: dict[str, Any]
    scene: Scene
    shots: tuple[Shot, ...]


@dataclass(frozen=True, slots=True)
class _Settings:
    """What all trials share; together with the plans it decides every byte."""

    rack: RackModel
    tubes: tuple[TubeModel, ...]
    cap: CapModel
    camera: Camera
    sensor: str
    variation: SceneVariation
    capture_format: CaptureFormat
    seed: int
    n_frames: int

    @property
    def label(self) -> str:
        """The sensor as sessions and captures name it."""
        return sensor_label(self.sensor, self.camera)


def simulate_session(
    out: Path,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    *,
    trials: int,
    seed: int,
    cap: CapModel,
    sensor: str = "raycast",
    resolution: int = 1376,
    camera: StereoCamera | None = None,
    frames: int = 1,
    variation: SceneVariation = DEFAULT_VARIATION,
    mixed: bool = False,
    calibration_error: bool = True,
    printed: bool = True,
    capture_format: CaptureFormat = "folder",
    threads: int = 1,
    resume: bool = False,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Simulate a session like the paper's: per trial one capture with printed caps, one with the original ones.

    Args:
        out: Folder to write; it must not exist or be empty.
        rack: The rack of every trial.
        tubes: Tube types. Each gets its own trials, unless `mixed`.
        trials: Trials per tube type; in all, if `mixed`.
        seed: The same seed gives the same bytes. Trial k does not depend on the number of trials, its scene not on the
            sensor.
        cap: The printed cap.
        sensor: Name of a simulated sensor.
        resolution: Width and height of a scanner's square image, pixels.
        camera: Of the sensor ``stereo``, and of no other.
        frames: Frames of each capture, all of the same unmoved scene; more than one need the format ``mcap``.
        variation: Ranges that the scenes are drawn from. At least one slot is filled.
        mixed: Any of the types in each trial.
        calibration_error: Whether the camera has one.
        printed: Whether each trial has its capture with printed caps, without which there is the exact truth alone. The
            other capture, and the room that tubes leave for printed caps, do not depend on it.
        capture_format: How captures are stored.
        threads: How many to use; they change no byte. More than one mean more processes, see `in_processes`.
        resume: Keep finished captures beside `out` if the session ends early, and go on from there in the next call.
        progress: Called after each capture with the number done and the number in all that this call makes.

    Raises:
        CaptureError: `out` holds files already, or captures to go on from are of another run; a process died.
        ConfigError: An option is out of range.
        LabwareError: A tube cannot stand in the rack, or the rack does not fit into the view.
    """
    _check_out(out)
    _check_tubes(tubes)
    _check_numbers(trials=(trials, 1), seed=(seed, 0), resolution=(resolution, 32), threads=(threads, 1))
    _check_names(sensor, capture_format, frames)
    seen_by = _camera(sensor, camera, resolution, calibration_error)
    settings = _Settings(rack, tuple(tubes), cap, seen_by, sensor, variation, capture_format, seed, frames)
    drawn = [_draw(plan, settings, printed) for plan in _plans(tubes, trials, seed, mixed)]
    aside = out.with_name(f".{out.name}.part" if resume else f".{out.name}.part-{os.getpid()}")
    if not resume:
        shutil.rmtree(aside, ignore_errors=True)
    try:
        _begin(aside, f"{settings} {[trial.entry for trial in drawn]}")
        left = [shot for trial in drawn for shot in trial.shots if not (aside / shot.place).exists()]
        shoot = Shooting(aside, seen_by, sensor, capture_format, frames)
        in_processes(shoot, left, threads, lambda done: progress(done, len(left)) if progress is not None else None)
        _finish(aside, settings, drawn)
        if out.exists():
            out.rmdir()
        aside.rename(out)
    finally:
        if not resume:
            shutil.rmtree(aside, ignore_errors=True)


def _check_out(out: Path) -> None:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise CaptureError(f"{out}: there is something already; choose another place or remove it")


def _check_tubes(tubes: Sequence[TubeModel]) -> None:
    doubled = sorted({tube.name for tube in tubes if [t.name for t in tubes].count(tube.name) > 1})
    if not tubes or doubled:
        found = f"{', '.join(doubled)} twice" if doubled else "none"
        raise ConfigError(f"tubes: found {found}; expected one or more different tube types")


def _check_numbers(**least_of: tuple[int, int]) -> None:
    for name, (value, least) in least_of.items():
        if value < least:
            raise ConfigError(f"{name} is {value}; expected {least} or more")


def _check_names(sensor: str, capture_format: str, frames: int) -> None:
    if capture_format not in get_args(CaptureFormat):
        known = ", ".join(get_args(CaptureFormat))
        raise ConfigError(f"unknown capture format '{capture_format}'; known formats: {known}")
    if sensor not in SENSORS:
        raise ConfigError(f"unknown sensor '{sensor}'; known sensors: {', '.join(SENSORS)}")

    if frames > 1 and capture_format != "mcap":
        raise ConfigError(f"{frames} frames do not go into a {capture_format}, which holds one; choose the format mcap")
    if not 1 <= frames <= MAX_FRAMES:
        raise ConfigError(f"frames is {frames}; expected 1 to {MAX_FRAMES}")


def _camera(sensor: str, camera: StereoCamera | None, resolution: int, calibration_error: bool) -> Camera:
    if (sensor == "stereo") != (camera is not None):
        found = "none" if camera is None else camera.name
        raise ConfigError(f"a camera goes with the sensor stereo, and with no other; found {found} with {sensor}")
    scanner = default_camera(resolution)
    if calibration_error:
        return camera or scanner
    if camera is not None:
        return camera.exact()
    return dataclasses.replace(scanner, noise=dataclasses.replace(scanner.noise, calibration_error_m=0.0))


def _plans(tubes: Sequence[TubeModel], trials: int, seed: int, mixed: bool) -> Iterator[_Plan]:
    groups = [("mixed", tuple(tubes))] if mixed else [(tube.name, (tube,)) for tube in tubes]
    for group, (label, types) in enumerate(groups):
        for k in range(trials):
            seeds = np.random.SeedSequence(seed, spawn_key=(group, k)).spawn(3)
            yield _Plan(f"{label}-{k + 1:03d}", group * 100_000 + k, types, tuple(seeds))


def _draw(plan: _Plan, settings: _Settings, printed: bool) -> _Trial:
    """Draw the scene of one trial, which no sensor has a part in."""
    scene_seed, printed_seed, original_seed = plan.seeds
    rng = np.random.default_rng(scene_seed)
    camera = settings.camera
    far_m = camera.face_distance_m if isinstance(camera, StereoCamera) else DISTANCE_M
    scene = random_scene(settings.rack, plan.types, settings.cap, camera, rng, settings.variation, far_m)
    entry: dict[str, Any] = {
        "name": plan.name,
        "tubes": {tube.slot: _labware_name(tube.model) for tube in scene.tubes},
    }
    first_ns = _FIRST_STAMP_NS + settings.seed % 3650 * _SESSION_NS + plan.number * _TRIAL_NS
    suffix = ".mcap" if settings.capture_format == "mcap" else ""
    shots = []
    labels = (("printed", settings.cap, printed_seed), ("original", None, original_seed))
    for i, (label, cap, seed) in enumerate(labels):
        if label == "printed" and not printed:
            continue
        name = f"{plan.name}-{label}"
        entry[label] = f"captures/{name}{suffix}"
        dressed = dataclasses.replace(scene, printed_cap=cap)
        shots.append(Shot(name, entry[label], dressed, first_ns + i * _RECAP_NS, seed))
    entry["hint"] = _hint(scene, camera, rng)
    return _Trial(entry, scene, tuple(shots))


def _hint(scene: Scene, camera: Camera, rng: np.random.Generator) -> dict[str, Any]:
    """Where somebody would click on the first slot's opening."""
    slot = scene.rack.all_slots[0]
    height_m = scene.rack.height_m + float(scene.bow.height_m(scene.rack, slot.center_m))
    opening = scene.T_camera_rack @ np.array([*slot.center_m, height_m, 1.0])
    k = camera.intrinsics
    click = camera.intrinsics.project(opening[:3]) + rng.normal(0, CLICK_ERROR_PX * k.width / 1376, 2)
    return {"slot": slot.name, "pixel": [int(value) for value in np.rint(click)]}


def _begin(aside: Path, plan: str) -> None:
    """Make the folder aside, or take it over if it is this run's: same plan, same code of simulator and writers."""
    code = [tree_sha256(_PACKAGE / part) for part in ("simulation", "capture")]
    run = hashlib.sha256(f"{plan} {code}".encode()).hexdigest()
    note = aside / _RUN_FILE
    if aside.exists() and (not note.is_file() or note.read_text(encoding="utf-8") != run):
        raise CaptureError(
            f"{aside}: captures of an interrupted run with other options or another version; expected those of this "
            "run; repeat that run, or remove them"
        )
    aside.mkdir(parents=True, exist_ok=True)
    note.write_text(run, encoding="utf-8")


def _finish(aside: Path, settings: _Settings, drawn: Sequence[_Trial]) -> None:
    """Write what goes with the captures: labware, exact truth, session file."""
    items: tuple[Labware, ...] = (settings.rack, settings.cap, *settings.tubes)
    for item in items:
        _write_labware(aside, item)
    for trial in drawn:
        write_exact_truth(aside, trial.entry["name"], trial.scene, trial.entry["tubes"])
    entries = [trial.entry for trial in drawn]
    data = {
        "format": 1,
        # Not named after the folder: the same seed gives the same bytes anywhere.
        "name": _session_name(settings, entries),
        "origin": "simulated",
        "sensor": f"simulated-{settings.label}",
        "rack": _labware_name(settings.rack),
        "printed_cap": _labware_name(settings.cap),
        "trials": entries,
    }
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120)
    (aside / SESSION_FILE).write_text(text, encoding="utf-8")
    (aside / _RUN_FILE).unlink()


def _labware_name(item: Labware) -> str:
    """Name of labware in the session: its catalogue name, or the file that it is written to."""
    return item.name if catalogue().get(item.name) == item else f"labware/{item.name}.yaml"


def _write_labware(folder: Path, item: Labware) -> None:
    name = _labware_name(item)
    if name != item.name:
        (folder / name).parent.mkdir(exist_ok=True)
        data = {"kind": item.kind} | item.model_dump(mode="json", exclude_defaults=True)
        (folder / name).write_text(yaml.safe_dump(data, sort_keys=False, allow_unicode=True), encoding="utf-8")


def _session_name(settings: _Settings, entries: list[dict[str, Any]]) -> str:
    """Name that tells sessions apart: sensor, rack and seed, and a digest of all that decides what is captured."""
    several = f" {settings.n_frames}" if settings.n_frames > 1 else ""
    content = f"{settings.camera} {settings.cap.name} {settings.variation} {entries}{several}"
    digest = hashlib.sha256(content.encode()).hexdigest()[:8]
    return f"{settings.label}-{settings.rack.name}-seed{settings.seed}-{digest}"
