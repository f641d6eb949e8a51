"""How fast everything is, in one run on one core: tubes, racks, a whole frame stage by stage, and the bound of it.

    python -m benchmarks.speed [SESSION] [--rounds N] [--tubes N] [--methods ...] [--out FOLDER]

Of each kind of tube the frame with the most tubes is taken. The methods take turns, tube by tube and rack by rack, so
that whatever else the machine does hits all alike; every one of them runs once before its time counts. Prints Markdown
and writes samples.csv (every time taken) and speed.csv. Run it on a quiet machine: the load is noted at both ends.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.speed_stages import REST, bandwidth, bound, timed_stages
from benchmarks.speed_tables import OURS, RACKS, Row, bound_line, claim_lines, markdown, summary
from tubepose.batch import Job, session_jobs
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.session import load_session
from tubepose.config import Config
from tubepose.detection import Detection, Detector
from tubepose.detection.geometric import GeometricDetector
from tubepose.errors import CaptureError, ConfigError, TubePoseError
from tubepose.methods import METHODS, require_methods
from tubepose.pipeline import estimate_tubes, prepare_scene
from tubepose.provenance import machine, pinned_threads
from tubepose.rack import RackStatus
from tubepose.scene import Scene, TubeEstimate
from tubepose_cli.inputs import sample_session

TIMED = (OURS, "paper", "slot-icp", "global-icp", "kiss-matcher", "gicp")
_ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "TBB_NUM_THREADS", "NUMBA_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class Boxes(Detector):
    """A source of boxes that were found before, so that detection takes no time."""

    found: tuple[Detection, ...]
    name: str = "recorded"

    def detect(self, frame: RgbdFrame) -> tuple[Detection, ...]:  # noqa: ARG002
        """The boxes, whatever the frame."""
        return self.found


@dataclass(frozen=True, slots=True, eq=False)
class Timed:
    """A frame that methods are timed on: its job, and its scene with boxes, rack and slots."""

    job: Job
    scene: Scene

    def prepared(self, config: Config) -> Scene:
        """The scene anew, as `profile` needs it: the boxes given, the rack registered."""
        boxes = Boxes(self.scene.detections)
        return prepare_scene(
            self.scene.frame, self.job.rack, self.job.tubes, boxes, config, self.job.hint, methods=(OURS,)
        )


def fullest_frames(path: Path, config: Config) -> list[Timed]:
    """Of each kind of tube the trial with the most tubes whose rack is accepted.

    Raises:
        CaptureError: There is none.
    """
    session = load_session(path)
    held = {trial.name: trial.tubes for trial in session.trials}
    jobs, problems = session_jobs(session)
    kinds: dict[tuple[str, ...], list[Job]] = {}
    for job in sorted(jobs, key=lambda job: -len(held[job.trial])):
        kinds.setdefault(tuple(sorted(set(held[job.trial].values()))), []).append(job)
    found = []
    for _, group in sorted(kinds.items()):
        for job in group:
            scene = _first_scene(job, config)
            if scene.rack_pose.status is RackStatus.OK:
                found.append(Timed(job, scene))
                break
            problems.append(f"{job.trial}: {scene.rack_pose.reason}")
    if not found:
        raise CaptureError(f"{path}: no frame whose rack is accepted: {'; '.join(problems)}")
    return found


def _first_scene(job: Job, config: Config) -> Scene:
    frame = next(job.capture.frames(), None)
    if frame is None:
        raise CaptureError(f"{job.capture.path}: no frame in it")
    return prepare_scene(frame, job.rack, job.tubes, GeometricDetector(job.rack, job.tubes, config), config, job.hint)


def known_tubes(estimates: Sequence[TubeEstimate]) -> int:
    """How many tubes there are a pose of, at least 1."""
    return max(sum(each.pose.T_rack_tube is not None for each in estimates), 1)


def time_tube(one: Timed, target: int, method: str, config: Config, seed: int) -> float:
    """Milliseconds of a method for one tube; `profile`, which does all at once, is shared out among them."""
    scene = replace(one.scene, targets=(one.scene.targets[target],))
    start = time.perf_counter_ns()
    estimates = estimate_tubes(scene, method, config, seed).estimates
    return (time.perf_counter_ns() - start) / 1e6 / (1 if METHODS[method].needs_targets else known_tubes(estimates))


def time_rack(one: Timed, method: str, config: Config) -> Row:
    """Milliseconds of a rack's registration, and how it ended."""
    chosen = config.model_copy(update={"rack": config.rack.model_copy(update={"method": method})})
    scene = one.prepared(chosen)
    (entry,) = (entry for entry in scene.times if entry.stage == "rack")
    return {"ms": entry.duration_ms, "outcome": scene.rack_pose.status.value}


def time_frame(one: Timed, config: Config) -> Iterator[Row]:
    """Milliseconds of a whole frame after detection, in all and by stage."""
    start = time.perf_counter_ns()
    scene = one.prepared(config)
    middle = time.perf_counter_ns()
    with timed_stages() as spent:
        estimates = estimate_tubes(scene, OURS, config).estimates
    end = time.perf_counter_ns()
    tubes = {"tubes": known_tubes(estimates)}
    yield {"part": "frame", "name": "rack + profile", "ms": (end - start) / 1e6, **tubes}
    yield {"part": "frame", "name": "rack", "ms": (middle - start) / 1e6, **tubes}
    yield {"part": "frame", "name": "profile", "ms": (end - middle) / 1e6, **tubes}
    rest = (end - middle) / 1e6 - sum(spent.values())
    for name, ms in {**spent, REST: rest}.items():
        yield {"part": "stage", "name": name, "ms": ms, **tubes}


def chosen_targets(scene: Scene, count: int) -> list[int]:
    """Tubes that every method can be asked for, spread evenly over the rack."""
    known = [i for i, target in enumerate(scene.targets) if target.slot is not None and target.tube is not None]
    steps = np.linspace(0, len(known) - 1, min(count, len(known)))
    return [known[i] for i in np.rint(steps).astype(int)]


def turns(names: Sequence[str], shift: int) -> list[str]:
    """The names in another order each time, so that none always follows the same other."""
    at = shift % len(names)
    return [*names[at:], *names[:at]]


def take_times(frames: Sequence[Timed], methods: Sequence[str], config: Config, rounds: int, tubes: int) -> list[Row]:
    """All samples; the rounds are counted from 0, the warm-up of every frame is left out."""
    rows: list[Row] = []
    for number in range(-1, rounds):
        for one in frames:
            targets = chosen_targets(one.scene, tubes if number >= 0 else 1)
            new: list[Row] = []
            for k, target in enumerate(targets):
                for method in turns(methods, number + k):
                    ms = time_tube(one, target, method, config, max(number, 0))
                    new.append({"part": "tube", "name": method, "ms": ms})
            for method in turns(RACKS, number):
                new.append({"part": "rack", "name": method, **time_rack(one, method, config)})
            new += time_frame(one, config)
            rows += [{"frame": one.job.trial, "round": number, **row} for row in new if number >= 0]
            print(f"round {number + 1} of {rounds}, {one.job.trial}: done", file=sys.stderr, flush=True)
    return rows


def measure_all(frames: Sequence[Timed], options: argparse.Namespace, out: Path) -> Iterator[str]:
    """Take all times, write them, and say what they come to."""
    config, began = Config(), os.getloadavg()
    samples = pd.DataFrame(take_times(frames, options.methods, config, options.rounds, options.tubes))
    table = summary(samples)
    out.mkdir(parents=True, exist_ok=True)
    samples.to_csv(out / "samples.csv", index=False)
    counted = samples[samples["name"] == "rack + profile"].groupby("frame")["tubes"].first()
    tubes = {one.job.trial: int(counted[one.job.trial]) for one in frames}
    yield from markdown(table, list(tubes))
    yield from claim_lines(table, tubes)
    bytes_per_s = bandwidth(options.megabytes)
    for one in frames:
        trial = one.job.trial
        least = bound(one.scene, estimate_tubes(one.scene, OURS, config).estimates, bytes_per_s)
        of = table[(table["part"] == "frame") & (table["frame"] == trial)].set_index("name")["median_ms"]
        yield bound_line(trial, tubes[trial], least, of["profile"], of["rack + profile"])
        rows = [{"part": "bound", "frame": trial, "name": name, "value": value} for name, value in least.items()]
        table = pd.concat([table, pd.DataFrame(rows)], ignore_index=True)
    table.to_csv(out / "speed.csv", index=False)
    ended = os.getloadavg()
    yield (
        f"- {options.session}: {', '.join(f'{trial} ({count} tubes)' for trial, count in tubes.items())}; "
        f"{machine()['cpu']}, one core, one thread; load {began[0]:.2f} at the start, {ended[0]:.2f} at the end "
        "(1 on a quiet machine)."
    )


def one_core() -> None:
    """Stay on one core, and say so to what is still to be loaded; `pinned_threads` bounds the rest."""
    for name in _ONE_THREAD:
        os.environ[name] = "1"
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})


def parser() -> argparse.ArgumentParser:
    """Parser of the command line."""
    whole = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    whole.add_argument("session", type=Path, nargs="?", default=sample_session(), help="default: the bundled sample")
    whole.add_argument("--rounds", type=int, default=5)
    whole.add_argument("--tubes", type=int, default=10, help="of every frame that every method is asked for")
    whole.add_argument("--methods", help="with commas; default: all that are installed")
    whole.add_argument("--megabytes", type=int, default=512, help="of the array that the memory is measured with")
    whole.add_argument("--out", type=Path, default=Path("out/speed"))
    return whole


def read_methods(text: str | None) -> list[str]:
    """Methods to time, `profile` first; by default those whose packages are installed."""
    if text is None:
        return [name for name in TIMED if all(find_spec(package) for package in METHODS[name].packages)]
    names = text.split(",")
    if unknown := [name for name in names if name not in METHODS]:
        raise ConfigError(f"unknown method '{unknown[0]}'; known methods: {', '.join(METHODS)}")
    return [OURS, *(name for name in names if name != OURS)]


def main(arguments: list[str] | None = None) -> int:
    """Run the command; 1 if it could not be done."""
    options = parser().parse_args(arguments)
    try:
        options.methods = read_methods(options.methods)
        if min(options.rounds, options.tubes, options.megabytes) < 1:
            raise ConfigError("--rounds, --tubes and --megabytes: expected 1 or more")
        one_core()
        require_methods(options.methods)
        with pinned_threads(1):
            frames = fullest_frames(options.session, Config())
            for line in measure_all(frames, options, options.out):
                print(line, flush=True)
    except (TubePoseError, OSError) as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
