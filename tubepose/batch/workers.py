"""Local processes that share a batch: each does one frame at a time, and one that is lost is replaced.

A process that is killed, runs out of memory or takes too long costs the frame that it was at. Signals to the group do
not reach the processes; they end with this one, however it ends.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from typing import Any

from tubepose.batch.performing import frame_words
from tubepose.batch.schedule import Schedule
from tubepose.batch.tasks import Ended, Outcome, Setup, Task
from tubepose.batch.worker_process import Compiling, Loaded, Ready, Unwritable, serve
from tubepose.compiled import tell_compiling
from tubepose.errors import CaptureError, OutputError

_START_SECONDS = 300.0
_MOST_FAILED_STARTS = 3


@dataclass(frozen=True, slots=True)
class Limits:
    """How many processes, and how long one may take.

    Attributes:
        count: Processes.
        frame_s: Seconds for a frame, from when the one before it was loaded.
    """

    count: int
    frame_s: float


@dataclass(slots=True, eq=False)
class _Worker:
    """A process and what it is at."""

    process: SpawnProcess
    connection: Connection
    since: float
    ready: bool = False
    loaded: int = -1
    task: Task | None = None
    last: int | None = None

    def end(self) -> None:
        self.process.kill()
        self.process.join()
        self.connection.close()


@dataclass(slots=True, eq=False)
class _Pool:
    schedule: Schedule
    setup: Setup
    limits: Limits
    workers: list[_Worker] = field(default_factory=list)
    failed_starts: int = 0

    def hand_out(self) -> None:
        """Give every free process a frame, and start more of them where frames are left."""
        for worker in self.workers:
            if worker.ready and worker.task is None:
                self._give(worker, self.schedule.take(worker.last))
        while len(self.workers) < self.limits.count and (task := self.schedule.take()) is not None:
            self._start().task = task

    def _give(self, worker: _Worker, task: Task | None) -> None:
        worker.task = task
        if task is None:
            return
        worker.since, worker.last, worker.loaded = time.monotonic(), task.number, -1
        with suppress(OSError):  # it is gone, which shows when it is waited for
            worker.connection.send(task)

    def _start(self) -> _Worker:
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=serve, args=(theirs, self.setup, self.schedule.store.writer), daemon=True)
        with _signals_held():
            process.start()
        theirs.close()
        worker = _Worker(process, ours, time.monotonic())
        self.workers.append(worker)
        return worker

    def wait(self) -> None:
        """Take in what the processes say; replace those that are lost."""
        now = time.monotonic()
        left = [self._limit(worker) - (now - worker.since) for worker in self.workers if worker.task is not None]
        ready = wait([worker.connection for worker in self.workers], timeout=max(0.0, min(left, default=1.0)))
        for worker in [worker for worker in self.workers if worker.connection in ready]:
            try:
                self._hear(worker, worker.connection.recv())
            except (EOFError, OSError):
                worker.process.join()
                self._lose(worker, _death(worker.process.exitcode))
        for worker in list(self.workers):
            if worker.task is not None and time.monotonic() - worker.since > self._limit(worker):
                self._lose(worker, f"took longer than {self._limit(worker):g} s (--timeout)")

    def _limit(self, worker: _Worker) -> float:
        return self.limits.frame_s if worker.ready else max(_START_SECONDS, self.limits.frame_s)

    def _hear(self, worker: _Worker, said: Any) -> None:
        task = worker.task
        if isinstance(said, Ready):
            worker.ready, self.failed_starts = True, 0
            self._give(worker, task)
        elif isinstance(said, Loaded):
            worker.since, worker.loaded = time.monotonic(), said.position
        elif isinstance(said, Compiling):
            worker.since = time.monotonic()
            tell_compiling()
        elif isinstance(said, Unwritable):
            raise OutputError(said.why)
        elif task is not None:
            worker.task = None
            self.schedule.finish(task, said)

    def _lose(self, worker: _Worker, why: str) -> None:
        """One line for the frame that a process was at."""
        worker.end()
        self.workers.remove(worker)
        task = worker.task
        if not worker.ready:
            self.failed_starts += 1
            if self.failed_starts == _MOST_FAILED_STARTS:
                raise CaptureError(f"no process of --jobs starts: each {why}; --jobs 1 does all in one")
        if task is None:
            return
        if self.schedule.store.read(task.key) is not None:  # it was lost after its frame
            self.schedule.revive(task)
            return
        loaded = worker.loaded == task.position
        line = f"{frame_words(self.setup.jobs[task.number], task.position)}: its process {why}; it is left out"
        if not loaded:
            line += ", and what comes after it in its capture"
        self.schedule.finish(task, Outcome(Ended.FAILED if loaded else Ended.CAPTURE_FAILED, line))

    def end(self) -> None:
        """End all processes; a frame whose record is there counts."""
        for worker in self.workers:
            worker.end()
            if worker.task is not None and self.schedule.store.read(worker.task.key) is not None:
                self.schedule.revive(worker.task)


def run_workers(schedule: Schedule, setup: Setup, limits: Limits, *, fail_fast: bool = False) -> None:
    """Do all that a schedule hands out by several processes.

    Raises:
        CaptureError: The first problem, with `fail_fast`; or no process starts.
        OutputError: Results cannot be written.
        KeyboardInterrupt: The user stopped the run.
    """
    pool = _Pool(schedule, setup, limits)
    try:
        pool.hand_out()
        while any(worker.task is not None for worker in pool.workers):
            pool.wait()
            if fail_fast and schedule.has_problems:
                raise CaptureError(schedule.problems[0])
            pool.hand_out()
    finally:
        pool.end()


def _death(code: int | None) -> str:
    if code is None or code >= 0:
        return f"ended by itself (status {code})"
    name = next((one.name for one in signal.Signals if one == -code), f"signal {-code}")
    hint = ", as a system does that is out of memory" if -code == signal.SIGKILL else ""
    return f"was killed ({name}{hint})"


@contextmanager
def _signals_held() -> Iterator[None]:
    """Processes that are started inside do not get signals that are meant for the batch; see `worker_process`."""
    if os.name != "posix":
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT, signal.SIGHUP, signal.SIGTERM))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
