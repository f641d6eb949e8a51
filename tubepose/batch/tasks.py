"""What is asked of a process, and what it answers: one frame of one capture at a time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

from tubepose.batch.jobs import DetectorFactory, Job, UnnamedJob
from tubepose.config import Config
from tubepose.labware import RackModel
from tubepose.result_tables import Tables
from tubepose.scene import Scene, TubeEstimate

OnScene = Callable[[int, Job, Scene, tuple[TubeEstimate, ...]], None]
"""Given a job's number, the job with its rack, and what was found in a frame."""


@dataclass(frozen=True, slots=True)
class Asked:
    """What is asked of every frame.

    Attributes:
        methods: Names in `methods.METHODS`.
        config: All sections.
        seeds: Seeds of a stochastic method: 0, 1, ...
        warm_up: Run the first frames of every set of types once more before, with their timings marked.
    """

    methods: tuple[str, ...]
    config: Config
    seeds: int = 1
    warm_up: bool = False


@dataclass(frozen=True, slots=True)
class NamedRack:
    """The rack that was found in a capture where no one named it, and by how much it was ahead of the next one."""

    rack: RackModel
    nats: float


@dataclass(frozen=True, slots=True)
class KnownTurn:
    """A rack whose turn was known: its name and its pose, (4, 4) row by row, metres."""

    rack: str
    pose: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Earlier:
    """What earlier frames of a session tell the next one about its rack's turn.

    Attributes:
        known: The last rack whose turn was known, if any.
        place_used: Whether the place of the job's hint has told a turn already.
    """

    known: KnownTurn | None = None
    place_used: bool = False


@dataclass(frozen=True, slots=True)
class Task:
    """One frame of one capture.

    Attributes:
        number: Of the job.
        position: Of the frame among those of the capture, from 0.
        key: Name of its record.
        named: The rack that an earlier frame named.
        earlier: What earlier frames of the session tell.
    """

    number: int
    position: int
    key: str
    named: NamedRack | None = None
    earlier: Earlier = Earlier()


class Ended(StrEnum):
    """How a task ended."""

    DONE = "done"
    NO_FRAME = "no_frame"
    FAILED = "failed"
    CAPTURE_FAILED = "capture_failed"


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a task ended.

    Attributes:
        ended: DONE: the frame has its record. NO_FRAME: the capture ended before it. FAILED: this frame is lost.
            CAPTURE_FAILED: this one and all after it.
        problem: One line where something failed.
        named: The rack that this frame named, or an earlier one.
        reason: Why no rack could be named in it.
        turn: The rack's turn, where it is known.
    """

    ended: Ended
    problem: str = ""
    named: NamedRack | None = None
    reason: str = ""
    turn: KnownTurn | None = None


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """A finished frame: its rows, and what later frames and the end of its capture need of it."""

    outcome: Outcome
    tables: Tables = field(default_factory=Tables)


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """What a process needs to do tasks; all of it can be sent to another process where its parts can.

    Attributes:
        jobs: All of the batch.
        asked: What is asked of every frame.
        make_detector: Makes the source of boxes; called once per process, before the first frame.
        on_scene: Called with each frame's result by one of the methods, ours if it is among them (overlays).
        tracebacks: Folder for tracebacks of unexpected exceptions; None lets those out.
    """

    jobs: tuple[Job | UnnamedJob, ...]
    asked: Asked
    make_detector: Callable[[], DetectorFactory]
    on_scene: OnScene | None = None
    tracebacks: Path | None = None
