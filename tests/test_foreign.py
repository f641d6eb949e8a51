from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import tubepose
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import tubepose as library
from tubepose.benchmark import EvaluateOptions, evaluate
from tubepose.errors import ConfigError, TubePoseError
from tubepose.foreign import ForeignMapping, read_estimates, read_mapping, read_truth, with_slots, write_bop_results
from tubepose.labware import load_tube
from tubepose.records import POSE_COLUMNS, pose_columns, transform_of
from tubepose.transforms import make_transform

TUBES = {name: load_tube(name) for name in ("chen2023-tube-1", "blood-16x100")}
UP = Rotation.from_euler("xyz", [175, 3, 20], degrees=True)


def true_pose(i: int):
    return make_transform(UP.as_matrix(), np.array([0.04 * (i % 3), 0.05 * (i // 3), 0.8]))


def estimated_pose(i: int):
    lean = Rotation.from_rotvec(np.deg2rad([0.3 * i, -0.2, 0.0]))
    return true_pose(i) @ make_transform(lean.as_matrix(), np.array([1e-4 * i, -2e-4, 3e-4]))


@pytest.fixture
def files(tmp_path: Path) -> Path:
    """Six tubes of two types in two trials as truth, and five answers of a stranger in four formats."""
    truth, rows, bop, tum = [], [], ["scene_id,im_id,obj_id,score,R,t,time"], ["# a comment"]
    for i in range(6):
        trial, tube = f"t{i // 3}", list(TUBES)[i % 2]
        truth.append({"session": "s", "trial": trial, "slot": f"A{i % 3 + 1}", "tube": tube, "status": "ok",
                      **pose_columns(true_pose(i))})  # fmt: skip
        if i == 4:
            continue
        T = estimated_pose(i)
        pose = pose_columns(T)
        rows.append({"trial": trial, "tube": tube, **pose, "confidence": 0.9})
        R, t = (" ".join(map(repr, map(float, part))) for part in (T[:3, :3].ravel(), T[:3, 3] * 1e3))
        bop.append(f"{i // 3},0,{i % 2 + 1},0.9,{R},{t},-1")
        tum.append(" ".join([trial, *(repr(float(pose[n])) for n in ("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"))]))
        tum[-1] += f" {tube}"
    pd.DataFrame(truth).to_csv(tmp_path / "truth.csv", index=False)
    pd.DataFrame(rows).to_csv(tmp_path / "ours.csv", index=False)
    (tmp_path / "list.json").write_text(json.dumps({"estimates": rows}))
    (tmp_path / "bop.csv").write_text("\n".join(bop) + "\n")
    (tmp_path / "poses.txt").write_text("\n".join(tum) + "\n")
    (tmp_path / "map.yaml").write_text(
        "method: stranger\nscenes: {0: t0, 1/0: s/t1}\nobjects: {1: chen2023-tube-1, 2: blood-16x100}\n"
    )
    return tmp_path


@pytest.mark.parametrize("name", ["list.json", "bop.csv", "poses.txt"])
def test_the_same_answers_give_the_same_tables_in_every_format(files: Path, name: str) -> None:
    options = EvaluateOptions(read_mapping(files / "map.yaml"))
    first = evaluate([files / "ours.csv"], [files / "truth.csv"], options=options)
    other = evaluate([files / name], [files / "truth.csv"], options=options)
    assert first.judgement.counts() == {
        "stranger": {"expected": 6, "ok": 5, "rejected": 0, "missed": 1, "failed": 0, "false": 0, "wrong_type": 0}
    }
    columns = [c for c in first.judgement.summary if c not in ("method", "tube")]
    np.testing.assert_allclose(
        other.judgement.summary[columns].to_numpy(float), first.judgement.summary[columns].to_numpy(float), atol=1e-9
    )
    rows = first.judgement.errors.sort_values(["trial", "slot"]).reset_index()
    assert rows["rx_deg"][3] == pytest.approx(0.9, abs=1e-6)
    assert list(rows["outcome"]) == ["ok"] * 4 + ["missed", "ok"]


def test_a_slot_is_given_to_the_nearest_true_tube_or_to_none(files: Path) -> None:
    truth = read_truth(files / "truth.csv")
    rows = read_estimates(files / "ours.csv", ForeignMapping(method="m"), TUBES).assign(session="s")
    assert list(with_slots(rows, truth)["slot"]) == ["A1", "A2", "A3", "A1", "A3"]
    far = rows.assign(tx_m=rows["tx_m"] + 1.0)
    assert with_slots(far, truth)["slot"].isna().all()
    named = rows.assign(slot=["A2", *[None] * 4])
    assert list(with_slots(named, truth)["slot"])[:1] == ["A2"]
    assert "A2" not in set(with_slots(named, truth)["slot"][1:3])


def test_far_answers_are_false_and_their_tubes_missed(files: Path) -> None:
    rows = pd.read_csv(files / "ours.csv")
    rows.loc[0, "tx_m"] += 0.5
    rows.to_csv(files / "far.csv", index=False)
    found = evaluate([files / "far.csv"], [files / "truth.csv"]).judgement.counts()["far"]
    assert (found["ok"], found["missed"], found["false"]) == (4, 2, 1)


@pytest.mark.parametrize("axis", ["x", "-z", "y"])
def test_a_declared_origin_and_axis_is_undone(files: Path, axis: str) -> None:
    mapping = ForeignMapping(method="m", origin="center", axis=axis)
    rows = pd.read_csv(files / "ours.csv")
    for i, row in enumerate(rows.to_dict("records")):
        T = transform_of(row) @ np.linalg.inv(mapping.to_tube(TUBES[row["tube"]]))
        rows.loc[i, list(POSE_COLUMNS)] = list(pose_columns(T).values())
        tube = TUBES[row["tube"]]
        centre = transform_of(row) @ np.array([0, 0, tube.height_m / 2, 1])
        np.testing.assert_allclose(T[:3, 3], centre[:3], atol=1e-12)
    rows.to_csv(files / "center.csv", index=False)
    moved = evaluate([files / "center.csv"], [files / "truth.csv"], options=EvaluateOptions(mapping))
    plain = evaluate([files / "ours.csv"], [files / "truth.csv"])
    for name in ("tilt_deg", "lateral_mm", "axial_mm", "mssd_mm"):
        np.testing.assert_allclose(moved.judgement.errors[name], plain.judgement.errors[name], atol=1e-6)


def test_bop_results_come_back_as_they_were_written(files: Path) -> None:
    rows = evaluate([files / "ours.csv"], [files / "truth.csv"]).estimates
    text = write_bop_results(
        rows, {("s", "t0"): (0, 0), ("s", "t1"): (1, 0)}, {"chen2023-tube-1": 1, "blood-16x100": 2}
    )
    (files / "again.csv").write_text(text)
    again = read_estimates(files / "again.csv", read_mapping(files / "map.yaml"), TUBES)
    np.testing.assert_allclose(again[list(POSE_COLUMNS)], rows[list(POSE_COLUMNS)], atol=1e-12)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("a.csv", "trial,tx_m\nt0,1\n", "column ty_m, tz_m, qw, qx, qy, qz is missing"),
        ("a.csv", "scene_id,im_id,obj_id,score,R,t\n7,0,1,1,1 0 0 0 1 0 0 0 1,0 0 1\n", "no trial is declared"),
        ("a.csv", "scene_id,im_id,obj_id,score,R,t\n0,0,9,1,1 0 0 0 1 0 0 0 1,0 0 1\n", "no tube is declared for obj_"),
        ("a.csv", "scene_id,im_id,obj_id,score,R,t\n0,0,1,1,1 0 0 0 1 0 0 0 -1,0 0 1\n", "R is no rotation"),
        ("a.csv", "scene_id,im_id,obj_id,score,R,t\n0,0,1,1,1 0 0,0 0 1\n", "expected 9 finite numbers"),
        ("a.csv", "trial,tx_m,ty_m,tz_m,qw,qx,qy,qz\nt0,0,0,1,2,0,0,0\n", "the quaternion's length is 2"),
        ("a.csv", "trial,tx_m,ty_m,tz_m,qw,qx,qy,qz\nt0,x,0,1,1,0,0,0\n", "tx_m 'x'; expected 1 finite number"),
        ("a.csv", "trial,tx_m,ty_m,tz_m,qw,qx,qy,qz\nnope,0,0,1,1,0,0,0\n", "trials without truth: nope"),
        ("a.csv", "trial,tx_m,ty_m,tz_m,qw,qx,qy,qz\n", "no row in it"),
        ("a.csv", "", "cannot be read as a CSV file"),
        ("a.json", "{}", "expected a list of objects"),
        ("a.txt", "t0 1 2\n", "line 1 has 3 words"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_file_is_one_line(files: Path, name: str, text: str, words: str) -> None:
    (files / name).write_text(text)
    arguments = ("--truth", files / "truth.csv", "--mapping", files / "map.yaml", "--out", files / "out")
    ended = tubepose("evaluate", files / name, *arguments)
    assert ended.code == 1
    (line,) = ended.errors
    assert words in line
    assert not (files / "out").exists()


@given(st.text(max_size=200))
def test_any_text_is_read_or_refused(tmp_path_factory: pytest.TempPathFactory, text: str) -> None:
    path = tmp_path_factory.getbasetemp() / "any.csv"
    path.write_text("scene_id,im_id,obj_id,score,R,t\n" + text, encoding="utf-8")
    with suppress(TubePoseError):
        assert len(read_estimates(path, ForeignMapping(), TUBES)) <= text.count("\n") + 1


def test_two_files_of_one_method_are_refused(files: Path) -> None:
    with pytest.raises(ConfigError, match="method 'stranger' is that of"):
        library.evaluate(
            [files / "ours.csv", files / "list.json"], [files / "truth.csv"],
            options=EvaluateOptions(read_mapping(files / "map.yaml")),
        )  # fmt: skip


def test_the_command_writes_the_tables_of_bench_beside_another_run(files: Path) -> None:
    both = (files / "ours.csv", files / "list.json")
    assert tubepose("evaluate", both[0], "--truth", files / "truth.csv", "--out", files / "first").code == 0
    ended = tubepose("evaluate", both[1], files / "first", "--truth", files / "truth.csv", "--out", files / "out")
    assert (ended.code, ended.errors) == (0, [])
    assert "ours: 5 of 6 tubes answered" in ended.out
    summary = pd.read_csv(files / "out" / "summary.csv")
    assert set(summary["method"]) == {"list", "ours"}
    assert {p.name for p in (files / "out").iterdir()} >= {"errors.csv", "table_accuracy.md", "comparison.csv"}
