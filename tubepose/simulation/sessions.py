"""Simulated sessions: folders like recorded ones, with exact truth beside them."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Protocol, get_args

import numpy as np
import yaml

from tubepose.capture.frame import RgbdFrame
from tubepose.capture.mcap_writing import write_mcap
from tubepose.capture.session import SESSION_FILE
from tubepose.capture.writing import write_folder_capture
from tubepose.errors import CaptureError, ConfigError
from tubepose.labware import CapModel, Labware, RackModel, TubeModel, catalogue
from tubepose.simulation import placement, raycast
from tubepose.simulation.camera import StructuredLightCamera, default_camera
from tubepose.simulation.scene import Scene
from tubepose.simulation.truth import write_exact_truth

CaptureFormat = Literal["folder", "mcap"]
CLICK_ERROR_PX = 3.0
# Stamps count from a fixed moment, so that they depend on the seed and the trial alone.
_FIRST_STAMP_NS = 1_700_000_000_123_456_789
_TRIAL_NS = 60_000_000_000
_RECAP_NS = 25_000_000_000
_SESSION_NS = 86_400_000_000_000


class Sensor(Protocol):
    """A simulated sensor."""

    def __call__(self, scene: Scene, camera: StructuredLightCamera, rng: np.random.Generator) -> RgbdFrame:
        """Capture a scene."""
        ...


SENSORS: dict[str, Sensor] = {"raycast": raycast.render}


@dataclass(frozen=True, slots=True)
class _Plan:
    """One trial before it is simulated."""

    name: str
    number: int
    types: tuple[TubeModel, ...]
    seeds: tuple[np.random.SeedSequence, ...]


@dataclass(frozen=True, slots=True)
class _Settings:
    rack: RackModel
    cap: CapModel
    camera: StructuredLightCamera
    sensor: str
    fill: float | None
    capture_format: CaptureFormat
    seed: int
    names: dict[str, str]


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
    fill: float | None = None,
    mixed: bool = False,
    capture_format: CaptureFormat = "folder",
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Simulate a session like the paper's: per trial one capture with printed caps, one with the original ones.

    Args:
        out: Folder to write; it must not exist or be empty.
        rack: The rack of every trial.
        tubes: Tube types. Each gets its own trials, unless `mixed`.
        trials: Trials per tube type; in all, if `mixed`.
        seed: The same seed gives the same bytes; trial k does not depend on the number of trials.
        cap: The printed cap.
        sensor: Name of a simulated sensor.
        resolution: Width and height of the square image, pixels.
        fill: Share of the slots that hold a tube; None draws 0.1 to 0.4 per trial. At least one slot is filled.
        mixed: Any of the types in each trial.
        capture_format: How captures are stored.
        progress: Called after each capture with the number done and the number in all.

    Raises:
        CaptureError: `out` holds files already.
        ConfigError: An option is out of range.
        LabwareError: A tube cannot stand in the rack, or the rack does not fit into the view.
    """
    _check_out(out)
    _check_options(tubes, trials, seed, sensor, resolution, fill, capture_format)
    aside = out.with_name(f".{out.name}.part-{os.getpid()}")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir(parents=True)
    try:
        labware: tuple[Labware, ...] = (rack, cap, *tubes)
        names = {item.name: _name_labware(aside, item) for item in labware}
        settings = _Settings(rack, cap, default_camera(resolution), sensor, fill, capture_format, seed, names)
        plans = list(_plans(tubes, trials, seed, mixed))
        entries = []
        for done, plan in enumerate(plans):
            entries.append(_simulate_trial(aside, plan, settings, progress, 2 * done, 2 * len(plans)))
        # Not named after the folder: the same seed gives the same bytes anywhere.
        _write_session(aside, _session_name(settings, entries), settings, entries)
        if out.exists():
            out.rmdir()
        aside.rename(out)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _check_out(out: Path) -> None:
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise CaptureError(f"{out}: there is something already; choose another place or remove it")


def _check_options(
    tubes: Sequence[TubeModel],
    trials: int,
    seed: int,
    sensor: str,
    resolution: int,
    fill: float | None,
    capture_format: str,
) -> None:
    if capture_format not in get_args(CaptureFormat):
        known = ", ".join(get_args(CaptureFormat))
        raise ConfigError(f"unknown capture format '{capture_format}'; known formats: {known}")
    if sensor not in SENSORS:
        raise ConfigError(f"unknown sensor '{sensor}'; known sensors: {', '.join(SENSORS)}")
    if fill is not None and not 0 < fill <= 1:
        raise ConfigError(f"fill is {fill:g}; expected a share of the slots above 0 and up to 1")
    for name, value, least in (("trials", trials, 1), ("seed", seed, 0), ("resolution", resolution, 32)):
        if value < least:
            raise ConfigError(f"{name} is {value}; expected {least} or more")
    doubled = sorted({tube.name for tube in tubes if [t.name for t in tubes].count(tube.name) > 1})
    if not tubes or doubled:
        found = f"{', '.join(doubled)} twice" if doubled else "none"
        raise ConfigError(f"tubes: found {found}; expected one or more different tube types")


def _name_labware(folder: Path, item: Labware) -> str:
    """Name of labware in the session: its catalogue name, or the file that it is written to."""
    if catalogue().get(item.name) == item:
        return item.name
    path = Path("labware") / f"{item.name}.yaml"
    (folder / path).parent.mkdir(exist_ok=True)
    data = {"kind": item.kind} | item.model_dump(mode="json", exclude_defaults=True)
    (folder / path).write_text(yaml.safe_dump(data, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return path.as_posix()


def _plans(tubes: Sequence[TubeModel], trials: int, seed: int, mixed: bool) -> Iterator[_Plan]:
    groups = [("mixed", tuple(tubes))] if mixed else [(tube.name, (tube,)) for tube in tubes]
    for group, (label, types) in enumerate(groups):
        for k in range(trials):
            seeds = np.random.SeedSequence(seed, spawn_key=(group, k)).spawn(3)
            yield _Plan(f"{label}-{k + 1:03d}", group * 100_000 + k, types, tuple(seeds))


def make_scene(
    rack: RackModel,
    types: Sequence[TubeModel],
    cap: CapModel,
    camera: StructuredLightCamera,
    rng: np.random.Generator,
    fill: float | None = None,
) -> Scene:
    """Random scene with original caps; `fill` as in `simulate_session`."""
    share = float(rng.uniform(*placement.FILL)) if fill is None else fill
    count = max(1, round(share * len(rack.all_slots)))
    placed = placement.place_tubes(rack, types, count, cap, rng)
    tallest = rack.floor_m + max(max(model.height_m, cap.offset_m(model)) for model in types)
    T_camera_rack = placement.place_rack(rack, tallest, camera.intrinsics, rng)
    return Scene(rack, T_camera_rack, placed)


def _simulate_trial(
    folder: Path, plan: _Plan, settings: _Settings, progress: Callable[[int, int], None] | None, done: int, total: int
) -> dict[str, Any]:
    """Simulate and write both captures and the truth of one trial; returns its entry of the session file."""
    scene_rng, printed_rng, original_rng = (np.random.default_rng(seed) for seed in plan.seeds)
    scene = make_scene(settings.rack, plan.types, settings.cap, settings.camera, scene_rng, settings.fill)
    names = {tube.slot: settings.names[tube.model.name] for tube in scene.tubes}
    entry: dict[str, Any] = {"name": plan.name, "tubes": names}
    shots = (("printed", settings.cap, printed_rng), ("original", None, original_rng))
    first_ns = _FIRST_STAMP_NS + settings.seed % 3650 * _SESSION_NS + plan.number * _TRIAL_NS
    for i, (label, cap, rng) in enumerate(shots):
        frame = SENSORS[settings.sensor](dataclasses.replace(scene, printed_cap=cap), settings.camera, rng)
        frame = dataclasses.replace(
            frame,
            capture=f"{plan.name}-{label}",
            timestamp_ns=first_ns + i * _RECAP_NS,
            sensor=f"simulated-{settings.sensor}",
            simulated=True,
        )
        entry[label] = _write_capture(folder, frame, settings.capture_format)
        if progress is not None:
            progress(done + i + 1, total)
    entry["hint"] = _hint(scene, settings.camera, scene_rng)
    write_exact_truth(folder, plan.name, scene, names)
    return entry


def _write_capture(folder: Path, frame: RgbdFrame, capture_format: CaptureFormat) -> str:
    place = f"captures/{frame.capture}" + (".mcap" if capture_format == "mcap" else "")
    if capture_format == "mcap":
        write_mcap(folder / place, [frame], as_depth=True)
    else:
        write_folder_capture(folder / place, frame)
    return place


def _hint(scene: Scene, camera: StructuredLightCamera, rng: np.random.Generator) -> dict[str, Any]:
    """Where somebody would click on the first slot's opening."""
    slot = scene.rack.all_slots[0]
    opening = scene.T_camera_rack @ np.array([*slot.center_m, scene.rack.height_m, 1.0])
    k = camera.intrinsics
    click = camera.intrinsics.project(opening[:3]) + rng.normal(0, CLICK_ERROR_PX * k.width / 1376, 2)
    return {"slot": slot.name, "pixel": [int(value) for value in np.rint(click)]}


def _session_name(settings: _Settings, entries: list[dict[str, Any]]) -> str:
    """Name that tells sessions apart: sensor, rack and seed, and a digest of what stands where in every trial."""
    content = f"{settings.camera.intrinsics.width} {settings.cap.name} {entries}"
    digest = hashlib.sha256(content.encode()).hexdigest()[:8]
    return f"{settings.sensor}-{settings.rack.name}-seed{settings.seed}-{digest}"


def _write_session(folder: Path, name: str, settings: _Settings, entries: list[dict[str, Any]]) -> None:
    data = {
        "format": 1,
        "name": name,
        "origin": "simulated",
        "sensor": f"simulated-{settings.sensor}",
        "rack": settings.names[settings.rack.name],
        "printed_cap": settings.names[settings.cap.name],
        "trials": entries,
    }
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120)
    (folder / SESSION_FILE).write_text(text, encoding="utf-8")
