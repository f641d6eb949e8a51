"""How loops are compiled, and the one small solver that they share."""

from __future__ import annotations

from numba import njit

compiled = njit(cache=True, error_model="numpy")
"""The machine code is kept; a division by zero is infinity, as in NumPy."""


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
