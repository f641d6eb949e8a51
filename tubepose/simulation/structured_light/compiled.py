"""How the kernels of the light transport are compiled, and where their machine code is kept between runs."""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import config

_HERE = Path(__file__).parent
_FOLDER = "CACHE_DIR"
# Not `fastmath`: sums keep their order, so that the same seed gives the same bytes. Without reference counts (`_nrt`)
# kernels cannot make arrays, and run six times as fast: a scene is many arrays. Threads run side by side (`nogil`).
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "_nrt": False}


def _digest() -> str:
    """Of all sources here: Numba itself does not see when a kernel changes that another one calls."""
    content = hashlib.sha256()
    for path in sorted(_HERE.glob("*.py")):
        content.update(path.read_bytes())
    return content.hexdigest()[:16]


def cache_folder() -> Path | None:
    """Where machine code is kept: NUMBA_CACHE_DIR, beside the sources, or the user's cache; None if read-only."""
    name = f"kernels-{_digest()}"
    user = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tubepose"
    asked = getattr(config, _FOLDER)
    given = [Path(asked)] if asked else []
    for base in (*given, _HERE / "__pycache__", user):
        folder = base / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        return folder
    return None


_CACHE = cache_folder()


def _compile(function: Callable[..., Any], **more: Any) -> Any:
    kept = getattr(config, _FOLDER)
    # Numba asks for the folder when a function is decorated.
    setattr(config, _FOLDER, kept if _CACHE is None else str(_CACHE))
    try:
        return njit(**_OPTIONS, **more, cache=_CACHE is not None)(function)
    finally:
        setattr(config, _FOLDER, kept)


def kernel(function: Callable[..., Any]) -> Any:
    """A function compiled by Numba when it is first called."""
    return _compile(function)


def inlined(function: Callable[..., Any]) -> Any:
    """The same for small functions, which would spend their time on being called: a scene is many arrays."""
    return _compile(function, forceinline=True)
