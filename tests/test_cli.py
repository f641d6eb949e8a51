"""The commands where things go wrong, and what stands in the files when they do not."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnx
import pandas as pd
import pytest
import yaml
from commands import Ended, tubepose
from conftest import SMALL_RACK, SMALL_TUBES
from onnx import TensorProto, helper, numpy_helper

from tubepose.batch import framing
from tubepose.capture.mcap_writing import write_mcap
from tubepose.capture.source import open_captures
from tubepose.checks import SENTENCES
from tubepose.config import Config
from tubepose.detection.box_writing import write_yolo_txt
from tubepose.detection.geometric import GeometricDetector
from tubepose.evaluation import AXES
from tubepose.labware import load_rack, load_tube
from tubepose.pose_errors import COVARIANCE_COLUMNS
from tubepose.records import (
    CHECK_COLUMNS,
    ESTIMATE_COLUMNS,
    LABWARE_COLUMNS,
    POSE_COLUMNS,
    RACK_COLUMNS,
    RACK_COVARIANCE_COLUMNS,
    SENSOR_COLUMNS,
    SLOT_COLUMNS,
    TIMING_COLUMNS,
)
from tubepose.simulation import SceneVariation
from tubepose.transforms import FloatArray
from tubepose.uncertainty import COVERAGE_COLUMNS, UNCERTAINTY_COLUMNS
from tubepose_cli.show import describe_noise, describe_tubes, progress

KNOWN = ("--rack", SMALL_RACK, "--tubes", SMALL_TUBES[1])
DOCS = Path(__file__).parents[1] / "docs" / "outputs.md"


NET = 416


def digests(folder: Path) -> dict[str, str]:
    """Every file below a folder, hidden ones too."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def table(path: Path) -> pd.DataFrame:
    return pd.read_csv(path, keep_default_na=False)


def columns(path: Path) -> list[str]:
    return path.read_text().split("\n", 1)[0].split(",")


def original(session: Path, tube: str = SMALL_TUBES[1]) -> Path:
    return session / "captures" / f"{tube}-001-original"


def edited(session: Path, to: Path, edit: Callable[[str], str]) -> Path:
    """A copy of a session with another `session.yaml`."""
    shutil.copytree(session, to)
    (to / "session.yaml").write_text(edit((to / "session.yaml").read_text()))
    return to


def one_error(ended: Ended, *words: str) -> None:
    """Exit 1 with one line that holds all the words."""
    assert (ended.code, ended.out, "Traceback" in ended.err) == (1, "", False)
    (line,) = ended.errors
    assert all(word in line for word in words), line


# What is written


@pytest.fixture(scope="module")
def estimated(small_session: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Ended]:
    out = tmp_path_factory.mktemp("estimate") / "out"
    before = digests(small_session)
    ended = tubepose("estimate", small_session, "--out", out, "--method", "paper,upright")
    assert digests(small_session) == before
    return out, ended


@pytest.fixture(scope="module")
def benched(small_session: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Ended]:
    out = tmp_path_factory.mktemp("bench") / "out"
    return out, tubepose("bench", small_session, "--out", out, "--methods", "upright,paper,global-icp", "--seeds", "1")


def test_estimate_writes_these_files_and_no_others(estimated: tuple[Path, Ended]) -> None:
    out, ended = estimated
    assert (ended.code, ended.out, ended.errors) == (0, "", [])
    session = table(out / "racks.csv")["session"][0]
    pictures = {f"{session}-{tube}-001-original-0000.png" for tube in SMALL_TUBES}
    assert {path.name for path in (out / "overlays").iterdir()} == pictures
    tables = ("racks", "sensor", "slots", "estimates", "checks", "labware_check", "timings")
    files = {*(f"{name}.csv" for name in tables), "run.json", "overlays", "records"}
    assert {path.name for path in out.iterdir()} == files
    assert {path.name for path in out.parent.iterdir()} == {"out"}


def test_estimate_writes_exactly_these_columns(estimated: tuple[Path, Ended]) -> None:
    out, _ = estimated
    assert columns(out / "racks.csv") == list(RACK_COLUMNS)
    assert columns(out / "sensor.csv") == list(SENSOR_COLUMNS)
    assert columns(out / "slots.csv") == list(SLOT_COLUMNS)
    assert columns(out / "estimates.csv") == list(ESTIMATE_COLUMNS)
    assert columns(out / "checks.csv") == list(CHECK_COLUMNS)
    assert columns(out / "labware_check.csv") == list(LABWARE_COLUMNS)
    assert columns(out / "timings.csv") == list(TIMING_COLUMNS)


def test_every_rack_and_every_tube_has_its_checks(estimated: tuple[Path, Ended]) -> None:
    out, _ = estimated
    checks, tubes = table(out / "checks.csv"), table(out / "estimates.csv")
    assert set(checks["code"]) <= {*SENTENCES, "column_more", "column_fewer"}
    racks = table(out / "racks.csv")
    assert set(checks.loc[checks["subject"] == "rack", "capture"]) == set(racks["capture"])
    checked = set(zip(*(checks.loc[checks["subject"] == "tube", name] for name in ("capture", "slot")), strict=True))
    assert checked == set(zip(tubes["capture"], tubes["slot"], strict=True))
    failed = checks[(checks["subject"] == "tube") & ~checks["passed"] & checks["decides"]]
    rejected = tubes[tubes["status"] == "rejected"]
    assert set(failed["code"]) >= set(rejected["reason_code"])
    assert tubes.loc[tubes["status"] == "ok", "reason_code"].fillna("").eq("").all()
    # Neither of the two methods states a covariance.
    assert set(tubes["confidence"]) == {""}


def test_every_frame_has_its_noise_and_the_run_says_it_in_one_line(estimated: tuple[Path, Ended]) -> None:
    out, ended = estimated
    sensor = table(out / "sensor.csv")
    assert len(sensor) == 2
    assert (sensor[["independent_m", "spacing_m", "cap_slope_std", "cap_height_std_m"]] > 0).all(axis=None)
    (line,) = [line for line in ended.err.splitlines() if line.startswith("depth noise: ")]
    assert " mm independent, " in line


def test_noise_in_one_line_is_the_median_and_says_where_it_was_measured() -> None:
    prior = {
        "source": "prior", "independent_m": 9e-3, "shared_m": 9e-3, "correlation_m": 9e-3, "n_patches": 0,
        "edge_source": "prior", "edge_blur_px": 1.0, "note": "the rack's pose is not known",
    }  # fmt: skip
    seen = {
        "source": "table", "independent_m": 8e-5, "shared_m": 2e-5, "correlation_m": 3e-3, "n_patches": 142,
        "edge_source": "rack_outline", "edge_blur_px": 0.5, "note": "",
    }  # fmt: skip
    words = "depth noise: 0.08 mm independent, 0.02 mm shared over 3 mm"
    assert describe_noise([seen]) == f"{words} (measured on the table, 142 patches), edges 0.5 px"
    several = describe_noise([seen, prior, {**seen, "independent_m": 8.2e-5, "note": "odd"}])
    assert (
        several == "depth noise: 0.081 mm independent, 0.02 mm shared over 3 mm "
        "(measured on the table in 2 of 3 frames, 142 patches), edges 0.5 px; odd"
    )
    assert describe_noise([prior]) == (
        "depth noise: 9 mm independent, 9 mm shared over 9 mm (assumed, not measured), edges 1.0 px (assumed)"
    )


def test_every_slot_is_listed_and_the_filled_ones_are_the_declared(
    estimated: tuple[Path, Ended], small_session: Path
) -> None:
    slots = table(estimated[0] / "slots.csv")
    assert len(slots) == 2 * 2 * 12
    declared = {
        (trial["name"], slot, tube)
        for trial in yaml.safe_load((small_session / "session.yaml").read_text())["trials"]
        for slot, tube in trial["tubes"].items()
    }
    held = slots[(slots["method"] == "paper") & (slots["state"] == "occupied")]
    assert set(held[["trial", "slot", "tube"]].itertuples(index=False, name=None)) == declared
    assert set(slots["state"]) <= {"empty", "occupied", "not_seen", "unclear"}
    empty = slots[slots["state"].isin(["empty", "not_seen"])]
    assert set(empty["tube"]) == {""}
    assert set(empty["n_points"]) == {0}


def test_poses_have_unit_quaternions_and_stamps_all_digits(estimated: tuple[Path, Ended], small_session: Path) -> None:
    estimates = table(estimated[0] / "estimates.csv")
    quaternions = estimates[list(POSE_COLUMNS[3:])].to_numpy(float)
    assert np.linalg.norm(quaternions, axis=1) == pytest.approx(1)
    assert (quaternions[:, 0] >= 0).all()
    stamps = {
        yaml.safe_load((original(small_session, tube) / "capture.yaml").read_text())["timestamp_ns"]
        for tube in SMALL_TUBES
    }
    assert set(estimates["timestamp_ns"]) == stamps
    assert all(len(str(stamp)) == 19 for stamp in stamps)


def test_pictures_open_and_are_not_blank(estimated: tuple[Path, Ended]) -> None:
    for path in (estimated[0] / "overlays").iterdir():
        picture = cv2.imread(str(path))
        assert picture is not None
        assert picture.shape[1] >= 800
        assert picture.std() > 10


def test_the_run_record_has_what_the_page_says(
    estimated: tuple[Path, Ended], benched: tuple[Path, Ended], small_session: Path
) -> None:
    section = sections()["run.json"]
    keys = set(re.findall(r"`(\w+)`", " ".join(re.findall(r"^\|(.+?)\|", section, re.MULTILINE)))) - {"key"}
    for out, _ in (estimated, benched):
        record = json.loads((out / "run.json").read_text())
        assert keys <= set(record)
        assert record["command"][0] == "tubepose"
        assert record["problems"] == []
        cap = {"printed-square-16.7"} if out == benched[0] else set()
        assert {SMALL_RACK, *SMALL_TUBES} | cap == set(record["labware_sha256"])
        assert str(small_session) in record["inputs_sha256"]
        digests_found = [*record["labware_sha256"].values(), *record["inputs_sha256"].values()]
        assert all(re.fullmatch("[0-9a-f]{64}", digest) for digest in digests_found)
        assert {"python", "numpy", "scipy", "pandas"} <= set(record["versions"])


def test_a_second_run_into_the_same_folder_gives_the_same_bytes(
    estimated: tuple[Path, Ended], small_session: Path, tmp_path: Path
) -> None:
    out = Path(shutil.copytree(estimated[0], tmp_path / "out"))
    (out / "racks.csv").write_text("an old table\n")
    assert tubepose("estimate", small_session, "--out", out, "--method", "paper,upright").code == 0
    first, second = digests(estimated[0]), digests(out)
    changed = {name for name in first if first[name] != second.get(name)}
    assert set(first) == set(second)
    assert {name for name in changed if not name.startswith("records/")} <= {"timings.csv", "run.json"}


def test_bench_prints_both_tables_on_stdout_and_talks_on_stderr(benched: tuple[Path, Ended]) -> None:
    out, ended = benched
    assert ended.code == 0
    assert ended.out.index("Rotational and translational errors") < ended.out.index("Time costs")
    assert "SIMULATED" in ended.out
    assert "[Open3D" not in ended.out + ended.err
    noise, last = ended.err.splitlines()
    assert noise.startswith("depth noise: ")
    assert last == f"all tables and rows: {out}"
    assert not [name for name in digests(out) if "/." in f"/{name}"]
    for name in ("table_accuracy", "table_timing"):
        assert r"\end{table}" in (out / f"{name}.tex").read_text()
        assert "| ---" in (out / f"{name}.md").read_text()


def test_counts_add_up(benched: tuple[Path, Ended], small_session: Path) -> None:
    out, _ = benched
    summary, errors = table(out / "summary.csv"), table(out / "errors.csv")
    parts = ["n_ok", "n_rejected", "n_missed", "n_failed"]
    assert (summary["n_expected"] == summary[parts].sum(axis=1)).all()
    assert summary["n_expected"].sum() == (errors["outcome"] != "false").sum()
    assert list(summary["method"].unique()) == ["upright", "paper", "global-icp"]
    assert set(summary.loc[summary["method"] == "upright", "tube"]) == set(SMALL_TUBES)
    accuracy = table(out / "table_accuracy.csv")
    assert accuracy["n_ok"].sum() == summary["n_ok"].sum()


# The page about the files


def sections() -> dict[str, str]:
    parts = DOCS.read_text(encoding="utf-8").split("\n## ")[1:]
    return {part.split("\n", 1)[0].strip(): part for part in parts}


def documented(name: str) -> set[str]:
    """Columns that docs/outputs.md gives a file: those of its keys, and those of its table."""
    text = sections()[f"{name}.csv"]
    keys = re.search(r"(?:Keys:|columns are) (.+?)(?:\.|, and:)", text, re.DOTALL)
    told = set(re.findall(r"\w+", re.sub(r"\(.*?\)", "", keys.group(1), flags=re.DOTALL))) if keys else set()
    for cell in re.findall(r"^\|(.+?)\|", text, re.MULTILINE):
        if "`tx_m` ... `qz`" in cell:
            told |= set(POSE_COLUMNS)
        elif "`cov_rx_rx` ... `cov_tz_tz`" in cell:
            told |= set(RACK_COVARIANCE_COLUMNS if name == "racks" else COVARIANCE_COLUMNS)
        else:
            told |= set(re.findall(r"`([^`]+)`", cell))
    generic = {column for column in told if column.startswith("X_")}
    outcomes = {"ok", "rejected", "missed", "failed", "false"}
    return (told - generic - outcomes) | {axis + column[1:] for column in generic for axis in AXES}


@pytest.mark.parametrize(
    "name",
    [
        "racks", "sensor", "slots", "estimates", "checks", "labware_check", "timings", "ground_truth", "errors",
        "summary", "comparison", "seeds",
        "slot_accuracy", "uncertainty", "coverage", "confusion",
    ],
)  # fmt: skip
def test_the_page_and_the_file_have_the_same_columns(name: str, benched: tuple[Path, Ended]) -> None:
    assert documented(name) == set(columns(benched[0] / f"{name}.csv"))


def test_the_page_lists_every_code_of_a_check() -> None:
    told = set(re.findall(r"`(\w+)`", " ".join(re.findall(r"^\|(.+?)\|", sections()["Codes of checks"], re.MULTILINE))))
    assert told == {*SENTENCES, "column_more", "column_fewer"}


def test_the_page_and_the_tables_have_the_same_columns(benched: tuple[Path, Ended]) -> None:
    assert documented_words("table_accuracy") == set(columns(benched[0] / "table_accuracy.csv"))
    cells = " ".join(re.findall(r"^\|(.+?)\|", sections()["table_timing"], re.MULTILINE))
    assert set(re.findall(r"`(\w+)`", cells)) == set(columns(benched[0] / "table_timing.csv"))
    floor = sections()["ground_truth.csv"].split("`ground_truth_floor.csv`")[1]
    words = set(re.findall(r"\w+", floor.split("Columns ")[1].split(" as in ")[0])) - {"and"}
    assert words == set(columns(benched[0] / "ground_truth_floor.csv"))


def documented_words(name: str) -> set[str]:
    text = sections()[name].split("CSV columns:")[1].split(": `measured`")[0]
    quoted = re.findall(r"`([^`]+)`", text)
    return {word for words in quoted for word in words.split() if not word.endswith(".csv")}


def test_the_page_lists_every_file(benched: tuple[Path, Ended]) -> None:
    page = DOCS.read_text(encoding="utf-8").split("\n## ")[0]
    for path in benched[0].iterdir():
        stem = path.name if not path.name.startswith("table_") else f"`{path.stem}.csv .md .tex`"
        assert stem in page


# One line each, and the rest is done


def write_ply(path: Path, points: FloatArray) -> None:
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(points)}\n"
    head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    path.write_bytes(head.encode() + points.astype("<f4").tobytes())


@pytest.fixture(scope="module")
def damaged(small_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a good capture first, then a cut, an incomplete and several contradictory ones, then a good one."""
    folder = tmp_path_factory.mktemp("damaged") / "captures"
    shutil.copytree(original(small_session), folder / "a-good")
    frame = next(open_captures(original(small_session))[0].frames())
    points = np.nan_to_num(frame.points_m)
    write_mcap(folder / "b-cut.mcap", [frame])
    content = (folder / "b-cut.mcap").read_bytes()
    (folder / "b-cut.mcap").write_bytes(content[: len(content) // 2])
    contents = {
        "c-missing": "unit: m\ncloud: scan.ply\n",
        "d-mm-as-m": "unit: m\n",
        "e-m-as-mm": "unit: mm\n",
        "f-key": "unit: m\nuntis: mm\n",
        "g-size": "unit: m\ncloud_width: 400\ncloud_height: 400\n",
        "h-cut-cloud": "unit: m\n",
    }
    for name, text in contents.items():
        (folder / name).mkdir()
        (folder / name / "capture.yaml").write_text(text)
        if name != "c-missing":
            step = 3 if name in ("d-mm-as-m", "e-m-as-mm") else 1
            write_ply(folder / name / "cloud.ply", points[::step] * (1000 if name == "d-mm-as-m" else 1))
    cv2.imwrite(str(folder / "g-size" / "image.png"), np.zeros((300, 300), np.uint8))
    whole = (folder / "h-cut-cloud" / "cloud.ply").read_bytes()
    (folder / "h-cut-cloud" / "cloud.ply").write_bytes(whole[: len(whole) // 2])
    (folder / "i-frame.zdf").write_bytes(b"")
    (folder / "notes.txt").write_text("nothing of a capture")
    shutil.copytree(original(small_session), folder / "z-good")
    return folder


def test_a_batch_with_bad_captures_names_each_in_one_line_and_does_the_good(damaged: Path, tmp_path: Path) -> None:
    ended = tubepose("estimate", damaged, *KNOWN, "--method", "upright", "--no-overlays", "--out", tmp_path / "out")
    assert (ended.code, ended.out, "Traceback" in ended.err) == (1, "", False)
    wanted = (
        ("b-cut.mcap", "truncated before the end of its first frame", "record it again"),
        ("c-missing/scan.ply", "no such file"),
        ("d-mm-as-m", "1000 times larger", "unit"),
        ("e-m-as-mm", "1000 times smaller", "unit"),
        ("f-key/capture.yaml", "unknown key 'untis'", "known keys: unit"),
        ("g-size", "300 x 300", "400 x 400"),
        ("h-cut-cloud/cloud.ply", "truncated", "160000"),
        ("i-frame.zdf", "Zivid", "save it as PLY"),
    )
    assert len(ended.errors) == len(wanted)
    for line, words in zip(ended.errors, wanted, strict=True):
        assert all(word in line for word in words), line
    racks = table(tmp_path / "out" / "racks.csv").set_index("capture")["status"].to_dict()
    assert racks == {"a-good": "ok", "d-mm-as-m": "wrong_unit", "e-m-as-mm": "wrong_unit", "z-good": "ok"}
    assert (table(tmp_path / "out" / "estimates.csv")["status"] == "ok").sum() == 4
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert [f"error: {line}" for line in record["problems"]] == ended.errors
    assert not [name for name in digests(tmp_path) if "/." in f"/{name}"]


def test_fail_fast_ends_with_the_first_bad_capture(damaged: Path, tmp_path: Path) -> None:
    ended = tubepose("estimate", damaged, *KNOWN, "--no-overlays", "--fail-fast", "--out", tmp_path / "out")
    one_error(ended, "b-cut.mcap: truncated")
    assert set(table(tmp_path / "out" / "racks.csv")["capture"]) == {"a-good"}
    assert "--resume goes on with it" in tubepose("estimate", damaged, *KNOWN, "--out", tmp_path / "out").errors[0]


@pytest.mark.parametrize(("after", "words"), [(0, "no estimate is written"), (1, "and in the tables")])
def test_ctrl_c_is_one_line_and_what_was_done_is_written(
    after: int, words: str, small_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare, asked = framing.prepare_scene, []

    def stopped(*args: Any) -> Any:
        if len(asked) == after:
            raise KeyboardInterrupt
        asked.append(args[0].capture)
        return prepare(*args)

    monkeypatch.setattr(framing, "prepare_scene", stopped)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "errors.csv").write_text("of an earlier bench")
    ended = tubepose("estimate", small_session, "--no-overlays", "--out", tmp_path / "out")
    (line,) = ended.errors
    assert ended.code == 130
    assert line.startswith(f"error: interrupted: {after or 'no'} frame is done")
    assert words in line
    if after:
        assert not (tmp_path / "out" / "errors.csv").exists()
        assert set(table(tmp_path / "out" / "racks.csv")["capture"]) == set(asked)
        assert "interrupted: 1 frame is done" in json.loads((tmp_path / "out" / "run.json").read_text())["problems"][0]
    else:
        assert list(digests(tmp_path)) == ["out/errors.csv"]


@pytest.mark.parametrize("command", ["estimate", "bench"])
def test_fail_fast_ends_with_a_trial_without_its_capture(command: str, small_session: Path, tmp_path: Path) -> None:
    session = edited(small_session, tmp_path / "s", lambda text: re.sub("  printed: .*\n", "", text))
    shutil.rmtree(original(session, SMALL_TUBES[0]))
    one_error(tubepose(command, session, "--fail-fast", "--out", tmp_path / "out"), "no such file or folder")
    assert not (tmp_path / "out" / "racks.csv").exists()


def test_a_session_that_cannot_be_read_does_not_stop_the_next(small_session: Path, tmp_path: Path) -> None:
    def unprinted(text: str) -> str:
        return re.sub("  printed: .*\n", "", text)

    good = edited(small_session, tmp_path / "good", lambda text: unprinted(text).replace("name: ray", "name: good-ray"))
    key = edited(small_session, tmp_path / "key", lambda text: text + "notes: none\n")
    tube = edited(small_session, tmp_path / "tube", lambda text: re.sub(r": blood-16x100\b(?=[,}])", ": nope", text))
    rack = edited(
        small_session, tmp_path / "rack", lambda text: text.replace(SMALL_RACK + "\nprinted", "r.yaml\nprinted")
    )
    (rack / "r.yaml").write_text("kind: rack\nname: r\noutlin_mm: [100, 50]\n")
    gone = tmp_path / "gone"
    ended = tubepose("bench", key, tube, rack, gone, good, "--methods", "upright", "--out", tmp_path / "out")
    assert (ended.code, ended.out) == (1, "")
    wanted = (
        "gone: no such file or folder",
        "unknown key 'notes'; known keys: format, name",
        "unknown tube 'nope'; known: blood-13x100",
        "unknown key 'outlin_mm'; known keys: kind, name",
    )
    assert len(ended.errors) == len(wanted)
    for line, words in zip(ended.errors, wanted, strict=True):
        assert words in line
    assert "no trial has a capture with printed caps" in ended.err
    assert list(table(tmp_path / "out" / "racks.csv")["status"]) == ["ok", "ok"]
    assert len(json.loads((tmp_path / "out" / "run.json").read_text())["problems"]) == 4


def test_captures_of_one_name_are_not_mixed_up(small_session: Path, tmp_path: Path) -> None:
    for place in "ab":
        shutil.copytree(original(small_session), tmp_path / place / "scan")
    paths = tmp_path / "a" / "scan", tmp_path / "b" / "scan"
    options = (*KNOWN, "--method", "upright", "--no-overlays", "--out", tmp_path / "out")
    one_error(tubepose("estimate", *paths, *options), f"{paths[1]}: {paths[0]} has the same name 'scan'", "give the")
    assert len(table(tmp_path / "out" / "racks.csv")) == 1
    one_error(tubepose("estimate", *paths, *options, "--fail-fast"), "has the same name")
    one_error(tubepose("estimate", paths[0], paths[0], *options), f"{paths[0]}: given twice; its rows are there once")


def test_known_rack_needs_the_exact_truth_and_says_which_session_has_none(small_session: Path, tmp_path: Path) -> None:
    session = edited(small_session, tmp_path / "s", lambda text: text.replace("origin: simulated", "origin: recorded"))
    shutil.rmtree(session / "captures")
    ended = tubepose("bench", session, "--known-rack", "--methods", "upright", "--out", tmp_path / "out")
    assert (ended.code, "Traceback" in ended.err) == (1, False)
    assert any("is recorded: only simulated ones know" in line for line in ended.errors)
    assert (tmp_path / "out" / "run.json").is_file()


def test_gt_keeps_its_problems_in_the_record(small_session: Path, tmp_path: Path) -> None:
    session = edited(small_session, tmp_path / "s", str)
    shutil.rmtree(session / "captures" / f"{SMALL_TUBES[0]}-001-printed")
    ended = tubepose("gt", session, "--out", tmp_path / "out")
    one_error(ended, f"{SMALL_TUBES[0]}-001-printed: no such file or folder")
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert [f"error: {line}" for line in record["problems"]] == ended.errors
    assert "printed-square-16.7" in record["labware_sha256"]
    truth = table(tmp_path / "out" / "ground_truth.csv")
    assert set(truth["tube"]) == {SMALL_TUBES[1]}
    assert set(truth["status"]) == {"ok"}
    assert {path.name for path in (tmp_path / "out").iterdir()} == {
        "ground_truth.csv", "ground_truth_floor.csv", "run.json"
    }  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--method", "papr"), "unknown method 'papr'; did you mean 'paper'?; known: profile, paper, upright"),
        (("--method", ","), "no method is named; expected one or more of profile, paper"),
        (("--detector", "geometrc"), "unknown detector 'geometrc'; did you mean 'geometric'?; known: geometric, yolo"),
        (("--detector", "recorded"), "--detector recorded needs --boxes PATH"),
        (("--detector", "recorded", "--boxes", "none"), "none: no such file or folder; expected a COCO .json"),
        (("--detector", "yolo", "--model", "none.onnx"), "none.onnx: no such model file; expected an .onnx file"),
        (("--rack", "round-10-3x4"), "unknown rack 'round-10-3x4'; did you mean 'round-10ml-3x4'?; known: "),
        (("--rack", "rack.yaml"), "rack.yaml: the key 'outline_mm' is missing"),
        (("--tubes", "blood-16x10"), "unknown tube 'blood-16x10'; did you mean 'blood-16x100'?; known: "),
        (("--unit", "cm"), "unit 'cm' is not known; expected m or mm"),
        (("--hint", "Z9@1,1"), "no slot Z9 in rack round-10ml-3x4; its slots run from A1 to C4"),
        (("--hint", "Z9@top"), "--hint Z9@top: no slot Z9 in rack round-10ml-3x4"),
        (("--hint", "A1@100,-50,620"), "--hint A1@100,-50,620: the point is 630 m away; expected metres"),
        (("--hint", "A1@top", "--hint", "B1@top"), "--hint A1@top,B1@top: expected SLOT@U,V"),
        (("--hints", "none.csv"), "none.csv: cannot be read"),
        (("--config", "none.yaml"), "none.yaml: no such file"),
        (("--config", "wrong.yaml"), "wrong.yaml: unknown key 'rak'; known keys: preprocess, rack_top, rack"),
    ],
)
def test_a_wrong_option_is_one_line(
    arguments: tuple[str, ...], message: str, small_session: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "wrong.yaml").write_text("rak: {min_fitness: 0.5}\n")
    (tmp_path / "rack.yaml").write_text("kind: rack\nname: r\n")
    monkeypatch.chdir(tmp_path)
    one_error(tubepose("estimate", original(small_session), "--out", "out", *KNOWN, *arguments), message)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ("out", "--sensor", "raycst"),
            "unknown sensor 'raycst'; did you mean 'raycast'?; known: raycast, structured-light",
        ),
        (("out", "--cap", "printed-square"), "unknown cap 'printed-square'; did you mean 'printed-square-16.7'?"),
        (("out", "--tubes", ","), "--tubes ',' names no tube; see 'tubepose labware list'"),
        (("out", "--tubes", "centrifuge-50ml-conical"), "cannot stand in rack 'round-10ml-3x4'"),
        (
            ("out", "--fill", "1.5"),
            "--fill: fill: expected [least, most] with 0 <= least <= most <= 1, found [1.5, 1.5]",
        ),
        (("out", "--fill", "0.4-0.1"), "--fill: fill: expected [least, most]"),
        (("out", "--fill", "some"), "--fill some: expected a number or a range, for example 0.3 or 0.1-0.4"),
        (("out", "--liquid", "2"), "--liquid: liquid_share: Input should be less than or equal to 1"),
        (("out", "--scenes", "nowhere.yaml"), "nowhere.yaml: no such file"),
        (("file",), "file: there is something already"),
        (("file/out",), "file/out: cannot be written"),
    ],
)
def test_simulate_refuses_in_one_line(
    arguments: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.chdir(tmp_path)
    one_error(tubepose("simulate", "--rack", SMALL_RACK, "--tubes", SMALL_TUBES[0], *arguments), message)
    assert list(digests(tmp_path)) == ["file"]


@pytest.mark.parametrize("command", ["estimate", "gt", "bench"])
@pytest.mark.parametrize("place", ["file", "file/out"])
def test_results_cannot_go_where_a_file_is(command: str, place: str, small_session: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("kept")
    one_error(tubepose(command, small_session, "--out", tmp_path / place), "cannot be a folder for results")
    assert (tmp_path / "file").read_text() == "kept"


@pytest.mark.parametrize(
    "arguments",
    [
        ("estimate", "--out", "out"),
        ("estimate", "x"),
        ("estimate", "x", "--out", "out", "--seeds", "0"),
        ("gt", "--out", "out"),
        ("bench", "x", "--nope"),
        ("simulate", "out"),
        ("simulate", "out", "--rack", SMALL_RACK, "--tubes", SMALL_TUBES[0], "--format", "bag"),
        ("frobnicate",),
    ],
)
def test_wrong_usage_is_exit_2(arguments: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    ended = tubepose(*arguments)
    assert (ended.code, ended.out, "Traceback" in ended.err) == (2, "", False)
    assert ended.err.startswith("Usage: ")
    assert list(tmp_path.iterdir()) == []


# The same content another way


def test_simulate_gives_the_same_bytes_for_the_same_seed(tmp_path: Path) -> None:
    options = (
        "--rack",
        SMALL_RACK,
        "--tubes",
        ",".join(SMALL_TUBES),
        "--mixed",
        "--trials",
        "1",
        "--resolution",
        "128",
        "--threads",
        "1",
    )
    for name, seed in (("one", "5"), ("two", "5"), ("other", "6")):
        ended = tubepose("simulate", tmp_path / name, *options, "--seed", seed)
        assert (ended.code, ended.out) == (0, ""), ended.err
    one, two, other = (digests(tmp_path / name) for name in ("one", "two", "other"))
    assert one == two
    assert "session.yaml" in one
    assert not set(one.values()) & {other["session.yaml"], *(v for k, v in other.items() if k.endswith("depth.png"))}
    assert {path.name for path in tmp_path.iterdir()} == {"one", "two", "other"}


def test_a_flag_goes_before_the_file_and_the_file_before_the_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: dict[str, Any] = {}
    monkeypatch.setattr("tubepose.simulation.simulate_session", lambda *_places, **options: asked.update(options))
    (tmp_path / "scenes.yaml").write_text(
        "fill: [0.1, 1.0]\nlabel_share: 0.3\nscattering_per_mm: [0, 1]\ntolerances: {cap_tilt_deg: 2.0}\n"
    )
    session = ("simulate", tmp_path / "out", "--rack", SMALL_RACK, "--tubes", SMALL_TUBES[0])
    flags = ("--fill", "0.3", "--scattering", "0.2-.5", "--liquid", "0.4", "--perfect-parts", "--no-calibration-error")
    ended = tubepose(*session, "--scenes", tmp_path / "scenes.yaml", *flags, "--threads", "3")
    assert ended.code == 0, ended.err
    given = asked["variation"]
    assert (given.fill, given.scattering_per_mm, given.liquid_share) == ((0.3, 0.3), (0.2, 0.5), 0.4)
    assert (given.label_share, given.table_albedo) == (0.3, (0.15, 0.15))
    assert set(given.tolerances.model_dump().values()) == {0.0}
    assert (asked["threads"], asked["calibration_error"], asked["sensor"]) == (3, False, "raycast")
    assert tubepose(*session).code == 0
    assert asked["variation"] == SceneVariation()
    assert (asked["threads"] >= 1, asked["calibration_error"]) == (True, True)


def test_progress_without_a_terminal_is_a_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter([0.0, 20.0, 61.0, 90.0, 7000.0, 7100.0])
    monkeypatch.setattr("tubepose_cli.show.time.monotonic", lambda: next(clock))
    with progress("captures", 4) as step:
        for _ in range(4):
            step()
    assert capsys.readouterr().err.splitlines() == [
        "captures: 1/4, about 3 min left",
        "captures: 3/4, about 39 min left",
    ]


def test_bench_gives_the_same_bytes_twice(benched: tuple[Path, Ended], small_session: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    methods = ("--methods", "upright,paper,global-icp", "--seeds", "1")
    assert tubepose("bench", small_session, "--out", out, *methods).code == 0
    first, second = digests(benched[0]), digests(out)
    assert set(first) == set(second)
    changed = {name for name in first if first[name] != second[name]}
    changed = {name for name in changed if not name.startswith("records/")}  # with times
    assert changed <= {"timings.csv", "run.json", "table_timing.csv", "table_timing.md", "table_timing.tex"}


def test_recordings_give_the_same_slots_and_truth_as_folders(benched: tuple[Path, Ended], tmp_path: Path) -> None:
    ended = tubepose(
        "simulate", tmp_path / "s", "--rack", SMALL_RACK, "--tubes", ",".join(SMALL_TUBES), "--trials", "1",
        "--seed", "9", "--resolution", "400", "--fill", "0.2", "--format", "mcap", "--threads", "1",
    )  # fmt: skip
    assert ended.code == 0
    assert {path.suffix for path in (tmp_path / "s" / "captures").iterdir()} == {".mcap"}
    ended = tubepose("bench", tmp_path / "s", "--methods", "upright", "--overlays", "--out", tmp_path / "out")
    assert (ended.code, ended.errors) == (0, [])
    assert len(list((tmp_path / "out" / "overlays").iterdir())) == 2
    folders, recordings = (table(out / "slots.csv") for out in (benched[0], tmp_path / "out"))
    folders = folders[folders["method"] == "upright"].reset_index(drop=True)
    same = ["trial", "capture", "frame", "slot", "state", "tube", "status"]
    assert folders[same].equals(recordings[same])
    truths = [pd.read_csv(out / "ground_truth.csv")[list(POSE_COLUMNS)] for out in (benched[0], tmp_path / "out")]
    # Depth images in folders are rounded to 0.02 mm.
    assert truths[0].to_numpy() == pytest.approx(truths[1].to_numpy(), abs=1e-3)


def test_a_known_rack_is_not_registered(small_session: Path, tmp_path: Path) -> None:
    ended = tubepose("bench", small_session, "--known-rack", "--methods", "upright", "--out", tmp_path / "out")
    assert ended.code == 0
    assert "its pose given" in ended.out
    assert set(table(tmp_path / "out" / "racks.csv")["resolved_by"]) == {"given"}
    assert "rack" not in set(table(tmp_path / "out" / "timings.csv")["stage"])


def test_exact_poses_judge_without_printed_caps_and_the_bytes_repeat(small_session: Path, tmp_path: Path) -> None:
    arguments = ("bench", small_session, "--exact-truth", "--methods", "profile,upright", "--out")
    ended = tubepose(*arguments, tmp_path / "out")
    assert (ended.code, ended.errors) == (0, [])
    assert "Truth: the exact poses of the simulation, not those measured from printed caps." in ended.out
    out = tmp_path / "out"
    assert not (out / "ground_truth_floor.csv").exists()
    truth, errors = table(out / "ground_truth.csv"), table(out / "errors.csv")
    assert set(truth["reason"]) == {"exact"}
    assert len(truth) == 4
    assert set(errors["outcome"]) == {"ok"}
    assert len(errors) == 8
    of_profile = errors[errors["method"] == "profile"]
    assert (of_profile["mahalanobis2"].astype(float) >= 0).all()
    assert set(errors.loc[errors["method"] == "upright", "mahalanobis2"]) == {""}
    assert (of_profile["tilt_deg"].astype(float) < 0.6).all()
    assert columns(out / "uncertainty.csv") == list(UNCERTAINTY_COLUMNS)
    assert columns(out / "coverage.csv") == list(COVERAGE_COLUMNS)
    honest = table(out / "uncertainty.csv")
    assert set(honest["method"]) == {"profile"}
    assert set(honest["tube"]) == {*SMALL_TUBES, "all"}
    assert honest.loc[honest["tube"] == "all", "n"].tolist() == [4]
    assert "% of 4 truths inside the stated 95 % region" in ended.out
    assert tubepose(*arguments, tmp_path / "again").code == 0
    first, second = digests(out), digests(tmp_path / "again")
    assert set(first) == set(second)
    changed = {name for name in first if first[name] != second[name]}
    assert all(name == "run.json" or "timing" in name or name.startswith("records/") for name in changed)


def test_exact_poses_of_a_recorded_session_are_one_line_and_the_others_are_done(
    small_session: Path, tmp_path: Path
) -> None:
    recorded = edited(
        small_session,
        tmp_path / "recorded",
        lambda text: text.replace("origin: simulated", "origin: recorded").replace("name: raycast", "name: real"),
    )
    arguments = ("bench", recorded, small_session, "--exact-truth", "--methods", "upright", "--out", tmp_path / "out")
    ended = tubepose(*arguments)
    assert ended.code == 1
    (line,) = ended.errors
    assert "is recorded: only simulated ones know exact poses" in line
    assert len(table(tmp_path / "out" / "ground_truth.csv")) == 4
    stopped = tubepose(*arguments, "--fail-fast")
    one_error(stopped, "is recorded: only simulated ones know exact poses")


def test_sessions_of_one_name_are_not_mixed_up(small_session: Path, tmp_path: Path) -> None:
    copy = edited(small_session, tmp_path / "copy", str)
    ended = tubepose("gt", small_session, copy, "--out", tmp_path / "out")
    one_error(ended, f"{copy}: its session name", f"that of {small_session} too; change 'name' in one of them")
    assert len(table(tmp_path / "out" / "ground_truth.csv")) == 4


# Boxes from elsewhere


def constant_network(path: Path, rows: list[list[float]], names: list[str]) -> None:
    """A network that finds these boxes (left, top, right, bottom, score, class) in every image."""
    boxes = numpy_helper.from_array(np.array([rows], np.float32), "boxes")
    zero = numpy_helper.from_array(np.array(0, np.float32), "zero")
    nodes = [
        helper.make_node("ReduceMax", ["images"], ["peak"], keepdims=0),
        helper.make_node("Mul", ["peak", "zero"], ["nothing"]),
        helper.make_node("Add", ["boxes", "nothing"], ["output0"]),
    ]
    images = helper.make_tensor_value_info("images", TensorProto.FLOAT, (1, 3, NET, NET))
    output = helper.make_tensor_value_info("output0", TensorProto.FLOAT, None)
    graph = helper.make_graph(nodes, "constant", [images], [output], [boxes, zero])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    helper.set_model_props(model, {"names": str(dict(enumerate(names))), "task": "detect"})
    onnx.save(model, str(path))


@pytest.mark.parametrize("source", ["yolo", "recorded"])
def test_boxes_from_elsewhere_give_the_same_slots(
    source: str, small_session: Path, estimated: tuple[Path, Ended], tmp_path: Path
) -> None:
    rack, tube = load_rack(SMALL_RACK), load_tube(SMALL_TUBES[1])
    frame = next(open_captures(original(small_session))[0].frames())
    found = GeometricDetector(rack, (tube,), Config()).detect(frame)
    names = list(dict.fromkeys(box.class_name for box in found))
    height, width = frame.cloud_m.shape[:2]
    if source == "yolo":
        zoom = NET / width
        rows = [[*(edge * zoom for edge in box.box_xyxy_px), 0.9, names.index(box.class_name)] for box in found]
        constant_network(tmp_path / "boxes.onnx", rows, names)
        place = ("--model", tmp_path / "boxes.onnx")
    else:
        (tmp_path / "boxes").mkdir()
        (tmp_path / "boxes" / "classes.txt").write_text("\n".join(names))
        write_yolo_txt(tmp_path / "boxes" / f"{frame.capture}.txt", found, (width, height), names)
        place = ("--boxes", tmp_path / "boxes")
    hint = yaml.safe_load((small_session / "session.yaml").read_text())["trials"][1]["hint"]
    ended = tubepose(
        "estimate", original(small_session), *KNOWN, "--detector", source, *place, "--no-overlays",
        "--hint", f"{hint['slot']}@{hint['pixel'][0]},{hint['pixel'][1]}", "--out", tmp_path / "out",
    )  # fmt: skip
    assert (ended.code, ended.errors, "ambiguous" in ended.err) == (0, [], False)
    slots, wanted = table(tmp_path / "out" / "slots.csv"), table(estimated[0] / "slots.csv")
    wanted = wanted[(wanted["capture"] == frame.capture) & (wanted["method"] == "paper")]
    assert list(slots["state"]) == list(wanted["state"])
    assert list(slots["status"]).count("ok") == 2
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert record["detector"] == source
    assert str(place[1]) in record["inputs_sha256"]


def test_what_became_of_the_tubes_is_said_with_the_commonest_reason() -> None:
    rows = [
        {"status": "ok", "reason": "", "reason_code": ""},
        *({"status": "rejected", "reason": "too tall", "reason_code": "tall"} for _ in range(2)),
    ]
    assert describe_tubes(rows) == "1 tubes ok, 2 rejected (too tall)"
    assert describe_tubes([]) == "0 tubes ok"


# Which way round it stands

CLOUD_ALONE = ("--rack", SMALL_RACK, "--detector", "geometric", "--method", "upright", "--no-overlays")


@pytest.fixture(scope="module")
def twice(small_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with two captures of a rack that was left alone."""
    folder = tmp_path_factory.mktemp("twice")
    for name in ("one", "two"):
        shutil.copytree(original(small_session), folder / name)
    return folder


def test_a_rack_that_may_stand_another_way_round_ends_with_1_and_a_hint_that_works(twice: Path, tmp_path: Path) -> None:
    run = ("estimate", twice, *CLOUD_ALONE, "--require-unambiguous", "--out", tmp_path / "out")
    ended = tubepose(*run)
    one_error(
        ended, "2 of 2 captures hold a rack that could as well stand another way round", "may be swapped: one, two;"
    )
    assert set(table(tmp_path / "out" / "slots.csv")["ambiguous"].astype(str)) == {"True"}
    given = table(tmp_path / "out" / "racks.csv")
    said = re.search(r"give --hint (\S+) if its slots are named right, else (\S+); racks that", ended.errors[0])
    assert said is not None
    for example, turned in ((said.group(1), False), (said.group(2), True)):
        ended = tubepose(*run, "--hint", example)
        assert (ended.code, ended.errors) == (0, [])
        racks = table(tmp_path / "out" / "racks.csv")
        assert set(racks["resolved_by"]) == {"hint"}
        assert set(table(tmp_path / "out" / "slots.csv")["ambiguous"].astype(str)) == {"False"}
        same = np.allclose(racks[list(POSE_COLUMNS[3:])].to_numpy(float), given[list(POSE_COLUMNS[3:])].to_numpy(float))
        assert same is not turned


def test_without_the_option_an_ambiguous_rack_is_said_and_no_error(twice: Path, tmp_path: Path) -> None:
    ended = tubepose("estimate", twice, *CLOUD_ALONE, "--out", tmp_path / "out")
    assert (ended.code, ended.errors) == (0, [])
    assert "may stand another way round (slot names may be swapped; give --hint A1@" in ended.err


@pytest.mark.parametrize("options", [("--hint", "A1@top", "--hint", "previous"), ("--hint", "previous,A1@top")])
def test_one_hint_and_previous_serve_a_folder(options: tuple[str, ...], twice: Path, tmp_path: Path) -> None:
    ended = tubepose("estimate", twice, *CLOUD_ALONE, "--require-unambiguous", *options, "--out", tmp_path / "out")
    assert (ended.code, ended.errors) == (0, [])
    assert list(table(tmp_path / "out" / "racks.csv")["resolved_by"]) == ["hint", "previous"]


@pytest.mark.parametrize("text", ["capture,hint\none,A1@top\n", "\ufeffhint;capture\n A1@top;one\n\n"])
def test_a_file_gives_captures_hints_of_their_own(text: str, twice: Path, tmp_path: Path) -> None:
    (tmp_path / "hints.csv").write_text(text, encoding="utf-8")
    run = ("estimate", twice, *CLOUD_ALONE, "--hints", tmp_path / "hints.csv", "--out", tmp_path / "out")
    assert tubepose(*run).code == 0
    assert list(table(tmp_path / "out" / "racks.csv")["resolved_by"]) == ["hint", "rule"]
    assert tubepose(*run, "--hint", "previous").code == 0
    assert list(table(tmp_path / "out" / "racks.csv")["resolved_by"]) == ["hint", "previous"]
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert str(tmp_path / "hints.csv") in record["inputs_sha256"]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "expected a first line 'capture,hint', found ''"),
        ("scan,where\none,A1@top\n", "expected a first line 'capture,hint', found 'scan,where'"),
        (
            "capture,hint\none,A1@4,5\n",
            ', line 2: more than two columns; put a hint with commas into quotes: "A1@412,300"',
        ),
        ("capture,hint\none,A1@up\n", ", line 2: hint A1@up: expected SLOT@U,V"),
        ("capture,hint\none,Z9@top\n", ", line 2: hint Z9@top: no slot Z9 in rack round-10ml-3x4"),
        ("capture,hint\none,\n", ", line 2: capture one has no hint; leave the line out"),
        ("capture,hint\none,A1@top\none,A1@top\n", ", line 3: capture one is there twice"),
        ("capture,hint\nthree,A1@top\n", "no capture is named three; the captures are one, two"),
    ],
)
def test_a_file_of_hints_that_cannot_be_used_is_one_line(text: str, words: str, twice: Path, tmp_path: Path) -> None:
    (tmp_path / "hints.csv").write_text(text)
    run = ("estimate", twice, *CLOUD_ALONE, "--hints", tmp_path / "hints.csv", "--out", tmp_path / "out")
    one_error(tubepose(*run), f"{tmp_path / 'hints.csv'}", words)


def test_without_tubes_it_is_said_that_only_the_rack_is_estimated(small_session: Path, tmp_path: Path) -> None:
    ended = tubepose("estimate", original(small_session), "--rack", SMALL_RACK, "--out", tmp_path / "out")
    assert ended.code == 0
    assert "only the rack and its slots are estimated" in ended.err


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--hint", "A1@10,10"), "--hint given, but a session says that itself"),
        (("--hint", "previous"), "--hint given, but a session says that itself"),
        (("--unit", "mm", "--depth-topic", "/d"), "--unit, --depth-topic given, but a session says that itself"),
    ],
)
def test_an_option_that_a_session_decides_is_refused(
    options: tuple[str, ...], words: str, small_session: Path, tmp_path: Path
) -> None:
    ended = tubepose("estimate", small_session, *options, "--out", tmp_path / "out")
    assert ended.code == 1
    assert any(words in line for line in ended.errors)


@pytest.mark.parametrize(
    ("detector", "options"),
    [
        ("geometric", ("--model", "nope.onnx")),
        ("yolo", ("--boxes", "nope")),
        ("recorded", ("--layout", "yolox", "--boxes", "nope")),
    ],
)
def test_an_option_that_a_detector_does_not_read_is_refused(
    detector: str, options: tuple[str, ...], small_session: Path, tmp_path: Path
) -> None:
    ended = tubepose("estimate", small_session, "--detector", detector, *options, "--out", tmp_path / "out")
    assert ended.code == 1
    assert ended.errors == [f"error: {options[0]} given, but --detector {detector} has no use for it; leave it out"]
    assert not (tmp_path / "out").exists()


def test_a_session_without_a_readable_capture_has_all_its_tubes_missed(small_session: Path, tmp_path: Path) -> None:
    session = tmp_path / "broken"
    shutil.copytree(small_session, session)
    text = (session / "session.yaml").read_text()
    (session / "session.yaml").write_text(re.sub(r"original: (\S+)", r"original: \1-gone", text))
    ended = tubepose("bench", session, "--methods", "upright", "--out", tmp_path / "out")
    assert ended.code == 1
    assert ended.errors
    errors = table(tmp_path / "out" / "errors.csv")
    assert len(errors)
    assert set(errors["outcome"]) == {"missed"}


def test_a_folder_of_sessions_is_each_of_them(small_session: Path, tmp_path: Path) -> None:
    above = tmp_path / "all"
    for name in ("one", "two"):
        shutil.copytree(small_session, above / name)
        file = above / name / "session.yaml"
        file.write_text(re.sub(r"^name: .*", f"name: {name}", file.read_text(), flags=re.MULTILINE))
    ended = tubepose("estimate", above, "--method", "upright", "--no-overlays", "--out", tmp_path / "out")
    assert ended.errors == []
    assert set(table(tmp_path / "out" / "racks.csv")["session"]) == {"one", "two"}


# What an earlier run, another trial or another session left


def test_judged_files_of_an_earlier_run_do_not_stay_beside_other_estimates(small_session: Path, tmp_path: Path) -> None:
    arguments = ("--methods", "upright", "--out", tmp_path / "out")
    assert tubepose("bench", small_session, *arguments).code == 0
    judged = {"errors.csv", "summary.csv", "table_accuracy.md", "ground_truth_floor.csv"}
    assert judged <= {path.name for path in (tmp_path / "out").iterdir()}
    bare = edited(small_session, tmp_path / "bare", str)
    shutil.rmtree(bare / "simulation_truth")
    assert tubepose("bench", bare, "--exact-truth", *arguments).code == 1
    left = {path.name for path in (tmp_path / "out").iterdir()}
    assert not left & judged
    assert "estimates.csv" in left


def test_trials_may_call_their_captures_by_the_same_name(small_session: Path, tmp_path: Path) -> None:
    copy = edited(
        small_session, tmp_path / "s", lambda text: re.sub(r"captures/(.+)-original", r"captures/\1/original", text)
    )
    for path in sorted((copy / "captures").glob("*-original*")):
        place = path.parent / path.name.removesuffix("-original")
        place.mkdir()
        path.rename(place / "original")
    ended = tubepose("bench", copy, "--methods", "upright", "--overlays", "--out", tmp_path / "out")
    assert ended.code == 0, ended.err
    assert "Racks: 2 of 2 frames with an accepted pose." in ended.out
    names = sorted(path.name for path in (tmp_path / "out" / "overlays").iterdir())
    assert len(names) == 2
    for name, tube in zip(names, sorted(SMALL_TUBES), strict=True):
        assert name.endswith(f"-captures_{tube}-001_original-0000.png")


def test_one_name_means_one_thing_in_a_run(small_session: Path, tmp_path: Path) -> None:
    def other(text: str) -> str:
        return re.sub(r": blood-16x100(?=[,}\n])", ": mine.yaml", text.replace("name: raycast", "name: other"))

    session = edited(small_session, tmp_path / "s", other)
    mine = load_tube("blood-16x100").model_dump(mode="json", exclude_none=True)
    (session / "mine.yaml").write_text(yaml.safe_dump(mine), encoding="utf-8")
    run = ("bench", small_session, session, "--methods", "upright", "--out", tmp_path / "out")
    assert tubepose(*run).code == 0  # the same tube, by another name
    mine["source"] = "another calliper"
    (session / "mine.yaml").write_text(yaml.safe_dump(mine), encoding="utf-8")
    ended = tubepose(*run)
    (line,) = ended.errors
    assert f"{session}: 'blood-16x100' is defined otherwise than in {small_session}" in line
    assert len(table(tmp_path / "out" / "ground_truth.csv")) == 4  # the first session is done


def test_the_exact_rack_of_one_trial_is_enough_for_that_trial(small_session: Path, tmp_path: Path) -> None:
    copy = edited(small_session, tmp_path / "s", str)
    (copy / "simulation_truth" / "blood-16x100-001.yaml").unlink()
    ended = tubepose("bench", copy, "--known-rack", "--exact-truth", "--methods", "upright", "--out", tmp_path / "out")
    assert ended.code == 1
    (line,) = ended.errors
    assert "blood-16x100-001.yaml: no such file" in line
    racks = table(tmp_path / "out" / "racks.csv")
    assert racks["trial"].tolist() == ["chen2023-tube-3-001"]


def test_detection_runs_on_one_thread_as_the_tables_say() -> None:
    from tubepose_cli.inputs import make_detector

    detector = make_detector("yolo", None, None, None, None, Config())(load_rack(SMALL_RACK), ())
    options = detector.yolo._session.runtime.get_session_options()
    assert options.intra_op_num_threads == 1


# What a typing mistake does


@pytest.mark.parametrize("command", ["estimate", "bench", "gt"])
def test_a_path_that_is_not_there_writes_over_nothing(command: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "racks.csv").write_text("kept", encoding="utf-8")
    one_error(tubepose(command, tmp_path / "nowhere", "--out", out), f"{tmp_path / 'nowhere'}: no such file")
    assert [path.name for path in out.iterdir()] == ["racks.csv"]
    assert tubepose(command, tmp_path / "nowhere", "--out", tmp_path / "new").code == 1
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--tubes", ","), "--tubes ',' names no tube"),
        (("--cloud-topic", "/points"), "--cloud-topic given, but no recording"),
        (("--hint", "A1@nan,2"), "--hint A1@nan,2: expected SLOT@U,V"),
    ],
)
def test_an_option_that_says_nothing_is_refused(
    options: tuple[str, ...], words: str, small_session: Path, tmp_path: Path
) -> None:
    capture = small_session / "captures" / "blood-16x100-001-original"
    one_error(tubepose("estimate", capture, "--rack", SMALL_RACK, *options, "--out", tmp_path / "out"), words)


def test_methods_are_named_and_seeds_are_one_tube(small_session: Path, tmp_path: Path) -> None:
    ended = tubepose(
        "estimate", small_session, "--method", "upright,global-icp", "--seeds", "2", "--out", tmp_path / "out"
    )
    lines = [line for line in ended.err.splitlines() if "tubes ok" in line]
    assert [re.search(r"; ([a-z-]+): 2 tubes ok", line)[1] for line in lines] == ["upright", "global-icp"] * 2  # type: ignore[index]


def test_overlays_of_odd_names_do_not_meet(small_session: Path, tmp_path: Path) -> None:
    capture = small_session / "captures" / "blood-16x100-001-original"
    long = "\u00e4" * 120
    for name in ("a/b", "a_b", long):
        shutil.copytree(capture, tmp_path / "in" / name)
    ended = tubepose(
        "estimate", tmp_path / "in", "--rack", SMALL_RACK, "--method", "upright", "--out", tmp_path / "out"
    )
    assert ended.code == 0, ended.err
    names = sorted(path.name for path in (tmp_path / "out" / "overlays").iterdir())
    assert names == ["a_b-0000.png", "a_b-2-0000.png", f"{long[:100]}-0000.png"]


@pytest.fixture(scope="module")
def recorded_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One trial of the small rack as recordings of three frames."""
    out = tmp_path_factory.mktemp("recorded") / "session"
    ended = tubepose(
        "simulate", out, "--rack", SMALL_RACK, "--tubes", SMALL_TUBES[1], "--trials", "1", "--seed", "9",
        "--resolution", "400", "--fill", "0.2", "--threads", "1", "--frames", "3",
    )  # fmt: skip
    assert ended.code == 0, ended.err
    return out


def test_frames_of_recordings_are_averaged(tmp_path: Path, recorded_session: Path) -> None:
    one = tubepose("bench", recorded_session, "--average", "all", "--methods", "profile", "--out", tmp_path / "a")
    assert one.code == 0, one.err
    assert "averaged: 3 frames in each of 1" in one.err
    sensor = pd.read_csv(tmp_path / "a" / "sensor.csv")
    assert sensor[["n_frames", "n_left_out"]].to_numpy().tolist() == [[3, 0]]
    two = tubepose(
        "estimate", recorded_session, "--average", "2", "--detector", "geometric", "--out", tmp_path / "b",
    )  # fmt: skip
    assert two.code == 0, two.err
    assert pd.read_csv(tmp_path / "b" / "sensor.csv")[["frame", "n_frames"]].to_numpy().tolist() == [[0, 2], [2, 1]]


def test_average_is_told_where_nothing_is_averaged_and_refused_where_it_is_no_number(
    tmp_path: Path, small_session: Path
) -> None:
    wrong = tubepose("gt", small_session, "--average", "some", "--out", tmp_path / "c")
    assert (wrong.code, wrong.errors) == (1, ["error: --average some: expected a number of frames, 2 or more, or all"])
    ended = tubepose("gt", small_session, "--average", "all", "--out", tmp_path / "d")
    assert ended.code == 0, ended.err
