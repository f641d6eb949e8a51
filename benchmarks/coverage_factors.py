"""Are stated covariances honest under other sensors? One factor at a time from a middle, then random combinations.

    python -m benchmarks.coverage_factors [--captures N] [--combinations N] [--seed S] [--factors NAME,...] [--out DIR]

All of it is SIMULATED: scenes of the sensor `raycast` without noise of its own, bowed and at the resolution that gives
the spacing, then noise of a known law (`tubepose.simulation.depth_noise`). The same scenes are looked at in every cell.
Inside: share of the stated tubes whose true pose lies in the stated 95 % region, with its 95 % interval by bootstrap
over captures. Kept: tubes with status `ok` that have no fault (as `wrong_labware` judges). Wrong: all statements that
are not so. 200 tubes a cell need some 10 captures.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.wrong_labware import SEPARATOR, ask
from benchmarks.wrong_labware_cases import Case
from benchmarks.wrong_labware_judging import Answer, TrueTube, Truth, judge
from benchmarks.wrong_labware_scenes import CAP, MOST_TYPES, racks, types_for
from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.config import Config
from tubepose.labware import TubeModel, load_cap
from tubepose.pose_errors import COVARIANCE_AXES, squared_mahalanobis
from tubepose.provenance import pinned_threads
from tubepose.simulation import SENSORS, SceneVariation
from tubepose.simulation.camera import FULL_FOCAL_PX, FULL_RESOLUTION, NO_NOISE, default_camera
from tubepose.simulation.depth_noise import DepthNoise
from tubepose.simulation.random_scene import random_scene
from tubepose.statistics import paired_bootstrap

DISTANCE_M = 0.65
"""Where the spacing counts: the middle of the distances that scenes are drawn from."""
REGION = 0.95
REASONS_SHOWN = 3
REASON_LENGTH = 40


@dataclass(frozen=True, slots=True)
class Setting:
    """A sensor and a bow; the defaults are the middle.

    Attributes:
        noise_mm: Standard deviation of depth, all of it.
        shared_share: Share of its variance that neighbouring pixels share.
        correlation_mm: Distance at which the correlation of the shared part has fallen to 1/e.
        spacing_mm: Of neighbouring points.
        missing: Share of the pixels without depth.
        blur_px: Width of the ramp that a depth edge becomes.
        bow_mm: Of the rack, the same along x and y.
    """

    noise_mm: float = 0.3
    shared_share: float = 0.5
    correlation_mm: float = 3.0
    spacing_mm: float = 0.6
    missing: float = 0.05
    blur_px: float = 1.0
    bow_mm: float = 1.0

    @property
    def depth_noise(self) -> DepthNoise:
        """The same as errors of depth."""
        return DepthNoise(
            independent_m=1e-3 * self.noise_mm * float(np.sqrt(1 - self.shared_share)),
            shared_m=1e-3 * self.noise_mm * float(np.sqrt(self.shared_share)),
            correlation_m=1e-3 * self.correlation_mm,
            blur_px=self.blur_px,
            missing=self.missing,
        )


MIDDLE = Setting()
FACTORS: dict[str, tuple[float, ...]] = {
    "noise_mm": (0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 1.0),
    "shared_share": (0.0, 0.25, 0.5, 0.75, 1.0),
    "correlation_mm": (1.0, 2.0, 3.0, 4.5, 6.0),
    "spacing_mm": (0.3, 0.45, 0.6, 0.9, 1.2),
    "missing": (0.0, 0.05, 0.1, 0.2, 0.3),
    "blur_px": (0.0, 1.0, 2.0, 3.0),
    "bow_mm": (-2.5, -1.25, 0.0, 1.0, 2.5),
}


@dataclass(frozen=True, slots=True, eq=False)
class _Kept:
    """A frame in little memory, and what stands there."""

    depth_m: NDArray[np.float32]
    image: NDArray[np.uint8]
    intrinsics: CameraIntrinsics
    truth: Truth
    types: tuple[TubeModel, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """One line of the table: a setting, what it is called, and what came out, capture by capture."""

    name: str
    setting: Setting
    answers: tuple[Outcome, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Outcome:
    """What came out of one capture.

    Attributes:
        tubes: Tubes that stand there.
        racks: Racks accepted, 0 or 1.
        kept: Tubes stated without a fault.
        wrong: Wrong statements of all kinds.
        squares: Squared Mahalanobis distances of stated tubes whose type is right.
        reasons: Why the rack or tubes were not stated.
    """

    tubes: int
    racks: int
    kept: int
    wrong: int
    squares: tuple[float, ...]
    reasons: tuple[str, ...]


def scene_of(
    seed: int, number: int, spacing_mm: float, bow_mm: float
) -> tuple[RgbdFrame, Truth, tuple[TubeModel, ...]]:
    """A frame without noise, what stands there, and its types; racks take turns."""
    kept = _kept(seed, number, spacing_mm, bow_mm)
    cloud = kept.intrinsics.backproject(kept.depth_m.astype(float))
    return RgbdFrame(cloud, kept.image, kept.intrinsics, None, f"{seed}-{number}"), kept.truth, kept.types


@lru_cache(maxsize=64)
def _kept(seed: int, number: int, spacing_mm: float, bow_mm: float) -> _Kept:
    drawing, placing = (np.random.default_rng(child) for child in np.random.SeedSequence([seed, number]).spawn(2))
    rack = racks()[number % len(racks())]
    fitting = types_for(rack)
    count = min(MOST_TYPES, len(fitting))
    types = tuple(fitting[i] for i in sorted(drawing.permutation(len(fitting))[:count]))
    fill = float(drawing.uniform(0.3, 1.0))
    focal_px = DISTANCE_M / (spacing_mm * 1e-3)
    camera = default_camera(round(FULL_RESOLUTION * focal_px / FULL_FOCAL_PX))
    camera = dataclasses.replace(camera, noise=NO_NOISE)
    variation = SceneVariation(fill=(fill, fill), rack_bow_mm=(bow_mm, bow_mm))
    scene = random_scene(rack, types, load_cap(CAP), camera, placing, variation)
    frame = SENSORS["raycast"](scene, camera, np.random.default_rng(0), threads=1)
    assert frame.image is not None
    placed = tuple(TrueTube(t.slot, t.model, scene.T_camera_rack @ t.T_rack_tube) for t in scene.tubes)
    truth = Truth(rack, scene.T_camera_rack, placed, scene.bow)
    return _Kept(frame.cloud_m[..., 2].astype(np.float32), frame.image, camera.intrinsics, truth, types)


def outcome(setting: Setting, seed: int, number: int) -> Outcome:
    """Ask about one capture."""
    frame, truth, types = scene_of(seed, number, setting.spacing_mm, setting.bow_mm)
    assert truth.rack is not None
    noisy = setting.depth_noise.applied(frame, np.random.default_rng([seed, number, 1]))
    answer, details = ask(Case("right", "right", truth.rack, types, noisy, truth), Config())
    verdict = judge(truth, answer, same_rack=True)
    tubes_not_ok = str(details.get("tubes_not_ok", "")).split(SEPARATOR)
    words = tuple(words.partition(": ")[2] for words in tubes_not_ok if words)
    words = (f"rack: {answer.reason}",) if answer.T_camera_rack is None else words
    return Outcome(len(truth.tubes), verdict.racks, verdict.kept, verdict.wrong, squares(truth, answer), words)


def squares(truth: Truth, answer: Answer) -> tuple[float, ...]:
    """Squared Mahalanobis distances of the stated tubes whose nearest true tube is of the stated type.

    Names of slots do not count here: a rack that may stand either way round has two for every tube.
    """
    found = []
    for stated in answer.tubes:
        apart = [np.linalg.norm((t.T_camera_tube - stated.T_camera_tube)[:3, 3]) for t in truth.tubes]
        if not apart or stated.covariance is None:
            continue
        nearest = truth.tubes[int(np.argmin(apart))]
        if nearest.model.name == stated.type_name:
            pair = (nearest.T_camera_tube[None], stated.T_camera_tube[None], stated.covariance[None])
            found.append(float(squared_mahalanobis(*pair)[0]))
    return tuple(value for value in found if np.isfinite(value))


def settings(names: Sequence[str], combinations: int, seed: int) -> Iterator[tuple[str, Setting]]:
    """The middle, each factor's levels, and random combinations: every factor uniform between its ends."""
    yield "middle", MIDDLE
    for name in names:
        for level in FACTORS[name]:
            if level != getattr(MIDDLE, name):
                yield f"{name} {level:g}", dataclasses.replace(MIDDLE, **{name: level})
    rng = np.random.default_rng(seed)
    for number in range(combinations):
        drawn = {name: float(rng.uniform(min(levels), max(levels))) for name, levels in FACTORS.items()}
        yield f"combination {number + 1}", Setting(**drawn)


HEADINGS = (
    "cell", "captures", "racks", "tubes", "kept", "share", "wrong", "inside 95 %", "interval", "d^2 / 5",
    "most frequent reasons",
)  # fmt: skip


def line(cell: Cell) -> str:
    """One line of the table."""
    tubes, kept = sum(a.tubes for a in cell.answers), sum(a.kept for a in cell.answers)
    d2 = np.array([value for a in cell.answers for value in a.squares])
    owner = [number for number, a in enumerate(cell.answers) for _ in a.squares]
    inside = paired_bootstrap((d2 <= chi2.ppf(REGION, len(COVARIANCE_AXES))).astype(float), owner)
    counted = Counter(reason[:REASON_LENGTH] for a in cell.answers for reason in a.reasons)
    reasons = "; ".join(f"{times} x {reason}" for reason, times in counted.most_common(REASONS_SHOWN))
    cells = (
        cell.name, len(cell.answers), sum(a.racks for a in cell.answers), tubes, kept, f"{kept / max(tubes, 1):.3f}",
        sum(a.wrong for a in cell.answers), f"{inside.mean:.3f}", f"{inside.low:.3f} to {inside.high:.3f}",
        f"{d2.mean() / len(COVARIANCE_AXES):.2f}" if len(d2) else "-", reasons,
    )  # fmt: skip
    return "| " + " | ".join(map(str, cells)) + " |"


def main() -> None:
    """Parse the command line, ask, and print the table line by line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=16, help="Per cell; racks take turns.")
    parser.add_argument("--combinations", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--factors", default=",".join(FACTORS))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    names = [name for name in options.factors.split(",") if name]
    if unknown := sorted(set(names) - set(FACTORS)):
        parser.error(f"--factors: unknown {', '.join(unknown)}; known: {', '.join(FACTORS)}")
    print("| " + " | ".join(HEADINGS) + " |\n|---" + "|--:" * (len(HEADINGS) - 2) + "|---|")
    rows = []
    with pinned_threads(1):
        for name, setting in settings(names, options.combinations, options.seed):
            cell = Cell(name, setting, tuple(outcome(setting, options.seed, k) for k in range(options.captures)))
            print(line(cell), flush=True)
            for number, found in enumerate(cell.answers):
                shown = dataclasses.asdict(found) | {"squares": " ".join(f"{v:.2f}" for v in found.squares)}
                rows.append({"cell": name, "capture": number} | dataclasses.asdict(setting) | shown)
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        pd.DataFrame(rows).to_csv(options.out / "coverage_factors.csv", index=False)
        print(f"{options.out / 'coverage_factors.csv'}: one row per cell and capture", file=sys.stderr)


if __name__ == "__main__":
    main()
