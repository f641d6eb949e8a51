"""Many captures through the pipeline.

One bad capture never stops a batch: its one-line problem is kept, and the next one is done.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tubepose.capture.frame import RgbdFrame
from tubepose.capture.hints import SlotHint, TurnHint
from tubepose.capture.session import Session, Trial
from tubepose.capture.source import Capture, open_captures
from tubepose.compiled import compilations
from tubepose.config import Config
from tubepose.detection import Detector
from tubepose.errors import CaptureError, TubePoseError, is_interrupt, kept
from tubepose.labware import RackModel, TubeModel
from tubepose.labware_check import compare_sizes, size_row
from tubepose.pipeline import DEFAULT_METHOD, STOCHASTIC, Scene, StageTime, TubeEstimate, estimate_tubes, prepare_scene
from tubepose.rack import RackPose, RackStatus
from tubepose.rack.turns import EarlierTurns
from tubepose.records import Row, check_rows, estimate_row, rack_pose_row, rack_row, sensor_row, slot_rows, timing_row
from tubepose.result_tables import Tables
from tubepose.transforms import FloatArray
from tubepose.tubes_pitch import refuse_by_tops

DetectorFactory = Callable[[RackModel, tuple[TubeModel, ...]], Detector]
RackFinder = Callable[[RgbdFrame], RackPose]
"""Finds out which rack stands in a frame: `RackPose.rack`, or the reason why none can be named."""


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """One capture and what is known about it.

    Attributes:
        capture: Where its frames come from.
        rack: The rack that stands in it.
        tubes: The kinds of tube that can stand in it.
        hint: Which way round the rack stands, if known; with `previous`, in the first frame whose turn is known.
        session: Name of its session, or empty.
        trial: Name of its trial, or empty.
        T_camera_rack: The rack's pose where it is known and not to be estimated, shape (4, 4), metres; else None.
        named_by_nats: By how much the rack was ahead of the catalogue's next one; NaN where a person named it.
        previous: Whether a rack that was left alone since an earlier frame of the session stands as it did there.
    """

    capture: Capture
    rack: RackModel
    tubes: tuple[TubeModel, ...]
    hint: SlotHint | None = None
    session: str = ""
    trial: str = ""
    T_camera_rack: FloatArray | None = None
    named_by_nats: float = float("nan")
    previous: bool = False


MOST_ASKED = 5
"""Frames that are asked for their rack: a search of a whole catalogue takes seconds."""


@dataclass(frozen=True, slots=True, eq=False)
class UnnamedJob:
    """One capture in which a rack stands that no one named.

    Attributes:
        capture: Where its frames come from.
        find_rack: Asked frame by frame until it names a rack, which then is the whole capture's; `MOST_ASKED` times.
        tubes: The kinds of tube that can stand in it.
        hint: As `Job.hint`.
        session: Name of its session, or empty.
        trial: Name of its trial, or empty.
        previous: As `Job.previous`.
    """

    capture: Capture
    find_rack: RackFinder
    tubes: tuple[TubeModel, ...]
    hint: SlotHint | None = None
    session: str = ""
    trial: str = ""
    previous: bool = False


MOST_WARMED = 5
"""Frames of one kind that are run twice at most where none has a tube."""


def session_jobs(session: Session, *, fail_fast: bool = False) -> tuple[list[Job], list[str]]:
    """One job per trial, on the capture with the original caps; and one line per trial whose capture is not there.

    Raises:
        CaptureError: A capture is not there, and `fail_fast` is set.
    """
    jobs: list[Job] = []
    problems: list[str] = []
    for trial in session.trials:
        with kept(None if fail_fast else problems):
            capture = trial_capture(session, trial, trial.original)
            tubes = session.tubes_of(trial)
            jobs.append(
                Job(capture, session.rack, tubes, trial.hint, session.name, trial.name, previous=trial.previous)
            )
    return jobs, problems


def trial_capture(session: Session, trial: Trial, relative: str) -> Capture:
    """The one capture that a trial names; by its path in the session where others of it have the same last name.

    Raises:
        CaptureError: It is not there, or it is a folder of several.
    """
    place = session.folder / relative
    paths = {path for one in session.trials for path in (one.original, one.printed) if path is not None}
    whole = Path(relative).with_suffix("" if place.is_file() else Path(relative).suffix).as_posix()
    name = whole if sum(Path(path).stem == Path(relative).stem for path in paths) > 1 else None
    topics = {f"{kind}_topic": topic for kind, topic in session.topics.model_dump().items()}
    found = open_captures(
        place, name=name, unit=session.unit, depth_scale_m=session.depth_scale_m,
        max_stamp_difference_ms=session.max_stamp_difference_ms, **topics,
    )  # fmt: skip
    if len(found) != 1:
        raise CaptureError(f"{place}: trial {trial.name} needs one capture, found {len(found)}")
    return found[0]


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
        methods: Names in `pipeline.METHODS`.
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
    warmed: dict[tuple[TubeModel, ...], int] = {}
    earlier = EarlierTurns()

    def run(job: Job | UnnamedJob) -> None:
        for named, frame, load_ms in _named_frames(job, methods, tables):
            hint: TurnHint | None = named.hint
            if named.previous:
                hint = earlier.hint(named.session, named.rack, named.hint, config.rack)
            tries = warmed.get(named.tubes, 0)
            if warm_up and tries < MOST_WARMED:
                warm = Tables()
                _run_frame(named, frame, hint, methods, detector_for, config, seeds, warm, tables.timings)
                # A frame without tubes warms half of it.
                warmed[named.tubes] = MOST_WARMED if warm.estimates else tries + 1
            load = StageTime("load", "all", "", None, load_ms)
            rows, compiled = len(tables.timings), compilations()
            pose = _run_frame(named, frame, hint, methods, detector_for, config, seeds, tables, None, load, on_scene)
            earlier.learn(named.session, named.rack, named.hint, pose)
            if compilations() > compiled:
                for row in tables.timings[rows:]:
                    row["warmup"] = True

    for job in jobs:
        before = tables.lengths()
        try:
            with kept(None if fail_fast else tables.problems, partial(_one_line, job)):
                run(job)
        except (KeyboardInterrupt, SystemError) as problem:
            tables.cut(before)
            if not is_interrupt(problem):
                raise
            raise KeyboardInterrupt from problem
        tables.done += 1
        if on_done is not None:
            on_done()
    return tables


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


def _run_frame(
    job: Job,
    frame: RgbdFrame,
    hint: TurnHint | None,
    methods: Sequence[str],
    detector_for: DetectorFactory,
    config: Config,
    seeds: int,
    tables: Tables,
    warm_timings: list[Row] | None,
    load: StageTime | None = None,
    on_scene: Callable[[Job, Scene, tuple[TubeEstimate, ...]], None] | None = None,
) -> RackPose:
    """Add a frame's rows to the tables; what is known of its rack."""
    detector = detector_for(job.rack, job.tubes)
    scene = prepare_scene(frame, job.rack, job.tubes, detector, config, hint, job.T_camera_rack, methods)
    tables.labware[job.rack.name] = job.rack
    tables.labware |= {tube.name: tube for tube in job.tubes}
    keys = _keys(job, frame)
    tables.sensor.append(sensor_row(keys, frame, scene.noise))
    times = ([load] if load is not None else []) + list(scene.times)
    shown_method = DEFAULT_METHOD if DEFAULT_METHOD in methods else methods[0]
    shown: tuple[TubeEstimate, ...] = ()
    shown_scene = scene
    for method in methods:
        for seed in range(seeds) if method in STOCHASTIC else (None,):
            estimates, tube_times = estimate_tubes(scene, method, config, seed)
            times += tube_times
            judged = scene
            if method == DEFAULT_METHOD:
                judged, estimates = refuse_by_tops(scene, estimates, config)
            tables.estimates += [estimate_row(keys, judged, estimate) for estimate in estimates]
            if method == shown_method and seed in (None, 0):
                shown, shown_scene = estimates, judged
            if seed in (None, 0):
                tables.racks.append({**keys, "method": method, **rack_row(judged), "named_by_nats": job.named_by_nats})
                tables.slots += slot_rows(keys, method, judged, estimates)
                tables.checks += check_rows(keys, method, judged, estimates)
    of_profile = shown if shown_method == DEFAULT_METHOD else ()
    tables.labware_check += [{**keys, **size_row(size)} for size in compare_sizes(shown_scene, of_profile, config)]
    timings = tables.timings if warm_timings is None else warm_timings
    timings += [timing_row(keys, entry, warm_timings is not None) for entry in times]
    if on_scene is not None:
        on_scene(job, shown_scene, shown)
    if scene.rack_pose.status is RackStatus.UNIT and warm_timings is None:
        raise CaptureError(scene.rack_pose.reason)
    return scene.rack_pose
