"""Running the real command in this process: what it wrote to which stream, and how it ended."""

from __future__ import annotations

import os
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

from tubepose_cli import main


@dataclass(frozen=True)
class Ended:
    """How a command ended.

    Attributes:
        code: Exit status.
        out: Everything on standard output, libraries written in C++ included.
        err: Everything on standard error.
    """

    code: int
    out: str
    err: str

    @property
    def errors(self) -> list[str]:
        """The lines on standard error that report an error."""
        return [line for line in self.err.splitlines() if line.startswith("error: ")]


def tubepose(*arguments: str | Path) -> Ended:
    """Run `tubepose ARGUMENTS` as the installed script does; an exception that it lets out fails the test."""
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as err:
        kept = {1: os.dup(1), 2: os.dup(2)}
        try:
            os.dup2(out.fileno(), 1)
            os.dup2(err.fileno(), 2)
            with (
                patch.object(sys, "stdout", out),
                patch.object(sys, "stderr", err),
                patch.object(sys, "argv", ["tubepose", *map(str, arguments)]),
            ):
                code = _exit_status()
                out.flush()
                err.flush()
        finally:
            for number, copy in kept.items():
                os.dup2(copy, number)
                os.close(copy)
        out.seek(0)
        err.seek(0)
        return Ended(code, out.read(), err.read())


def _exit_status() -> int:
    try:
        main.run()
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    return 0
