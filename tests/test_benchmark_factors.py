"""Each factor alone: its definition, its sessions, its table."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest
import yaml

from tubepose.capture.session import load_session
from tubepose.evaluation import ERROR_COLUMNS
from tubepose.simulation import read_exact_truth

REPOSITORY = Path(__file__).resolve().parent.parent
TUBE = "chen2023-tube-3"
SMALL = {
    "materials": "test",
    "seed": 5,
    "tubes": [TUBE],
    "trials": 1,
    "resolution": 640,
    "sensor": "raycast",
    "scenes": {"fill": [0.06, 0.06]},
    "factors": {"base": {}, "label": {"scenes": {"label_share": 1}}},
}


@pytest.fixture(scope="module")
def factors() -> ModuleType:
    """The script is no part of an installed package: it is found in the repository."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [*sys.path, str(REPOSITORY)])
        return importlib.import_module("benchmarks.factors")


@pytest.fixture(scope="module")
def run(factors: ModuleType, tmp_path_factory: pytest.TempPathFactory):
    """The command with a small plan; two sessions are made with it."""
    root = tmp_path_factory.mktemp("factors")
    (root / "plan.yaml").write_text(yaml.safe_dump(SMALL))

    def command(*arguments: str) -> int:
        return factors.main(["--plan", str(root / "plan.yaml"), "--place", str(root / "made"), *arguments])

    assert command("make") == 0
    command.root = root
    return command


def test_every_factor_changes_one_thing(factors: ModuleType) -> None:
    plan = factors.read_plan()
    base = factors.variation_of(plan, "base")
    assert (base.fill, base.scanner_tilt_deg, base.scattering_per_mm) == ((0.5, 0.5), (10, 10), (0.5, 0.5))
    assert (base.liquid_share, base.label_share) == (0, 0)
    changed = {}
    for name, factor in plan.factors.items():
        found = factors.variation_of(plan, name)
        keys = {key for key in type(base).model_fields if getattr(found, key) != getattr(base, key)}
        assert keys == set(factor.scenes), name
        changed[name] = (frozenset(keys), factor.sensor)
    assert changed.pop("label-and-liquid") == ({"label_share", "liquid_share"}, None)
    assert changed.pop("fill-1-raycast") == ({"fill"}, "raycast")
    assert all(len(keys) + (sensor is not None) == (name != "base") for name, (keys, sensor) in changed.items())
    assert len(plan.factors) == 11
    assert (len(plan.tubes), plan.trials, plan.resolution, plan.sensor) == (3, 3, 1376, "structured-light")


def test_materials_are_those_of_test_and_the_seed_is_its_own(factors: ModuleType) -> None:
    plan, recipe = factors.read_plan(), factors.read_recipe()
    assert plan.seed not in {each.seed for each in recipe.sets.values()}
    ours, theirs = factors.variation_of(plan, "base"), recipe.variation("test")
    design = {"fill", "scanner_tilt_deg", "scattering_per_mm", "liquid_share", "label_share"}
    assert {key for key in type(ours).model_fields if getattr(ours, key) != getattr(theirs, key)} == design


def test_sessions_share_their_tubes_and_are_made_once(run) -> None:
    places = [run.root / "made" / name for name in SMALL["factors"]]
    base, label = (load_session(place) for place in places)
    assert base.trials == label.trials
    assert base.name != label.name
    (trial,) = base.trials
    assert trial.printed is None
    truths = [read_exact_truth(place, trial.name) for place in places]
    assert np.array_equal(truths[0].T_camera_rack, truths[1].T_camera_rack)
    for slot, (_, pose) in truths[0].tubes.items():
        assert np.array_equal(pose, truths[1].tubes[slot][1])
    captures = [(place / trial.original).read_bytes() for place in places]
    assert captures[0] != captures[1]
    before = [path.stat().st_mtime_ns for path in sorted((run.root / "made").rglob("*"))]
    assert run("make") == 0
    assert [path.stat().st_mtime_ns for path in sorted((run.root / "made").rglob("*"))] == before


def test_the_table_is_written_and_printed(run, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("report", "--out", str(run.root / "out")) == 0
    table = pd.read_csv(run.root / "out" / "factors.csv", keep_default_na=False)
    assert list(zip(table["factor"], table["method"], strict=True)) == [
        (factor, method) for factor in SMALL["factors"] for method in ("profile", "upright")
    ]
    profile = table[table["method"] == "profile"]
    assert (profile["ok"] == profile["expected"]).all()
    assert (profile["expected"] == 3).all()
    assert (profile[["wrong", "false", "missed"]] == 0).all(axis=None)
    assert (profile["tilt_deg_mean"].to_numpy() < table.loc[table["method"] == "upright", "tilt_deg_mean"]).all()
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 + len(table)
    assert len({line.count(" | ") for line in (lines[0], *lines[2:])}) == 1
    errors = pd.read_csv(run.root / "out" / "errors.csv")
    assert (errors.groupby(["factor", "method"]).size() == 3).all()


def test_a_known_rack_needs_no_boxes(run, factors: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*arguments):
        raise AssertionError("boxes are not needed")

    monkeypatch.setattr(factors, "GeometricDetector", refuse)
    assert run("report", "--known-rack", "--methods", "profile", "--out", str(run.root / "known")) == 0
    table = pd.read_csv(run.root / "known" / "factors.csv")
    assert (table[["ok", "expected"]] == 3).all(axis=None)
    assert (table["racks"] == "1/1").all()


def test_wrong_and_beyond_targets_are_counted(factors: ModuleType) -> None:
    values = dict.fromkeys(("rx_deg", "ry_deg", "tx_mm", "ty_mm", "tz_mm"), 0.1) | {"tilt_deg": 0.2}
    rows = [
        values | {"outcome": "ok", "mahalanobis2": 3.0},
        values | {"outcome": "ok", "mahalanobis2": 30.0, "tilt_deg": 2.1},
        values | {"outcome": "ok", "mahalanobis2": 30.0, "tx_mm": -1.5, "ty_mm": 1.5},
        values | {"outcome": "rejected", "mahalanobis2": 3.0, "tilt_deg": 5.0},
        {"outcome": "missed"},
        {"outcome": "false"},
    ]
    errors = pd.DataFrame(rows).reindex(columns=ERROR_COLUMNS)
    errors = errors.assign(method="profile", tube=TUBE, confidence=0.5, type_correct=None)
    (row,) = factors.table_rows(errors, {TUBE: False})
    assert (row["ok"], row["expected"], row["rejected"], row["missed"], row["false"]) == (3, 5, 1, 1, 1)
    assert row["wrong"] == 2
    assert row["inside_95"] == pytest.approx(1 / 3)
    assert row["over"] == "tilt p95, T_x, T_y"


def test_targets_depend_on_the_tube_and_are_doubled(factors: ModuleType) -> None:
    row = {"rx_deg_mean": 0.24, "ry_deg_mean": 0.25, "tilt_deg_p95": 0.8, **dict.fromkeys(factors._SHIFTS, 0.4)}
    assert factors.over_targets(row, is_open=False) == ["R_y"]
    assert factors.over_targets(row, is_open=True) == []
    unknown = dict.fromkeys(row, float("nan"))
    assert len(factors.over_targets(unknown, is_open=True)) == 6


def test_what_cannot_be_done_is_said(run, factors: ModuleType, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("report", "--methods", "profil") == 1
    assert "unknown method 'profil'" in capsys.readouterr().err
    assert factors.main(["--place", str(run.root / "nothing"), "report"]) == 1
    assert "no session base, scattering-0, " in capsys.readouterr().err
    broken = run.root / "broken.yaml"
    broken.write_text(yaml.safe_dump(SMALL | {"factors": {"base": {"sensors": "raycast"}}}))
    assert factors.main(["--plan", str(broken), "make"]) == 1
    assert "unknown key" in capsys.readouterr().err
