from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import tubepose
from scipy.spatial.transform import Rotation

from tubepose.evaluation.repeatability import change_test, drifts, innovations, repeatability
from tubepose.pose_errors import COVARIANCE_COLUMNS
from tubepose.records import covariance_columns, pose_columns
from tubepose.transforms import make_transform

STDS = np.array([2e-3, 3e-3, 1e-4, 2e-4, 3e-4])
"""Standard deviations over rx, ry (rad), tx, ty, tz (m)."""
RACK = make_transform(Rotation.from_euler("x", 175, degrees=True).as_matrix(), np.array([0.0, 0.0, 0.9]))


def moved(values):
    return make_transform(Rotation.from_rotvec([*values[:2], 0]).as_matrix(), np.array(values[2:]))


def series(seed: int, frames: int = 20, tubes: int = 3, stated: float = 1.0, change=lambda i: np.eye(4)):
    """Estimates and racks of a scene that is still but for `change`, errors drawn from the law that is stated."""
    rng = np.random.default_rng(seed)
    estimates, racks = [], []
    for i in range(frames):
        keys = {"session": "", "trial": "", "capture": f"c{i:03d}", "frame": 0, "method": "m", "status": "ok"}
        T = change(i) @ RACK @ moved(rng.normal(0, STDS / 3))
        racks.append({**keys, **pose_columns(T)})
        for k in range(tubes):
            T_tube = change(i) @ RACK @ make_transform(np.eye(3), np.array([0.03 * k, 0, -0.05]))
            pose = pose_columns(T_tube @ moved(rng.normal(0, STDS)))
            row = {**keys, "seed": None, "slot": f"A{k + 1}", "tube": "t", **pose}
            estimates.append(row | covariance_columns(np.diag((stated * STDS) ** 2), COVARIANCE_COLUMNS))
    return pd.DataFrame(estimates), pd.DataFrame(racks)


def test_the_spread_of_every_axis_is_that_of_the_law() -> None:
    table = repeatability(*series(1, frames=400))
    expected = [*np.rad2deg(STDS[:2]), *(STDS[2:] * 1e3)]
    found = table[[f"{name}_std" for name in ("rx_deg", "ry_deg", "tx_mm", "ty_mm", "tz_mm")]].to_numpy()
    np.testing.assert_allclose(found, np.tile(expected, (3, 1)), rtol=0.12)
    assert list(table["n_frames"]) == [400] * 3


def test_honest_covariances_are_consistent_and_small_ones_are_not() -> None:
    (honest,) = innovations(series(2, frames=100)[0]).to_dict("records")
    assert honest["ci95_low"] < 1 < honest["ci95_high"]
    assert honest["consistent"]
    (small,) = innovations(series(2, frames=100, stated=0.8)[0]).to_dict("records")
    assert small["nis_mean"] == pytest.approx(honest["nis_mean"] / 0.64)
    assert not small["consistent"]


def test_a_drift_and_a_turned_camera_are_found() -> None:
    slow = drifts(*series(3, change=lambda i: make_transform(np.eye(3), np.array([2e-4 * i, 0, 0]))))
    alarms = slow[slow["alarm"]]
    assert set(alarms["subject"]) == {"rack_or_camera"}
    assert alarms.set_index("axis").loc["tx_mm", "per_frame"] == pytest.approx(0.2, abs=0.02)
    turn = Rotation.from_euler("z", 0.1, degrees=True).as_matrix()
    about = (
        make_transform(np.eye(3), RACK[:3, 3])
        @ make_transform(turn, np.zeros(3))
        @ make_transform(np.eye(3), -RACK[:3, 3])
    )
    step = drifts(*series(4, change=lambda i: about if i >= 12 else np.eye(4)))
    (alarm,) = step[step["alarm"]].to_dict("records")
    assert (alarm["subject"], alarm["axis"], alarm["step_at"]) == ("rack_or_camera", "rz_deg", 12)
    assert abs(alarm["step"]) == pytest.approx(0.1, abs=0.02)


def test_a_tube_that_is_pushed_is_told_from_a_rack_that_is() -> None:
    estimates, racks = series(5)
    pushed = (estimates["slot"] == "A2") & (estimates["capture"] >= "c010")
    estimates.loc[pushed, "tx_m"] += 2e-3
    found = drifts(estimates, racks)
    assert set(found.loc[found["alarm"], ["subject", "slot", "axis"]].itertuples(index=False, name=None)) == {
        ("tube", "A2", "tx_mm")
    }


def test_still_series_give_no_alarm() -> None:
    assert not any(drifts(*series(100 + i, frames=12, tubes=1))["alarm"].any() for i in range(30))


def test_too_few_frames_say_nothing() -> None:
    assert change_test(np.arange(4.0), np.arange(4.0))[3] == 1.0
    assert change_test(np.arange(9.0), np.zeros(9))[3] == 1.0


def test_the_command_reads_a_run_and_ends_with_1_at_an_alarm(tmp_path: Path) -> None:
    for name, speed_m in (("still", 0.0), ("slow", 2e-4)):
        (tmp_path / name).mkdir()
        tables = series(6, change=lambda i, v=speed_m: make_transform(np.eye(3), np.array([0, v * i, 0])))
        for table, file in zip(tables, ("estimates", "racks"), strict=True):
            table.to_csv(tmp_path / name / f"{file}.csv", index=False)
    still = tubepose("repeat", tmp_path / "still", "--out", tmp_path / "out")
    assert (still.code, still.errors) == (0, [])
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"repeatability.csv", "innovation.csv", "drift.csv"}
    slow = tubepose("repeat", tmp_path / "slow", "--out", tmp_path / "out")
    assert slow.code == 1
    assert "the rack or the camera moved" in slow.errors[0]


def test_captures_of_one_scene_are_estimated_first(small_session: Path, tmp_path: Path) -> None:
    ended = tubepose("repeat", small_session, "--method", "upright", "--detector", "geometric", "--out", tmp_path / "o")
    assert ended.code == 1
    assert "2 frames" in ended.errors[0]
    assert (tmp_path / "o" / "estimates.csv").is_file()
