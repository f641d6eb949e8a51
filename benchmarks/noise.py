"""How noisy the measurements of tops are on a simulated session: what the defaults of `ProfileConfig` were taken from.

    python -m benchmarks.noise data/dev

Tops are found and measured with the rack's exact pose and compared with the exact poses. One row per kind of top: the
middle of its circle, the slope of a closed cap's plane against the body's axis (crooked caps included), and its height.
"""

from __future__ import annotations

import argparse
import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from tubepose.batch import trial_capture
from tubepose.capture.session import Session, Trial, load_session
from tubepose.config import Config
from tubepose.labware import TubeModel
from tubepose.profile.closed_tops import Measured
from tubepose.profile.measure import measure_tops
from tubepose.simulation import read_exact_truth
from tubepose.transforms import FloatArray, invert_transform

HEAD = "| tops | n | circle x, y: rms (mm) | p95 (mm) | stated (mm) | slope x, y: rms (deg) | height: mean, std (mm) |"


def trial_errors(session: Session, trial: Trial, config: Config) -> list[tuple[TubeModel, FloatArray]]:
    """Per measured top: error of the circle (m), stated std (m), error of the slope (rad), of the height (m): (7,)."""
    frame = next(trial_capture(session, trial, trial.original).frames())
    exact = read_exact_truth(session.folder, trial.name)
    tubes = session.tubes_of(trial)
    found = measure_tops(frame, frame.intrinsics, exact.T_camera_rack, session.rack, tubes, config)
    names = [slot.name for slot in session.rack.all_slots]
    T_rack_camera = invert_transform(exact.T_camera_rack)
    rows = []
    for i, slot in enumerate(found.tops.slot):
        if names[slot] in exact.tubes:
            tube = tubes[found.tops.tube[i]]
            rows.append((tube, _errors(found, i, T_rack_camera @ exact.tubes[names[slot]][1], tube)))
    return rows


def _errors(found: Measured, i: int, T_rack_tube: FloatArray, tube: TubeModel) -> FloatArray:
    axis = T_rack_tube[:3, 2]
    top = T_rack_tube[:3, 3] + tube.height_m * axis
    stated = np.sqrt(np.diag(found.circles.covariance_m2[i]))
    slope = -found.planes.slope[i] - axis[:2] / axis[2]
    return np.array([*(found.center_m[i] - top[:2]), *stated, *slope, found.planes.height_m[i] - top[2]])


def row(name: str, errors: FloatArray) -> str:
    """Row of the table."""
    rms = np.sqrt(np.nansum(errors**2, axis=0) / np.maximum(np.isfinite(errors).sum(axis=0), 1))
    p95 = np.nanpercentile(np.abs(errors[:, :2]), 95, axis=0)
    mm, deg = 1e3, float(np.rad2deg(1))
    plane = "-" if np.isnan(errors[:, 4]).all() else f"{rms[4] * deg:.3f}, {rms[5] * deg:.3f}"
    height = "-" if plane == "-" else f"{np.nanmean(errors[:, 6]) * mm:+.3f}, {np.nanstd(errors[:, 6]) * mm:.3f}"
    return (
        f"| {name} | {len(errors)} | {rms[0] * mm:.3f}, {rms[1] * mm:.3f} | {p95[0] * mm:.2f}, {p95[1] * mm:.2f} "
        f"| {rms[2] * mm:.3f}, {rms[3] * mm:.3f} | {plane} | {height} |"
    )


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("session", type=Path)
    options = parser.parse_args(arguments)
    session = load_session(options.session)
    kinds: dict[str, list[FloatArray]] = defaultdict(list)
    for trial in session.trials:
        for tube, errors in trial_errors(session, trial, Config()):
            if np.isfinite(errors[:4]).all():
                kinds["open" if tube.is_open else "closed"].append(errors)
                kinds[tube.name].append(errors)
    print(HEAD)
    print("|---|--:|--:|--:|--:|--:|--:|")
    for name in sorted(kinds):
        print(row(name, np.array(kinds[name])))
    return 0


if __name__ == "__main__":
    sys.exit(main())
