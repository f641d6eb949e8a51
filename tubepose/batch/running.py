"""Many captures through the pipeline.

One bad capture never stops a batch: its one-line problem is kept, and the next one is done.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

from tubepose.batch.jobs import MOST_ASKED, DetectorFactory, Job, UnnamedJob
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.hints import TurnHint
from tubepose.capture.source import Capture
from tubepose.compiled import compilations
from tubepose.config import Config
from tubepose.errors import CaptureError, TubePoseError, is_interrupt, kept
from tubepose.labware import TubeModel
from tubepose.labware_check import compare_sizes, size_row
from tubepose.methods import MethodResult, foremost, seeds_of
from tubepose.pipeline import estimate_tubes, prepare_scene
from tubepose.rack import RackStatus
from tubepose.rack.turns import EarlierTurns
from tubepose.records import Row, check_rows, estimate_row, rack_pose_row, rack_row, sensor_row, slot_rows, timing_row
from tubepose.result_tables import Tables
from tubepose.scene import Scene, TubeEstimate
from tubepose.stage_times import StageTime

MOST_WARMED = 5
"""Frames of one kind that are run twice at most where none has a tube."""


@dataclass(frozen=True, slots=True, eq=False)
class _Answer:
    """A frame's scene, and the results of all methods and seeds in the order in which they were asked."""

    scene: Scene
    results: tuple[MethodResult, ...]
    first: dict[str, MethodResult]

    @property
    def times(self) -> list[StageTime]:
        """Times of all stages."""
        return [*self.scene.times, *(entry for result in self.results for entry in result.times)]


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
    on_done: Callable[[], None] | None = None,
    tables: Tables | None = None,
) -> Tables:
    """Run the methods on every frame of every job.

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
        on_done: Called after each job (progress).
        tables: Empty ones to fill, to keep what was done where the user stops the run; by default new ones.

    Raises:
        KeyboardInterrupt: The user stopped the run, in compiled code or not; `tables` hold the jobs that were done.
    """
    tables = Tables() if tables is None else tables
    run = _Run(methods, detector_for, config, seeds, warm_up, on_scene, tables)
    for job in jobs:
        before = tables.lengths()
        try:
            with kept(None if fail_fast else tables.problems, partial(_one_line, job)):
                run.job(job)
        except (KeyboardInterrupt, SystemError) as problem:
            tables.cut(before)
            if not is_interrupt(problem):
                raise
            raise KeyboardInterrupt from problem
        tables.done += 1
        if on_done is not None:
            on_done()
    return tables


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """What is asked of every frame, where its rows go, and what is remembered from frame to frame."""

    methods: Sequence[str]
    detector_for: DetectorFactory
    config: Config
    seeds: int
    warm_up: bool
    on_scene: Callable[[Job, Scene, tuple[TubeEstimate, ...]], None] | None
    tables: Tables
    warmed: dict[tuple[TubeModel, ...], int] = field(default_factory=dict)
    earlier: EarlierTurns = field(default_factory=EarlierTurns)

    def job(self, job: Job | UnnamedJob) -> None:
        """Add the rows of a capture."""
        for named, frame, load_ms in _named_frames(job, self.methods, self.tables):
            hint: TurnHint | None = named.hint
            if named.previous:
                hint = self.earlier.hint(named.session, named.rack, named.hint, self.config.rack)
            if self.warm_up:
                self._warm(named, frame, hint)
            compiled = compilations()
            answer = self._ask(named, frame, hint)
            times = [StageTime("load", "all", "", None, load_ms), *answer.times]
            self._add_times(named, frame, times, warmup=compilations() > compiled)
            self._add_rows(named, answer)
            if answer.scene.rack_pose.status is RackStatus.UNIT:
                raise CaptureError(answer.scene.rack_pose.reason)
            self.earlier.learn(named.session, named.rack, named.hint, answer.scene.rack_pose)

    def _warm(self, job: Job, frame: RgbdFrame, hint: TurnHint | None) -> None:
        """Ask once more before it counts, for the first frame with tubes of every set of types."""
        tries = self.warmed.get(job.tubes, 0)
        if tries == MOST_WARMED:
            return
        answer = self._ask(job, frame, hint)
        self._add_times(job, frame, answer.times, warmup=True)
        # A frame without tubes warms half of it.
        self.warmed[job.tubes] = MOST_WARMED if any(one.estimates for one in answer.results) else tries + 1

    def _ask(self, job: Job, frame: RgbdFrame, hint: TurnHint | None) -> _Answer:
        """All methods and seeds for one frame."""
        detector = self.detector_for(job.rack, job.tubes)
        scene = prepare_scene(frame, job.rack, job.tubes, detector, self.config, hint, job.T_camera_rack, self.methods)
        results: list[MethodResult] = []
        first: dict[str, MethodResult] = {}
        for method in self.methods:
            for seed in seeds_of(method, self.seeds):
                results.append(estimate_tubes(scene, method, self.config, seed))
                first.setdefault(method, results[-1])
        return _Answer(scene, tuple(results), first)

    def _add_times(self, job: Job, frame: RgbdFrame, times: Sequence[StageTime], *, warmup: bool) -> None:
        self.tables.timings += [timing_row(_keys(job, frame), entry, warmup) for entry in times]

    def _add_rows(self, job: Job, answer: _Answer) -> None:
        """Rows of all tables but the timings; racks and slots of a method are those of its first seed."""
        tables, frame = self.tables, answer.scene.frame
        keys = _keys(job, frame)
        tables.labware[job.rack.name] = job.rack
        tables.labware |= {tube.name: tube for tube in job.tubes}
        tables.sensor.append(sensor_row(keys, frame, answer.scene.noise))
        for result in answer.results:
            tables.estimates += [estimate_row(keys, result.scene, estimate) for estimate in result.estimates]
        for method, result in answer.first.items():
            judged, estimates = result.scene, result.estimates
            tables.racks.append({**keys, "method": method, **rack_row(judged), "named_by_nats": job.named_by_nats})
            tables.slots += slot_rows(keys, method, judged, estimates)
            tables.checks += check_rows(keys, method, judged, estimates)
        shown = answer.first[foremost(self.methods)]
        sizes = compare_sizes(shown.scene, shown.estimates, self.config)
        tables.labware_check += [{**keys, **size_row(size)} for size in sizes]
        if self.on_scene is not None:
            self.on_scene(job, shown.scene, shown.estimates)


def _one_line(job: Job | UnnamedJob, problem: TubePoseError) -> str:
    text = str(problem)
    return text if str(job.capture.path) in text else f"{job.capture.name}: {text}"


def _named_frames(
    job: Job | UnnamedJob, methods: Sequence[str], tables: Tables
) -> Iterator[tuple[Job, RgbdFrame, float]]:
    """Frames whose rack is known, with the milliseconds of loading; the others have their rows in `tables.racks`.

    Raises:
        CaptureError: No frame's rack can be named, or the hint's slot is none of the rack's.
    """
    named, reason, asked = job if isinstance(job, Job) else None, "", 0
    for frame, load_ms in _timed_frames(job.capture):
        if isinstance(job, UnnamedJob) and named is None:
            pose = job.find_rack(frame)
            if pose.rack is None or pose.T_camera_rack is None:
                reason = reason or pose.reason
                row = {**_keys(job, frame), "rack": "", **rack_pose_row(frame, pose)}
                tables.racks += [{**row, "method": method} for method in methods]
                asked += 1
                if asked == MOST_ASKED:
                    break
                continue
            named = Job(
                job.capture, pose.rack, job.tubes, job.hint, job.session, job.trial, None, pose.named_by_nats,
                job.previous,
            )  # fmt: skip
        assert named is not None
        _check_hint(named)
        yield named, frame, load_ms
    if named is None:
        raise CaptureError(f"{job.capture.path}: {reason or 'no frame to find the rack in'}")


def _check_hint(job: Job) -> None:
    if job.hint is not None and not job.rack.has_slot(job.hint.slot):
        raise CaptureError(
            f"{job.capture.path}: the hint speaks of slot {job.hint.slot}, and rack {job.rack.name} has none of that "
            f"name; {job.rack.slot_words}"
        )


def _keys(job: Job | UnnamedJob, frame: RgbdFrame) -> Row:
    return {"session": job.session, "trial": job.trial, "capture": frame.capture, "frame": frame.index}


def _timed_frames(capture: Capture) -> Iterator[tuple[RgbdFrame, float]]:
    frames = capture.frames()
    while True:
        start = time.perf_counter_ns()
        frame = next(frames, None)
        if frame is None:
            return
        yield frame, (time.perf_counter_ns() - start) / 1e6
