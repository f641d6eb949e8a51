"""Where results go, as the commands take it."""

from __future__ import annotations

from pathlib import Path

import typer


def named(path: str | Path) -> Path:
    """A path that says something; an unset variable of a shell is none, and would be the folder that one is in."""
    if not str(path).strip():
        raise typer.BadParameter("an empty name; is a variable not set? '.' is the folder you are in")
    return Path(path)
