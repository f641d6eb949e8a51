"""Noise of the simulated stereo cameras beside that of real ones (SIMULATED).

    python -m benchmarks.stereo_noise [--recordings 6] [--out FILE.csv]

One row per line of the table of REAL noise: measured on public RealSense captures, 28 pairs of a D405 and 40 of a
D435. Residuals along the normal of planar patches: their standard deviation, what of it is finer than 20 mm (behind a
high pass that takes out a Gaussian mean of 10 mm standard deviation), the rest of the variance, the distance at which
the correlation of the fine part is 1/e, along u and v, and the share of pixels without depth. In time: standard
deviation of a frame about the mean of a static recording, and the 1/e distance of the difference of two frames.

A row is met if the median over the recordings is inside of its range widened by 20 %; missing is at most the row's.
Every recording looks at a plane of its own depth and slope, up to 20 deg. Exit 1 if a row is not met.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics
from tubepose.simulation.stereo import StereoCamera, load_stereo_camera
from tubepose.simulation.stereo.matching import matched_depth_m
from tubepose.simulation.stereo.stereo_view import StereoView
from tubepose.simulation.stereo.waves import depth_error_m, smooth_field
from tubepose.transforms import FloatArray

Range = tuple[float, float]
WIDER = 0.2
FINE_M = 0.010
"""Standard deviation of the Gaussian mean that is taken out: what is left is finer than 20 mm."""
CLIP = 3.0
PATCH = 0.6
"""Side of the patch in the middle of the image, as a share of it."""
FRAMES = 8
MOST_TILT_RAD = np.deg2rad(20.0)


@dataclass(frozen=True, slots=True)
class RealRow:
    """A line of the table of REAL noise; lengths in millimetres.

    Attributes:
        camera: The simulated camera of the same kind and resolution.
        depth_mm: Depths of the planes.
        total_mm: Standard deviation.
        fine_mm: What of it is finer than 20 mm.
        low_mm: The rest.
        along_u_mm: 1/e distance of the fine part along u.
        along_v_mm: The same along v.
        missing: Largest share of pixels without depth.
    """

    camera: str
    depth_mm: Range
    total_mm: Range
    fine_mm: Range
    low_mm: Range
    along_u_mm: Range
    along_v_mm: Range
    missing: float


REAL = (
    RealRow("d405", (156, 177), (0.70, 0.92), (0.51, 0.80), (0.30, 0.48), (4.5, 5.5), (3.1, 3.5), 0.03),
    RealRow("d405", (183, 207), (0.92, 1.27), (0.78, 0.92), (0.47, 0.88), (5.0, 6.6), (3.5, 3.5), 0.02),
    RealRow("d405", (223, 268), (0.92, 1.22), (0.82, 1.07), (0.41, 0.68), (5.0, 5.0), (3.4, 3.4), 0.01),
    RealRow("d405", (312, 358), (1.31, 1.59), (0.89, 1.42), (0.67, 0.97), (5.4, 8.0), (4.0, 5.0), 0.01),
    RealRow("d435-640", (308, 308), (0.63, 0.63), (0.52, 0.52), (0.34, 0.34), (4.9, 4.9), (3.6, 3.6), 0.01),
    RealRow("d435", (560, 560), (2.2, 2.7), (1.5, 1.7), (1.6, 2.1), (7.0, 7.0), (5.5, 5.5), 0.01),
    RealRow("d435-640", (787, 787), (2.85, 2.85), (1.4, 1.4), (2.5, 2.5), (13.0, 13.0), (7.5, 7.5), 0.01),
    RealRow("d435", (1050, 1050), (4.6, 4.6), (2.4, 2.4), (3.8, 3.8), (12.0, 12.0), (7.6, 7.6), 0.01),
    RealRow("d435", (1450, 1490), (7.0, 7.4), (2.9, 3.1), (6.4, 6.8), (12.0, 13.0), (8.0, 9.0), 0.01),
)


@dataclass(frozen=True, slots=True)
class RealInTime:
    """What REAL static recordings of a D435 say; the D405's share in time is assumed.

    Attributes:
        depth_mm: Depths.
        frame_mm: Standard deviation of a frame about the mean.
    """

    depth_mm: Range
    frame_mm: Range


IN_TIME = (
    RealInTime((450, 700), (1.05, 1.05)),
    RealInTime((700, 1000), (2.1, 3.2)),
    RealInTime((1000, 1300), (2.1, 5.2)),
)
DIFFERENCE_U_PX, DIFFERENCE_V_PX = (15.0, 17.0), (10.0, 12.0)
TEMPORAL_SHARE = (0.2, 0.67)
"""Share of the variance that is new in each frame."""


def plane_view(camera: StereoCamera, depth_m: float, rng: np.random.Generator) -> StereoView:
    """A well textured plane before a camera, its middle at a depth, with a random slope."""
    k = camera.intrinsics
    tilt, about = float(rng.uniform(0, MOST_TILT_RAD)), float(rng.uniform(0, 2 * np.pi))
    normal = np.array([np.sin(tilt) * np.cos(about), np.sin(tilt) * np.sin(about), np.cos(tilt)])
    exact = normal[2] * depth_m / (k.rays() @ normal)
    depth = matched_depth_m(camera, exact, np.ones(exact.shape), rng)
    depth = depth + depth_error_m(camera, depth, rng, temporal=False)
    patches = smooth_field((k.height, k.width), (12.0, 6.0), rng)
    return StereoView(camera, np.zeros((k.height, k.width, 3), np.float32), depth, patches, 0)


def patch_residuals(depth_m: FloatArray, camera: CameraIntrinsics) -> FloatArray:
    """Distances of the middle of an image from its plane along the normal, metres; NaN without depth."""
    height, width = depth_m.shape
    rows, columns = (slice(round(side * (1 - PATCH) / 2), round(side * (1 + PATCH) / 2)) for side in (height, width))
    points = camera.backproject(depth_m)[rows, columns]
    valid = np.isfinite(points[..., 2])
    listed, kept = points[valid], np.ones(int(valid.sum()), bool)
    for _ in range(8):
        middle = listed[kept].mean(axis=0)
        normal = np.linalg.eigh(np.cov((listed[kept] - middle).T))[1][:, 0]
        off = (listed - middle) @ normal
        kept = np.abs(off) < CLIP * off[kept].std()
    residuals = np.full(valid.shape, np.nan)
    residuals[valid] = np.where(kept, off, np.nan)
    return residuals


def high_passed(residuals_m: FloatArray, px_per_m: Range) -> FloatArray:
    """Residuals (H, W) without their Gaussian mean of `FINE_M`, metres."""
    valid = np.isfinite(residuals_m)
    sigma_u, sigma_v = (FINE_M * scale for scale in px_per_m)
    total = cv2.GaussianBlur(np.where(valid, residuals_m, 0.0), (0, 0), sigma_u, sigmaY=sigma_v)
    weight = cv2.GaussianBlur(valid.astype(float), (0, 0), sigma_u, sigmaY=sigma_v)
    return np.where(valid, residuals_m - total / np.maximum(weight, 0.1), np.nan)


def one_over_e_px(field: NDArray[np.floating], axis: int) -> float:
    """Lag along an axis (0: v, 1: u) at which the autocorrelation falls to 1/e, between pixels linearly."""
    variance, before = float(np.nanvar(field)), 1.0
    for lag in range(1, field.shape[axis] // 2):
        ahead, behind = (np.roll(field, -lag, axis), field)
        keep = [slice(None), slice(None)]
        keep[axis] = slice(0, field.shape[axis] - lag)
        now = float(np.nanmean(ahead[tuple(keep)] * behind[tuple(keep)])) / variance
        if now < np.exp(-1):
            return lag - 1 + (before - np.exp(-1)) / (before - now)
        before = now
    return float("nan")


def measured(row: RealRow, recordings: int) -> dict[str, float]:
    """Medians over recordings of what the table has, millimetres."""
    camera = load_stereo_camera(row.camera)
    k, found = camera.intrinsics, []
    for number, depth_mm in enumerate(np.linspace(*row.depth_mm, recordings)):
        rng = np.random.default_rng([number, round(depth_mm)])
        depth = plane_view(camera, depth_mm * 1e-3, rng).frame_depth_m(rng)
        residuals = patch_residuals(depth, k)
        scale = (k.fx / depth_mm * 1e3, k.fy / depth_mm * 1e3)
        fine, total = high_passed(residuals, scale), float(np.nanstd(residuals))
        fine_m = float(np.nanstd(fine))
        found.append(
            {
                "total": total * 1e3,
                "fine": fine_m * 1e3,
                "low": np.sqrt(max(total**2 - fine_m**2, 0.0)) * 1e3,
                "u": one_over_e_px(fine, 1) / scale[0] * 1e3,
                "v": one_over_e_px(fine, 0) / scale[1] * 1e3,
                "missing": float(np.mean(np.isnan(depth[:, round(k.fx * camera.baseline_m / depth_mm * 1e3) + 1 :]))),
            }
        )
    return {name: float(np.median([one[name] for one in found])) for name in found[0]}


def measured_in_time(row: RealInTime, camera_name: str, recordings: int) -> dict[str, float]:
    """Medians over recordings: a frame's std, 1/e of the difference of two frames, share of the variance."""
    camera = load_stereo_camera(camera_name)
    found = []
    for number, depth_mm in enumerate(np.linspace(*row.depth_mm, recordings)):
        rng = np.random.default_rng([number, round(depth_mm), 7])
        view = plane_view(camera, depth_mm * 1e-3, rng)
        frames = np.array([view.frame_depth_m(own) for own in rng.spawn(FRAMES)])
        a, b = (int(side * (1 - PATCH) / 2) for side in frames.shape[1:])
        frames = frames[:, a:-a, b:-b]
        always = np.isfinite(frames).all(axis=0)
        in_time = float(np.sqrt(np.mean(np.var(frames[:, always], axis=0, ddof=1))))
        apart = frames[1] - frames[0]
        apart = apart - np.nanmean(apart)
        total = float(np.nanstd(patch_residuals(view.frame_depth_m(rng), camera.intrinsics)))
        found.append(
            {
                "frame": in_time * 1e3,
                "u": one_over_e_px(apart, 1),
                "v": one_over_e_px(apart, 0),
                "share": (in_time / total) ** 2,
            }
        )
    return {name: float(np.median([one[name] for one in found])) for name in found[0]}


def met(value: float, real: Range) -> bool:
    """Whether a value is inside of a range widened by 20 %."""
    return real[0] * (1 - WIDER) <= value <= real[1] * (1 + WIDER)


def compared(recordings: int) -> pd.DataFrame:
    """One row per number: REAL range, simulated value, whether it is met."""
    rows = []
    for real in REAL:
        found = measured(real, recordings)
        depth = f"{real.depth_mm[0]:.0f}-{real.depth_mm[1]:.0f}"
        ranges = {
            "total": real.total_mm,
            "fine": real.fine_mm,
            "low": real.low_mm,
            "u": real.along_u_mm,
            "v": real.along_v_mm,
        }
        rows += [(real.camera, depth, name, *b, found[name], met(found[name], b)) for name, b in ranges.items()]
        missing = found["missing"]
        rows.append((real.camera, depth, "missing", 0.0, real.missing, missing, missing <= real.missing))
    for camera in ("d435", "d435-640"):
        for line in IN_TIME:
            found = measured_in_time(line, camera, recordings)
            depth = f"{line.depth_mm[0]:.0f}-{line.depth_mm[1]:.0f}"
            bounds = {"frame": line.frame_mm, "u": DIFFERENCE_U_PX, "v": DIFFERENCE_V_PX, "share": TEMPORAL_SHARE}
            rows += [(camera, depth, f"in time: {n}", *b, found[n], met(found[n], b)) for n, b in bounds.items()]
    return pd.DataFrame(rows, columns=["camera", "depth_mm", "quantity", "real_low", "real_high", "simulated", "met"])


UNITS = {"missing": "share", "in time: share": "share", "in time: u": "px", "in time: v": "px"}


def main() -> int:
    """Print the comparison; 1 if a row is not met."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recordings", type=int, default=6, help="of each row")
    parser.add_argument("--out", type=Path, help="CSV file for the table")
    args = parser.parse_args()
    table = compared(args.recordings)
    print("simulated cameras beside REAL ones: real range, simulated median, met within 20 %")
    for (camera, depth), rows in table.groupby(["camera", "depth_mm"], sort=False):
        print(f"{camera} {depth} mm")
        for row in rows.itertuples():
            unit = UNITS.get(row.quantity, "mm")
            real = f"{row.real_low:g} to {row.real_high:g}"
            print(f"  {row.quantity:15} {real:>14} {row.simulated:8.3f} {unit:5} {'met' if row.met else 'NOT MET'}")
    missed = int((~table["met"]).sum())
    print(f"{len(table) - missed} of {len(table)} numbers are met")
    if args.out is not None:
        args.out.parent.mkdir(parents=True, exist_ok=True)
        table.to_csv(args.out, index=False)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
