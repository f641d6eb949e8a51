from __future__ import annotations

import json
import re
from io import StringIO
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pandas as pd
import pytest
from commands import tubepose
from hypothesis import given
from hypothesis import strategies as st

import tubepose as library
from tubepose.benchmark import read_run, write_baseline
from tubepose.errors import ConfigError
from tubepose.evaluation import ERROR_COLUMNS, gate_counts_alone, gate_pair, read_gates, sign_flip_p
from tubepose.evaluation.gate import LEAST_CAPTURES

ALL = read_gates("kept,wrong,error,coverage")
METHODS = ("m", "m")


def errors(seed: int = 0, captures: int = 40, tubes: int = 5, noise: int = 0) -> pd.DataFrame:
    """Rows of errors.csv of an honest method: an error of the capture, one of the tube, one of the noise draw."""
    rng = np.random.default_rng(seed)
    shared = np.repeat(np.abs(rng.normal(0.5, 0.1, captures)), tubes)
    own = np.abs(rng.normal(0.3, 0.1, captures * tubes))
    drawn = np.random.default_rng(1000 + noise)
    size = len(own)
    slots = ["A1", "A2", "A3", "A4", "A5"][:tubes] * captures
    table = pd.DataFrame({"trial": np.repeat([f"t{i}" for i in range(captures)], tubes), "slot": slots})
    ok = rng.random(size) < 0.95
    ok ^= drawn.random(size) < 0.01
    for name in ("tilt_deg", "cap_mm", "lateral_mm", "axial_mm"):
        table[name] = np.where(ok, shared + own + drawn.normal(0, 0.05, size), np.nan)
    table["mahalanobis2"] = np.where(ok, drawn.chisquare(5, size), np.nan)
    table["outcome"] = np.where(ok, "ok", "rejected")
    table["right"] = pd.Series(drawn.random(size) < 0.99, dtype="boolean").mask(~ok)
    table = table.assign(session="s", method="m", tube="t", seed=pd.array([pd.NA] * size, dtype="Int64"))
    return table.reindex(columns=list(ERROR_COLUMNS))


def failed(before: pd.DataFrame, after: pd.DataFrame) -> set[str]:
    return {gate.gate.split()[0] for gate in gate_pair(before, after, METHODS, ALL) if not gate.passed}


def drop(table: pd.DataFrame, share: float) -> pd.DataFrame:
    lost = np.random.default_rng(3).choice(table.index[table["outcome"] == "ok"], round(share * len(table)), False)
    after = table.copy()
    after.loc[lost, "outcome"] = "missed"
    after.loc[lost, ["tilt_deg", "cap_mm", "lateral_mm", "axial_mm", "mahalanobis2"]] = np.nan
    return after


def test_the_same_run_passes_every_gate() -> None:
    assert failed(errors(), errors()) == set()


def test_errors_a_twentieth_larger_are_caught() -> None:
    worse = errors()
    for name in ("tilt_deg", "cap_mm", "lateral_mm", "axial_mm"):
        worse[name] *= 1.05
    assert failed(errors(), worse) == {"error"}
    assert failed(worse, errors()) == set()


def test_the_digits_of_a_baseline_file_are_no_change() -> None:
    rounded = errors()
    for name in ("tilt_deg", "cap_mm", "lateral_mm", "axial_mm", "mahalanobis2"):
        rounded[name] *= 1 - 2e-6
    assert failed(rounded, errors()) == set()


def test_answering_less_is_caught_though_the_means_are_better() -> None:
    before = errors(captures=80)
    assert failed(before, drop(before, 0.02)) == {"kept"}
    hard = before.sort_values("cap_mm", ascending=False).index[:40]
    picky = before.copy()
    picky.loc[hard, "outcome"] = "rejected"
    assert picky.loc[picky["outcome"] == "ok", "cap_mm"].mean() < before["cap_mm"].mean()
    assert "kept" in failed(before, picky)


def test_leaving_captures_out_is_answering_less() -> None:
    before = errors()
    assert "kept" in failed(before, before[before["trial"] < "t2"])
    with pytest.raises(ConfigError, match="share no tube"):
        gate_pair(before, before.assign(trial="other"), METHODS, ALL)


def test_covariances_a_fifth_too_small_are_caught() -> None:
    worse = errors()
    worse["mahalanobis2"] /= 0.8
    assert failed(errors(), worse) == {"coverage"}


def test_coverage_far_from_its_range_is_caught_without_a_baseline() -> None:
    (gate,) = gate_counts_alone(errors().assign(mahalanobis2=20.0), "m", read_gates("coverage"))
    assert not gate.passed
    assert gate_counts_alone(errors(), "m", read_gates("coverage"))[0].passed


def test_more_wrong_and_false_answers_are_caught() -> None:
    before = errors()
    wrong = before.copy()
    wrong.loc[wrong.index[::8], "right"] = False
    assert "wrong" in failed(before, wrong)
    false = before.iloc[::8].assign(outcome="false", slot="H9")
    assert "wrong" in failed(before, pd.concat([before, false]))


def test_noise_drawn_anew_alarms_in_five_of_a_hundred_at_most() -> None:
    alarms = sum(bool(failed(errors(noise=2 * i), errors(noise=2 * i + 1))) for i in range(30))
    assert alarms <= 4  # P(more | 5 %) < 2 %


def test_with_few_captures_any_loss_counts() -> None:
    few = errors(captures=LEAST_CAPTURES - 1)
    after = few.copy()
    after.loc[after.index[after["outcome"] == "ok"][0], "outcome"] = "missed"
    assert failed(few, after) == {"kept"}


def test_nothing_answered_fails_alone_and_against_another() -> None:
    none = errors().assign(outcome="missed", right=pd.NA)
    (gate,) = gate_counts_alone(none, "m", read_gates("kept"))
    assert (gate.passed, gate.after) == (False, "0/200")
    assert "kept" in failed(errors(), none)
    assert not gate_counts_alone(drop(errors(), 0.2), "m", read_gates("kept:0.9"))[0].passed


def test_sign_flips_have_known_answers() -> None:
    assert sign_flip_p(np.ones(5), list("abcde")) == pytest.approx(1 / 32)
    assert sign_flip_p(np.ones(6), list("aabbcc")) == pytest.approx(1 / 8)
    assert sign_flip_p(np.zeros(4), list("abcd")) == 1.0
    assert sign_flip_p(np.array([1.0, -1.0]), ["a", "b"]) == pytest.approx(0.75)
    assert sign_flip_p(np.ones(40), range(40)) < 1e-3


@pytest.mark.parametrize("text", ["", "nope", "kept,kept", "time:x", "time:-1", "kept:nan"])
def test_gates_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="--fail-if"):
        read_gates(text)


@given(st.text(max_size=30))
def test_any_word_is_a_gate_or_refused(text: str) -> None:
    try:
        assert set(read_gates(text)) <= {"kept", "wrong", "error", "coverage", "time"}
    except ConfigError:
        assert text not in ("kept", "time:1.2")


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Two folders of runs with times, the second 1.5 times as slow and with errors a tenth larger."""
    for name, factor in (("before", 1.0), ("after", 1.1)):
        table = errors()
        for axis in ("tilt_deg", "cap_mm", "lateral_mm", "axial_mm"):
            table[axis] *= factor
        (tmp_path / name).mkdir()
        table.to_csv(tmp_path / name / "errors.csv", index=False)
        times = [{"method": "m", "stage": "tube", "warmup": False, "duration_ms": 10 * (1 + 5 * (factor - 1))}]
        pd.DataFrame(times).to_csv(tmp_path / name / "timings.csv", index=False)
        record = {"inputs_sha256": {"/a": "1"}, "labware_sha256": {}, "tubepose": "1", "versions": {"numpy": "1"}}
        (tmp_path / name / "run.json").write_text(json.dumps(record))
    return tmp_path


def test_a_baseline_file_stands_for_its_run(runs: Path) -> None:
    run = read_run(runs / "before")
    write_baseline(runs / "base.json", run)
    again = read_run(runs / "base.json")
    assert again.fingerprint == run.fingerprint
    assert again.times_ms == run.times_ms == {"m": 10.0}
    pd.testing.assert_frame_equal(again.errors[["slot", "outcome", "right"]], run.errors[["slot", "outcome", "right"]])
    np.testing.assert_allclose(again.errors["cap_mm"], run.errors["cap_mm"], rtol=1e-5)
    found = library.compare([runs / "base.json", runs / "before"], ALL)
    assert found.passed


def test_compare_writes_tables_gates_and_reasons(runs: Path) -> None:
    ended = tubepose(
        "compare", runs / "before", runs / "after", "--fail-if", "kept,wrong,error,coverage,time:1.2",
        "--junit", runs / "j.xml", "--summary-json", runs / "s.json", "--out", runs / "out", "--format", "markdown",
    )  # fmt: skip
    assert ended.code == 1
    (line,) = ended.errors
    assert line.startswith("error: 4 of 7 gates failed: error tilt_deg (m)")
    assert re.search(r"\| +FAIL \|", ended.out)
    assert ended.out.index("Counts") < ended.out.index("Paired by tube") < ended.out.index("Worst changes")
    suite = ElementTree.parse(runs / "j.xml").getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("7", "4")
    summary = json.loads((runs / "s.json").read_text())
    assert summary["passed"] is False
    changes = pd.read_csv(runs / "out" / "changes.csv")
    assert len(changes) == 200
    assert changes["cap_mm_change"].dropna().is_monotonic_decreasing
    assert tubepose("compare", runs / "before", runs / "after").code == 0


def test_other_data_is_refused_where_a_gate_is_asked_for(runs: Path) -> None:
    (runs / "after" / "run.json").write_text(json.dumps({"inputs_sha256": {"/a": "2"}}))
    ended = tubepose("compare", runs / "before", runs / "after", "--fail-if", "kept")
    assert (ended.code, "--other-data" in ended.errors[0]) == (1, True)
    assert tubepose("compare", runs / "before", runs / "after", "--fail-if", "kept", "--other-data").code == 0


def test_a_run_that_is_none_is_one_line(runs: Path) -> None:
    (runs / "x.json").write_text("{}")
    for words in ((runs / "nowhere",), (runs / "x.json",), ()):
        ended = tubepose("compare", runs / "before", *words)
        assert (ended.code, len(ended.errors)) == (1, 1)


def test_bench_gates_by_a_baseline_and_alone(small_session: Path, tmp_path: Path) -> None:
    base = ("bench", small_session, "--methods", "upright", "--detector", "geometric", "--out", tmp_path / "out")
    assert tubepose(*base, "--write-baseline", tmp_path / "b.json", "--fail-if", "kept").code == 0
    same = tubepose(*base, "--baseline", tmp_path / "b.json", "--fail-if", "kept,wrong,error,coverage")
    assert (same.code, same.errors) == (0, [])
    data = json.loads((tmp_path / "b.json").read_text())
    rows = pd.read_csv(StringIO("\n".join(data["rows"])))
    better = rows.assign(tilt_deg=0.5 * rows["tilt_deg"])
    (tmp_path / "b.json").write_text(json.dumps(data | {"rows": better.to_csv(index=False).splitlines()}))
    worse = tubepose(*base, "--baseline", tmp_path / "b.json", "--fail-if", "kept,error")
    assert worse.code == 1
    assert worse.errors == ["error: 1 of 4 gates failed: error tilt_deg (upright)"]
    assert tubepose(*base, "--fail-if", "error").errors[0].startswith("error: --fail-if error needs --baseline")
