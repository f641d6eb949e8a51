"""The error that no estimator can go below from a scan of tops: what the slot's play and crooked caps leave open.

    python -m benchmarks.floor [--rack NAME] [--tubes NAME,...]

Tubes are drawn as the simulator places them. An ideal estimator is told the middle of each top exactly, and the plane
of a closed cap's top exactly; the cap sits crooked by the simulator's tolerance, and the floor lets the bottom stand
off the slot's centre. It knows these laws and answers with the posterior mean, by importance weights over twenty
thousand drawn tubes. The printed means are floors of the tables' R and T against the exact truth. A second row per tube
adds what is measured of tops on `dev`: circles to 0.1 mm, planes with the shared error of neighbouring points.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

import numpy as np

from tubepose.labware import RackModel, TubeModel, load_rack, load_tube
from tubepose.simulation.placement import lean
from tubepose.simulation.variation import Tolerances
from tubepose.transforms import FloatArray

DRAWS = 20_000
JUDGED = 400
SETTINGS = (
    ("ideal: tops and planes exact", 0.02e-3, 0.0),
    ("tops to 0.1 mm, planes to 0.09 deg", 0.1e-3, 0.09),
)
"""Name, standard deviation of a top's middle (m) and of a plane's slope (deg), beside the cap's own."""


def draw(rack: RackModel, tube: TubeModel, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """Places of held points off their slot's centre (N, 2), metres, and slopes of axes (N, 2)."""
    slot = rack.all_slots[0]
    poses = np.array([lean(rack, slot, tube, rng) for _ in range(DRAWS)])
    axis = poses[:, :3, 2]
    slope = axis[:, :2] / axis[:, 2:]
    held = poses[:, :2, 3] + tube.pivot_height_m * axis[:, :2] - slot.center_m
    return held, slope


def posterior_means(
    held: FloatArray, slope: FloatArray, tube: TubeModel, top_std_m: float, slope_std: float, rng: np.random.Generator
) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Errors of slope (2,) and of the bottom (2,), metres, of the ideal estimator for some of the drawn tubes."""
    pivot = tube.pivot_height_m
    top = held + slope * (tube.height_m - pivot)
    bottom = held - pivot * slope
    for k in range(JUDGED):
        seen_top = top[k] + rng.normal(0, top_std_m, 2)
        misfit = ((top - seen_top) ** 2).sum(axis=1) / top_std_m**2
        if np.isfinite(slope_std):
            seen_slope = slope[k] + rng.normal(0, slope_std, 2)
            misfit = misfit + ((slope - seen_slope) ** 2).sum(axis=1) / slope_std**2
        misfit[k] = np.inf
        weight = np.exp(-0.5 * (misfit - misfit.min()))
        weight /= weight.sum()
        yield weight @ slope - slope[k], weight @ bottom - bottom[k]


def rows(rack: RackModel, tubes: list[TubeModel], seed: int) -> Iterator[str]:
    """Rows of the table."""
    crooked_deg = Tolerances().cap_tilt_deg
    for tube in tubes:
        rng = np.random.default_rng(seed)
        held, slope = draw(rack, tube, rng)
        for name, top_std_m, plane_deg in SETTINGS:
            slope_std = np.inf if tube.is_open else float(np.deg2rad(np.hypot(crooked_deg, plane_deg)))
            found = list(posterior_means(held, slope, tube, max(top_std_m, 0.05e-3), slope_std, rng))
            turn = np.rad2deg(np.array([entry[0] for entry in found]))
            shift = np.array([entry[1] for entry in found]) * 1e3
            r, t = np.abs(turn).mean(), np.abs(shift).mean()
            p95 = np.percentile(np.hypot(*turn.T), 95)
            yield f"| {tube.name} | {name} | {r:.3f} | {p95:.2f} | {t:.3f} |"


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rack", default="chen2023-soft-5x10")
    parser.add_argument("--tubes", default="chen2023-tube-1,chen2023-tube-2,chen2023-tube-3")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    print("| tube | known of it | mean of R_x, R_y (deg) | tilt p95 (deg) | mean of T_x, T_y (mm) |")
    print("|---|---|--:|--:|--:|")
    for row in rows(load_rack(options.rack), [load_tube(name) for name in options.tubes.split(",")], options.seed):
        print(row)
    return 0


if __name__ == "__main__":
    sys.exit(main())
