"""The timing command: what is timed, how it is summed up, and what is claimed of it."""

from __future__ import annotations

import importlib
import os
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
import pytest

from tubepose.labware import load_cap, load_rack, load_tube
from tubepose.profile import estimate, measure
from tubepose.simulation import SceneVariation, simulate_session

REPOSITORY = Path(__file__).resolve().parent.parent
TUBE = "chen2023-tube-3"


def module_of(name: str) -> ModuleType:
    """The scripts are no part of an installed package: they are found in the repository."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", [*sys.path, str(REPOSITORY)])
        return importlib.import_module(f"benchmarks.{name}")


@pytest.fixture(scope="module")
def speed() -> ModuleType:
    return module_of("speed")


@pytest.fixture(scope="module")
def session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two racks with a few tubes each, seen by the quick sensor."""
    place = tmp_path_factory.mktemp("speed") / "session"
    rack, cap = load_rack("chen2023-soft-5x10"), load_cap("printed-square-16.7")
    few = SceneVariation(fill=(0.04, 0.16), table_albedo=(0.02, 0.02))
    options = {"trials": 2, "seed": 6, "cap": cap, "resolution": 512, "variation": few, "printed": False}
    simulate_session(place, rack, [load_tube(TUBE)], **options)
    return place


@pytest.fixture(scope="module")
def fullest(speed: ModuleType, session: Path):
    (one,) = speed.fullest_frames(session, speed.Config())
    return one


def test_the_fullest_frame_of_a_kind_is_taken(speed: ModuleType, session: Path, fullest) -> None:
    counts = {trial.name: len(trial.tubes) for trial in speed.load_session(session).trials}
    assert len(set(counts.values())) == 2
    assert counts[fullest.job.trial] == max(counts.values())
    assert speed.chosen_targets(fullest.scene, 2) == [0, len(fullest.scene.targets) - 1]
    assert len(speed.chosen_targets(fullest.scene, 99)) == counts[fullest.job.trial]


def test_stages_of_a_frame_add_up_and_nothing_stays_patched(speed: ModuleType, fullest) -> None:
    before = {name: getattr(module, name) for module in (measure, estimate) for name in vars(module)}
    rows = {(row["part"], row["name"]): row for row in speed.time_frame(fullest, speed.Config())}
    stages = {name: row["ms"] for (part, name), row in rows.items() if part == "stage"}
    assert set(stages) == {*module_of("speed_stages").STAGES, "rest"}
    assert stages.pop("rims") == stages.pop("faint rims") == 0.0
    assert min(stages.values()) > 0.0
    assert sum(stages.values()) == pytest.approx(rows["frame", "profile"]["ms"])
    parts = rows["frame", "rack"]["ms"] + rows["frame", "profile"]["ms"]
    assert parts == pytest.approx(rows["frame", "rack + profile"]["ms"])
    assert rows["frame", "profile"]["tubes"] == len(fullest.scene.targets)
    assert before == {name: getattr(module, name) for module in (measure, estimate) for name in vars(module)}


def test_methods_take_turns(speed: ModuleType, fullest, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(speed, "time_tube", lambda one, target, method, config, seed: asked.append(method) or 1.0)
    monkeypatch.setattr(speed, "time_rack", lambda one, method, config: {"ms": 1.0, "outcome": "ok"})
    monkeypatch.setattr(speed, "time_frame", lambda one, config: [])
    rows = speed.take_times([fullest], ["profile", "paper", "upright"], speed.Config(), rounds=2, tubes=2)
    assert len(asked) == 3 + 2 * 6
    assert {tuple(sorted(asked[i : i + 3])) for i in range(0, len(asked), 3)} == {("paper", "profile", "upright")}
    assert {asked[i] for i in range(0, len(asked), 3)} == {"profile", "paper", "upright"}
    assert [row["round"] for row in rows if row["part"] == "tube"] == [0] * 6 + [1] * 6
    assert [row["name"] for row in rows if row["part"] == "rack"] == ["edges", "obb-icp", "obb-icp", "edges"]


def test_the_command_prints_and_writes(
    speed: ModuleType,
    session: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(speed, "one_core", lambda: None)
    monkeypatch.setattr(speed, "RACKS", ("edges",))
    options = ["--rounds", "1", "--tubes", "1", "--methods", "upright", "--megabytes", "1", "--out", str(tmp_path)]
    assert speed.main([str(session), *options]) == 0
    told = capsys.readouterr().out
    assert "| upright | 1 | " in told
    assert "| . find tops | " in told
    assert "times that, rack and `profile`" in told
    table = pd.read_csv(tmp_path / "speed.csv")
    assert set(table["part"]) == {"tube", "rack", "frame", "stage", "bound"}
    samples = pd.read_csv(tmp_path / "samples.csv")
    assert (samples["ms"] >= 0).all()
    assert samples.loc[samples["part"] == "rack", "outcome"].tolist() == ["ok"]


def test_claims_hold_by_mean_and_median(speed: ModuleType) -> None:
    tables = module_of("speed_tables")
    times = {("tube", "profile"): [1, 1, 1], ("tube", "paper"): [11, 11, 11], ("tube", "global-icp"): [1, 299, 900]}
    times |= {("rack", "edges"): [1, 1, 1], ("rack", "obb-icp"): [4, 5, 9], ("frame", "rack + profile"): [50, 55, 90]}
    samples = pd.DataFrame(
        [
            {"frame": "one", "part": part, "name": name, "ms": float(ms), "outcome": "ok"}
            for (part, name), group in times.items()
            for ms in group
        ]
    )
    table = tables.summary(samples)
    row = table[(table["frame"] == "one") & (table["name"] == "global-icp")].iloc[0]
    assert (row["n"], row["mean_ms"], row["median_ms"]) == (3, 400, 299)
    assert (row["ratio_of_means"], row["ratio_of_medians"]) == (400, 299)
    lines = list(tables.claim_lines(table, {"one": 50}))
    assert [word for line in lines for word in ("holds", "FAILS") if word in line] == [
        "FAILS", "holds", "holds", "FAILS",
    ]  # fmt: skip
    assert "Rack and 50 tubes (one) under 60 ms" in lines[-1]


def test_the_bound_counts_bytes_and_operations(fullest) -> None:
    stages = module_of("speed_stages")
    scene = fullest.scene
    found = stages.bound(scene, (), bytes_per_s=1e9)
    # As large as the rack's outline is from its distance; a box about a turned rack is larger.
    focal, distance = scene.intrinsics.fx, scene.rack_pose.T_camera_rack[2, 3] - scene.rack.height_m
    least = np.prod(scene.rack.outline_m) * (focal / distance) ** 2 * 24
    assert 0.9 * least < found["bytes"] < min(4 * least, scene.frame.cloud_m.nbytes)
    assert found["read_ms"] == pytest.approx(found["bytes"] / 1e6)
    assert found["bound_ms"] == pytest.approx(found["read_ms"] + found["fit_ms"])
    operations, rate = stages.normal_equations(1000)
    assert operations == 2 * 1000 * 4 * 4
    assert rate > 0
    assert stages.bandwidth(1) > 0


def test_one_core_and_one_thread(speed: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(os, "sched_getaffinity", lambda of: {0, 3}, raising=False)
    monkeypatch.setattr(os, "sched_setaffinity", lambda of, cores: asked.append((of, cores)), raising=False)
    for name in speed._ONE_THREAD:
        monkeypatch.setenv(name, "7")
    speed.one_core()
    assert asked == [(0, {3})]
    assert {os.environ[name] for name in speed._ONE_THREAD} == {"1"}


def test_what_cannot_be_done_is_said(
    speed: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(speed, "one_core", lambda: None)
    for arguments, message in (
        (["--methods", "papier"], "unknown method 'papier'"),
        (["--rounds", "0"], "expected 1 or more"),
        ([str(tmp_path)], "no session.yaml found"),
    ):
        assert speed.main(arguments) == 1
        assert message in capsys.readouterr().err
    monkeypatch.setattr(speed, "find_spec", lambda package: None)
    assert speed.read_methods(None) == ["profile", "paper", "slot-icp", "global-icp"]
    assert speed.read_methods("paper") == ["profile", "paper"]
