"""The few sums that compiled loops share, and the word before they are compiled."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tubepose.compiled import mean_square, median, put_in_order, solved

NUMBERS = st.lists(st.floats(-1e6, 1e6, width=32), min_size=1, max_size=60)
COMPILES = (
    "import numpy as np\n"
    "from tubepose.compiled import before_compiling, put_in_order, median\n"
    "before_compiling(lambda: print('told'))\n"
    "put_in_order(np.ones(3))\n"
    "print('sorted')\n"
    "median(np.ones(3))\n"
)


@given(NUMBERS)
def test_numbers_are_put_in_order(numbers: list[float]) -> None:
    values = np.array(numbers)
    put_in_order(values)
    np.testing.assert_array_equal(values, np.sort(numbers))


@given(NUMBERS)
def test_the_median_is_that_of_numpy(numbers: list[float]) -> None:
    assert median(np.array(numbers)) == np.median(numbers)


@given(NUMBERS, st.floats(-10, 10))
def test_the_mean_square_leaves_out_what_is_not_known(numbers: list[float], center: float) -> None:
    values = np.concatenate([[np.nan], numbers, [np.nan]])
    square, mean = mean_square(values, center)
    assert square == pytest.approx(np.mean((np.array(numbers) - center) ** 2), rel=1e-9, abs=1e-9)
    assert mean == pytest.approx(np.mean(numbers), rel=1e-9, abs=1e-6)


def test_a_small_system_is_solved_and_left_as_it_was() -> None:
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, 5))
    matrix, right = root @ root.T + np.eye(5), rng.normal(size=5)
    before = matrix.copy()
    np.testing.assert_allclose(solved(matrix, right), np.linalg.solve(matrix, right), rtol=1e-9)
    np.testing.assert_array_equal(matrix, before)


def test_who_waits_for_the_compiler_is_told_once_and_once_on_a_machine(tmp_path: Path) -> None:
    def words() -> list[str]:
        done = subprocess.run(
            [sys.executable, "-c", COMPILES], env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True, text=True, check=True,
        )  # fmt: skip
        return done.stdout.split()

    assert words() == ["told", "sorted"]
    assert words() == ["sorted"]
