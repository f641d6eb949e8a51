"""Batches that are stopped, killed, starved and spread: no finished frame is lost, and the rows are always the same."""

from __future__ import annotations

import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from commands import tubepose
from test_batch import CONFIG, GOOD, RACK, TUBE, Recorded

from tubepose.batch import Asked, Job, Limits, Schedule, Setup, fill_tables, run_jobs, run_schedule, session_jobs
from tubepose.batch.record_store import FolderStore, MemoryStore, RecordFolder
from tubepose.batch.run_index import JobIndex, Shard, open_records, read_shard, run_index
from tubepose.batch.tasks import Ended, FrameRecord, Outcome, Task
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.session import load_session
from tubepose.detection import Detector
from tubepose.errors import ConfigError, OutputError
from tubepose.report.writing import csv_text
from tubepose.result_folder import held_folder
from tubepose.result_tables import Tables

TABLES = ("racks", "sensor", "slots", "estimates", "checks", "labware_check")
WANTED = ("--no-overlays", "--method", "upright", "--detector", "geometric", "--tubes", "blood-16x100")
RACK_WORDS = ("--rack", "round-10ml-3x4")


@dataclass(frozen=True)
class Scan:
    """A capture of so many frames in memory, one of which misbehaves where a file says so."""

    name: str
    count: int
    path: Path
    bad: int = -1
    how: str = ""

    def frames(self) -> Iterator[RgbdFrame]:
        for index in range(self.count):
            if index == self.bad and self.how == "load":
                os.kill(os.getpid(), signal.SIGKILL)
            stamp = 7 if index == self.bad and self.how != "load" else 1000 + index
            yield RgbdFrame(GOOD.cloud_m, GOOD.image, None, stamp, self.name, index, False, self.how)


class Unsafe(Detector):
    """Sees nothing; a frame with a stamp of 7 kills its process, keeps it, or breaks."""

    name = "unsafe"

    def detect(self, frame: RgbdFrame) -> Any:
        if frame.timestamp_ns == 7:
            if frame.sensor == "kill":
                os.kill(os.getpid(), signal.SIGKILL)
            if frame.sensor == "hang":
                time.sleep(60)
            if frame.sensor == "memory":
                raise MemoryError
            raise ZeroDivisionError("secret of a file")
        return ()


def unsafe() -> Callable[..., Detector]:
    return make_unsafe


def make_unsafe(*_: object) -> Detector:
    return Unsafe()


def scan_jobs(*scans: Scan) -> tuple[Job, ...]:
    return tuple(Job(scan, RACK, (TUBE,)) for scan in scans)


def spread(
    jobs: tuple[Job, ...], folder: Path, count: int | None, seconds: float = 60.0, tracebacks: Path | None = None
) -> tuple[Tables, Schedule]:
    """Run jobs with records in a folder by so many processes."""
    folder.mkdir(exist_ok=True)
    schedule = Schedule(jobs, FolderStore(RecordFolder(folder), jobs, "asked", str))
    setup = Setup(jobs, Asked(("upright",), CONFIG), unsafe, None, tracebacks)
    tables = Tables()
    run_schedule(schedule, setup, limits=None if count is None else Limits(count, seconds))
    fill_tables(tables, schedule)
    return tables, schedule


def test_rows_are_the_same_for_every_number_of_processes_and_lost_ones_cost_one_frame(tmp_path: Path) -> None:
    scans = (Scan("a", 3, Path("a"), 1, "kill"), Scan("b", 2, Path("b"), 0, "hang"), Scan("c", 3, Path("c"), 2, "load"))
    whole, _ = spread(scan_jobs(*(Scan(s.name, s.count, s.path) for s in scans)), tmp_path / "whole", None)
    assert whole.done == 8
    tables, _ = spread(scan_jobs(*scans), tmp_path / "two", 2, seconds=3.0)
    found = [(row["capture"], row["frame"]) for row in tables.racks]
    assert found == [("a", 0), ("a", 2), ("b", 1), ("c", 0), ("c", 1)]
    assert [line.split(": ")[0] for line in tables.problems] == ["a, frame 1", "b, frame 0", "c, frame 2"]
    killed, hung, cut = tables.problems
    assert "was killed (SIGKILL" in killed
    assert "took longer than 3 s (--timeout)" in hung
    assert cut.endswith("it is left out, and what comes after it in its capture")
    known = {(row["capture"], row["frame"]): row for row in whole.racks}
    assert all(str(row) == str(known[row["capture"], row["frame"]]) for row in tables.racks)


@pytest.mark.parametrize(("how", "words"), [("memory", "out of memory"), ("bug", "internal error ZeroDivisionError")])
def test_an_unexpected_exception_is_one_line_and_the_batch_goes_on(how: str, words: str, tmp_path: Path) -> None:
    jobs = scan_jobs(Scan("a", 3, Path("a"), 1, how), Scan("b", 1, Path("b")))
    tables, _ = spread(jobs, tmp_path / "records", None, tracebacks=tmp_path / "bugs")
    assert [(row["capture"], row["frame"]) for row in tables.racks] == [("a", 0), ("a", 2), ("b", 0)]
    (line,) = tables.problems
    assert words in line
    assert "secret" not in line
    if how == "bug":
        (path,) = (tmp_path / "bugs").iterdir()
        assert str(path) in line
        assert "secret of a file" in path.read_text()


def test_what_has_a_record_is_not_done_again_and_a_changed_input_is(tmp_path: Path) -> None:
    jobs = scan_jobs(Scan("a", 2, Path("a")), Scan("b", 1, Path("b")))
    first, _ = spread(jobs, tmp_path / "r", None)
    broken = scan_jobs(Scan("a", 2, Path("a")), Scan("b", 1, Path("b")))
    schedule = Schedule(broken, FolderStore(RecordFolder(tmp_path / "r"), broken, "asked", str))
    assert schedule.take() is None
    again = Tables()
    fill_tables(again, schedule)
    assert str(again.racks) == str(first.racks)
    for asked, digest in (("other", str), ("asked", lambda path: f"new {path}")):
        schedule = Schedule(jobs, FolderStore(RecordFolder(tmp_path / "r"), jobs, asked, digest))
        assert schedule.take() is not None


def test_a_torn_record_is_done_again(tmp_path: Path) -> None:
    jobs = scan_jobs(Scan("a", 1, Path("a")))
    spread(jobs, tmp_path / "r", None)
    for path in (tmp_path / "r").iterdir():
        path.write_bytes(path.read_bytes()[:50])
    schedule = Schedule(jobs, FolderStore(RecordFolder(tmp_path / "r"), jobs, "asked", str))
    assert schedule.take() is not None


# The real command ---------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def captures(small_session: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Links to one capture by several names."""
    folder = tmp_path_factory.mktemp("links")
    source = next(path for path in sorted((small_session).rglob("*")) if path.name.endswith("original"))
    for name in "abcd":
        (folder / name).symlink_to(source, target_is_directory=True)
    return folder


@pytest.fixture(scope="module")
def undisturbed(captures: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("whole") / "out"
    ended = tubepose("estimate", captures, *RACK_WORDS, *WANTED, "--out", out)
    assert ended.code == 0, ended.err
    return out


def command(captures: Path, out: Path, *more: str) -> subprocess.Popen[str]:
    code = "from tubepose_cli.main import run; run()"
    words = ["estimate", captures, *RACK_WORDS, *WANTED, "--out", out, *more]
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, words)],
        stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )  # fmt: skip


def wait_for(out: Path, count: int, process: subprocess.Popen[str]) -> None:
    """Until there are so many records, or the process ends."""
    while process.poll() is None and RecordFolder(out / "records").count() < count:
        time.sleep(0.01)


def same(out: Path, whole: Path) -> bool:
    return all((out / f"{name}.csv").read_bytes() == (whole / f"{name}.csv").read_bytes() for name in TABLES)


@pytest.mark.parametrize(("number", "count", "jobs"), [(signal.SIGKILL, 1, "1"), (signal.SIGTERM, 2, "1")])
def test_a_run_that_is_stopped_loses_nothing(
    number: signal.Signals, count: int, jobs: str, captures: Path, undisturbed: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    process = command(captures, out, "--jobs", jobs)
    wait_for(out, count, process)
    process.send_signal(number)
    _, err = process.communicate(timeout=60)
    there = RecordFolder(out / "records").count()
    assert there >= count
    if number == signal.SIGKILL:
        assert process.returncode == -signal.SIGKILL
    else:
        assert process.returncode == 128 + number, err
        assert len(pd.read_csv(out / "racks.csv")) == there
        assert "interrupted: " in err.splitlines()[-1]
    kept = {path: path.stat().st_mtime_ns for path in (out / "records").glob("*.json") if path.name != "index.json"}
    refused = tubepose("estimate", captures, *RACK_WORDS, *WANTED, "--out", out)
    assert "--resume goes on with it" in refused.errors[0]
    ended = tubepose("estimate", captures, *RACK_WORDS, *WANTED, "--resume", "--out", out)
    assert ended.code == 0, ended.err
    assert same(out, undisturbed)
    assert all(path.stat().st_mtime_ns == time_ns for path, time_ns in kept.items())


def test_other_settings_are_refused_or_begin_anew(captures: Path, undisturbed: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(undisturbed, out)
    (tmp_path / "c.yaml").write_text("rack:\n  left_alone_m: 0.02\n")
    options = (*RACK_WORDS, *WANTED, "--config", tmp_path / "c.yaml", "--out", out)
    ended = tubepose("estimate", captures, *options, "--resume")
    assert "differs in --config; --fresh begins anew" in ended.errors[0]
    assert same(out, undisturbed)
    assert tubepose("estimate", captures, *options, "--fresh").code == 0
    assert json.loads((out / "run.json").read_text())["config"]["rack"]["left_alone_m"] == 0.02


def test_shards_merged_are_one_run(captures: Path, undisturbed: Path, tmp_path: Path) -> None:
    parts = [tmp_path / "1", tmp_path / "2"]
    for number, part in enumerate(parts, 1):
        shard = ("--shard", f"{number}/2")
        ended = tubepose("estimate", captures, *RACK_WORDS, *WANTED, *shard, "--out", part)
        assert ended.code == 0, ended.err
        assert len(pd.read_csv(part / "racks.csv")) == 2
    ended = tubepose("merge", *parts, "--out", tmp_path / "all")
    assert ended.code == 0, ended.err
    assert same(tmp_path / "all", undisturbed)
    lacking = tubepose("merge", parts[1], "--out", tmp_path / "half")
    assert lacking.code == 1
    assert lacking.errors == ["error: part 1/2 is in none of the folders"]
    assert (
        tubepose("merge", tmp_path, "--out", tmp_path / "none").errors[0].startswith(f"error: {tmp_path}: no records")
    )


def test_a_full_disk_ends_the_run_with_one_line_and_what_was_there_is_whole(
    captures: Path, undisturbed: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(undisturbed, out)
    sizes = [path.stat().st_size for path in (out / "records").glob("*.json") if path.stat().st_size > 5000]
    for path in sorted((out / "records").glob("*.json")):
        if path.stat().st_size in sizes[1:]:
            path.unlink()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (min(sizes) // 2, before[1]))
    try:
        with held_small_probe():
            ended = tubepose("estimate", captures, *RACK_WORDS, *WANTED, "--resume", "--out", out)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert ended.code == 1
    assert len(ended.errors) == 1, ended.err
    assert "cannot be written (File too large)" in ended.errors[0]
    assert same(out, undisturbed)
    assert tubepose("estimate", captures, *RACK_WORDS, *WANTED, "--resume", "--out", out).code == 0
    assert same(out, undisturbed)


@contextmanager
def held_small_probe() -> Iterator[None]:
    """The probe of the folder passes: the disk fills later."""
    from tubepose import result_folder

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(result_folder, "_PROBE_BYTES", 16)
        yield


def test_a_folder_is_held_by_one_run_and_probed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with (
        held_folder(tmp_path / "out"),
        pytest.raises(OutputError, match="another run is writing its results there"),
        held_folder(tmp_path / "out"),
    ):
        pass
    with held_folder(tmp_path / "out"):
        assert list((tmp_path / "out").iterdir()) == []
    monkeypatch.setattr(Path, "write_bytes", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left on device")))
    with pytest.raises(OutputError, match="No space left on device"), held_folder(tmp_path / "out"):
        pass


# Order, parts, records ----------------------------------------------------------------------------------------------


def test_frames_of_a_session_with_previous_wait_for_one_another() -> None:
    jobs = tuple(Job(Recorded(name), RACK, (TUBE,), session="s", previous=name != "a") for name in "abc")
    schedule = Schedule(jobs, MemoryStore())
    first = schedule.take()
    assert first is not None
    assert (first.number, schedule.take()) == (0, None)
    schedule.finish(first, Outcome(Ended.NO_FRAME))
    following = schedule.take()
    assert following is not None
    assert following.number == 1


def test_a_recording_is_spread_where_its_frames_do_not_wait() -> None:
    schedule = Schedule((Job(Recorded("a"), RACK, (TUBE,)),), MemoryStore())
    tasks = [schedule.take() for _ in range(3)]
    assert [task.position for task in tasks if task is not None] == [0, 1, 2]
    assert all(isinstance(task, Task) for task in tasks)


@pytest.mark.parametrize("text", ["0/3", "4/3", "1", "1/0", "a/b", "-1/2"])
def test_a_part_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(ConfigError, match="expected i/n with i from 1 to n"):
        read_shard(text)


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_parts_have_every_job_once(parts: int) -> None:
    jobs = [Job(Recorded(str(k)), RACK, (TUBE,), session="s" * (k % 2), previous=k % 4 == 1) for k in range(9)]
    found = [number for part in range(1, parts + 1) for number in Shard(part, parts).numbers(jobs)]
    assert sorted(found) == list(range(9))


def test_records_of_another_kind_of_file_are_not_read(tmp_path: Path) -> None:
    folder = RecordFolder(tmp_path)
    row = {"capture": "a", "tx_m": float("nan"), "big": 1_861_606_485_123_456_789, "none": None, "x": 0.1 + 0.2}
    folder.write("k", FrameRecord(Outcome(Ended.DONE), Tables(racks=[row])))
    read = folder.read("k")
    assert read is not None
    assert str(read.tables.racks) == str([row])
    assert folder.read("other") is None
    (tmp_path / "k.json").write_text("[]")
    assert folder.read("k") is None


def test_a_finished_run_is_replaced_and_an_unfinished_one_kept(tmp_path: Path) -> None:
    index = run_index((), {"--config": 1})
    folder, _ = open_records(tmp_path, index, resume=False, fresh=False)
    folder.write("a" * 40, FrameRecord(Outcome(Ended.DONE)))
    with pytest.raises(ConfigError, match="1 finished frames there; --resume"):
        open_records(tmp_path, index, resume=False, fresh=False)
    assert open_records(tmp_path, index, resume=True, fresh=False)[1] == 1
    with pytest.raises(ConfigError, match="differs in --config"):
        open_records(tmp_path, run_index((), {"--config": 2}), resume=True, fresh=False)
    assert folder.count() == 1
    open_records(tmp_path, index, resume=False, fresh=True)
    assert folder.count() == 0
    assert JobIndex(0).keys == ()


def test_a_pipe_and_a_name_that_is_no_utf8_cost_nothing_but_a_line(captures: Path, tmp_path: Path) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    os.mkfifo(folder / "pipe.ply")
    os.mkfifo(folder / "not-ours.txt")
    os.symlink(os.fsencode(captures / "a"), os.fsencode(folder) + b"/gr\xf6sse")
    options = [word for word in WANTED if word != "--no-overlays"]
    ended = tubepose("estimate", folder, *RACK_WORDS, *options, "--out", tmp_path / "out")
    assert ended.code == 1
    assert ended.errors == [f"error: {folder}/pipe.ply: a pipe; expected a file or a folder"]
    for name in TABLES[:4]:
        assert set(pd.read_csv(tmp_path / "out" / f"{name}.csv")["capture"]) == {r"gr\xf6sse"}
    (picture,) = (tmp_path / "out" / "overlays").iterdir()
    assert picture.name == r"gr\xf6sse-0000.png"
    one = tubepose("estimate", folder / "pipe.ply", *RACK_WORDS, *options, "--out", tmp_path / "one")
    assert "a pipe; expected a file" in one.errors[0]


def test_cells_that_a_spreadsheet_would_run_are_escaped() -> None:
    table = pd.DataFrame({"capture": ["=1+1", "-a", "@b", "+c", "plain", None], "x": [-1.5, 2, 3, 4, 5, 6]})
    lines = csv_text(table).splitlines()
    assert lines == ["capture,x", "'=1+1,-1.5", "'-a,2.0", "'@b,3.0", "'+c,4.0", "plain,5.0", ",6.0"]


@pytest.mark.parametrize(("original", "words"), [(".", "names the session's own folder"), ("../x", "--allow-outside")])
def test_a_trial_names_a_capture_in_its_session(original: str, words: str, tmp_path: Path) -> None:
    text = "format: 1\nname: s\norigin: recorded\nrack: round-10ml-3x4\ntrials:\n"
    (tmp_path / "session.yaml").write_text(f"{text}- {{name: one, tubes: {{}}, original: {original}}}\n")
    jobs, (problem,) = session_jobs(load_session(tmp_path))
    assert jobs == []
    assert words in problem


@pytest.mark.parametrize("stamp", [2**63, 2**64 - 1, -1])
def test_a_stamp_that_is_no_time_costs_its_capture_alone(stamp: int) -> None:
    jobs = [
        Job(Recorded(name, (replace(GOOD, timestamp_ns=at),)), RACK, (TUBE,)) for name, at in (("a", stamp), ("b", 1))
    ]
    tables = run_jobs(jobs, ("upright",), make_unsafe, CONFIG)
    assert len(tables.racks) == 1
    assert [line.startswith(f"a: its stamp {stamp} ns is no time") for line in tables.problems] == [True]
