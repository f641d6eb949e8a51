"""What all tests share, and one small simulated session.

Property tests try the same examples in every run, so that a change is not failed for what another one left; none is
timed, as machines differ. `pytest --hypothesis-profile search` tries new ones.
"""

from __future__ import annotations

import os
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from commands import tubepose
from hypothesis import settings

settings.register_profile("same", deadline=None, derandomize=True)
settings.register_profile("search", deadline=None)
settings.load_profile("same")

os.environ["TUBEPOSE_JOBS"] = "1"  # unless a test asks for processes

LIGHT = ("test_structured_light.py", "test_simulation_sessions.py", "test_benchmark_surfaces.py")
"""Files that follow light through plastic, whose loops take a minute to compile; the first begins with those."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """The files of `LIGHT` before all others, those with the most tests first."""
    counts = Counter(item.path.name for item in items)

    def place(item: pytest.Item) -> tuple[int, int, str]:
        name = item.path.name
        return LIGHT.index(name) if name in LIGHT else len(LIGHT), -counts[name], name

    items.sort(key=place)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """One process runs all of `LIGHT`: it compiles what follows light, another what fits poses, and both use both."""
    from xdist.scheduler import LoadFileScheduling

    class LightTogether(LoadFileScheduling):  # type: ignore[misc]
        def _split_scope(self, nodeid: str) -> str:
            file = super()._split_scope(nodeid)
            return "light" if Path(file).name in LIGHT else file

    config.option.loadscopereorder = False  # in the order of the items
    return LightTogether(config, log)


SMALL_RACK = "round-10ml-3x4"
SMALL_TUBES = ("blood-16x100", "chen2023-tube-3")


@pytest.fixture(scope="session")
def small_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two trials in a rack with wide ribs, at about the coarsest resolution at which it and the caps are found."""
    out = tmp_path_factory.mktemp("small") / "session"
    ended = tubepose(
        "simulate", out, "--rack", SMALL_RACK, "--tubes", ",".join(SMALL_TUBES), "--trials", "1", "--seed", "9",
        "--resolution", "400", "--fill", "0.2", "--threads", "1",
    )  # fmt: skip
    assert (ended.code, ended.out) == (0, ""), ended.err
    return out
