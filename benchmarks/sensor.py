"""What the simulated sensor delivers: the numbers of docs/simulation.md.

    python -m benchmarks.sensor [--scan FILE.ply] [--rack NAME] [--seeds N]

Prints Markdown tables from N seeded simulated scenes per row at 1376 px: the scatter of an empty rack's top, the tilt
error of a plane through the top of a printed cap, what is seen of tube walls and rims. With --scan also the scatter of
a real scan, in metres, of the top of an empty rack of the kind --rack.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial import cKDTree

from tubepose.capture.ply import read_ply
from tubepose.config import Config
from tubepose.errors import TubePoseError
from tubepose.ground_truth.planes import plane_frame, plane_heights
from tubepose.labware import RackModel, TubeModel, load_cap, load_rack, load_tube
from tubepose.provenance import pinned_threads
from tubepose.rack import register_rack
from tubepose.simulation import raycast
from tubepose.simulation.camera import NoiseModel, default_camera
from tubepose.simulation.random_scene import random_scene
from tubepose.simulation.scene import PlacedTube, Scene
from tubepose.transforms import FloatArray, invert_transform, tilt_rad, transform_points

TUBES = ("chen2023-tube-1", "chen2023-tube-2", "chen2023-tube-3")
CAP = "printed-square-16.7"
SHARED_MM = (0.02, 0.10)
RADII_MM = (1.0, 1.5, 3.0, 6.0)
BAND_M, EDGE_M, SAMPLES, LEAST_POINTS = 3e-3, 1.5e-3, 3000, 8
CAP_MARGIN_M, RIM_M, OFF_M, NEAR_M = 1e-3, 1e-3, 2e-3, 1e-4


def shoot(scene: Scene, shared_mm: float, seed: int) -> FloatArray:
    """Cloud (H, W, 3) of a scene at full resolution, camera frame, metres."""
    noise = dataclasses.replace(NoiseModel(), smooth_depth_m=shared_mm * 1e-3)
    camera = dataclasses.replace(default_camera(), noise=noise)
    print(f"{scene.rack.name}, {len(scene.tubes)} tubes, shared {shared_mm} mm, seed {seed}", file=sys.stderr)
    return raycast.render(scene, camera, np.random.default_rng(seed)).cloud_m


def scene_of(rack: RackModel, tube: TubeModel, seed: int) -> Scene:
    """A seeded scene with one type of tube."""
    return random_scene(rack, [tube], load_cap(CAP), default_camera(), np.random.default_rng(seed))


def scatter_mm(points_m: FloatArray, T_camera_rack: FloatArray, rack: RackModel, away: bool) -> list[float]:
    """Deviation about local planes, per radius the median over the top, and about one plane; millimetres."""
    local = transform_points(invert_transform(T_camera_rack), points_m)
    distance = rack.top_signed_distance_m(local[:, :2])
    top = local[(np.abs(local[:, 2] - rack.height_m) < BAND_M) & (distance < (-EDGE_M if away else 1e-3))]
    tree = cKDTree(top)
    centers = top[np.random.default_rng(0).permutation(len(top))[:SAMPLES]]
    found = []
    for radius in RADII_MM:
        near = [top[rows] for rows in tree.query_ball_point(centers, radius * 1e-3)]
        found.append(float(np.median([_about_plane_mm(p) for p in near if len(p) >= LEAST_POINTS])))
    return [*found, _about_plane_mm(top)]


def _about_plane_mm(points_m: FloatArray) -> float:
    heights = plane_heights(plane_frame(points_m), points_m)
    return float(np.sqrt(np.sum(heights**2) / (len(points_m) - 3))) * 1e3


def scatter_table(rack: RackModel, scan: Path | None, seeds: int) -> pd.DataFrame:
    """Scatter of the simulated top at every shared error (mean over the seeds), and of the scan."""
    sources: dict[str, list[tuple[FloatArray, FloatArray]]] = {}
    if scan is not None:
        points = read_ply(scan).xyz
        points = points[np.isfinite(points).all(axis=1)]
        pose = register_rack(points, rack, Config())
        if pose.T_camera_rack is None:
            sys.exit(f"{scan}: {pose.status.value}: {pose.reason}")
        sources[f"scan {scan.name}"] = [(points, pose.T_camera_rack)]
    for shared in SHARED_MM:
        for seed in range(seeds):
            scene = dataclasses.replace(scene_of(rack, load_tube(TUBES[0]), seed), tubes=())
            points = shoot(scene, shared, seed).reshape(-1, 3)
            seen = points[np.isfinite(points[:, 2])]
            sources.setdefault(f"simulated, shared error {shared:.2f} mm", []).append((seen, scene.T_camera_rack))
    rows = []
    for name, clouds in sources.items():
        for away in (False, True):
            values = np.mean([scatter_mm(points, T, rack, away) for points, T in clouds], axis=0)
            labels = [*(f"{radius} mm" for radius in RADII_MM), "whole top"]
            points_of = f"{EDGE_M * 1e3} mm or more from any edge" if away else "all"
            cells = (f"{value:.3f}" for value in values)
            rows.append({"source": name, "points": points_of, **dict(zip(labels, cells, strict=True))})
    return pd.DataFrame(rows)


def cap_table(rack: RackModel, seeds: int) -> pd.DataFrame:
    """Tilt error of the least-squares plane through the points on printed caps, 1 mm of the edge left out."""
    cap, tube = load_cap(CAP), load_tube(TUBES[1])
    rows = []
    for shared in SHARED_MM:
        errors = []
        for seed in range(seeds):
            scene = dataclasses.replace(scene_of(rack, tube, seed), printed_cap=cap)
            cloud = shoot(scene, shared, seed).reshape(-1, 3)
            for placed in scene.tubes:
                T = scene.T_camera_rack @ placed.T_rack_tube @ placed.T_tube_cap
                local = transform_points(invert_transform(T), cloud) - [0, 0, cap.offset_m(tube)]
                inner = np.abs(local[:, :2]).max(axis=1) < cap.square_m / 2 - CAP_MARGIN_M
                plane = plane_frame(cloud[inner & (np.abs(local[:, 2]) < OFF_M)])
                errors.append(np.rad2deg(tilt_rad(plane[:3, 2], T[:3, 2])))
        row: dict[str, object] = {"shared error (mm)": f"{shared:.2f}", "caps": len(errors)}
        rows.append(row | {"mean (deg)": f"{np.mean(errors):.2f}", "p95 (deg)": f"{np.percentile(errors, 95):.2f}"})
    return pd.DataFrame(rows)


def first_hits(scene: Scene) -> FloatArray:
    """What every camera ray meets first, walls included, shape (H * W, 3), camera frame; NaN for nothing."""
    rays = default_camera().intrinsics.rays().reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    hits = raycast.Surfaces(scene.parts()).cast(np.zeros_like(rays), rays)
    return np.where(np.isfinite(hits.distance_m)[:, None], hits.points_m, np.nan)


def tube_shares(scene: Scene, placed: PlacedTube, true_m: FloatArray, cloud: FloatArray) -> Iterator[tuple[str, float]]:
    """Per measure of one scene and tube: values of single pixels, by the name of the measure."""
    model, T = placed.model, invert_transform(scene.T_camera_rack @ placed.T_rack_tube)
    local = transform_points(T, true_m)
    above = true_m @ scene.T_camera_rack[:3, 2] - scene.T_camera_rack[:3, 3] @ scene.T_camera_rack[:3, 2]
    r, z = np.hypot(local[:, 0], local[:, 1]), local[:, 2]
    skirt = model.height_m - (model.cap.height_mm * 1e-3 if model.cap is not None else 0.0)
    wall = (np.abs(r - model.body_radius_m(z)) < NEAR_M) & (z < skirt - NEAR_M) & (above > scene.rack.height_m)
    valid = np.isfinite(cloud[:, 2])
    off = np.abs(np.linalg.norm(cloud, axis=1) - np.linalg.norm(true_m, axis=1)) > OFF_M
    yield from (("wall seen", float(value)) for value in valid[wall])
    yield from (("wall off", float(value)) for value in off[wall & valid])
    if model.is_open:
        rim = (r < model.max_radius_m + NEAR_M) & (np.abs(z - model.height_m) < NEAR_M)
        yield from (("rim seen", float(value)) for value in valid[rim])
        heights = transform_points(T, cloud[rim & valid])[:, 2] - model.height_m
        yield from (("rim height", float(value) * 1e3) for value in heights[np.abs(heights) < RIM_M])


def tube_table(rack: RackModel, seeds: int) -> pd.DataFrame:
    """Share of the outer wall above the rack that has points, of those the share that is off, and the rims."""
    rows = []
    for tube in (load_tube(name) for name in TUBES):
        scenes = []
        for seed in range(seeds):
            scene = scene_of(rack, tube, seed)
            true_m, cloud = first_hits(scene), shoot(scene, SHARED_MM[0], seed).reshape(-1, 3)
            pairs = [pair for placed in scene.tubes for pair in tube_shares(scene, placed, true_m, cloud)]
            scenes.append(pd.DataFrame(pairs, columns=["measure", "value"]).groupby("measure")["value"])
        shares = pd.concat([scene.mean() for scene in scenes], axis=1)
        low, high = shares.min(axis=1), shares.max(axis=1)

        def span(name: str, form: str, low: pd.Series = low, high: pd.Series = high) -> str:
            return f"{low[name]:{form}} to {high[name]:{form}}" if name in low.index else "-"

        row = {"tube": tube.name, "wall": tube.body.material, "wall with points": span("wall seen", ".0%")}
        row |= {
            f"of them more than {OFF_M * 1e3:g} mm off": span("wall off", ".0%"),
            "rim with points": span("rim seen", ".0%"),
        }
        rows.append(row | {"mean height of rim points (mm)": span("rim height", "+.2f")})
    return pd.DataFrame(rows)


def main() -> None:
    """Parse the arguments and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scan", type=Path)
    parser.add_argument("--rack", default="chen2023-soft-5x10")
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    try:
        rack = load_rack(options.rack)
        tables: dict[str, Callable[[], pd.DataFrame]] = {
            "Standard deviation about a local plane, median over the top, by the neighbourhood's radius; "
            "about one plane through the whole top (mm)": lambda: scatter_table(rack, options.scan, options.seeds),
            f"Tilt error of a plane through the top of {CAP}": lambda: cap_table(rack, options.seeds),
            "Tubes, least to most of the scenes": lambda: tube_table(rack, options.seeds),
        }
        for title, make in tables.items():
            with pinned_threads(1):
                table = make()
            print(f"\n{title}:\n\n| " + " | ".join(table.columns) + " |\n|" + "---|" * len(table.columns))
            for values in table.itertuples(index=False):
                print("| " + " | ".join(str(value) for value in values) + " |", flush=True)
    except TubePoseError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
