"""How many pairs of features KISS-Matcher's own matcher finds between a tube's scan and its template.

    python -m benchmarks.kiss_matcher_pairs SESSION...   # simulated sessions; the rack's pose is the exact one

Prints, per tube and setting: points of scan and template, pairs that its matcher keeps, pairs after pruning (means).
This is why `tubepose.methods.kiss_matcher` pairs features itself: the matcher's ratio test cannot be
turned off from Python.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import kiss_matcher
import numpy as np
from scipy.spatial import cKDTree

from tubepose.batch import session_jobs
from tubepose.capture.session import load_session
from tubepose.config import Config
from tubepose.detection.geometric import GeometricDetector
from tubepose.labware import TubeModel
from tubepose.methods.visible_template import visible_template
from tubepose.pipeline import prepare_scene
from tubepose.preprocessing import remove_outliers, voxel_downsample
from tubepose.provenance import pinned_threads
from tubepose.transforms import FloatArray
from tubepose.truth_tables import with_exact_rack

# Voxel, radius of the normals, radius of the features, all in millimetres.
SETTINGS_MM = ((0.7, 2.4, 4.0), (1.0, 2.4, 4.0), (1.0, 3.0, 6.0), (1.0, 4.8, 12.0), (1.5, 4.5, 7.5), (3.0, 9.0, 15.0))
TEMPLATE_POINTS = 5000
INSIDE_MM = 8.0
MIN_NEIGHBORS = 5


def prepared_mm(points_m: FloatArray, voxel_mm: float, normal_radius_mm: float) -> FloatArray:
    """Down-sampled points (N, 3) about a place inside the body, millimetres.

    The package turns normals towards the origin, so that both clouds need it at the same place; and it crashes on
    points without enough neighbours for a normal, which are left out.
    """
    points = voxel_downsample(points_m, voxel_mm * 1e-3) * 1e3
    points = points - np.array([*np.median(points[:, :2], axis=0), np.percentile(points[:, 2], 98) - INSIDE_MM])
    while len(points):
        counts = cKDTree(points).query_ball_point(points, 0.99 * normal_radius_mm, return_length=True)
        if np.all(counts >= MIN_NEIGHBORS):
            break
        points = points[counts >= MIN_NEIGHBORS]
    return np.asarray(points)


def pairs(scan_mm: FloatArray, template_mm: FloatArray, setting_mm: tuple[float, float, float]) -> tuple[int, int]:
    """Pairs that the matcher keeps, and those that its pruning leaves."""
    voxel, normals, features = setting_mm
    matcher = kiss_matcher.KISSMatcher(
        kiss_matcher.KISSMatcherConfig(
            voxel_size=voxel,
            use_voxel_sampling=False,
            normal_r_gain=normals / voxel,
            fpfh_r_gain=features / voxel,
            robin_noise_bound_gain=2.0 / voxel,
            solver_noise_bound_gain=1.5 / voxel,
            enable_noise_bound_clamping=False,
        )
    )
    matcher.estimate(list(template_mm.astype(np.float32)), list(scan_mm.astype(np.float32)))
    return len(matcher.get_initial_correspondences()), len(matcher.get_final_correspondences())


def scans(folders: Sequence[str]) -> Iterator[tuple[FloatArray, TubeModel, float]]:
    """Points (N, 3) in the rack frame, metres, of every detected tube; its model; the rack's depth."""
    config = Config()
    for folder in folders:
        session = load_session(Path(folder))
        for job in with_exact_rack(session_jobs(session)[0], session):
            detector = GeometricDetector(job.rack, job.tubes, config)
            for frame in job.capture.frames():
                scene = prepare_scene(frame, job.rack, job.tubes, detector, config, job.hint, job.T_camera_rack)
                for target in scene.targets:
                    if target.tube is not None:
                        points_m = remove_outliers(target.points_m, config.preprocess)
                        yield points_m, target.tube, job.rack.depth_m


def main() -> None:
    """Print a Markdown table."""
    folders = sys.argv[1:]
    if not folders or folders[0].startswith("-"):
        sys.exit(__doc__)
    with pinned_threads(1):
        found = list(scans(folders))
    print("| tube | voxel, normals, features (mm) | tubes | points, template | pairs | after pruning |")
    print("|---|---|--:|--:|--:|--:|")
    for name in sorted({tube.name for _, tube, _ in found}):
        for setting in SETTINGS_MM:
            rows = []
            for points_m, tube, depth_m in found:
                if tube.name != name:
                    continue
                template_m = np.asarray(visible_template(tube, depth_m, TEMPLATE_POINTS).points)
                clouds = [prepared_mm(cloud_m, *setting[:2]) for cloud_m in (points_m, template_m)]
                if min(map(len, clouds)) >= 10:
                    rows.append((*map(len, clouds), *pairs(clouds[0], clouds[1], setting)))
            scan, template, kept, pruned = np.mean(rows, axis=0)
            told = ", ".join(f"{value:g}" for value in setting)
            print(
                f"| {name} | {told} | {len(rows)} | {scan:.0f}, {template:.0f} | {kept:.1f} | {pruned:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
