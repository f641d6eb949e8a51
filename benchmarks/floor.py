"""The error that no estimator can go below from a scan of tops: what the slot's play and crooked caps leave open.

    python -m benchmarks.floor [--rack NAME] [--tubes NAME,...]     # tubes drawn at random
    python -m benchmarks.floor --session data/test                  # the very tubes of a simulated session

Tubes are drawn as the simulator places them, or are those that a session was simulated with. An ideal estimator is told
the middle of each top and the plane of a closed cap's top, exactly or but for what is measured of tops on `dev`:
circles to 0.1 mm, planes with the shared error of neighbouring points. It knows the laws that tubes are placed by: the
cap sits crooked by the simulator's tolerance, and the floor lets the bottom stand off the slot's centre. It answers
with the posterior mean: where the bottom stands is drawn from the floor's play, which with the top gives the slope;
draws that the slot's walls allow are weighted by the plane. The printed means are floors of the tables' R and T against
the exact truth, the rack's pose known exactly; the last column is how many equally weighted draws an answer rests on
(median), and too few are refused.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.session import load_session
from tubepose.errors import TubePoseError
from tubepose.labware import RackModel, SlotModel, TubeModel, load_rack, load_tube
from tubepose.simulation import read_exact_truth
from tubepose.simulation.placement import clears_walls, in_disc, lean, opening_height_m, play_at_top_m
from tubepose.simulation.scene import CapFit, PlacedTube
from tubepose.simulation.variation import Tolerances
from tubepose.transforms import FloatArray, invert_transform

DRAWS = 4000
"""Places of the bottom that are drawn for every tube that is judged."""
JUDGED = 1000
"""Tubes that are drawn; those of a session are asked about so often together."""
LEAST_DRAWS = 100
"""Effective draws that a floor has to rest on."""
SETTINGS = (
    ("ideal: tops and planes exact", 0.0, 0.0),
    ("tops to 0.1 mm, planes to 0.09 deg", 0.1e-3, 0.09),
)
"""Name, standard deviation of a top's middle (m) and of a plane's slope (deg), beside the cap's own."""
HEAD = "| tube | n | known of it | R_x (deg) | R_y (deg) | tilt p95 (deg) | T_x (mm) | T_y (mm) | draws |"


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """A tube that stands in a slot.

    Attributes:
        slot: The slot.
        held_m: Where the point that the floor holds stands, off the slot's centre, shape (2,), metres.
        slope: Of its axis, dx/dz and dy/dz, shape (2,).
        top_m: Middle of its top, off the slot's centre, shape (2,), metres.
        cap_slope: The same slopes of its closed cap's axis, shape (2,); NaN for an open tube.
    """

    slot: SlotModel
    held_m: FloatArray
    slope: FloatArray
    top_m: FloatArray
    cap_slope: FloatArray


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


def placed(slot: SlotModel, tube: TubeModel, T_rack_tube: FloatArray, cap_fit: CapFit) -> Placed:
    """A tube by its pose, shape (4, 4), metres, and by how its own cap sits."""
    T_rack_cap = T_rack_tube @ PlacedTube(slot.name, tube, T_rack_tube, cap_fit=cap_fit).T_tube_own_cap
    axis, cap_axis = T_rack_tube[:3, 2], T_rack_cap[:3, 2]
    return Placed(
        slot,
        T_rack_tube[:2, 3] + tube.pivot_height_m * axis[:2] - slot.center_m,
        axis[:2] / axis[2],
        (T_rack_cap @ [0.0, 0.0, tube.height_m, 1.0])[:2] - slot.center_m,
        cap_axis[:2] / cap_axis[2] if not tube.is_open else np.full(2, np.nan),
    )


def drawn(rack: RackModel, tube: TubeModel, count: int, rng: np.random.Generator) -> list[Placed]:
    """Random tubes of one type, each with a crooked cap, in a rack's first slot."""
    slot, crooked = rack.all_slots[0], np.deg2rad(Tolerances().cap_tilt_deg)
    fits = (CapFit(tilt_rad=(float(x), float(y))) for x, y in rng.normal(0, crooked, (count, 2)))
    return [placed(slot, tube, lean(rack, slot, tube, rng), fit if not tube.is_open else CapFit()) for fit in fits]


def placed_in(folder: Path) -> tuple[RackModel, dict[str, tuple[TubeModel, list[Placed]]]]:
    """Rack of a simulated session, and by name every type of tube with all that stand there, by the exact truth.

    Raises:
        CaptureError: The session cannot be read, or has no exact truth.
    """
    session = load_session(folder)
    found: dict[str, tuple[TubeModel, list[Placed]]] = {}
    for trial in session.trials:
        exact = read_exact_truth(session.folder, trial.name)
        T_rack_camera = invert_transform(exact.T_camera_rack)
        for slot, (name, T_camera_tube) in exact.tubes.items():
            tube, fit = session.tubes[name], exact.as_made[slot].cap_fit or CapFit()
            one = placed(session.rack.slot(slot), tube, T_rack_camera @ T_camera_tube, fit)
            found.setdefault(tube.name, (tube, []))[1].append(one)
    return session.rack, found


def ideal_answers(
    rack: RackModel, tube: TubeModel, tubes: Sequence[Placed], top_std_m: float, plane_std: float,
    rng: np.random.Generator, draws: int = DRAWS,
) -> Answers:  # fmt: skip
    """Answers for tubes, from the middle of each top and, where it is closed, from its plane.

    Args:
        rack: The rack, whose pose is known.
        tube: Their type.
        tubes: The tubes.
        top_std_m: Standard deviation of what is measured of a top's middle, along x and along y.
        plane_std: The same of a plane's slopes, beside how crooked caps sit.
        rng: Source of what is measured, and of the estimator's draws.
        draws: Places of the bottom that are tried.

    Raises:
        ArithmeticError: Too few draws explain what was seen for a mean of them to be the posterior's.
    """
    # A closed cap sits crooked on the rim: there, down its own axis from its top, is the tube's axis.
    cap_m = 0.0 if tube.is_open else tube.height_m - tube.rim_height_m
    lever_m = tube.height_m - cap_m - tube.pivot_height_m
    slope_std = float(np.hypot(plane_std, np.deg2rad(Tolerances().cap_tilt_deg)))
    found = []
    for one in tubes:
        seen_top, seen_slope = one.top_m + rng.normal(0, top_std_m, 2), one.cap_slope + rng.normal(0, plane_std, 2)
        if not tube.is_open:
            seen_top = seen_top - cap_m * seen_slope
        low = in_disc(rng, rack.floor_play_mm * 1e-3, draws)
        guess = (seen_top + rng.normal(0, top_std_m, (draws, 2)) - low) / lever_m
        weight = allowed(rack, one.slot, tube, low, guess).astype(float)
        if not tube.is_open:
            weight *= np.exp(-0.5 * ((guess - seen_slope) ** 2).sum(axis=1) / slope_std**2)
        weight /= max(weight.sum(), np.finfo(float).tiny)
        bottom, true_bottom = low - tube.pivot_height_m * guess, one.held_m - tube.pivot_height_m * one.slope
        effective = 1 / max((weight**2).sum(), np.finfo(float).tiny) if weight.any() else 0.0
        found.append((weight @ guess - one.slope, weight @ bottom - true_bottom, effective))
    answers = Answers(*(np.array(part) for part in zip(*found, strict=True)))
    if np.median(answers.draws) < LEAST_DRAWS:
        raise ArithmeticError(f"{np.median(answers.draws):.0f} effective draws, {LEAST_DRAWS} expected: raise DRAWS")
    return answers


def allowed(
    rack: RackModel, slot: SlotModel, tube: TubeModel, low_m: FloatArray, slope: FloatArray
) -> NDArray[np.bool_]:
    """Which tubes `lean` could have placed so."""
    high = low_m + slope * (opening_height_m(rack, tube) - tube.pivot_height_m)
    fits = np.all(np.abs(high) <= play_at_top_m(rack, slot, tube), axis=1)
    fits[fits] = clears_walls(rack, slot, tube, low_m[fits], slope[fits])
    return fits


def rows(rack: RackModel, kinds: Sequence[tuple[TubeModel, Sequence[Placed]]], seed: int) -> Iterator[str]:
    """Rows of the table, two for each type with its tubes."""
    for tube, tubes in kinds:
        for name, top_std_m, plane_deg in SETTINGS:
            often = [*tubes] * max(1, round(JUDGED / len(tubes)))
            rng = np.random.default_rng(seed)
            answers = ideal_answers(rack, tube, often, top_std_m, float(np.deg2rad(plane_deg)), rng)
            # A turn about x moves the axis along y.
            (r_y, r_x), (t_x, t_y) = (
                np.abs(errors * scale).mean(axis=0)
                for errors, scale in ((answers.slope, np.rad2deg(1.0)), (answers.bottom_m, 1e3))
            )
            p95 = np.percentile(np.rad2deg(np.hypot(*answers.slope.T)), 95)
            yield (
                f"| {tube.name} | {len(tubes)} | {name} | {r_x:.3f} | {r_y:.3f} | {p95:.2f} | {t_x:.3f} | {t_y:.3f} "
                f"| {np.median(answers.draws):.0f} |"
            )


def main(arguments: list[str] | None = None) -> int:
    """Print the table; 1 if a session or labware cannot be read."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rack", default="chen2023-soft-5x10")
    parser.add_argument("--tubes", default="chen2023-tube-1,chen2023-tube-2,chen2023-tube-3")
    parser.add_argument("--session", type=Path, help="a simulated session, whose own tubes are asked about")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    try:
        if options.session is not None:
            rack, found = placed_in(options.session)
            kinds = [*found.values()]
        else:
            rack, rng = load_rack(options.rack), np.random.default_rng(options.seed)
            kinds = [(tube, drawn(rack, tube, JUDGED, rng)) for tube in map(load_tube, options.tubes.split(","))]
    except TubePoseError as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 1
    print(HEAD)
    print("|---|--:|---|--:|--:|--:|--:|--:|--:|")
    for row in rows(rack, kinds, options.seed):
        print(row)
    return 0


if __name__ == "__main__":
    sys.exit(main())
