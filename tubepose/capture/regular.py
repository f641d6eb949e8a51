"""Files that are files: a pipe would be waited for for ever, and a device has no end."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from tubepose.errors import CaptureError, TubePoseError

_KINDS = (
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISDIR, "a folder"),
)


def irregular_words(path: Path) -> str:
    """What a path is that is no regular file, in words; empty where it is one, or where nothing is there."""
    try:
        mode = path.stat().st_mode
    except OSError:
        return "" if not path.is_symlink() else "a link that leads nowhere"
    return next((words for is_kind, words in _KINDS if is_kind(mode)), "")


def require_regular(path: Path, error: type[TubePoseError]) -> None:
    """Raise `error` in one line for a pipe, a device, a socket or a folder."""
    if words := irregular_words(path):
        raise error(f"{path}: {words}; expected a file")


def leaves(relative: str) -> bool:
    """Whether a path that a file names leads out of the folder of that file; links that a person made do not count."""
    return os.path.isabs(relative) or os.path.normpath(relative).split(os.sep, 1)[0] == os.pardir


def require_inside(folder: Path, relative: str, what: str) -> None:
    """Refuse a path that leads out of a folder: who wrote it may not be who runs it.

    Raises:
        CaptureError: It does.
    """
    if leaves(relative):
        raise CaptureError(
            f"{folder}: {what} '{relative}' leads out of the folder; move the file into it, or give --allow-outside if "
            "you trust who wrote that"
        )
