"""Signals that ask a batch to end: it stops in order, writes its tables, and exits as a shell expects."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP")


class Stopping:
    """What signals do: raise `Interrupt`, or while results are written be kept for later.

    Attributes:
        number: Of the first signal; 0 without any.
        held: Whether signals wait.
    """

    def __init__(self) -> None:
        self.number = 0
        self.held = False

    def __call__(self, number: int, _frame: FrameType | None) -> None:
        from tubepose.errors import Interrupt

        first, self.number = not self.number, self.number or number
        if first and not self.held:
            raise Interrupt(number)


@contextmanager
def stoppable() -> Iterator[Stopping]:
    """Signals raise `Interrupt` inside, the first of them; those that are ignored (nohup) stay so."""
    stopping, before = Stopping(), {}
    for name in _NAMES:
        number = getattr(signal, name, None)  # not all of them on Windows
        if number is not None and signal.getsignal(number) not in (signal.SIG_IGN, None):
            before[number] = signal.signal(number, stopping)
    try:
        yield stopping
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
