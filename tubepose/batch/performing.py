"""Doing tasks: a capture is opened, its frame is loaded, asked and recorded; what goes wrong becomes one line."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from tubepose.batch.framing import FrameRunner, unnamed_rows
from tubepose.batch.jobs import Job, UnnamedJob
from tubepose.batch.tasks import Ended, FrameRecord, KnownTurn, NamedRack, Outcome, Setup, Task
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.hints import TurnHint
from tubepose.errors import CaptureError, Interrupt, OutputError, TubePoseError, interrupt_number, one_line, readable
from tubepose.rack import RackPose, RackStatus
from tubepose.rack.turns import EarlierTurns
from tubepose.result_folder import write_aside

Write = Callable[[str, FrameRecord], None]
"""Keeps a record under its key."""


@dataclass(slots=True)
class _Open:
    """A capture that is being read, and how many of its frames were taken."""

    number: int
    frames: Iterator[RgbdFrame]
    taken: int = 0


@dataclass(slots=True)
class Performer:
    """Does tasks one after the other in this process.

    Attributes:
        setup: What is needed for them.
        write: Keeps records.
        on_loaded: Called with a task's position and a frame's each time one was loaded on the way to it (a sign of
            life).
    """

    setup: Setup
    write: Write
    on_loaded: Callable[[int], None] | None = None
    _runner: FrameRunner | None = None
    _open: _Open | None = None
    _loaded: bool = field(default=False)

    def do(self, task: Task) -> Outcome:
        """Do a task and keep its record.

        Raises:
            OutputError: The record or the picture cannot be written.
            KeyboardInterrupt: The user stopped the run, in compiled code or not.
        """
        self._loaded = False
        try:
            return self._do(task)
        except OutputError:
            raise
        except TubePoseError as problem:
            return Outcome(Ended.CAPTURE_FAILED, _one_line(self.setup.jobs[task.number], problem))
        except MemoryError:
            return Outcome(self._lost, f"{self._where(task)}: out of memory; it is left out")
        except (KeyboardInterrupt, SystemError) as problem:
            if number := interrupt_number(problem):
                raise Interrupt(number) from problem
            return self._bug(task, problem)
        except Exception as problem:  # noqa: BLE001 - a bug of ours costs one frame
            return self._bug(task, problem)

    @property
    def _lost(self) -> Ended:
        """A generator that has failed gives no more frames."""
        return Ended.FAILED if self._loaded else Ended.CAPTURE_FAILED

    def _where(self, task: Task) -> str:
        return frame_words(self.setup.jobs[task.number], task.position)

    def _bug(self, task: Task, problem: BaseException) -> Outcome:
        folder = self.setup.tracebacks
        if folder is None:
            raise problem
        path = folder / f"{task.key}.txt"
        with write_aside(path) as aside:
            text = "".join(traceback.format_exception(problem))
            aside.write_text(f"{self._where(task)}\n{text}", encoding="utf-8", errors="backslashreplace")
        at = traceback.extract_tb(problem.__traceback__)[-1]
        line = f"internal error {type(problem).__name__} in {Path(at.filename).name}, line {at.lineno}"
        return Outcome(self._lost, f"{self._where(task)}: {line}; please report it with {path}")

    def _do(self, task: Task) -> Outcome:
        frame, load_ms = self._load(task)
        if frame is None:
            return Outcome(Ended.NO_FRAME)
        self._loaded = True
        if frame.timestamp_ns is not None and not 0 <= frame.timestamp_ns < 2**63:
            raise CaptureError(f"its stamp {frame.timestamp_ns} ns is no time; expected 0 to 2^63 - 1 nanoseconds")
        job, named = self.setup.jobs[task.number], task.named
        if isinstance(job, UnnamedJob):
            if named is None:
                pose = job.find_rack(frame)
                if pose.rack is None or pose.T_camera_rack is None:
                    return self._keep(task, Outcome(Ended.DONE, reason=pose.reason), job, frame, pose)
                named = NamedRack(pose.rack, pose.named_by_nats)
            job = Job(
                job.capture, named.rack, job.tubes, job.hint, job.session, job.trial, None, named.nats, job.previous
            )
        _check_hint(job)
        return self._answer(task, job, named, frame, load_ms)

    def _keep(self, task: Task, outcome: Outcome, job: UnnamedJob, frame: RgbdFrame, pose: RackPose) -> Outcome:
        self.write(task.key, FrameRecord(outcome, unnamed_rows(job, frame, pose, self.setup.asked.methods)))
        return outcome

    def _answer(self, task: Task, job: Job, named: NamedRack | None, frame: RgbdFrame, load_ms: float) -> Outcome:
        if self._runner is None:
            self._runner = FrameRunner(self.setup.asked, self.setup.make_detector())
        answer = self._runner.answer(job, frame, self._hint(task, job), load_ms)
        if self.setup.on_scene is not None:
            self.setup.on_scene(task.number, job, answer.shown, answer.estimates)
        pose, turn = answer.rack_pose, None
        if pose.T_camera_rack is not None and not pose.ambiguous:
            turn = KnownTurn(job.rack.name, tuple(map(float, pose.T_camera_rack.ravel())))
        outcome = Outcome(Ended.DONE, named=named, turn=turn)
        if pose.status is RackStatus.UNIT:
            outcome = replace(outcome, problem=_one_line(job, CaptureError(pose.reason)))
        self.write(task.key, FrameRecord(outcome, answer.tables))
        return outcome

    def _hint(self, task: Task, job: Job) -> TurnHint | None:
        if not job.previous:
            return job.hint
        known, used = task.earlier.known, [job.hint] if task.earlier.place_used and job.hint is not None else []
        last = {} if known is None else {job.session: (known.rack, np.reshape(known.pose, (4, 4)))}
        return EarlierTurns(last, used).hint(job.session, job.rack, job.hint, self.setup.asked.config.rack)

    def _load(self, task: Task) -> tuple[RgbdFrame | None, float]:
        """The frame of a task, None where the capture ends before it, and the milliseconds of loading."""
        if self._open is None or self._open.number != task.number or self._open.taken > task.position:
            self._open = _Open(task.number, self.setup.jobs[task.number].capture.frames())
        opened = self._open
        while True:
            start = time.perf_counter_ns()
            try:
                frame = next(opened.frames, None)
            except BaseException:
                self._open = None
                raise
            opened.taken += 1
            if frame is None or opened.taken > task.position:
                if self.on_loaded is not None:
                    self.on_loaded(task.position)
                return frame, (time.perf_counter_ns() - start) / 1e6
            if self.on_loaded is not None:
                self.on_loaded(opened.taken - 1)


def frame_words(job: Job | UnnamedJob, position: int) -> str:
    """A frame as problems name it."""
    return one_line(readable(f"{job.capture.path}, frame {position}"))


def _one_line(job: Job | UnnamedJob, problem: TubePoseError) -> str:
    text = str(problem)
    return text if str(job.capture.path) in text else f"{job.capture.name}: {text}"


def _check_hint(job: Job) -> None:
    if job.hint is not None and not job.rack.has_slot(job.hint.slot):
        raise CaptureError(
            f"{job.capture.path}: the hint speaks of slot {job.hint.slot}, and rack {job.rack.name} has none of that "
            f"name; {job.rack.slot_words}"
        )
