"""What structured light makes of each surface: the tables and pictures of docs/simulation.md.

    python -m benchmarks.surfaces [--out DIR] [--resolution N] [--seeds N] [--threads N] [--pictures DIR]

Both simulated sensors look at the same seeded scenes. The true first surface and distance of every pixel come from the
analytic shapes, along the ray through the pixel's centre; pixels on edges, with light of two surfaces, stay in.
Prints one Markdown table per set-up; --out writes all of them as surfaces.csv, --pictures draws one of the scenes.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tubepose.errors import TubePoseError
from tubepose.labware import load_cap, load_rack, load_tube
from tubepose.provenance import pinned_threads
from tubepose.simulation import raycast, structured_light
from tubepose.simulation.camera import StructuredLightCamera, default_camera
from tubepose.simulation.random_scene import random_scene
from tubepose.simulation.scene import Scene
from tubepose.simulation.structured_light.codes import BOX, CAVITY, FLAT, NOTHING, OPAQUE, RACK_TOP, REVOLVED
from tubepose.simulation.structured_light.intersection import first_hits
from tubepose.simulation.structured_light.shapes import Shapes, shapes_of
from tubepose.simulation.variation import SceneVariation
from tubepose.transforms import FloatArray, invert_transform, make_transform, transform_points

RACK = "chen2023-soft-5x10"
TUBES = ("chen2023-tube-1", "chen2023-tube-2", "chen2023-tube-3")
CAP = "printed-square-16.7"
FILL = 0.3
DISTANCE_M = 0.65
MILKY_PER_M = 100.0
"""Walls that scatter more than this are milky, others clear."""
SAME_M = 2e-5
"""A ray from the projector that ends within this of a point lights it."""
OFF_MM = (1.0, 2.0)
OUTER_WALLS = ("outer wall, milky", "outer wall, clear")
SURFACES = ("cap top", "cap side", "printed cap top", "rim", *OUTER_WALLS, "inner wall", "rack top")
CAP_TOP, CAP_SIDE, PRINTED_TOP, RIM, MILKY_WALL, CLEAR_WALL, INNER_WALL, TOP = range(len(SURFACES))
SENSORS = {"structured-light": structured_light.render, "raycast": raycast.render}


@dataclass(frozen=True, slots=True)
class SetUp:
    """How scanner and rack stand.

    Attributes:
        name: Of the set-up.
        tilt_deg: Scanner's tilt about its baseline: camera and projector turn to the same side of the tubes.
        yaw_deg: Angle between the rack's long axis and the baseline.
    """

    name: str
    tilt_deg: float = 0.0
    yaw_deg: float = 0.0

    def T_camera_rack(self, height_m: float) -> FloatArray:  # noqa: N802
        """Pose (4, 4) of a rack of that height, metres: its top's centre on the camera's axis, `DISTANCE_M` away."""
        facing = Rotation.from_euler("x", 180 - self.tilt_deg, degrees=True)
        R = (facing * Rotation.from_euler("z", self.yaw_deg, degrees=True)).as_matrix()
        return make_transform(R, np.array([0.0, 0.0, DISTANCE_M]) - height_m * R[:, 2])


SET_UPS = (
    SetUp("overhead"),
    SetUp("scanner tilted by 20 deg", tilt_deg=20.0),
    SetUp("rack turned by 90 deg", yaw_deg=90.0),
)


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """What the ray through each pixel's centre meets first; N pixels, row by row.

    Attributes:
        surface: Row of `SURFACES`, -1 for anything else, shape (N,).
        distance_m: Along the ray, shape (N,).
        lit: Whether the projector's straight light arrives there too, shape (N,).
        tube: Solid of revolution that is met, -1 for anything else, shape (N,).
        T_solid_camera: Camera points into the frame of each solid, shape (S, 4, 4).
    """

    surface: NDArray[np.int8]
    distance_m: FloatArray
    lit: NDArray[np.bool_]
    tube: NDArray[np.int64]
    T_solid_camera: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class _Hits:
    """What N rays meet first, as `first_hits` fills it."""

    distance_m: FloatArray
    code: NDArray[np.int64]
    index: NDArray[np.int64]
    owner: NDArray[np.int64]


def _cast(shapes: Shapes, origins_m: FloatArray, directions: FloatArray) -> _Hits:
    n = len(directions)
    hits = _Hits(np.empty(n), *(np.empty(n, dtype=np.int64) for _ in range(3)))
    first_hits(shapes, origins_m, np.ascontiguousarray(directions), hits.distance_m, hits.code, hits.index, hits.owner)
    return hits


def pixel_rays(camera: StructuredLightCamera) -> FloatArray:
    """Unit rays through the centres of all pixels, row by row, shape (N, 3), camera frame."""
    rays = camera.intrinsics.rays().reshape(-1, 3)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def truth_of(scene: Scene, camera: StructuredLightCamera) -> Truth:
    """True first surfaces of a scene of open or capped see-through tubes without labels."""
    shapes, T_rack_camera = shapes_of(scene), invert_transform(scene.T_camera_rack)
    directions = pixel_rays(camera) @ T_rack_camera[:3, :3].T
    origin = T_rack_camera[:3, 3]
    hits = _cast(shapes, np.broadcast_to(origin, directions.shape), directions)
    points = origin + np.where(hits.code == NOTHING, 0.0, hits.distance_m)[:, None] * directions
    surface = _classed(shapes, hits, points[:, 2], scene)
    projector = T_rack_camera[:3, :3] @ camera.projector_m + origin
    away = points - projector
    reach = np.linalg.norm(away, axis=1)
    lighting = _cast(shapes, np.broadcast_to(projector, away.shape), away / reach[:, None])
    in_field = np.isfinite(camera.column(transform_points(scene.T_camera_rack, points)))
    lit = in_field & (lighting.distance_m > reach - SAME_M)
    return Truth(
        surface=surface,
        distance_m=np.where(hits.code == NOTHING, np.nan, hits.distance_m),
        lit=lit,
        tube=np.where(hits.code == REVOLVED, hits.owner, -1),
        T_solid_camera=np.array([_into(row) @ T_rack_camera for row in shapes.solids]).reshape(-1, 4, 4),
    )


def _into(solid: FloatArray) -> FloatArray:
    """Rack points into the frame of a row of `Shapes.solids`, shape (4, 4)."""
    return make_transform(solid[:9].reshape(3, 3), solid[9:12])


def _classed(shapes: Shapes, hits: _Hits, height_m: FloatArray, scene: Scene) -> NDArray[np.int8]:
    surface = np.full(len(hits.code), -1, dtype=np.int8)
    surface[hits.code == RACK_TOP] = TOP
    # Face 5 of a box is its top.
    surface[(hits.code == BOX) & (hits.index == 5)] = PRINTED_TOP
    rows = np.flatnonzero(hits.code == REVOLVED)
    segment = hits.index[rows]
    kind, form = shapes.segment_type[segment], shapes.segments[segment, 0]
    upwards = (form == FLAT) & (shapes.segments[segment, 8] > 0)
    above = height_m[rows] > scene.rack.height_m
    milky = shapes.solids[hits.owner[rows], 16] > MILKY_PER_M
    opaque_top, opaque_side = (CAP_TOP, CAP_SIDE) if scene.printed_cap is None else (-1, -1)
    wall = np.where(above, np.where(milky, MILKY_WALL, CLEAR_WALL), -1)
    of_body = np.where(upwards, RIM, wall)
    of_cap = np.where(upwards, opaque_top, opaque_side)
    surface[rows] = np.where(kind == OPAQUE, of_cap, np.where(kind == CAVITY, INNER_WALL, of_body))
    return surface


def pixels_of(truth: Truth, camera: StructuredLightCamera, cloud_m: FloatArray) -> pd.DataFrame:
    """One row per pixel of a known surface: surface, lit, error along the ray and from the tube's axis, millimetres.

    Errors are NaN where the cloud has no point; the radial one also where the surface is no outer wall.
    """
    rows = np.flatnonzero(truth.surface >= 0)
    measured = cloud_m.reshape(-1, 3)[rows]
    error = (np.linalg.norm(measured, axis=1) - truth.distance_m[rows]) * 1e3
    radial = np.full(len(rows), np.nan)
    wall = np.flatnonzero(np.isin(truth.surface[rows], (MILKY_WALL, CLEAR_WALL)))
    true_m = pixel_rays(camera)[rows[wall]] * truth.distance_m[rows[wall], None]
    T = truth.T_solid_camera[truth.tube[rows[wall]]]
    radial[wall] = (_radius_m(T, measured[wall]) - _radius_m(T, true_m)) * 1e3
    return pd.DataFrame(
        {"surface": truth.surface[rows], "lit": truth.lit[rows], "error_mm": error, "radial_mm": radial}
    ).astype({"error_mm": np.float32, "radial_mm": np.float32})


def _radius_m(T: FloatArray, points_m: FloatArray) -> FloatArray:
    """Distance of points (N, 3) from the z axes of frames that T (N, 4, 4) leads into."""
    local = np.einsum("nij,nj->ni", T[:, :2, :3], points_m) + T[:, :2, 3]
    return np.asarray(np.hypot(local[:, 0], local[:, 1]))


def summary(pixels: pd.DataFrame) -> dict[str, float]:
    """Shares and errors of the pixels of one surface and sensor."""
    valid = pixels["error_mm"].notna()
    found, radial = pixels.loc[valid, "error_mm"], pixels.loc[valid, "radial_mm"].dropna()
    row = {"pixels": float(len(pixels)), "lit": pixels["lit"].mean(), "complete": valid.mean()}
    row["complete_lit"] = valid[pixels["lit"]].mean()
    row |= {f"error_p{q}_mm": float(np.percentile(found, q)) if len(found) else np.nan for q in (5, 50, 95)}
    row |= {f"off_{limit:g}_mm": (found.abs() > limit).mean() for limit in OFF_MM}
    row |= {f"radial_p{q}_mm": float(np.percentile(radial, q)) if len(radial) else np.nan for q in (5, 50, 95)}
    return row


def scene_of(seed: int) -> Scene:
    """A seeded scene with all three types of tube; every set-up looks at the same tubes."""
    variation = SceneVariation(fill=(FILL, FILL))
    tubes = [load_tube(name) for name in TUBES]
    return random_scene(load_rack(RACK), tubes, load_cap(CAP), default_camera(), np.random.default_rng(seed), variation)


def with_own_and_printed_caps(seed: int, set_up: SetUp) -> tuple[Scene, Scene]:
    """The seeded scene as a set-up sees it, twice."""
    scene = scene_of(seed)
    own = dataclasses.replace(scene, T_camera_rack=set_up.T_camera_rack(scene.rack.height_m))
    return own, dataclasses.replace(own, printed_cap=load_cap(CAP))


def set_up_table(set_up: SetUp, seeds: int, resolution: int, threads: int) -> pd.DataFrame:
    """One row per surface and sensor, all seeds together. Printed caps are looked at for their tops alone."""
    camera, found = default_camera(resolution), []
    for seed in range(seeds):
        for scene in with_own_and_printed_caps(seed, set_up):
            truth = truth_of(scene, camera)
            for sensor, render in SENSORS.items():
                kind = "own" if scene.printed_cap is None else "printed"
                print(f"{set_up.name}, seed {seed}, {kind} caps, {sensor}", file=sys.stderr)
                frame = render(scene, camera, np.random.default_rng(seed), threads=threads)
                pixels = pixels_of(truth, camera, frame.cloud_m)
                wanted = (pixels["surface"] == PRINTED_TOP) == (scene.printed_cap is not None)
                found.append(pixels[wanted].assign(sensor=sensor))
    groups = pd.concat(found).groupby(["surface", "sensor"], sort=False)
    rows = [{"set_up": set_up.name, "surface": s, "sensor": n} | summary(group) for (s, n), group in groups]
    table = pd.DataFrame(rows).sort_values("surface", kind="stable")
    return table.assign(surface=[SURFACES[s] for s in table["surface"]])


def markdown(table: pd.DataFrame) -> Iterator[str]:
    """Lines of a Markdown table."""
    names = ["surface", "sensor", "pixels", "lit", "with depth", "lit, with depth", "error 5 / 50 / 95 % (mm)"]
    names += [*(f"beyond {limit:g} mm" for limit in OFF_MM), "radial 5 / 50 / 95 % (mm)"]
    yield "| " + " | ".join(names) + " |"
    yield "|---|---|" + "--:|" * (len(names) - 2)
    for row in table.to_dict("records"):
        cells = [row["surface"], row["sensor"], f"{row['pixels']:.0f}"]
        shares = ["lit", "complete", "complete_lit", *(f"off_{limit:g}_mm" for limit in OFF_MM)]
        percent = ["-" if np.isnan(row[name]) else f"{row[name]:.1%}" for name in shares]
        along, radial = (
            "-"
            if np.isnan(row[f"{name}_p50_mm"])
            else " / ".join(f"{row[f'{name}_p{q}_mm']:+.2f}" for q in (5, 50, 95))
            for name in ("error", "radial")
        )
        yield "| " + " | ".join([*cells, *percent[:3], along, *percent[3:], radial]) + " |"


def main() -> None:
    """Parse the arguments, print the tables, write and draw what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, help="folder for surfaces.csv")
    parser.add_argument("--resolution", type=int, default=1376)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--pictures", type=Path, help="folder for pictures of one scene")
    options = parser.parse_args()
    try:
        with pinned_threads(1):
            tables = []
            for set_up in SET_UPS:
                tables.append(set_up_table(set_up, options.seeds, options.resolution, options.threads))
                print(f"\n{set_up.name[0].upper()}{set_up.name[1:]}:\n\n" + "\n".join(markdown(tables[-1])), flush=True)
            if options.out is not None:
                options.out.mkdir(parents=True, exist_ok=True)
                pd.concat(tables).to_csv(options.out / "surfaces.csv", index=False)
            if options.pictures is not None:
                from benchmarks.surface_pictures import draw

                draw(options.pictures, options.resolution, options.threads)
    except TubePoseError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
