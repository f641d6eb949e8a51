"""What a batch is asked: captures with what is known about them, and the jobs of a session."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from tubepose.capture.frame import RgbdFrame
from tubepose.capture.hints import SlotHint
from tubepose.capture.regular import require_inside
from tubepose.capture.session import Session, Trial
from tubepose.capture.source import Capture, open_captures
from tubepose.detection import Detector
from tubepose.errors import CaptureError, kept
from tubepose.labware import RackModel, TubeModel
from tubepose.rack import RackPose
from tubepose.transforms import FloatArray

MOST_ASKED = 5
"""Frames that are asked for their rack: a search of a whole catalogue takes seconds."""
DetectorFactory = Callable[[RackModel, tuple[TubeModel, ...]], Detector]
RackFinder = Callable[[RgbdFrame], RackPose]
"""Finds out which rack stands in a frame: `RackPose.rack`, or the reason why none can be named."""


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """One capture and what is known about it.

    Attributes:
        capture: Where its frames come from.
        rack: The rack that stands in it.
        tubes: The kinds of tube that can stand in it.
        hint: Which way round the rack stands, if known; with `previous`, in the first frame whose turn is known.
        session: Name of its session, or empty.
        trial: Name of its trial, or empty.
        T_camera_rack: The rack's pose where it is known and not to be estimated, shape (4, 4), metres; else None.
        named_by_nats: By how much the rack was ahead of the catalogue's next one; NaN where a person named it.
        previous: Whether a rack that was left alone since an earlier frame of the session stands as it did there.
    """

    capture: Capture
    rack: RackModel
    tubes: tuple[TubeModel, ...]
    hint: SlotHint | None = None
    session: str = ""
    trial: str = ""
    T_camera_rack: FloatArray | None = None
    named_by_nats: float = float("nan")
    previous: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class UnnamedJob:
    """One capture in which a rack stands that no one named.

    Attributes:
        capture: Where its frames come from.
        find_rack: Asked frame by frame until it names a rack, which then is the whole capture's; `MOST_ASKED` times.
        tubes: The kinds of tube that can stand in it.
        hint: As `Job.hint`.
        session: Name of its session, or empty.
        trial: Name of its trial, or empty.
        previous: As `Job.previous`.
    """

    capture: Capture
    find_rack: RackFinder
    tubes: tuple[TubeModel, ...]
    hint: SlotHint | None = None
    session: str = ""
    trial: str = ""
    previous: bool = False


def session_jobs(session: Session, *, fail_fast: bool = False) -> tuple[list[Job], list[str]]:
    """One job per trial, on the capture with the original caps; and one line per trial whose capture is not there.

    Raises:
        CaptureError: A capture is not there, and `fail_fast` is set.
    """
    jobs: list[Job] = []
    problems: list[str] = []
    for trial in session.trials:
        with kept(None if fail_fast else problems):
            capture = trial_capture(session, trial, trial.original)
            tubes = session.tubes_of(trial)
            jobs.append(
                Job(capture, session.rack, tubes, trial.hint, session.name, trial.name, previous=trial.previous)
            )
    return jobs, problems


def trial_capture(session: Session, trial: Trial, relative: str) -> Capture:
    """The one capture that a trial names; by its path in the session where others of it have the same last name.

    Raises:
        CaptureError: It is not there, or it is a folder of several.
    """
    if not session.allow_outside:
        require_inside(session.folder, relative, f"trial {trial.name} names a capture that")
    if os.path.normpath(relative) in (os.curdir, ""):
        raise CaptureError(
            f"{session.folder}: trial {trial.name} names the session's own folder '{relative}'; name its capture in it"
        )
    place = session.folder / relative
    paths = {path for one in session.trials for path in (one.original, one.printed) if path is not None}
    whole = Path(relative).with_suffix("" if place.is_file() else Path(relative).suffix).as_posix()
    name = whole if sum(Path(path).stem == Path(relative).stem for path in paths) > 1 else None
    topics = {f"{kind}_topic": topic for kind, topic in session.topics.model_dump().items()}
    found = open_captures(
        place, name=name, unit=session.unit, depth_scale_m=session.depth_scale_m,
        max_stamp_difference_ms=session.max_stamp_difference_ms, average=session.average,
        allow_outside=session.allow_outside, **topics,
    )  # fmt: skip
    if len(found) != 1:
        raise CaptureError(f"{place}: trial {trial.name} needs one capture, found {len(found)}")
    return found[0]
