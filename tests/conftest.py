"""What all tests share, and one small simulated session.

Property tests try the same examples in every run, so that a change is not failed for what another one left; none is
timed, as machines differ. `pytest --hypothesis-profile search` tries new ones.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from commands import tubepose
from hypothesis import settings

settings.register_profile("same", deadline=None, derandomize=True)
settings.register_profile("search", deadline=None)
settings.load_profile("same")

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
