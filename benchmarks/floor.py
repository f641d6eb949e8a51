"""The error that no estimator can go below from a scan of tops: what the slot's play and crooked caps leave open.

    python -m benchmarks.floor [--rack NAME] [--tubes NAME,...]

Tubes are drawn as the simulator places them. An ideal estimator is told the middle of each top exactly, and the plane
of a closed cap's top exactly; the cap sits crooked by the simulator's tolerance, and the floor lets the bottom stand
off the slot's centre. It knows these laws and answers with the posterior mean: where the bottom stands is drawn from
the floor's play, which with the top gives the slope; draws that the slot's walls allow are weighted by the plane. The
printed means are floors of the tables' R and T against the exact truth; the last column is how many equally weighted
draws an answer rests on (median), and too few are refused. A second row per tube adds what is measured of tops on
`dev`: circles to 0.1 mm, planes with the shared error of neighbouring points.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.labware import RackModel, TubeModel, load_rack, load_tube
from tubepose.simulation.placement import clears_walls, in_disc, lean, opening_height_m, play_at_top_m
from tubepose.simulation.variation import Tolerances
from tubepose.transforms import FloatArray

DRAWS = 4000
"""Places of the bottom that are drawn for every tube that is judged."""
JUDGED = 1000
LEAST_DRAWS = 100
"""Effective draws that a floor has to rest on."""
SETTINGS = (
    ("ideal: tops and planes exact", 0.0, 0.0),
    ("tops to 0.1 mm, planes to 0.09 deg", 0.1e-3, 0.09),
)
"""Name, standard deviation of a top's middle (m) and of a plane's slope (deg), beside the cap's own."""


@dataclass(frozen=True, slots=True, eq=False)
class Answers:
    """What the ideal estimator answers.

    Attributes:
        slope: Errors of the axis' slopes dx/dz and dy/dz, shape (N, 2).
        bottom_m: Errors of the bottom's x and y, metres, shape (N, 2).
        draws: Effective number of draws of each answer, shape (N,).
    """

    slope: FloatArray
    bottom_m: FloatArray
    draws: FloatArray


def placed(rack: RackModel, tube: TubeModel, count: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Random tubes: places of held points off their slot's centre (N, 2), metres, and slopes of axes (N, 2)."""
    slot = rack.all_slots[0]
    poses = np.array([lean(rack, slot, tube, rng) for _ in range(count)])
    axis = poses[:, :3, 2]
    slope = axis[:, :2] / axis[:, 2:]
    held = poses[:, :2, 3] + tube.pivot_height_m * axis[:, :2] - slot.center_m
    return held, slope


def ideal_answers(
    rack: RackModel, tube: TubeModel, top_std_m: float, slope_std: float, rng: np.random.Generator,
    judged: int = JUDGED, draws: int = DRAWS,
) -> Answers:  # fmt: skip
    """Answers for random tubes, from the middle of each top and, unless `slope_std` is infinite, from its plane.

    Raises:
        ArithmeticError: Too few draws explain what was seen for a mean of them to be the posterior's.
    """
    lever_m = tube.height_m - tube.pivot_height_m
    found = []
    for held, slope in zip(*placed(rack, tube, judged, rng), strict=True):
        seen_top = held + slope * lever_m + rng.normal(0, top_std_m, 2)
        low = in_disc(rng, rack.floor_play_mm * 1e-3, draws)
        guess = (seen_top + rng.normal(0, top_std_m, (draws, 2)) - low) / lever_m
        weight = allowed(rack, tube, low, guess).astype(float)
        if np.isfinite(slope_std):
            seen_slope = slope + rng.normal(0, slope_std, 2)
            weight *= np.exp(-0.5 * ((guess - seen_slope) ** 2).sum(axis=1) / slope_std**2)
        weight /= max(weight.sum(), np.finfo(float).tiny)
        bottom, true_bottom = low - tube.pivot_height_m * guess, held - tube.pivot_height_m * slope
        effective = 1 / max((weight**2).sum(), np.finfo(float).tiny) if weight.any() else 0.0
        found.append((weight @ guess - slope, weight @ bottom - true_bottom, effective))
    answers = Answers(*(np.array(part) for part in zip(*found, strict=True)))
    if np.median(answers.draws) < LEAST_DRAWS:
        raise ArithmeticError(f"{np.median(answers.draws):.0f} effective draws, {LEAST_DRAWS} expected: raise DRAWS")
    return answers


def allowed(rack: RackModel, tube: TubeModel, low_m: FloatArray, slope: FloatArray) -> NDArray[np.bool_]:
    """Which tubes `lean` could have placed so."""
    slot = rack.all_slots[0]
    high = low_m + slope * (opening_height_m(rack, tube) - tube.pivot_height_m)
    fits = np.all(np.abs(high) <= play_at_top_m(rack, slot, tube), axis=1)
    fits[fits] = clears_walls(rack, slot, tube, low_m[fits], slope[fits])
    return fits


def rows(rack: RackModel, tubes: list[TubeModel], seed: int) -> Iterator[str]:
    """Rows of the table."""
    crooked_deg = Tolerances().cap_tilt_deg
    for tube in tubes:
        for name, top_std_m, plane_deg in SETTINGS:
            slope_std = np.inf if tube.is_open else float(np.deg2rad(np.hypot(crooked_deg, plane_deg)))
            answers = ideal_answers(rack, tube, top_std_m, slope_std, np.random.default_rng(seed))
            turn, shift = np.rad2deg(answers.slope), answers.bottom_m * 1e3
            r, t = np.abs(turn).mean(), np.abs(shift).mean()
            p95 = np.percentile(np.hypot(*turn.T), 95)
            yield f"| {tube.name} | {name} | {r:.3f} | {p95:.2f} | {t:.3f} | {np.median(answers.draws):.0f} |"


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rack", default="chen2023-soft-5x10")
    parser.add_argument("--tubes", default="chen2023-tube-1,chen2023-tube-2,chen2023-tube-3")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    print("| tube | known of it | mean of R_x, R_y (deg) | tilt p95 (deg) | mean of T_x, T_y (mm) | draws |")
    print("|---|---|--:|--:|--:|--:|")
    for row in rows(load_rack(options.rack), [load_tube(name) for name in options.tubes.split(",")], options.seed):
        print(row)
    return 0


if __name__ == "__main__":
    sys.exit(main())
