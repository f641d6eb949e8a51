"""Many captures through the pipeline, in this process or by several.

One bad capture never stops a batch: its one-line problem is kept, and the next one is done.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

from tubepose.batch.jobs import DetectorFactory, Job, UnnamedJob
from tubepose.batch.performing import Performer
from tubepose.batch.record_store import MemoryStore
from tubepose.batch.schedule import Schedule
from tubepose.batch.tasks import Asked, FrameRecord, OnScene, Setup
from tubepose.batch.workers import Limits, run_workers
from tubepose.config import Config
from tubepose.errors import CaptureError
from tubepose.result_tables import Tables
from tubepose.scene import Scene, TubeEstimate


def run_jobs(
    jobs: Sequence[Job | UnnamedJob],
    methods: Sequence[str],
    detector_for: DetectorFactory,
    config: Config,
    *,
    seeds: int = 1,
    warm_up: bool = False,
    fail_fast: bool = False,
    on_scene: Callable[[Job, Scene, tuple[TubeEstimate, ...]], None] | None = None,
    on_done: Callable[[int, int], None] | None = None,
    tables: Tables | None = None,
) -> Tables:
    """Run the methods on every frame of every job, in this process, with the rows in memory.

    Args:
        jobs: What to run, in the order in which hints say `previous`.
        methods: Names in `methods.METHODS`.
        detector_for: Makes the source of boxes for a rack and the tubes that can stand in it.
        config: All sections.
        seeds: Seeds of a stochastic method: 0, 1, ... (a deterministic method runs once).
        warm_up: Run the first frame with tubes of every set of types, and those before it, once more before, with their
            timings marked. Those of frames in which code is compiled always are.
        fail_fast: Raise the first problem instead of keeping it.
        on_scene: Called with each frame's result by one of the methods, ours if it is among them (overlays).
        on_done: Called after each frame and each problem with how many there were and how many are expected (progress).
        tables: Empty ones to fill, to keep what was done where the user stops the run; by default new ones.

    Raises:
        KeyboardInterrupt: The user stopped the run, in compiled code or not; `tables` hold the frames that were done.
    """
    tables = Tables() if tables is None else tables
    store = MemoryStore()
    draw: OnScene | None = None if on_scene is None else partial(_unnumbered, on_scene)
    setup = Setup(tuple(jobs), Asked(tuple(methods), config, seeds, warm_up), lambda: detector_for, draw)
    schedule = Schedule(jobs, store, on_done=on_done)
    try:
        run_schedule(schedule, setup, fail_fast=fail_fast)
    finally:
        fill_tables(tables, schedule)
    return tables


def run_schedule(schedule: Schedule, setup: Setup, *, limits: Limits | None = None, fail_fast: bool = False) -> None:
    """Do all that a schedule hands out.

    Args:
        schedule: With the records.
        setup: What processes need.
        limits: Of local processes that share the work; None does all of it in this one.
        fail_fast: Stop at the first problem.

    Raises:
        CaptureError: The first problem, with `fail_fast`.
        OutputError: Results cannot be written.
        KeyboardInterrupt: The user stopped the run.
    """
    if limits is not None:
        run_workers(schedule, setup, limits, fail_fast=fail_fast)
        return
    performer, last = Performer(setup, schedule.store.write), None
    while (task := schedule.take(last)) is not None:
        schedule.finish(task, performer.do(task))
        last = task.number
        stop_at_problem(schedule, fail_fast)


def stop_at_problem(schedule: Schedule, fail_fast: bool) -> None:
    """Raise the first problem where one is enough.

    Raises:
        CaptureError: There is one.
    """
    if fail_fast and schedule.has_problems:
        raise CaptureError(schedule.problems[0])


def fill_tables(tables: Tables, schedule: Schedule) -> None:
    """Add the rows of all records of a schedule in the order of captures and frames, and its problems."""
    for _, keys, problems in schedule.results():
        add_records(tables, schedule.store.read, keys)
        tables.problems += problems


def add_records(tables: Tables, read: Callable[[str], FrameRecord | None], keys: Sequence[str]) -> None:
    """Add the rows of records."""
    for key in keys:
        record = read(key)
        if record is not None:
            tables.add(record.tables)
            tables.done += 1


def _unnumbered(
    on_scene: Callable[[Job, Scene, tuple[TubeEstimate, ...]], None],
    number: int,  # noqa: ARG001
    job: Job,
    scene: Scene,
    estimates: tuple[TubeEstimate, ...],
) -> None:
    on_scene(job, scene, estimates)
