from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import scenes

from tubepose.batch import MOST_ASKED, Job, UnnamedJob, framing, run_jobs, session_jobs, trial_capture
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.hints import SlotHint
from tubepose.capture.session import Session, load_session
from tubepose.checks import Check
from tubepose.config import Config
from tubepose.detection import Detection, Detector
from tubepose.detection.geometric import GeometricDetector
from tubepose.errors import CaptureError, DetectorError
from tubepose.labware import load_rack, load_tube
from tubepose.pipeline import prepare_scene
from tubepose.rack import RackPose, RackStatus
from tubepose.records import ESTIMATE_COLUMNS, RACK_COLUMNS, SENSOR_COLUMNS, SLOT_COLUMNS, TIMING_COLUMNS, to_table
from tubepose.result_tables import Tables
from tubepose.scene import Scene
from tubepose.transforms import HALF_TURN, transform_points

CONFIG = Config()
RACK = load_rack("round-10ml-3x4")
TUBE = load_tube("blood-16x100")
T_CAMERA_RACK = scenes.camera_from_rack(RACK, 0.3, 0.15)


def make_frame(name: str, slots: tuple[str, ...] = ("B2",), index: int = 0, scale: float = 1.0) -> RgbdFrame:
    view = scenes.towards_camera(T_CAMERA_RACK)
    surfaces = [
        scenes.tube_surface(TUBE, scenes.tube_pose(RACK, slot, 0.01, 0.01), RACK.height_m, seed=i, seen_from=view)
        for i, slot in enumerate(slots)
    ]
    points = transform_points(T_CAMERA_RACK, np.vstack([scenes.rack_top(RACK, spacing_m=1.2e-3), *surfaces]))
    return replace(scenes.unorganised(points * scale), capture=name, index=index)


@dataclass(frozen=True)
class Recorded:
    """A capture of frames in memory that ends with a problem, if it has one."""

    name: str
    content: tuple[RgbdFrame, ...] = ()
    problem: BaseException | None = None
    path: Path = Path("captures/scan")

    def frames(self) -> Iterator[RgbdFrame]:
        yield from self.content
        if self.problem is not None:
            raise self.problem


def job(name: str, *frames: RgbdFrame, problem: BaseException | None = None, **more: Any) -> Job:
    return Job(Recorded(name, frames, problem), RACK, (TUBE,), **more)


def run(*jobs: Job | UnnamedJob, methods: tuple[str, ...] = ("upright",), **options: Any) -> Tables:
    return run_jobs(jobs, methods, lambda rack, tubes: GeometricDetector(rack, tubes, CONFIG), CONFIG, **options)


GOOD = make_frame("good")


def test_a_bad_capture_stops_neither_the_ones_before_nor_the_ones_after() -> None:
    done: list[tuple[int, int]] = []
    broken = job("broken", replace(GOOD, capture="broken"), problem=CaptureError("cut after 1 frame"))
    nothing = job("nothing", problem=CaptureError("captures/scan: no such file"))
    tables = run(job("good", GOOD), broken, nothing, job("good", GOOD), on_done=lambda *counts: done.append(counts))
    assert [row["capture"] for row in tables.racks] == ["good", "broken", "good"]
    assert tables.problems == ["broken: cut after 1 frame", "captures/scan: no such file"]
    assert [count for count, _ in done] == [1, 2, 3, 4, 5]  # three frames and two problems
    assert done[-1] == (5, 5)


def test_a_detector_that_cannot_work_is_a_problem_of_its_capture() -> None:
    class Blind(Detector):
        name = "blind"

        def detect(self, frame: RgbdFrame) -> Any:
            raise DetectorError("no image")

    tables = run_jobs([job("a", GOOD), job("b", GOOD)], ["upright"], lambda rack, tubes: Blind(), CONFIG, warm_up=True)
    assert tables.problems == ["a: no image", "b: no image"]
    assert tables.racks == []


def in_compiled_code(problem: BaseException) -> SystemError:
    """What becomes of an exception that arrives while compiled code runs."""
    swallowed = SystemError("returned a result with an exception set")
    swallowed.__cause__ = problem
    return swallowed


@pytest.mark.parametrize(
    "stop", [KeyboardInterrupt(), in_compiled_code(KeyboardInterrupt())], ids=["python", "compiled"]
)
def test_ctrl_c_keeps_the_rows_of_frames_that_were_done(stop: BaseException) -> None:
    cut = job("cut", replace(GOOD, capture="cut"), problem=stop)
    tables = Tables()
    with pytest.raises(KeyboardInterrupt):
        run(job("good", GOOD), cut, job("later", replace(GOOD, capture="later")), tables=tables)
    assert (tables.done, tables.problems) == (2, [])
    for rows in (tables.racks, tables.slots, tables.estimates, tables.timings, tables.checks, tables.labware_check):
        assert {row["capture"] for row in rows} == {"good", "cut"}


def test_why_and_which_marks_stand_in_every_table(monkeypatch: pytest.MonkeyPatch) -> None:
    def marked(frame: RgbdFrame, *rest: Any) -> Scene:
        scene = prepare_scene(frame, *rest)
        checks = (*scene.rack_pose.checks, Check("scale", 1.0, 0.5, False, decides=False))
        return replace(scene, rack_pose=replace(scene.rack_pose, checks=checks))

    monkeypatch.setattr("tubepose.batch.framing.prepare_scene", marked)
    tables = run(job("good", GOOD), job("bad", make_frame("bad", scale=0.5)), methods=("profile", "paper"))
    good, bad = ([row for row in tables.racks if row["capture"] == name] for name in ("good", "bad"))
    assert {(row["reason_code"], "scale" in row["marks"].split(";")) for row in good} == {("", True)}
    assert all(row["reason_code"] and row["status"] != "ok" for row in bad)
    assert {row["rack_marks"] for row in (*tables.slots, *tables.estimates)} == {good[0]["marks"]}
    for row in tables.estimates:
        assert bool(row["reason_code"]) == bool(row["reason"]) == (row["status"] != "ok")
    rows = [row for row in tables.checks if row["code"] == "scale" and not row["decides"] and not row["passed"]]
    assert {(row["subject"], row["slot"], row["method"]) for row in rows} == {
        ("rack", None, "profile"),
        ("rack", None, "paper"),
    }
    assert {row["slot"] for row in tables.checks if row["subject"] == "tube" and row["method"] == "paper"} == {"B2"}
    # Sizes are told once a frame, whatever the methods, and of no rack that is not there.
    sizes = [(row["capture"], row["frame"], row["quantity"], row["labware"]) for row in tables.labware_check]
    assert len(sizes) == len(set(sizes)) > 0
    assert {size[0] for size in sizes} == {"good"}


def test_a_system_error_that_is_no_ctrl_c_is_raised() -> None:
    with pytest.raises(SystemError):
        run(job("good", GOOD, problem=in_compiled_code(ValueError())))


def test_other_racks_in_view_are_counted() -> None:
    class TwoRacks(GeometricDetector):
        def detect(self, frame: RgbdFrame) -> tuple[Detection, ...]:
            found = super().detect(frame)
            rack = next(detection for detection in found if detection.is_rack)
            return (replace(rack, score=0.3, point_rows=rack.point_rows[:10]), *found)

    tables = run_jobs([job("good", GOOD)], ("upright",), lambda rack, tubes: TwoRacks(rack, tubes, CONFIG), CONFIG)
    assert [(row["n_racks_detected"], row["status"], row["box_score"]) for row in tables.racks] == [(2, "ok", 1.0)]


def test_fail_fast_raises_the_first_problem() -> None:
    with pytest.raises(CaptureError, match="cut"):
        run(job("good", GOOD), job("bad", problem=CaptureError("cut")), fail_fast=True)


def test_warm_up_goes_on_until_there_were_tubes() -> None:
    empty = replace(GOOD, cloud_m=GOOD.cloud_m[:, :5])
    tables = run(job("empty", empty), job("good", GOOD), job("good", GOOD), warm_up=True)
    tubes = [row["warmup"] for row in tables.timings if row["stage"] == "tube"]
    assert tubes == [True, False, False]


def test_every_set_of_types_is_warmed_up() -> None:
    other = replace(job("other", GOOD), tubes=(TUBE.model_copy(update={"name": "other"}),))
    tables = run(job("good", GOOD), job("good", GOOD), other, other, warm_up=True)
    tubes = [row["warmup"] for row in tables.timings if row["stage"] == "tube"]
    assert tubes == [True, False, False, True, False, False]


def test_times_of_a_frame_in_which_code_is_compiled_are_marked(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = iter([0, 0, 0, 3])  # before and after each of two frames
    monkeypatch.setattr(framing, "compilations", lambda: next(counts))
    tables = run(job("good", GOOD), job("late", GOOD), warm_up=True)
    tubes = [row["warmup"] for row in tables.timings if row["stage"] == "tube"]
    assert tubes == [True, False, True]


def test_our_own_bugs_are_not_kept_as_problems() -> None:
    with pytest.raises(ZeroDivisionError):
        run(job("bug", problem=ZeroDivisionError()))


def test_only_stochastic_methods_run_once_per_seed() -> None:
    tables = run(job("good", GOOD), methods=("upright", "global-icp"), seeds=3)
    rows = [(row["method"], row["seed"]) for row in tables.estimates]
    assert rows == [("upright", None), *(("global-icp", seed) for seed in range(3))]
    assert [row["method"] for row in tables.racks] == ["upright", "global-icp"]
    assert len(tables.slots) == 2 * len(RACK.all_slots)


def test_warm_up_runs_the_first_frame_once_more_and_marks_its_times_only() -> None:
    run(job("good", GOOD))  # what this compiles on a new machine is not asked for below
    cold, warm = (run(job("good", GOOD), job("good", GOOD), warm_up=wanted) for wanted in (False, True))
    assert (len(warm.racks), len(warm.estimates)) == (len(cold.racks), len(cold.estimates)) == (2, 2)
    marked = [row["stage"] for row in warm.timings if row["warmup"]]
    assert marked == ["detect", "rack", "sensor", "slots", "tube"]
    assert [row["stage"] for row in warm.timings if not row["warmup"]] == ["load", *marked] * 2
    assert not any(row["warmup"] for row in cold.timings)


def test_a_wrong_unit_is_a_row_and_a_problem() -> None:
    tables = run(job("mm", make_frame("mm", scale=1000.0)), job("good", GOOD))
    assert [row["status"] for row in tables.racks] == ["wrong_unit", "ok"]
    assert len(tables.problems) == 1
    assert tables.problems[0].startswith("mm: ")
    assert "unit" in tables.problems[0]


def test_a_given_rack_is_not_registered() -> None:
    tables = run(job("good", GOOD, T_camera_rack=T_CAMERA_RACK))
    assert tables.racks[0]["resolved_by"] == "given"
    assert "rack" not in {row["stage"] for row in tables.timings}
    assert [row["slot"] for row in tables.estimates] == ["B2"]


def test_every_frame_of_a_recording_has_its_rows() -> None:
    frames = [make_frame("film", slots, index=i) for i, slots in enumerate([("B2",), ("A1", "C4")])]
    tables = run(job("film", *frames, T_camera_rack=T_CAMERA_RACK, session="s", trial="t"))
    found = [(row["session"], row["trial"], row["frame"], row["slot"]) for row in tables.estimates]
    assert found == [("s", "t", 0, "B2"), ("s", "t", 1, "A1"), ("s", "t", 1, "C4")]
    occupied = [(row["frame"], row["slot"]) for row in tables.slots if row["state"] == "occupied"]
    assert occupied == [(0, "B2"), (1, "A1"), (1, "C4")]


def test_pictures_show_our_method_if_it_ran() -> None:
    seen: list[str] = []

    def keep(job: Job, scene: Any, estimates: Any) -> None:
        seen.extend(estimate.method for estimate in estimates)

    run(job("good", GOOD), methods=("upright", "profile"), on_scene=keep)
    run(job("good", GOOD), methods=("upright", "slot-icp"), on_scene=keep)
    assert seen == ["profile", "upright"]


def test_the_rows_fit_the_columns() -> None:
    tables = run(job("good", GOOD), methods=("paper",))
    for rows, columns in (
        (tables.racks, RACK_COLUMNS),
        (tables.sensor, SENSOR_COLUMNS),
        (tables.slots, SLOT_COLUMNS),
        (tables.estimates, ESTIMATE_COLUMNS),
        (tables.timings, TIMING_COLUMNS),
    ):
        assert rows
        assert all(set(row) <= set(columns) for row in rows)
        assert list(to_table(rows, columns).columns) == list(columns)
        assert list(to_table([], columns).columns) == list(columns)


# Sessions


@pytest.fixture
def session(tmp_path: Path) -> Session:
    (tmp_path / "session.yaml").write_text(
        "format: 1\nname: s\norigin: recorded\nrack: round-10ml-3x4\ntrials:\n"
        "- {name: one, tubes: {A1: blood-16x100, B1: blood-16x100}, original: scan-1}\n"
        "- {name: two, tubes: {A1: centrifuge-10ml, C3: blood-16x100}, original: scan-2,"
        " hint: {slot: A1, pixel: [5, 6]}}\n"
        "- {name: four, tubes: {}, original: scan-2, hint: 'A1@top-left,previous'}\n"
        "- {name: three, tubes: {}, original: folder}\n"
    )
    for name in ("scan-2", "folder/a", "folder/b"):
        (tmp_path / name).mkdir(parents=True)
        (tmp_path / name / "cloud.ply").write_text("")
    return load_session(tmp_path)


def test_a_session_gives_one_job_per_trial_and_one_line_per_trial_that_has_none(session: Session) -> None:
    jobs, problems = session_jobs(session)
    names = [(job.session, job.trial, job.capture.name) for job in jobs]
    assert names == [("s", "two", "scan-2"), ("s", "four", "scan-2")]
    assert [job.previous for job in jobs] == [False, True]
    assert jobs[1].hint == SlotHint(slot="A1", toward="top-left")
    assert [tube.name for tube in jobs[0].tubes] == ["blood-16x100", "centrifuge-10ml"]
    assert jobs[0].hint is not None
    assert jobs[0].hint.pixel == (5, 6)
    assert len(problems) == 2
    assert "scan-1: no such file or folder" in problems[0]
    assert "folder: trial three needs one capture, found 2" in problems[1]


def test_fail_fast_raises_at_the_first_trial_without_its_capture(session: Session) -> None:
    with pytest.raises(CaptureError, match="scan-1: no such file or folder"):
        session_jobs(session, fail_fast=True)


def test_captures_of_one_name_are_told_apart_by_their_paths(session: Session) -> None:
    first, second, *_ = session.trials
    trials = (first.model_copy(update={"original": "folder/a"}), second.model_copy(update={"printed": "scan-2/a"}))
    twins = session.model_copy(update={"trials": trials})
    assert trial_capture(twins, trials[0], "folder/a").name == "folder/a"
    assert trial_capture(twins, trials[1], "scan-2").name == "scan-2"


def test_a_trial_names_one_capture(session: Session) -> None:
    assert trial_capture(session, session.trials[1], "scan-2").name == "scan-2"
    with pytest.raises(CaptureError, match="trial two needs one capture, found 2"):
        trial_capture(session, session.trials[1], "folder")


# A rack that no one named -------------------------------------------------------------------------------------------


def unnamed(name: str, *frames: RgbdFrame, nameable: tuple[int, ...] = (), **more: Any) -> UnnamedJob:
    """A job whose finder names `RACK` in the frames of these numbers only."""

    def find(frame: RgbdFrame) -> RackPose:
        if frame.index in nameable:
            return RackPose(RackStatus.OK, "", T_CAMERA_RACK, rack=RACK, named_by_nats=0.75)
        return RackPose(RackStatus.REFUSED, f"no rack fits in {frame.index}")

    return UnnamedJob(Recorded(name, frames), find, (TUBE,), **more)


def test_a_rack_is_asked_for_until_it_is_named_and_frames_before_have_their_rows() -> None:
    frames = [replace(GOOD, index=index) for index in range(3)]
    tables = run(unnamed("good", *frames, nameable=(1,), session="s", trial="t"), methods=("upright", "slot-icp"))
    assert tables.problems == []
    rows = [(row["frame"], row["method"], row["rack"], row["status"], row["reason"]) for row in tables.racks]
    assert rows == [
        *((0, method, "", "refused", "no rack fits in 0") for method in ("upright", "slot-icp")),
        *((frame, method, RACK.name, "ok", "") for frame in (1, 2) for method in ("upright", "slot-icp")),
    ]
    assert {(row["session"], row["trial"]) for row in tables.racks} == {("s", "t")}
    assert {row.get("named_by_nats") for row in tables.racks} == {None, 0.75}
    assert set(tables.labware) == {RACK.name, TUBE.name}
    assert list(to_table(tables.racks, RACK_COLUMNS)["tx_m"].isna()) == [True, True, False, False, False, False]


def test_a_capture_whose_rack_no_frame_names_is_a_problem_and_counted() -> None:
    frames = [replace(GOOD, index=index) for index in range(2)]
    tables = run(unnamed("bad", *frames), unnamed("none"), job("good", GOOD))
    assert tables.problems == [
        "captures/scan: no rack fits in 0",
        "captures/scan: no frame to find the rack in",
    ]
    assert [(row["capture"], row["rack"]) for row in tables.racks] == [("good", ""), ("good", ""), ("good", RACK.name)]
    with pytest.raises(CaptureError, match="no rack fits in 0"):
        run(unnamed("bad", *frames), fail_fast=True)


def test_a_long_recording_is_not_asked_for_ever() -> None:
    frames = [replace(GOOD, index=index) for index in range(MOST_ASKED + 3)]
    tables = run(unnamed("bad", *frames, nameable=(MOST_ASKED + 1,)))
    assert [row["frame"] for row in tables.racks] == list(range(MOST_ASKED))
    assert tables.problems == ["captures/scan: no rack fits in 0"]


def test_a_hint_of_another_rack_is_told_in_one_line() -> None:
    hint = SlotHint(slot="F9", pixel=(10.0, 10.0))
    tables = run(unnamed("good", GOOD, nameable=(0,), hint=hint), job("good", GOOD, hint=hint))
    line = f"captures/scan: the hint speaks of slot F9, and rack {RACK.name} has none of that name; its slots run"
    assert [problem.startswith(line) for problem in tables.problems] == [True, True]


# Which way round it stands ------------------------------------------------------------------------------------------

OPENING = transform_points(T_CAMERA_RACK, np.array([*RACK.slot("A1").center_m, RACK.height_m]))
A1 = SlotHint(slot="A1", point_m=(OPENING[0], OPENING[1], OPENING[2]))
OTHER_WAY = transform_points(T_CAMERA_RACK @ HALF_TURN, np.array([*RACK.slot("A1").center_m, RACK.height_m]))
TURNED_A1 = SlotHint(slot="A1", point_m=(OTHER_WAY[0], OTHER_WAY[1], OTHER_WAY[2]))


def moved(frame: RgbdFrame, shift_m: float, **more: Any) -> RgbdFrame:
    return replace(frame, cloud_m=frame.cloud_m + np.array([shift_m, 0.0, 0.0]), **more)


def resolved(tables: Tables) -> list[str]:
    return [row["resolved_by"] for row in tables.racks]


@pytest.mark.parametrize("place", [A1, TURNED_A1], ids=["as-it-is", "half-turn"])
def test_captures_after_the_first_stand_as_it_did(place: SlotHint) -> None:
    """In one direction or the other the rule would have taken the other turn."""
    jobs = [job(name, moved(GOOD, shift_m), hint=place, previous=True) for name, shift_m in (("a", 0), ("b", 2e-3))]
    tables = run(*jobs)
    assert resolved(tables) == ["hint", "previous"]
    assert not any(row["ambiguous"] for rows in (tables.racks, tables.slots, tables.estimates) for row in rows)
    filled = [row["slot"] for row in tables.slots if row["state"] == "occupied"]
    assert filled == (["B2"] if place is A1 else ["B3"]) * 2


def test_a_rack_may_creep_but_not_jump() -> None:
    """What counts is the last frame that knew: each of four steps of 2 mm is of a rack that was left alone."""
    steps = [moved(GOOD, 2e-3 * k, index=k) for k in range(5)]
    tables = run(job("good", *steps, moved(GOOD, 30e-3, index=5), moved(GOOD, 9e-3, index=6), hint=A1, previous=True))
    assert resolved(tables) == ["hint", *["previous"] * 4, "rule", "previous"]
    jumped = tables.racks[5]
    assert jumped["ambiguous"]
    assert jumped["hint_note"].startswith("the rack has moved by 22.")
    assert {row["ambiguous"] for row in tables.slots if row["frame"] == 5} == {True}
    assert {row["ambiguous"] for row in tables.estimates if row["frame"] == 5} == {True}


def test_without_an_earlier_turn_there_is_nothing_to_go_by() -> None:
    tables = run(job("a", GOOD, previous=True), job("b", GOOD, hint=A1), job("c", GOOD, previous=True))
    assert resolved(tables) == ["rule", "hint", "previous"]
    told = "the turn of the rack was known in no earlier frame: give a hint for this capture"
    assert [row["hint_note"] for row in tables.racks] == [told, "", ""]


def test_a_hint_of_a_capture_of_its_own_goes_before_an_earlier_frame() -> None:
    """Said once for all captures a place is the first one's; said again it is of a rack that was set up anew."""
    again = A1.model_copy()
    jobs = [job("a", GOOD, hint=A1, previous=True), job("b", moved(GOOD, 20e-3), hint=A1, previous=True)]
    assert resolved(run(*jobs)) == ["hint", "rule"]
    jobs[1] = job("b", moved(GOOD, 20e-3), moved(GOOD, 20e-3, index=1), hint=again, previous=True)
    assert resolved(run(*jobs)) == ["hint", "hint", "previous"]


def test_another_session_or_rack_is_no_earlier_frame() -> None:
    tables = run(job("a", GOOD, hint=A1, session="s"), job("b", GOOD, previous=True, session="t"))
    assert resolved(tables) == ["hint", "rule"]
    other = RACK.model_copy(update={"name": "other"})
    tables = run(job("a", GOOD, hint=A1), replace(job("b", GOOD, previous=True), rack=other))
    assert resolved(tables) == ["hint", "rule"]
    assert tables.racks[1]["hint_note"].startswith(f"the last rack whose turn was known was another one, {RACK.name}")


def test_a_rack_that_is_named_on_the_way_stands_as_before_too() -> None:
    frames = [replace(GOOD, index=index) for index in range(3)]
    tables = run(unnamed("good", *frames, nameable=(0,), hint=A1, previous=True))
    assert resolved(tables) == ["hint", "previous", "previous"]


def test_the_warm_up_is_no_earlier_frame() -> None:
    tables = run(job("a", GOOD, previous=True), warm_up=True)
    assert resolved(tables) == ["rule"]


def test_a_stamp_is_exact_beside_a_capture_without_one() -> None:
    stamp = 1_861_606_485_123_456_789
    tables = run(job("good", replace(GOOD, timestamp_ns=stamp)), job("good", replace(GOOD, timestamp_ns=None)))
    assert to_table(tables.racks, RACK_COLUMNS)["timestamp_ns"].tolist() == [stamp, pd.NA]
