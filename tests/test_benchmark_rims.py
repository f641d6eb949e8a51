"""What the log odds of faint rims are fitted to: the regression, and the report on a session."""

from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest

from benchmarks import rims
from tubepose.capture.session import load_session
from tubepose.config import Config
from tubepose.profile import measure
from tubepose.profile.faint_rims import LIKELY, UNLIKELY, find_faint_rims


def test_the_regression_finds_the_weights_that_rings_were_drawn_by():
    rng = np.random.default_rng(3)
    facts = rng.uniform(size=(4_000, 3)) * [0.6, 0.4, 1.0]
    weights, less = np.array([8.0, 12.0, -3.0]), 4.0
    is_rim = rng.uniform(size=len(facts)) < 1 / (1 + np.exp(-(facts @ weights - less)))
    found, found_less = rims.fitted(facts, is_rim.astype(float))
    assert found == pytest.approx(weights, rel=0.2, abs=0.6)
    assert found_less == pytest.approx(less, abs=0.6)


def test_rings_of_a_session_are_told_apart_by_the_exact_poses(capsys):
    folder = Path(str(files("tubepose"))) / "sample"
    assert rims.main([str(folder)]) == 0
    report = capsys.readouterr().out
    assert f"in use: {LIKELY.tolist()} less {UNLIKELY:g}" in report
    assert measure.find_faint_rims is find_faint_rims  # nothing is left of the recording
    session = load_session(folder)
    rings = [ring for trial in session.trials for ring in rims.rings_of(session, trial, [], Config())]
    assert all(facts.shape == (3,) and np.isfinite(facts).all() for facts, _ in rings)
    assert not any(is_rim for trial in session.trials[1:] for _, is_rim in rims.rings_of(session, trial, [], Config()))
