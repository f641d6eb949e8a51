"""Is a confidence the share that is right? Under the noise of several sensors, by bins of confidence.

    python -m benchmarks.confidence [--captures N] [--seed S] [--noise MM,MM,...]

SIMULATED scenes, as those of `benchmarks.coverage_factors` in its middle, at several levels of depth noise of which
half is shared. Counted are all tubes of `profile` that have a pose and a slot that holds a tube: accepted ones, and
rejected ones beside them. Right is as in `tubepose.confidence`, and of the right type. Names of slots do not count: a
rack that may stand either way round has two for every tube.
"""

from __future__ import annotations

import argparse
import dataclasses
from itertools import pairwise

import numpy as np

from benchmarks.coverage_factors import MIDDLE, scene_of
from benchmarks.wrong_labware_judging import Truth
from tubepose.confidence import within
from tubepose.config import Config
from tubepose.detection.geometric import GeometricDetector
from tubepose.methods import DEFAULT_METHOD
from tubepose.pipeline import estimate_tubes, prepare_scene
from tubepose.pose_errors import pose_errors
from tubepose.provenance import pinned_threads
from tubepose.scene import TubeEstimate

BINS = (0.0, 0.5, 0.8, 0.9, 0.95, 0.99, 0.999, 1.0)


def judged(truth: Truth, estimate: TubeEstimate) -> bool:
    """Whether an estimate is right about the nearest true tube."""
    T, tube, covariance = estimate.T_camera_tube, estimate.target.tube, estimate.pose.covariance
    assert T is not None
    assert tube is not None
    assert covariance is not None
    apart = [np.linalg.norm((true.T_camera_tube - T)[:3, 3]) for true in truth.tubes]
    true = truth.tubes[int(np.argmin(apart))]
    errors = pose_errors(true.T_camera_tube[None], T[None], np.array([tube.height_m]))
    std_along_m = np.sqrt(covariance[4:, 4])
    close = within(np.deg2rad(errors.tilt_deg), 1e-3 * errors.lateral_mm, 1e-3 * errors.axial_mm, std_along_m)
    return bool(close[0]) and true.model.name == tube.name


def answers(noise_mm: float, seed: int, number: int) -> list[tuple[float, bool, bool]]:
    """Confidence, whether it is right and whether it is accepted, of every posed tube of one capture."""
    setting = dataclasses.replace(MIDDLE, noise_mm=noise_mm)
    frame, truth, types = scene_of(seed, number, setting.spacing_mm, setting.bow_mm)
    assert truth.rack is not None
    noisy = setting.depth_noise.applied(frame, np.random.default_rng([seed, number, 1]))
    config = Config()
    detector = GeometricDetector(truth.rack, types, config)
    scene = prepare_scene(noisy, truth.rack, types, detector, config, methods=(DEFAULT_METHOD,))
    found = estimate_tubes(scene, DEFAULT_METHOD, config).estimates
    posed = [e for e in found if e.T_camera_tube is not None and e.pose.covariance is not None and truth.tubes]
    return [(e.pose.confidence, judged(truth, e), e.pose.status.value == "ok") for e in posed]


def main() -> None:
    """Parse the command line, ask, and print one line per level of noise and bin."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--captures", type=int, default=16, help="Per level of noise; racks take turns.")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--noise", default="0,0.3,0.7,1.0")
    options = parser.parse_args()
    everything: list[tuple[float, bool, bool]] = []
    print("| noise (mm) | answers | confidence | tubes | mean confidence | right |\n|---|---|---|--:|--:|--:|")
    with pinned_threads(1):
        for noise_mm in map(float, options.noise.split(",")):
            rows = [row for k in range(options.captures) for row in answers(noise_mm, options.seed, k)]
            everything += rows
            show(f"{noise_mm:g}", rows)
    show("all", everything)


def show(name: str, rows: list[tuple[float, bool, bool]]) -> None:
    """Lines of one level of noise."""
    for accepted in (True, False):
        of = np.array([(sure, right) for sure, right, ok in rows if ok == accepted]).reshape(-1, 2)
        for low, high in pairwise(BINS):
            here = of[(of[:, 0] > low) & (of[:, 0] <= high)]
            if len(here):
                cells = (f"{low:g} to {high:g}", len(here), f"{here[:, 0].mean():.3f}", f"{here[:, 1].mean():.3f}")
                print(
                    "| " + " | ".join(map(str, (name, "accepted" if accepted else "rejected", *cells))) + " |",
                    flush=True,
                )


if __name__ == "__main__":
    main()
