"""Which rings of even gray are rims: what the log odds of `profile` for rims that the image alone shows are fitted to.

    python -m benchmarks.rims SESSION ... [--types TUBE,...]

In simulated sessions, with the rack's exact pose, the most even ring of every slot that `profile` looks at there is
compared with the exact poses: it is a rim if one is within 1.2 mm. Trials without an open tube are looked at for the
types that are given, so none of their rings is one. Printed are how many rings each session has, the logistic
regression of what is known of them (`EvenRings.facts`), and how many rims and others have more than some odds.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tubepose.batch import trial_capture
from tubepose.capture.session import Session, Trial, load_session
from tubepose.config import Config
from tubepose.labware import TubeModel, load_tube
from tubepose.profile import measure
from tubepose.profile.faint_rims import LIKELY, UNLIKELY, FaintRims, RimSearch, find_faint_rims, is_a_hole, most_even
from tubepose.simulation import read_exact_truth
from tubepose.transforms import FloatArray, invert_transform, transform_points

RIM_M, NO_RIM_M = 1.2e-3, 3.0e-3
"""A ring this near to a rim is one, and this far from all of them none; those between are left out."""
ODDS = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0)
RIDGE, STEPS, RATE = 1e-3, 20_000, 0.5


def rings_of(
    session: Session, trial: Trial, types: list[TubeModel], config: Config
) -> Iterator[tuple[FloatArray, bool]]:
    """What is known of every ring of a trial, shape (3,), and whether it is a rim."""
    exact = read_exact_truth(session.folder, trial.name)
    own = list(session.tubes_of(trial))
    is_open = any(tube.is_open for tube in own)
    searches: list[RimSearch] = []

    def recorded(search: RimSearch) -> FaintRims:
        searches.append(search)
        return find_faint_rims(search)

    frame = next(trial_capture(session, trial, trial.original).frames())
    kept, measure.find_faint_rims = measure.find_faint_rims, recorded
    try:
        tubes = own if is_open else [*own, *types]
        measure.measure_tops(frame, frame.intrinsics, exact.T_camera_rack, session.rack, tubes, config)
    finally:
        measure.find_faint_rims = kept
    heights = {tube.name: tube.height_m for tube in own}
    T_rack_camera = invert_transform(exact.T_camera_rack)
    tops_m = np.array(
        [
            transform_points(T_rack_camera @ T, np.array([[0, 0, heights[Path(name).stem]]]))[0]  # a file's, or a name
            for name, T in exact.tubes.values()
        ]
    ).reshape(-1, 3)
    for search in searches:
        rings = most_even(search)
        usable = np.isfinite(rings.facts).all(axis=1) & ~is_a_hole(rings.center_m, search)
        for center_m, facts in zip(rings.center_m[usable], rings.facts[usable], strict=True):
            apart_m = np.linalg.norm(tops_m[:, :2] - center_m, axis=1).min(initial=np.inf)
            if is_open and (apart_m < RIM_M or apart_m > NO_RIM_M):
                yield facts, bool(apart_m < RIM_M)
            elif not is_open and apart_m > 2 * NO_RIM_M:
                yield facts, False


def fitted(facts: FloatArray, is_rim: FloatArray) -> tuple[FloatArray, float]:
    """Weights (3,) of the log odds, and what is taken off them: logistic regression by gradient ascent."""
    mean, scale = facts.mean(axis=0), facts.std(axis=0)
    design = np.column_stack([(facts - mean) / scale, np.ones(len(facts))])
    weight, shrunk = np.zeros(4), np.array([RIDGE, RIDGE, RIDGE, 0.0])
    for _ in range(STEPS):
        chance = 1 / (1 + np.exp(-design @ weight))
        weight += RATE * (design.T @ (is_rim - chance) / len(is_rim) - shrunk * weight)
    return weight[:3] / scale, float((weight[:3] * mean / scale).sum() - weight[3])


def main(arguments: list[str] | None = None) -> int:
    """Print the report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sessions", type=Path, nargs="+")
    parser.add_argument("--types", default="chen2023-tube-1")
    options = parser.parse_args(arguments)
    types, found = [load_tube(name) for name in options.types.split(",")], []
    print("| session | rings that are rims | others |")
    print("|---|--:|--:|")
    for folder in options.sessions:
        session = load_session(folder)
        rings = [ring for trial in session.trials for ring in rings_of(session, trial, types, Config())]
        rims = sum(is_rim for _, is_rim in rings)
        print(f"| {folder.name} | {rims} | {len(rings) - rims} |")
        found += rings
    facts, is_rim = np.array([facts for facts, _ in found]), np.array([is_rim for _, is_rim in found], float)
    if 0 < is_rim.sum() < len(is_rim):
        weights, less = fitted(facts, is_rim)
        print(f"\nfitted to these: {np.round(weights, 1).tolist()} less {less:.1f}")
    odds = facts @ LIKELY - UNLIKELY
    print(f"in use: {LIKELY.tolist()} less {UNLIKELY:g}\n\n| log odds in use | rims | others |\n|--:|--:|--:|")
    for least in ODDS:
        told = odds >= least
        print(f"| {least:g} | {int(is_rim[told].sum())} of {int(is_rim.sum())} | {int((1 - is_rim[told]).sum())} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
