"""All methods and seeds on one frame, and its rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from tubepose.batch.jobs import DetectorFactory, Job, UnnamedJob
from tubepose.batch.tasks import Asked
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.hints import TurnHint
from tubepose.compiled import compilations
from tubepose.labware import TubeModel
from tubepose.labware_check import compare_sizes, size_row
from tubepose.methods import MethodResult, foremost, seeds_of
from tubepose.pipeline import estimate_tubes, prepare_scene
from tubepose.rack import RackPose
from tubepose.records import Row, check_rows, estimate_row, rack_pose_row, rack_row, sensor_row, slot_rows, timing_row
from tubepose.result_tables import Tables
from tubepose.scene import Scene, TubeEstimate
from tubepose.stage_times import StageTime

MOST_WARMED = 5
"""Frames of one kind that are run twice at most where none has a tube."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameAnswer:
    """A frame's rows, its rack's pose, and the scene and estimates that a picture shows."""

    tables: Tables
    rack_pose: RackPose
    shown: Scene
    estimates: tuple[TubeEstimate, ...]


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


@dataclass(frozen=True, slots=True, eq=False)
class FrameRunner:
    """What is asked of every frame, and which sets of types were warmed up."""

    asked: Asked
    detector_for: DetectorFactory
    warmed: dict[tuple[TubeModel, ...], int] = field(default_factory=dict)

    def answer(self, job: Job, frame: RgbdFrame, hint: TurnHint | None, load_ms: float) -> FrameAnswer:
        """Ask all methods and seeds, and make the rows."""
        tables = Tables()
        if self.asked.warm_up:
            self._warm(job, frame, hint, tables)
        compiled = compilations()
        answer = self._ask(job, frame, hint)
        times = [StageTime("load", "all", "", None, load_ms), *answer.times]
        tables.timings += _time_rows(job, frame, times, warmup=compilations() > compiled)
        self._add_rows(job, answer, tables)
        shown = answer.first[foremost(self.asked.methods)]
        return FrameAnswer(tables, answer.scene.rack_pose, shown.scene, shown.estimates)

    def _warm(self, job: Job, frame: RgbdFrame, hint: TurnHint | None, tables: Tables) -> None:
        """Ask once more before it counts, for the first frame with tubes of every set of types."""
        tries = self.warmed.get(job.tubes, 0)
        if tries == MOST_WARMED:
            return
        answer = self._ask(job, frame, hint)
        tables.timings += _time_rows(job, frame, answer.times, warmup=True)
        # A frame without tubes warms half of it.
        self.warmed[job.tubes] = MOST_WARMED if any(one.estimates for one in answer.results) else tries + 1

    def _ask(self, job: Job, frame: RgbdFrame, hint: TurnHint | None) -> _Answer:
        """All methods and seeds for one frame."""
        detector, asked = self.detector_for(job.rack, job.tubes), self.asked
        scene = prepare_scene(
            frame, job.rack, job.tubes, detector, asked.config, hint, job.T_camera_rack, asked.methods
        )
        results: list[MethodResult] = []
        first: dict[str, MethodResult] = {}
        for method in asked.methods:
            for seed in seeds_of(method, asked.seeds):
                results.append(estimate_tubes(scene, method, asked.config, seed))
                first.setdefault(method, results[-1])
        return _Answer(scene, tuple(results), first)

    def _add_rows(self, job: Job, answer: _Answer, tables: Tables) -> None:
        """Rows of all tables but the timings; racks and slots of a method are those of its first seed."""
        frame = answer.scene.frame
        keys = frame_keys(job, frame)
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
        shown = answer.first[foremost(self.asked.methods)]
        sizes = compare_sizes(shown.scene, shown.estimates, self.asked.config)
        tables.labware_check += [{**keys, **size_row(size)} for size in sizes]


def unnamed_rows(job: UnnamedJob, frame: RgbdFrame, pose: RackPose, methods: Sequence[str]) -> Tables:
    """The rows of a frame in which no rack could be named."""
    row = {**frame_keys(job, frame), "rack": "", **rack_pose_row(frame, pose)}
    return Tables(racks=[{**row, "method": method} for method in methods])


def frame_keys(job: Job | UnnamedJob, frame: RgbdFrame) -> Row:
    """What tells the rows of a frame from all others."""
    return {"session": job.session, "trial": job.trial, "capture": frame.capture, "frame": frame.index}


def _time_rows(job: Job, frame: RgbdFrame, times: Sequence[StageTime], *, warmup: bool) -> list[Row]:
    return [timing_row(frame_keys(job, frame), entry, warmup) for entry in times]
