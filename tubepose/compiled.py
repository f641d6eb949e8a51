"""How loops are compiled, and the few small sums that they share.

Every call of NumPy inside of a loop is compiled with it, anew for each shape: what is written out here takes a tenth of
that time.
"""

from __future__ import annotations

import hashlib
import math
import os
import tempfile
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

from numba import njit
from numba.core import config
from numba.core import event as events

_HERE = Path(__file__).parent
_FOLDER = "CACHE_DIR"


def compiler(sources: Iterable[Path], **options: Any) -> Callable[..., Any]:
    """A decorator that has Numba compile a function when it is first called; more options may be given to it.

    The machine code is kept between runs for as long as none of the sources changes: Numba itself does not see when a
    kernel changes that another one calls. Where no folder can be written, it is compiled in each run.

    Args:
        sources: All files of kernels that call each other.
        options: Of `numba.njit`.
    """
    folder = _machine_code(sources)

    def compile_(function: Callable[..., Any], **more: Any) -> Any:
        kept = getattr(config, _FOLDER)
        # Numba asks for the folder when a function is decorated.
        setattr(config, _FOLDER, kept if folder is None else str(folder))
        try:
            return njit(**options, **more, cache=folder is not None)(function)
        finally:
            setattr(config, _FOLDER, kept)

    return compile_


def _machine_code(sources: Iterable[Path]) -> Path | None:
    """Where the machine code of sources is kept; None if nothing can be written."""
    content = hashlib.sha256()
    for path in sorted(sources):
        content.update(path.read_bytes())
    for base in _bases():
        folder = base / f"kernels-{content.hexdigest()[:16]}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            tempfile.TemporaryFile(dir=folder).close()
        except OSError:
            continue
        return folder
    return None


def _bases() -> Iterator[Path]:
    """NUMBA_CACHE_DIR, beside the sources, the user's cache."""
    if asked := getattr(config, _FOLDER):
        yield Path(asked)
    yield _HERE / "__pycache__"
    with suppress(RuntimeError):  # a user without a home
        yield Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser()) / "tubepose"


SOURCES = (
    Path(__file__),
    *(path for part in ("profile", "rack", "sensor", "slots") for path in _HERE.glob(f"{part}/*kernels.py")),
)
"""The files of all loops over points."""
compiled = compiler(SOURCES, error_model="numpy")
"""For the loops over points; a division by zero is infinity, as in NumPy."""


class _Compilations(events.Listener):
    """Counts what this process compiles; machine code that was kept needs none."""

    def __init__(self) -> None:
        self.count = 0
        self.tell: Callable[[], object] | None = None

    def on_start(self, event: Any) -> None:  # noqa: ARG002
        self.count += 1
        self.say()

    def say(self) -> None:
        """Call what is to be told, once."""
        if self.tell is not None:
            tell, self.tell = self.tell, None
            tell()

    def on_end(self, event: Any) -> None:
        pass


_COMPILATIONS = _Compilations()
events.register("numba:compile", _COMPILATIONS)


def compilations() -> int:
    """How many loops this process has begun to compile."""
    return _COMPILATIONS.count


def before_compiling(tell: Callable[[], object]) -> None:
    """Call a function before this process next compiles a loop, once; machine code that was kept needs no compiling."""
    _COMPILATIONS.tell = tell


def tell_compiling() -> None:
    """Call what `before_compiling` was given: another process of the batch compiles."""
    _COMPILATIONS.say()


@compiled
def solved(matrix, right):
    """Solution (n,) of a small symmetric positive definite system, by Gaussian elimination."""
    a, b = matrix.copy(), right.copy()
    n = len(b)
    for i in range(n):
        for j in range(i + 1, n):
            factor = a[j, i] / a[i, i]
            for k in range(i, n):
                a[j, k] -= factor * a[i, k]
            b[j] -= factor * b[i]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]
    return b


@compiled
def put_in_order(values):
    """Sort numbers (N,) in place: Shell's sort."""
    gap = len(values) // 2
    while gap > 0:
        for i in range(gap, len(values)):
            value, k = values[i], i
            while k >= gap and values[k - gap] > value:
                values[k] = values[k - gap]
                k -= gap
            values[k] = value
        gap = gap // 2


@compiled
def median(values):
    """Median of numbers (N,), at least one, which it puts in order."""
    put_in_order(values)
    half = len(values) // 2
    return values[half] if len(values) % 2 else 0.5 * (values[half - 1] + values[half])


@compiled
def mean_square(values, center):
    """Mean squared distance of numbers (N,) from a center, and their mean; NaN are left out."""
    total, squares, count = 0.0, 0.0, 0
    for value in values:
        if not math.isnan(value):
            total += value
            squares += (value - center) ** 2
            count += 1
    return squares / count, total / count
