"""From what was typed to what is run: captures, sessions, racks, tubes, detectors."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tubepose.batch import DetectorFactory, Job, UnnamedJob
    from tubepose.capture.fusion import Average
    from tubepose.config import Config
    from tubepose.labware import TubeModel
    from tubepose_cli.hints import HintChoice
    from tubepose_cli.racks import RackChoice

SAMPLE = "sample"
DETECTORS = {"geometric": (), "yolo": ("--model", "--classes", "--layout"), "recorded": ("--boxes", "--classes")}
"""Sources of boxes by name, and the options that each of them reads."""


def sample_session() -> Path:
    """Folder of the bundled (simulated) sample session."""
    from importlib.resources import files

    from tubepose.errors import CaptureError

    folder = Path(str(files("tubepose"))) / SAMPLE
    if not (folder / "session.yaml").is_file():
        raise CaptureError(f"{folder}: the bundled sample is missing; give a session folder")
    return folder


def read_tubes(names: str) -> tuple[TubeModel, ...]:
    """Tube models of a comma-separated list of names and files."""
    from tubepose.errors import ConfigError
    from tubepose.labware import load_tube, unique_tubes

    tubes = [name.strip() for name in names.split(",") if name.strip()]
    if not tubes:
        raise ConfigError(f"--tubes '{names}' names no tube; see 'tubepose labware list'")
    return unique_tubes([load_tube(name) for name in tubes], "--tubes")


def read_methods(names: str) -> tuple[str, ...]:
    """Methods of a comma-separated list."""
    from tubepose.errors import ConfigError
    from tubepose.methods import METHODS, require_methods

    methods = tuple(dict.fromkeys(name.strip() for name in names.split(",") if name.strip()))
    unknown = [name for name in methods if name not in METHODS]
    if unknown:
        raise ConfigError(unknown_name("method", unknown[0], METHODS))
    if not methods:
        raise ConfigError(f"no method is named; expected one or more of {', '.join(METHODS)}")
    require_methods(methods)
    return methods


def unknown_name(kind: str, name: str, known: Iterable[str]) -> str:
    """What to say of a name that is not known: the nearest one, and all."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    guess = f"; did you mean '{close[0]}'?" if close else ""
    return f"unknown {kind} '{name}'{guess}; known: {', '.join(known)}"


def no_such_file(path: Path) -> str:
    """What to say of a path that is not there."""
    return f"{path}: no such file or folder"


def find_sessions(paths: Sequence[Path], *, fail_fast: bool = False) -> tuple[list[Path], list[str]]:
    """Session folders at or below the given paths, and one line per path that has none."""
    from tubepose.capture.session import is_session
    from tubepose.errors import CaptureError

    sessions: list[Path] = []
    problems: list[str] = []
    for path in paths:
        folder = path.parent if path.name == "session.yaml" else path
        found = [folder] if is_session(folder) else sessions_below(folder)
        sessions += found
        if not path.exists():
            problems.append(f"{no_such_file(path)}; expected a session folder")
        elif not found:
            problems.append(f"{path}: no session.yaml there or one folder below; see docs/capture-format.md")
        if problems and fail_fast:
            raise CaptureError(problems[0])
    return sessions, problems


def sessions_below(path: Path) -> list[Path]:
    """Sessions one folder below a folder that is none itself."""
    from tubepose.capture.session import SESSION_FILE, is_session

    return [] if is_session(path) else sorted(found.parent for found in path.glob(f"*/{SESSION_FILE}"))


def capture_jobs(
    path: Path,
    choice: RackChoice,
    tubes: tuple[TubeModel, ...],
    config: Config,
    *,
    unit: str | None = None,
    depth_scale_m: float | None = None,
    max_stamp_difference_ms: float | None = None,
    hints: HintChoice | None = None,
    topics: Mapping[str, str | None] | None = None,
    average: Average = 1,
    allow_outside: bool = False,
    fail_fast: bool = False,
) -> tuple[list[Job | UnnamedJob], list[str]]:
    """Jobs of one typed path (a session's trials, or the captures found there), and what could not be opened.

    `choice` and `tubes` win over what a session says.
    """
    from tubepose.batch import Job, UnnamedJob, session_jobs
    from tubepose.capture.session import SESSION_FILE, is_session, load_session
    from tubepose.capture.source import open_captures
    from tubepose.errors import CaptureError, ConfigError
    from tubepose_cli.racks import rack_finder

    if path.name == SESSION_FILE or (path.is_dir() and is_session(path)):
        given: dict[str, object] = {"--unit": unit, "--depth-scale": depth_scale_m}
        given["--max-stamp-difference"] = max_stamp_difference_ms
        given |= {f"--{kind}-topic": name for kind, name in (topics or {}).items()}
        idle = [option for option, value in given.items() if value is not None] + (hints.options if hints else [])
        if idle:
            raise ConfigError(
                f"{path}: {', '.join(idle)} given, but a session says that itself: unit, depth_scale_m, "
                "max_stamp_difference_ms, topics, and a trial's hint; leave it out, or give the captures one by one"
            )
        known, problems = session_jobs(
            load_session(path, average).model_copy(update={"allow_outside": allow_outside}), fail_fast=fail_fast
        )
        if choice.open:
            find = rack_finder(choice, config)
            return [
                UnnamedJob(
                    job.capture, find, tubes or job.tubes, job.hint, job.session, job.trial, previous=job.previous
                )
                for job in known
            ], problems
        return [replace(job, rack=choice.rack or job.rack, tubes=tubes or job.tubes) for job in known], problems
    if not path.exists():
        raise CaptureError(no_such_file(path))
    topic = {f"{kind}_topic": name for kind, name in (topics or {}).items()}
    opened = open_captures(
        path,
        unit=unit,
        depth_scale_m=depth_scale_m,
        max_stamp_difference_ms=max_stamp_difference_ms,
        average=average,
        allow_outside=allow_outside,
        **topic,
    )
    told = [(capture, *(hints.of(capture.name) if hints else (None, False))) for capture in opened]
    if choice.rack is not None:
        rack = choice.rack
        return [Job(capture, rack, tubes, place, previous=previous) for capture, place, previous in told], []
    if not choice.open:
        raise ConfigError(
            f"{path}: not a session, so the rack must be named: --rack NAME|FILE|auto|grid "
            "(see 'tubepose labware list')"
        )
    find = rack_finder(choice, config)
    return [UnnamedJob(capture, find, tubes, place, previous=previous) for capture, place, previous in told], []


def refuse_twins(
    found: Sequence[Job | UnnamedJob], others: Sequence[Job | UnnamedJob]
) -> tuple[list[Job | UnnamedJob], list[str]]:
    """The jobs that differ from all before them by name, and one line per capture that does not.

    Rows are told apart by session, trial and capture, and pictures are named by them.
    """
    places = {(job.session, job.trial, job.capture.name): job.capture.path for job in others}
    kept, problems = [], []
    for job in found:
        key = (job.session, job.trial, job.capture.name)
        if key in places:
            same = places[key].resolve() == job.capture.path.resolve()
            problems.append(
                f"{job.capture.path}: given twice; its rows are there once"
                if same
                else f"{job.capture.path}: {places[key]} has the same name '{job.capture.name}', so the rows could not "
                "be told apart; give the folder above both, or rename one"
            )
            continue
        places[key] = job.capture.path
        kept.append(job)
    return kept, problems


def refuse_idle_topics(jobs: Sequence[Job | UnnamedJob], topics: Mapping[str, object]) -> None:
    """Topics and stamps are of recordings.

    Raises:
        ConfigError: One is given, and no capture is a recording.
    """
    from tubepose.capture.formats.containers import SUFFIXES, is_recording
    from tubepose.errors import ConfigError

    idle = [f"--{kind}{'' if '-' in kind else '-topic'}" for kind, name in topics.items() if name is not None]
    if idle and not any(is_recording(job.capture.path) for job in jobs):
        raise ConfigError(
            f"{', '.join(idle)} given, but no recording ({', '.join(SUFFIXES)}) is there that has topics; leave it out"
        )


def refuse_idle_scale(jobs: Sequence[Job | UnnamedJob], depth_scale_m: float | None) -> None:
    """A scale is of depth images.

    Raises:
        ConfigError: One is given, and every capture is a cloud in a file.
    """
    from tubepose.capture.formats.cloud_files import CLOUD_READERS
    from tubepose.errors import ConfigError

    if depth_scale_m is not None and all(job.capture.path.suffix.lower() in CLOUD_READERS for job in jobs):
        raise ConfigError("--depth-scale given, but no depth image is there; a cloud's unit is --unit; leave it out")


@dataclass(frozen=True, slots=True)
class DetectorChoice:
    """The source of boxes as it was typed; another process can have it, and make the detector from it.

    Attributes:
        name: In `DETECTORS`.
        model: ONNX file of ``yolo``; None is the bundled one.
        boxes: Of ``recorded``.
        classes: Names of the classes.
        layout: Of the model's output.
        config: All sections.
    """

    name: str
    model: Path | None
    boxes: Path | None
    classes: Path | None
    layout: str | None
    config: Config

    def factory(self) -> DetectorFactory:
        """Read its files and make it."""
        return make_detector(self.name, self.model, self.boxes, self.classes, self.layout, self.config)

    @property
    def files(self) -> tuple[Path, ...]:
        """What it depends on."""
        return tuple(p for p in (used_model(self.name, self.model), self.boxes, self.classes) if p is not None)


def used_model(detector: str, model: Path | None) -> Path | None:
    """The network that a run depends on: as given, or the bundled one of ``yolo``."""
    from tubepose.detection.bundled import bundled_model

    return bundled_model() if model is None and detector == "yolo" else model


def make_detector(
    name: str, model: Path | None, boxes: Path | None, classes: Path | None, layout: str | None, config: Config
) -> DetectorFactory:
    """Source of boxes by name; the files are read once, before the first capture."""
    from tubepose.errors import ConfigError

    given = {"--model": model, "--boxes": boxes, "--classes": classes, "--layout": layout}
    idle = [option for option, value in given.items() if value is not None and option not in DETECTORS.get(name, given)]
    if idle:
        raise ConfigError(f"{', '.join(idle)} given, but --detector {name} has no use for it; leave it out")
    if name == "geometric":
        from tubepose.detection.geometric import GeometricDetector

        return lambda rack, tubes: GeometricDetector(rack, tubes, config)
    if name == "yolo":
        from tubepose.detection.assisted import AssistedDetector
        from tubepose.detection.bundled import bundled_model
        from tubepose.detection.geometric import GeometricDetector
        from tubepose.detection.label_formats import read_class_names
        from tubepose.detection.yolo import YoloDetector

        names = read_class_names(classes) if classes is not None else None
        yolo = YoloDetector(model or bundled_model(), classes=names, layout=layout, threads=1)  # as all that is timed
        return lambda rack, tubes: AssistedDetector(yolo, GeometricDetector(rack, tubes, config))
    if name == "recorded":
        if boxes is None:
            raise ConfigError("--detector recorded needs --boxes PATH (YOLO txt folder or file, or COCO json)")
        from tubepose.detection.recorded import RecordedDetector

        recorded = RecordedDetector(boxes, classes=classes)
        return lambda _rack, _tubes: recorded
    raise ConfigError(unknown_name("detector", name, DETECTORS))
