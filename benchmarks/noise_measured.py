"""Noise measured in a capture beside the noise that was put into it (SIMULATED, ray cast).

    python -m benchmarks.noise_measured [--resolution 1000] [--seeds 1]

Known noise is put onto noiseless ray cast frames, and `measure_noise` is asked for it. One row per law: standard
deviation of each slope of a plane through a cap (6.5 mm), and of its mean height, true and measured; then the parts.

The true values come from the injected noise alone: it is put onto a plane at the caps' height that fills the image, at
the same law per pixel, and planes are fitted to discs of that plane; no code is shared with the measurement.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
import time
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.config import SensorConfig
from tubepose.labware import RackModel, load_cap, load_rack, load_tube
from tubepose.sensor import SensorNoise, measure_noise
from tubepose.simulation import raycast
from tubepose.simulation.camera import NO_NOISE, StructuredLightCamera, default_camera
from tubepose.simulation.depth_noise import DepthNoise
from tubepose.simulation.random_scene import random_scene
from tubepose.transforms import FloatArray, invert_transform, transform_points

SCENES = (("round-10ml-3x4", "blood-16x100"), ("chen2023-hard-5x10", "chen2023-tube-1"))
CAP = "printed-square-16.7"
RADIUS_M = 6.5e-3
PER_POINT: dict[str, DepthNoise] = {
    "none": DepthNoise(),
    **{f"independent {mm} mm": DepthNoise(independent_m=mm * 1e-3) for mm in (0.03, 0.1, 0.3, 1.0)},
    **{
        f"shared {mm} mm over {length} mm": DepthNoise(shared_m=mm * 1e-3, correlation_m=length * 1e-3)
        for mm in (0.03, 0.1, 0.3, 1.0)
        for length in (1, 3, 6)
    },
    **{f"both {mm} mm over 3 mm": DepthNoise(mm * 1e-3, mm * 1e-3) for mm in (0.07, 0.3)},
    **{f"both 0.1 mm, steps {mm} mm": DepthNoise(1e-4, 1e-4, step_m=mm * 1e-3) for mm in (0.1, 0.5, 1.0)},
    **{f"steps {mm} mm alone": DepthNoise(step_m=mm * 1e-3) for mm in (0.1, 0.5, 1.0)},
    **{f"both 0.1 mm, blur {px} px": DepthNoise(1e-4, 1e-4, blur_px=px) for px in (1, 2, 3, 6)},
    **{f"both 0.1 mm, missing {share:.0%}": DepthNoise(1e-4, 1e-4, missing=share) for share in (0.1, 0.3)},
}

REAL_POWER = 1.0
"""Noise grows with the depth as that of REAL stereo cameras does; the last rows say what another power changes."""
LAWS = {name: dataclasses.replace(law, depth_power=REAL_POWER) for name, law in PER_POINT.items()}
LAWS |= {
    f"both 0.1 mm, power {power:g} of depth": DepthNoise(1e-4, 1e-4, depth_power=power) for power in (0.0, 1.0, 2.0)
}


@dataclass(frozen=True, slots=True, eq=False)
class Clean:
    """A noiseless frame.

    Attributes:
        frame: The frame.
        rack: Its rack.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
        cap_height_m: Height of the caps over the rack's base.
    """

    frame: RgbdFrame
    rack: RackModel
    T_camera_rack: FloatArray
    cap_height_m: float

    @property
    def camera(self) -> CameraIntrinsics:
        """The frame's intrinsics."""
        assert self.frame.intrinsics is not None
        return self.frame.intrinsics


@lru_cache(maxsize=8)
def clean(rack_name: str, tube_name: str, resolution: int, seed: int) -> Clean:
    """A noiseless ray cast frame of a seeded scene."""
    rack, tube = load_rack(rack_name), load_tube(tube_name)
    camera: StructuredLightCamera = dataclasses.replace(default_camera(resolution), noise=NO_NOISE)
    scene = random_scene(rack, [tube], load_cap(CAP), camera, np.random.default_rng(seed))
    frame = raycast.render(scene, camera, np.random.default_rng(seed), threads=1)
    return Clean(frame, rack, scene.T_camera_rack, rack.floor_m + tube.height_m)


def plane_at_caps(scene: Clean) -> RgbdFrame:
    """A frame that a plane at the caps' height, parallel to the rack's top, fills."""
    camera = scene.camera
    normal = scene.T_camera_rack[:3, 2]
    origin = scene.T_camera_rack[:3, 3] + scene.cap_height_m * normal
    rays = camera.rays()
    cloud = rays * ((origin @ normal) / (rays @ normal))[..., None]
    return RgbdFrame(cloud, None, camera, None, "plane")


def true_stds(scene: Clean, noise: DepthNoise, rng: np.random.Generator) -> tuple[float, float, float]:
    """Std of each slope and of the mean height (m) of discs at the caps' height, and their depth (m)."""
    plane = plane_at_caps(scene)
    depths = scene.frame.cloud_m[..., 2], plane.cloud_m[..., 2]
    ratio = float(np.nanmedian(depths[1]) / np.nanmedian(depths[0]))
    # The law lives in pixels: a correlation length in pixels is shorter on a nearer surface.
    grown = ratio**noise.depth_power
    law = dataclasses.replace(
        noise,
        independent_m=noise.independent_m * grown,
        shared_m=noise.shared_m * grown,
        correlation_m=noise.correlation_m * ratio,
        blur_px=0.0,
    )
    points = transform_points(invert_transform(scene.T_camera_rack), law.applied(plane, rng).cloud_m)
    places = transform_points(invert_transform(scene.T_camera_rack), plane.cloud_m)
    reach = RADIUS_M * scene.camera.fx / float(np.nanmedian(depths[1])) + 2
    fits, n = [], int(np.ceil(reach))
    for v in range(n, scene.camera.height - n, 2 * n + 1):
        for u in range(n, scene.camera.width - n, 2 * n + 1):
            window = (slice(v - n, v + n + 1), slice(u - n, u + n + 1))
            xy = places[window][..., :2] - places[v, u, :2]
            kept = (np.hypot(*np.moveaxis(xy, -1, 0)) < RADIUS_M) & np.isfinite(points[window][..., 2])
            terms = np.column_stack([np.ones(kept.sum()), xy[kept]])
            height = points[window][kept][:, 2] - scene.cap_height_m
            fits.append([*np.linalg.lstsq(terms, height, rcond=None)[0][1:], height.mean()])
    values = np.array(fits)
    return (
        float(np.sqrt(np.mean(values[:, :2] ** 2))),
        float(np.sqrt(np.mean(values[:, 2] ** 2))),
        float(np.nanmedian(depths[1])),
    )


def measured(scene: Clean, noise: DepthNoise, rng: np.random.Generator) -> tuple[SensorNoise, float]:
    """What is measured of a frame with that noise, and the milliseconds that it took."""
    noisy = noise.applied(scene.frame, rng)
    measure_noise(noisy, scene.camera, scene.T_camera_rack, scene.rack, SensorConfig())
    start = time.perf_counter()
    found = measure_noise(noisy, scene.camera, scene.T_camera_rack, scene.rack, SensorConfig())
    return found, (time.perf_counter() - start) * 1e3


HEAD = (
    "| rack | noise put in | slope std: true, measured (deg) | ratio | height std: true, measured (mm) | ratio "
    "| independent (mm) | shared (mm) over (mm) | edges (px) | outliers | source | ms |"
)


def row(scene: Clean, name: str, noise: DepthNoise, seed: int) -> str:
    """Row of the table."""
    rng, other = np.random.default_rng(seed), np.random.default_rng(seed + 1)
    slope, height, depth = true_stds(scene, noise, rng)
    found, took_ms = measured(scene, noise, other)
    found_slope, found_height = found.slope_std(RADIUS_M, depth), found.height_std_m(RADIUS_M, depth)
    deg, mm = float(np.rad2deg(1)), 1e3
    ratios = [f"{b / a:.2f}" if a > 1e-9 else "-" for a, b in ((slope, found_slope), (height, found_height))]
    return (
        f"| {scene.rack.name} | {name} | {slope * deg:.3f}, {found_slope * deg:.3f} | {ratios[0]} "
        f"| {height * mm:.4f}, {found_height * mm:.4f} | {ratios[1]} | {found.independent_m * mm:.3f} "
        f"| {found.shared_m * mm:.3f} over {found.correlation_m * mm:.1f} | {found.edge_blur_px:.1f} "
        f"| {found.outlier_share:.3f} | {found.source} {found.n_patches} | {took_ms:.0f} |"
    )


def main(arguments: list[str] | None = None) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--resolution", type=int, default=1000)
    parser.add_argument("--seeds", type=int, default=1)
    options = parser.parse_args(arguments)
    print(HEAD)
    print("|---|---|--:|--:|--:|--:|--:|--:|--:|--:|---|--:|")
    for rack_name, tube_name in SCENES:
        for seed in range(options.seeds):
            scene = clean(rack_name, tube_name, options.resolution, seed)
            for name, noise in LAWS.items():
                print(row(scene, name, noise, seed), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
