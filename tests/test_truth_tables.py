from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from tubepose.batch import session_jobs
from tubepose.capture.session import load_session
from tubepose.errors import CaptureError, ConfigError
from tubepose.ground_truth import GroundTruthConfig
from tubepose.records import POSE_COLUMNS, to_table
from tubepose.simulation import read_exact_truth
from tubepose.transforms import FloatArray, make_transform
from tubepose.truth_tables import (
    FLOOR_COLUMNS,
    TRUTH_COLUMNS,
    TruthTables,
    exact_truth_rows,
    floor_note,
    measure_session,
    refused_note,
    with_exact_rack,
)

CONFIG = GroundTruthConfig()


def measured(folder: Path, config: GroundTruthConfig = CONFIG, **options: Any) -> TruthTables:
    tables = TruthTables()
    measure_session(load_session(folder), tables, config, **options)
    return tables


def edited(session: Path, to: Path, old: str, new: str) -> Path:
    shutil.copytree(session, to)
    text = (to / "session.yaml").read_text()
    assert old in text
    (to / "session.yaml").write_text(text.replace(old, new))
    return to


def pose_of(row: Any) -> FloatArray:
    tx, ty, tz, qw, qx, qy, qz = (row[name] for name in POSE_COLUMNS)
    return make_transform(Rotation.from_quat([qx, qy, qz, qw]).as_matrix(), np.array([tx, ty, tz]))


def test_measured_poses_lie_by_the_exact_ones_and_the_floor_says_how_near(small_session: Path) -> None:
    done: list[int] = []
    tables = measured(small_session, on_done=lambda: done.append(1))
    session = load_session(small_session)
    declared = [(trial.name, slot) for trial in session.trials for slot in trial.tubes]
    assert [(row["trial"], row["slot"]) for row in tables.truth] == declared
    assert len(done) == len(session.trials)
    assert tables.problems == []
    floors = {(row["trial"], row["slot"]): row for row in tables.floor}
    for row in tables.truth:
        assert row["status"] == "ok", row["reason"]
        exact = read_exact_truth(small_session, row["trial"]).tubes[row["slot"]][1]
        found, floor = pose_of(row), floors[row["trial"], row["slot"]]
        off_mm = 1e3 * np.linalg.norm(found[:3, 3] - exact[:3, 3])
        assert np.linalg.norm([floor["tx_mm"], floor["ty_mm"], floor["tz_mm"]]) == pytest.approx(off_mm)
        tilt_deg = np.rad2deg(np.arccos(np.clip(found[:3, 2] @ exact[:3, 2], -1, 1)))
        assert floor["tilt_deg"] == pytest.approx(tilt_deg, abs=1e-5)
        assert off_mm < 1.5
        assert tilt_deg < 1
    assert list(to_table(tables.truth, TRUTH_COLUMNS)) == list(TRUTH_COLUMNS)
    assert all(set(row) == set(FLOOR_COLUMNS) for row in tables.floor)


def test_a_refused_cap_keeps_its_row_and_its_reason_without_a_pose(small_session: Path) -> None:
    tables = measured(small_session, GroundTruthConfig(max_plane_rms_m=1e-6))
    assert {row["status"] for row in tables.truth} == {"refused"}
    assert all("plane" in row["reason"] for row in tables.truth)
    assert all(row["n_points"] > 0 for row in tables.truth)
    assert all(np.isnan(row[name]) for row in tables.truth for name in POSE_COLUMNS)
    assert tables.floor == []


def test_a_scene_without_the_rack_refuses_every_declared_tube(small_session: Path) -> None:
    tables = measured(small_session, GroundTruthConfig(outline_loss_m=-1.0))
    assert len(tables.truth) == 4
    assert {row["status"] for row in tables.truth} == {"refused"}
    assert all(row["reason"] for row in tables.truth)


def test_a_recorded_session_has_no_floor(small_session: Path, tmp_path: Path) -> None:
    folder = edited(small_session, tmp_path / "s", "origin: simulated", "origin: recorded")
    shutil.rmtree(folder / "simulation_truth")
    tables = measured(folder)
    assert (len(tables.truth), tables.floor, tables.problems) == (4, [], [])


def test_a_missing_capture_is_one_line_and_the_next_trial_is_measured(small_session: Path, tmp_path: Path) -> None:
    name = "captures/blood-16x100-001-printed"
    folder = edited(small_session, tmp_path / "s", name, "captures/lost")
    tables = measured(folder)
    assert {row["trial"] for row in tables.truth} == {"chen2023-tube-3-001"}
    (line,) = tables.problems
    assert "trial blood-16x100-001, ground truth: " in line
    assert "captures/lost: no such file or folder" in line
    with pytest.raises(CaptureError, match="captures/lost: no such file or folder"):
        measured(folder, fail_fast=True)


def test_trials_without_a_printed_capture_are_left_out(small_session: Path, tmp_path: Path) -> None:
    printed = "  printed: captures/blood-16x100-001-printed\n"
    tables = measured(edited(small_session, tmp_path / "s", printed, ""))
    assert {row["trial"] for row in tables.truth} == {"chen2023-tube-3-001"}
    assert tables.problems == []


# The rack's exact pose


def test_the_exact_rack_comes_from_the_truth_of_its_own_trial(small_session: Path) -> None:
    session = load_session(small_session)
    jobs, _ = session_jobs(session)
    given = with_exact_rack(jobs, session)
    assert len(given) == len(jobs)
    assert all(job.T_camera_rack is None for job in jobs)
    for job in given:
        assert job.T_camera_rack is not None
        assert np.array_equal(job.T_camera_rack, read_exact_truth(small_session, job.trial).T_camera_rack)


def test_the_exact_rack_is_not_to_be_had_elsewhere(small_session: Path, tmp_path: Path) -> None:
    recorded = load_session(edited(small_session, tmp_path / "r", "origin: simulated", "origin: recorded"))
    with pytest.raises(ConfigError, match="is recorded: only simulated ones know"):
        with_exact_rack([], recorded)
    shutil.copytree(small_session, tmp_path / "s", ignore=shutil.ignore_patterns("simulation_truth"))
    session = load_session(tmp_path / "s")
    with pytest.raises(CaptureError, match=r"simulation_truth/blood-16x100-001\.yaml: no such file"):
        with_exact_rack(session_jobs(session)[0], session)
    problems: list[str] = []
    assert with_exact_rack(session_jobs(session)[0], session, problems) == []
    assert len(problems) == 2


def test_a_trial_without_exact_truth_costs_no_other_trial(small_session: Path, tmp_path: Path) -> None:
    copy = tmp_path / "s"
    shutil.copytree(small_session, copy)
    (copy / "simulation_truth" / "blood-16x100-001.yaml").unlink()
    session = load_session(copy)
    told: list[str] = []
    told_again: list[str] = []
    given = with_exact_rack(session_jobs(session)[0], session, told)
    rows = exact_truth_rows(session, told_again)
    assert [job.trial for job in given] == ["chen2023-tube-3-001"]
    assert {row["trial"] for row in rows} == {"chen2023-tube-3-001"}
    assert len(told) == len(told_again) == 1
    assert all("blood-16x100-001.yaml: no such file" in line for line in told + told_again)


# The tubes' exact poses


def test_exact_rows_are_the_simulations_own_poses(small_session: Path) -> None:
    session = load_session(small_session)
    rows = exact_truth_rows(session)
    declared = [(trial.name, slot, tube) for trial in session.trials for slot, tube in trial.tubes.items()]
    assert [(row["trial"], row["slot"], row["tube"]) for row in rows] == declared
    assert {(row["session"], row["status"], row["reason"]) for row in rows} == {(session.name, "ok", "exact")}
    for row in rows:
        exact = read_exact_truth(small_session, row["trial"]).tubes[row["slot"]][1]
        assert pose_of(row) == pytest.approx(exact, abs=1e-12)
    assert list(to_table(rows, TRUTH_COLUMNS)) == list(TRUTH_COLUMNS)


def test_exact_rows_are_not_to_be_had_elsewhere(small_session: Path, tmp_path: Path) -> None:
    recorded = load_session(edited(small_session, tmp_path / "r", "origin: simulated", "origin: recorded"))
    words = rf"^session {recorded.name} is recorded: only simulated ones know exact poses$"
    with pytest.raises(ConfigError, match=words):
        exact_truth_rows(recorded)
    session = load_session(small_session)
    (slot, *_) = session.trials[0].tubes
    free = next(known.name for known in session.rack.all_slots if known.name not in session.trials[0].tubes)
    moved = load_session(edited(small_session, tmp_path / "m", f"{{{slot}: ", f"{{{free}: "))
    with pytest.raises(CaptureError, match=f"a tube is declared in slot {free}, but its exact truth has none there"):
        exact_truth_rows(moved)


# In words


def test_the_floor_in_words() -> None:
    floor = pd.DataFrame({"tilt_deg": [0.1, 0.3], "tx_mm": [3.0, 0.0], "ty_mm": [-4.0, 0.0], "tz_mm": [0.0, 1.0]})
    assert floor_note(floor) == (
        "Ground truth against the exact truth of the simulation, 2 caps: tilt mean 0.200, max 0.300 deg; "
        "position mean 3.000, max 5.000 mm."
    )


def test_refusals_in_words() -> None:
    def truth(*reasons: str) -> pd.DataFrame:
        status = ["refused" if reason else "ok" for reason in reasons]
        slots = [f"A{k + 1}" for k in range(len(reasons))]
        columns = {"trial": ["007"] * len(reasons), "slot": slots, "status": status, "reason": reasons}
        return pd.DataFrame({name: pd.Series(list(values), dtype="str") for name, values in columns.items()})

    assert refused_note(truth()) == "Ground truth: 0 caps measured, 0 refused."
    assert refused_note(truth("", "")) == "Ground truth: 2 caps measured, 0 refused."
    assert (
        refused_note(truth("", "bent", "bent", ""))
        == "Ground truth: 2 caps measured, 2 refused (bent: 007 A2 and 1 more)."
    )
    assert refused_note(truth("d", "c", "b", "a")).endswith("4 refused (a: 007 A4; b: 007 A3; c: 007 A2; ...).")
