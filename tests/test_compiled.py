"""The few sums that compiled loops share, and the word before they are compiled."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tubepose import compiled as compiling
from tubepose.compiled import SOURCES, compiler, mean_square, median, put_in_order, solved

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


CALLER = "from kernels import kernel\nfrom callee import one\n\n@kernel\ndef g():\n    return one() + 1\n\nprint(g())\n"
KERNEL = (
    "from pathlib import Path\nfrom tubepose.compiled import compiler\n"
    "kernel = compiler(Path(__file__).parent.glob('call*.py'))\n"
)
CALLEE = "from kernels import kernel\n\n@kernel\ndef one():\n    return {}\n"


def test_code_of_a_kernel_that_calls_another_one_is_new_when_that_one_changes(tmp_path: Path) -> None:
    (tmp_path / "caller.py").write_text(CALLER)
    (tmp_path / "kernels.py").write_text(KERNEL)

    def run() -> str:
        command, kept = [sys.executable, "-B", "caller.py"], {"NUMBA_CACHE_DIR": str(tmp_path / "kept")}
        ended = subprocess.run(command, cwd=tmp_path, env=os.environ | kept, capture_output=True, text=True, check=True)
        return ended.stdout.strip()

    for value in (1, 1000):
        (tmp_path / "callee.py").write_text(CALLEE.format(value))
        assert run() == str(value + 1)
    assert len(list((tmp_path / "kept").iterdir())) == 3  # before, after, and those of the package


def test_where_nothing_can_be_written_code_is_compiled_and_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_args: object, **_options: object) -> None:
        raise PermissionError(13, "read-only")

    monkeypatch.setattr(Path, "mkdir", refuse)
    monkeypatch.setattr(compiling.Path, "expanduser", lambda _: (_ for _ in ()).throw(RuntimeError("no home")))
    double = compiler(SOURCES)(lambda x: 2 * x)
    assert double(3) == 6
    assert not double.stats.cache_path


def test_every_file_that_is_compiled_is_among_those_whose_change_is_seen() -> None:
    library = Path(compiling.__file__).parent
    users = {path for path in library.rglob("*.py") if "import compiled" in path.read_text()}
    assert users
    assert users <= {*SOURCES}
