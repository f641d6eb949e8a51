"""What a process of a batch does: it says that it is ready, takes a task, says how it ended, and takes the next."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing import parent_process
from multiprocessing.connection import Connection, wait

from tubepose.batch.tasks import FrameRecord, Setup
from tubepose.errors import OutputError


@dataclass(frozen=True, slots=True)
class Ready:
    """The process can take tasks."""


@dataclass(frozen=True, slots=True)
class Loaded:
    """A frame was loaded.

    Attributes:
        position: Of the frame.
    """

    position: int


@dataclass(frozen=True, slots=True)
class Compiling:
    """Code is compiled, which takes longer than a frame."""


@dataclass(frozen=True, slots=True)
class Unwritable:
    """Results cannot be written.

    Attributes:
        why: One line.
    """

    why: str


def serve(connection: Connection, setup: Setup, write: Callable[[str, FrameRecord], None]) -> None:
    """Do tasks until there are no more, on one thread.

    Args:
        connection: Tasks come by it; what is said of them goes back.
        setup: What is needed for them.
        write: Keeps records.
    """
    from tubepose.batch.performing import Performer
    from tubepose.compiled import before_compiling
    from tubepose.provenance import pinned_threads

    threading.Thread(target=_end_with_parent, daemon=True).start()
    before_compiling(lambda: connection.send(Compiling()))
    performer = Performer(setup, write, lambda position: connection.send(Loaded(position)))
    with pinned_threads(1):
        connection.send(Ready())
        while True:
            try:
                task = connection.recv()
            except EOFError:
                return
            try:
                connection.send(performer.do(task))
            except OutputError as problem:
                connection.send(Unwritable(str(problem)))


def _end_with_parent() -> None:
    """However the process ends that started this one, this one does too, also in the middle of a frame."""
    parent = parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM if os.name != "posix" else signal.SIGKILL)
