"""Result folders: the tables of a run, its record and its pictures, each file written whole or not at all."""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tubepose.errors import StoppedError, interrupt_number
from tubepose_cli.stopping import stoppable

if TYPE_CHECKING:
    from tubepose.batch import Asked, Job, Schedule, Setup, UnnamedJob
    from tubepose.batch.run_index import JobIndex, RunIndex, Shard
    from tubepose.config import Config
    from tubepose.labware import Labware
    from tubepose.records import Row
    from tubepose.result_tables import Tables
    from tubepose_cli.inputs import DetectorChoice


FRAME_SECONDS = 600.0
"""What a frame may take in a process where the user says nothing: a hundred times the usual."""
LONG_BYTES = 32_000_000
"""A recording of this size has work for one process."""
JUDGED_FILES = (
    "errors.csv", "summary.csv", "comparison.csv", "uncertainty.csv", "coverage.csv", "confusion.csv", "seeds.csv",
    "slot_accuracy.csv", *(f"table_{kind}.{form}" for kind in ("accuracy", "timing") for form in ("csv", "md", "tex")),
)  # fmt: skip
"""What only a run with truth writes: of an earlier one nothing stays beside other estimates."""


@dataclass(frozen=True, slots=True)
class RunOptions:
    """How a batch is run: nothing of it changes a row.

    Attributes:
        jobs: Local processes; 1 does all in this one, None chooses by the cores.
        frame_s: Seconds that a frame may take in a process; None is `FRAME_SECONDS`.
        resume: Go on after the last finished frame of the run whose records are in the folder.
        fresh: Begin anew, whatever is there.
        shard: Which part of the captures to do; None does all.
        fail_fast: Stop at the first problem.
        overlays: Draw a picture of every frame.
    """

    jobs: int | None = 1
    frame_s: float | None = None
    resume: bool = False
    fresh: bool = False
    shard: Shard | None = None
    fail_fast: bool = False
    overlays: bool = True


def run_estimates(
    jobs: Sequence[Job | UnnamedJob],
    asked: Asked,
    detector: DetectorChoice,
    out: Path,
    how: RunOptions,
    *,
    inputs: Sequence[Path] = (),
    labware: Sequence[Labware] = (),
    problems: Sequence[str] = (),
    averaged: bool = False,
    **more: Any,
) -> Tables:
    """Run jobs, write records/, tables, run.json and overlays/ into `out`, and say how noisy they are and what differs.

    The tables are racks, sensor, slots, estimates, checks, labware_check and timings.csv: views over the records, of
    which each is written as soon as its frame is done. `problems` are those from before, `labware` what was used
    besides, for the record, and `averaged` says that frames were to be fused. `JUDGED_FILES` of an earlier run are
    removed. `out` is held by `held_folder`.

    Raises:
        StoppedError: A signal stopped the run. What was done by then is written; nothing where nothing was done.
        TubePoseError: The first problem, where one is enough; or the folder cannot be written, or has another run.
    """
    from tubepose.batch import Schedule, Setup
    from tubepose.batch.record_store import FolderStore
    from tubepose.batch.run_index import open_records, run_index
    from tubepose.provenance import content_sha256, inputs_sha256
    from tubepose_cli.overlays import Overlays, overlay_names
    from tubepose_cli.show import say, say_when_compiling

    index = run_index(jobs, _settings(asked, detector, how), how.shard)
    records, kept = open_records(out, index, resume=how.resume, fresh=how.fresh)
    if kept:
        say(f"resumed: {kept} finished frames have their records in {out}; only what is new or changed is done")
    paths = [*inputs, *detector.files, *(job.capture.path for job in jobs if job.capture.path.exists())]
    used = inputs_sha256(paths, out)
    store = FolderStore(records, jobs, index.digest, partial(content_sha256, out=out))
    draw = Overlays(out / "overlays", overlay_names(jobs)) if how.overlays else None
    setup = Setup(tuple(jobs), asked, detector.factory, draw, out / "internal_errors")
    schedule = Schedule(jobs, store, None if how.shard is None else how.shard.numbers(jobs))
    say_when_compiling()
    with stoppable() as stopping:
        end = _run(schedule, setup, how)
        stopping.held = True
        tables = _close(schedule, index, out, end)
        stopped = _stopped_words(end, tables)
        more |= {"methods": list(asked.methods), "seeds": list(range(asked.seeds)), "threads": 1}
        more["problems"] = [*problems, *tables.problems, *([stopped] if stopped else [])]
        run = RunWords(sys.argv, asked.config, (*tables.labware.values(), *labware), used)
        write_results(tables, out, run, {"detector": detector.name, **more})
        tell_results(tables, averaged=averaged)
    if number := stopping.number or interrupt_number(end):
        raise StoppedError(f"{stopped or 'interrupted'}, and in the tables in {out}; --resume goes on", number)
    if end is not None:
        raise end
    return tables


def _settings(asked: Asked, detector: DetectorChoice, how: RunOptions) -> dict[str, object]:
    """What a run that is resumed has to have in common with the one before, by what a person calls it."""
    from tubepose import __version__
    from tubepose.capture.manifest import file_sha256
    from tubepose.provenance import code_sha256

    files = [file_sha256(path) if path.is_file() else str(path) for path in detector.files]
    return {
        "--config": asked.config,
        "--method": asked.methods,
        "--seeds": asked.seeds,
        "--detector": [detector.name, detector.layout, files],
        "--overlays": how.overlays,
        "the version of tubepose": [__version__, code_sha256(), asked.warm_up],
    }


def _run(schedule: Schedule, setup: Setup, how: RunOptions) -> BaseException | None:
    """Do all that is left; what stopped it, if anything."""
    from tubepose.batch import Limits, run_schedule
    from tubepose.provenance import pinned_threads
    from tubepose_cli.show import counted_progress

    count = how.jobs if how.jobs is not None else usual_jobs([job.capture.path for job in setup.jobs])
    inside = count == 1 and how.frame_s is None
    limits = None if inside else Limits(count, how.frame_s or FRAME_SECONDS)
    try:
        with pinned_threads(1), counted_progress("frames") as show:
            show(0, schedule.expected)
            schedule.on_done = show
            run_schedule(schedule, setup, limits=limits, fail_fast=how.fail_fast)
    except (Exception, KeyboardInterrupt) as problem:  # noqa: BLE001 - raised again when the tables are written
        return problem
    return None


def usual_jobs(captures: Sequence[Path]) -> int:
    """Processes where the user names no number: one per core, and no more than there is work for."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    sizes = [path.stat().st_size if path.is_file() else 0 for path in captures]
    return max(1, min(cores, sum(max(1, size // LONG_BYTES) for size in sizes)))


def _close(schedule: Schedule, index: RunIndex, out: Path, end: BaseException | None) -> Tables:
    """The rows of all that was done.

    Raises:
        BaseException: `end`, where nothing was done or results cannot be written: then nothing is written over.
    """
    from tubepose.batch import fill_tables
    from tubepose.batch.run_index import indexed_jobs, remove_empty, write_index
    from tubepose.errors import OutputError
    from tubepose.result_tables import Tables

    if isinstance(end, OutputError):  # no table could be written whole
        raise end
    tables = Tables()
    fill_tables(tables, schedule)
    if end is not None and not tables.done:
        remove_empty(out)
        if isinstance(end, KeyboardInterrupt):
            raise StoppedError(
                f"interrupted: no frame is done; no estimate is written to {out}",
                interrupt_number(end),
            ) from None
        raise end
    write_index(out, replace(index, finished=end is None, jobs=indexed_jobs(schedule)))
    return tables


def _stopped_words(end: BaseException | None, tables: Tables) -> str:
    frames = "1 frame is" if tables.done == 1 else f"{tables.done} frames are"
    return f"interrupted: {frames} done" if isinstance(end, KeyboardInterrupt) else ""


@dataclass(frozen=True, slots=True)
class RunWords:
    """What run.json says of what went in: command line, configuration, labware, digests."""

    command: Sequence[str]
    config: Config
    labware: Sequence[Labware]
    used: Mapping[str, str]


def write_results(tables: Tables, out: Path, run: RunWords, more: Mapping[str, Any]) -> None:
    """The tables and run.json; what only a run with truth writes is removed."""
    from tubepose.labware_check import pooled_rows
    from tubepose.provenance import run_record
    from tubepose.report.writing import remove_files, write_json

    remove_files(out, JUDGED_FILES)
    _write_tables(tables, pooled_rows(tables.labware_check), out)
    write_json(out / "run.json", run_record(run.command, run.config, run.labware, run.used, **more))


def copy_results(jobs: Sequence[tuple[JobIndex, Path]], folders: Sequence[Path], out: Path) -> None:
    """Records, their index and pictures of several folders of results, so that the run can be resumed there."""
    from tubepose.batch.run_index import INDEX, RECORDS, Shard, open_records, read_index, write_index
    from tubepose.result_folder import write_aside

    index = read_index(folders[0])
    assert index is not None
    open_records(out, index, resume=False, fresh=True)
    names = [f"{RECORDS}/{key}.json" for job, _ in jobs for key in job.keys]
    for folder in folders:
        ends = [*folder.glob(f"{RECORDS}/end-*.json"), *folder.glob("overlays/*.png")]
        for name in [*names, *(path.relative_to(folder).as_posix() for path in ends)]:
            if (folder / name).is_file() and Path(name).name != INDEX:
                with write_aside(out / name) as aside:
                    shutil.copyfile(folder / name, aside)
    write_index(out, replace(index, finished=True, shard=Shard(1, 1), jobs=tuple(job for job, _ in jobs)))


def tell_results(tables: Tables, *, averaged: bool = False) -> None:
    """What averaging has brought, how noisy the captures are, and what contradicts the labware."""
    from tubepose.labware_check import pooled_rows
    from tubepose_cli.show import describe_averaging, describe_noise, describe_sizes, say

    for line in describe_averaging(tables.sensor) if averaged else ():
        say(line)
    if tables.sensor:
        say(describe_noise(tables.sensor))
    for line in describe_sizes(pooled_rows(tables.labware_check)):
        say(line)


def _write_tables(tables: Tables, sizes: Sequence[Row], out: Path) -> None:
    """Every table of a run; `sizes` are the rows of labware_check.csv for the run as a whole."""
    from tubepose import records
    from tubepose.report.writing import write_csv

    for name, rows, columns in (
        ("racks", tables.racks, records.RACK_COLUMNS),
        ("sensor", tables.sensor, records.SENSOR_COLUMNS),
        ("slots", tables.slots, records.SLOT_COLUMNS),
        ("estimates", tables.estimates, records.ESTIMATE_COLUMNS),
        ("checks", tables.checks, records.CHECK_COLUMNS),
        ("labware_check", [*tables.labware_check, *sizes], records.LABWARE_COLUMNS),
        ("timings", tables.timings, records.TIMING_COLUMNS),
    ):
        write_csv(out / f"{name}.csv", records.to_table(rows, columns))
