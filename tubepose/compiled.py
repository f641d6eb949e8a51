"""How loops are compiled, and the few small sums that they share.

Every call of NumPy inside of a loop is compiled with it, anew for each shape: what is written out here takes a tenth of
that time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core import event as events

compiled = njit(cache=True, error_model="numpy")
"""The machine code is kept; a division by zero is infinity, as in NumPy."""


class _Compilations(events.Listener):
    """Counts what this process compiles; machine code that was kept needs none."""

    def __init__(self) -> None:
        self.count = 0
        self.tell: Callable[[], object] | None = None

    def on_start(self, event: Any) -> None:  # noqa: ARG002
        self.count += 1
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
