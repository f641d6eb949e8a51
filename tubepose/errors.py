"""Errors that a user can correct.

A `TubePoseError` always says three things in one line: what was found, what was expected, what to do.
The command line prints it and exits with 1; a batch records it and goes on with the next capture.
Bad data inside one frame is not an error but a status in the tables; a broken invariant is an ordinary exception.
"""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager


def one_line(text: str) -> str:
    """A text without breaks, and with escapes for characters that do not print."""
    line = " ".join(part.strip() for part in text.splitlines())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)


class TubePoseError(Exception):
    """Base of all errors that a user can correct.

    The text is one line whatever it quotes: a break and the white space around it become one space, and characters
    that do not print (a damaged file's) are written as escapes.
    """

    def __init__(self, text: str) -> None:
        super().__init__(one_line(text))


class LabwareError(TubePoseError):
    """A labware definition is missing, unknown or wrong."""


class CaptureError(TubePoseError):
    """A capture or session file is missing, cut, or not what it claims to be."""


class DetectorError(TubePoseError):
    """A detector model or a file of boxes cannot be used."""


class ConfigError(TubePoseError):
    """A configuration file or an option is wrong."""


class OutputError(ConfigError):
    """The folder of results cannot be written: no other capture would do better, so a batch ends with it."""


class StoppedError(TubePoseError):
    """A signal stopped a batch (Ctrl-C, SIGTERM, SIGHUP); what was done by then is kept.

    Attributes:
        number: Of the signal.
    """

    def __init__(self, text: str, number: int = signal.SIGINT) -> None:
        super().__init__(text)
        self.number = number


class Interrupt(KeyboardInterrupt):
    """A signal that asks the process to end.

    Attributes:
        number: Of the signal.
    """

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def is_interrupt(problem: BaseException | None) -> bool:
    """Whether an exception is Ctrl-C, or what compiled code makes of one."""
    return interrupt_number(problem) != 0


def interrupt_number(problem: BaseException | None) -> int:
    """The signal behind an exception, also where compiled code made another one of it; 0 where there is none."""
    if isinstance(problem, SystemError):
        return interrupt_number(problem.__cause__ or problem.__context__)
    if isinstance(problem, Interrupt):
        return problem.number
    return int(signal.SIGINT) if isinstance(problem, KeyboardInterrupt) else 0


def readable(name: str) -> str:
    """A file's name as tables and pictures have it: bytes that are no UTF-8 are written as escapes, as in Python."""
    return name.encode("utf-8", "surrogateescape").decode("utf-8", "backslashreplace")


@contextmanager
def kept(problems: list[str] | None, words: Callable[[TubePoseError], str] = str) -> Iterator[None]:
    """Where a batch goes on: an error inside is one more line of `problems`; it is raised if that is None."""
    try:
        yield
    except TubePoseError as problem:
        if problems is None:
            raise
        problems.append(words(problem))
