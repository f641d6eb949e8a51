"""A benchmark from session folders to tables: plan, run, judge."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd

from tubepose.batch import DetectorFactory, Job, run_jobs, session_jobs
from tubepose.benchmark.judgement import Judgement, count_lines, judge, write_tables
from tubepose.benchmark.measured import EXACT_NOTE, MeasuredTruth, Progress, measure_sessions, silent
from tubepose.benchmark.notes import (
    confusion_notes,
    data_note,
    machine_note,
    rack_notes,
    slot_notes,
    spread_notes,
    uncertainty_notes,
)
from tubepose.capture.fusion import Average
from tubepose.config import Config
from tubepose.errors import CaptureError, kept
from tubepose.evaluation import slot_accuracy
from tubepose.methods import METHODS, require_methods
from tubepose.provenance import pinned_threads
from tubepose.records import ESTIMATE_COLUMNS, RACK_COLUMNS, SLOT_COLUMNS, TIMING_COLUMNS, to_table
from tubepose.report.tables import Table, accuracy_table, timing_table
from tubepose.report.writing import make_folder, write_csv
from tubepose.result_tables import Tables
from tubepose.truth_tables import with_exact_rack

BENCH_METHODS = ("upright", "profile", "paper", "slot-icp", "global-icp")


@dataclass(frozen=True, slots=True)
class BenchOptions:
    """What a benchmark is asked for.

    Attributes:
        methods: Methods to run, in the order of the tables.
        seeds: Seeds of a stochastic method: 0 to N-1.
        exact_truth: Judge by the exact poses of simulated sessions, not by measured printed caps.
        known_rack: Take the rack's pose from the exact truth (simulated sessions only).
        all_tubes: Any of a session's types may stand in any trial.
        published: Add the paper's own figures to the tables.
        fail_fast: Raise the first problem instead of keeping it.
        average: How many frames of a static recording are fused into one.
    """

    methods: tuple[str, ...] = BENCH_METHODS
    seeds: int = 3
    exact_truth: bool = False
    known_rack: bool = False
    all_tubes: bool = False
    published: bool = False
    fail_fast: bool = False
    average: Average = 1


@dataclass(frozen=True, slots=True, eq=False)
class BenchPlan:
    """What is run and what judges it.

    Attributes:
        jobs: One per trial.
        measured: The truth.
        problems: One line per session or trial that could not be read.
    """

    jobs: tuple[Job, ...]
    measured: MeasuredTruth
    problems: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Bench:
    """Result of a benchmark.

    Attributes:
        judgement: Tables of estimates against truth.
        slot_accuracy: Slots called occupied or empty against the declared ones.
        estimates: Rows of estimates.csv.
        truth: Rows of ground_truth.csv.
        timings: Rows of timings.csv.
        tables: The paper's two tables for a reader, ``accuracy`` and ``timing``.
        problems: One line per capture that could not be done.
    """

    judgement: Judgement
    slot_accuracy: pd.DataFrame
    estimates: pd.DataFrame
    truth: pd.DataFrame
    timings: pd.DataFrame
    tables: dict[str, Table]
    problems: tuple[str, ...]

    def write(self, out: Path) -> None:
        """Write what judges the run, as CSV, and the two tables.

        Raises:
            ConfigError: The folder cannot be written.
        """
        self.judgement.write(out)
        write_csv(out / "slot_accuracy.csv", self.slot_accuracy)
        write_tables(out, self.tables)


def plan_bench(
    folders: Sequence[Path], out: Path | None, options: BenchOptions, progress: Progress = silent
) -> BenchPlan:
    """Measure the truth of sessions and list what is to be run.

    Args:
        folders: Session folders.
        out: Folder for ground_truth.csv; None to write none.
        options: What is asked for.
        progress: Shows how far it is.

    Raises:
        CaptureError: A session cannot be read, and `options.fail_fast` is set.
    """
    fail_fast = options.fail_fast
    measured = measure_sessions(
        folders, out, exact=options.exact_truth, average=options.average, fail_fast=fail_fast, progress=progress
    )
    jobs: list[Job] = []
    problems: list[str] = []
    for session in measured.sessions:
        keep = None if fail_fast else problems
        with kept(keep):
            found, unread = session_jobs(session, fail_fast=fail_fast)
            problems += unread
            if options.all_tubes:
                found = [replace(job, tubes=tuple(session.types.values())) for job in found]
            jobs += with_exact_rack(found, session, keep) if options.known_rack else found
    # Both can miss the same file of a trial.
    return BenchPlan(tuple(jobs), measured, tuple(dict.fromkeys([*problems, *measured.problems])))


def judge_run(plan: BenchPlan, tables: Tables, options: BenchOptions, config: Config) -> Bench:
    """Judge the rows of a run by the truth of its plan.

    Args:
        plan: What was run.
        tables: Rows of the run.
        options: What was asked for.
        config: The configuration that methods describe in notes.
    """
    estimates = to_table(tables.estimates, ESTIMATE_COLUMNS)
    timings = to_table(tables.timings, TIMING_COLUMNS)
    tube_models = {name: tube for session in plan.measured.sessions for name, tube in session.types.items()}
    seeds = {name: range(options.seeds) for name, method in METHODS.items() if method.is_stochastic}
    judgement = judge(
        estimates, plan.measured.truth, tube_models, options.methods,
        racks=to_table(tables.racks, RACK_COLUMNS), seeds=seeds,
    )  # fmt: skip
    slots = slot_accuracy(to_table(tables.slots, SLOT_COLUMNS), plan.measured.truth)
    accuracy = accuracy_table(
        judgement.summary, _notes(plan, tables, judgement, slots, options, config), options.published
    )
    shown = {"accuracy": accuracy, "timing": timing_table(timings, [machine_note()], options.published)}
    problems = tuple(dict.fromkeys([*plan.problems, *tables.problems]))
    return Bench(judgement, slots, estimates, plan.measured.truth, timings, shown, problems)


def _notes(
    plan: BenchPlan, tables: Tables, judgement: Judgement, slots: pd.DataFrame, options: BenchOptions, config: Config
) -> list[str]:
    errors, exact = judgement.errors, EXACT_NOTE in plan.measured.notes
    notes = [f"Counts, {line}." for line in count_lines(judgement)]
    notes += [data_note(plan.measured, plan.jobs), *plan.measured.notes, *rack_notes(tables), *slot_notes(slots)]
    notes += [*uncertainty_notes(errors, exact), *confusion_notes(errors)]
    notes += [note for name in options.methods if (note := METHODS[name].note(config, options.seeds))]
    if any(METHODS[name].is_stochastic for name in options.methods):
        notes += spread_notes(judgement.seeds)
    return notes


def bench(
    sessions: Sequence[Path | str],
    out: Path | str | None = None,
    *,
    options: BenchOptions | None = None,
    config: Config | None = None,
    detector_for: DetectorFactory | None = None,
    progress: Progress = silent,
) -> Bench:
    """Run methods on sessions and judge them by the ground truth, as ``tubepose bench`` does.

    Args:
        sessions: Session folders.
        out: Folder for the tables; None to write nothing.
        options: Methods, seeds and what truth to take.
        config: All sections; None for the defaults.
        detector_for: Makes the source of boxes for a rack and its tubes; None for the bundled network.
        progress: Shows how far it is.

    Raises:
        CaptureError: No session could be read, or none has a truth.
        ConfigError: The folder cannot be written.
    """
    asked, settings = options or BenchOptions(), config or Config()
    require_methods(asked.methods)
    folder = Path(out) if out is not None else None
    plan = plan_bench([Path(path) for path in sessions], folder, asked, progress)
    if not plan.jobs or not len(plan.measured.truth):
        why = "; ".join(plan.problems) or "no trial has a capture with printed caps that could be measured"
        raise CaptureError(f"nothing to judge: {why}")
    with pinned_threads(1), progress("captures", len(plan.jobs)) as step:
        tables = run_jobs(
            plan.jobs, asked.methods, detector_for or bundled_detector(settings), settings, seeds=asked.seeds,
            warm_up=True, fail_fast=asked.fail_fast, on_done=lambda _done, _expected: step(),
        )  # fmt: skip
    found = judge_run(plan, tables, asked, settings)
    if folder is not None:
        make_folder(folder)
        write_csv(folder / "estimates.csv", found.estimates)
        write_csv(folder / "timings.csv", found.timings)
        found.write(folder)
    return found


def bundled_detector(config: Config) -> DetectorFactory:
    """The default source of boxes: the bundled network, helped by the geometry of the cloud."""
    from tubepose.detection.assisted import AssistedDetector
    from tubepose.detection.bundled import bundled_model
    from tubepose.detection.geometric import GeometricDetector
    from tubepose.detection.yolo import YoloDetector

    yolo = YoloDetector(bundled_model(), threads=1)
    return lambda rack, tubes: AssistedDetector(yolo, GeometricDetector(rack, tubes, config))
