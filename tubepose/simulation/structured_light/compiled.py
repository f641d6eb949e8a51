"""How the kernels of the light transport are compiled."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from tubepose.compiled import compiler

# Not `fastmath`: sums keep their order, so that the same seed gives the same bytes. Without reference counts (`_nrt`)
# kernels cannot make arrays, and run six times as fast: a scene is many arrays. Threads run side by side (`nogil`).
kernel = compiler(Path(__file__).parent.glob("*.py"), nogil=True, error_model="numpy", _nrt=False)
"""Compiles a function when it is first called."""


def inlined(function: Callable[..., Any]) -> Any:
    """The same for small functions, which would spend their time on being called: a scene is many arrays."""
    return kernel(function, forceinline=True)
