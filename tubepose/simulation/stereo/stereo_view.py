"""Frames of a scene by a stereo camera: what stays over the frames is made once, the rest for each frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import RgbdFrame
from tubepose.simulation.looks.exposure import expose
from tubepose.simulation.looks.render import render
from tubepose.simulation.raycast import Surfaces
from tubepose.simulation.scene import Material, Scene
from tubepose.simulation.stereo.dressing import dressed, look_seed
from tubepose.simulation.stereo.matching import matched_depth_m
from tubepose.simulation.stereo.stereo_camera import StereoCamera
from tubepose.simulation.stereo.waves import depth_error_m, smooth_field
from tubepose.transforms import FloatArray

HALF_TEXTURE = 0.2
"""Light, as a share of the picture's bright parts, at which a surface gives half of the texture of a bright one."""
GLARE = 4.0
"""Light, as a multiple of the picture's bright parts, at which a highlight gives none."""
BRIGHT_QUANTILE = 0.9
PATCH_PX = (12.0, 6.0)
"""Lengths along u and v of patches without depth."""
FLICKER = 0.5
"""Share of the variance of the field that patches are cut from that is new in each frame."""
TILE_RAYS = 200_000


@dataclass(frozen=True, slots=True, eq=False)
class StereoView:
    """A scene before a camera.

    Attributes:
        camera: The camera.
        radiance: Light in linear units, shape (H, W, 3).
        depth_m: Depth with all that stays over the frames, shape (H, W), metres; NaN where nothing is matched.
        patches: Field that missing patches are cut from, what stays of it, shape (H, W).
        exposure_seed: Of what the colour camera has in common over the frames.
    """

    camera: StereoCamera
    radiance: NDArray[np.float32]
    depth_m: FloatArray
    patches: NDArray[np.float32]
    exposure_seed: int

    def frame(self, rng: np.random.Generator) -> RgbdFrame:
        """One frame; its capture name is empty and its time unknown."""
        camera, depth = self.camera, self.frame_depth_m(rng)
        image = expose(self.radiance, "color", np.random.default_rng(self.exposure_seed), "good", noise_rng=rng)
        return RgbdFrame(
            camera.intrinsics.backproject(depth), image, camera.intrinsics, None, "", sensor=camera.name, simulated=True
        )

    def frame_depth_m(self, rng: np.random.Generator) -> FloatArray:
        """Depth (H, W) of one frame in the camera's steps, metres; NaN where nothing is measured."""
        camera = self.camera
        depth = self.depth_m + depth_error_m(camera, self.depth_m, rng, temporal=True)
        fresh = smooth_field((depth.shape[0], depth.shape[1]), PATCH_PX, rng)
        field = np.sqrt(1 - FLICKER) * self.patches + np.sqrt(FLICKER) * fresh
        depth[field > _upper(camera.missing_share)] = np.nan
        return counted_depth_m(camera, depth)


def counted_depth_m(camera: StereoCamera, depth_m: FloatArray) -> FloatArray:
    """Depth in the steps of the camera's disparity, and of what it stores; NaN outside of its range."""
    depth = depth_m
    with np.errstate(invalid="ignore", divide="ignore"):
        if camera.subpixel:
            step = camera.inverse_depth_per_px / camera.subpixel
            depth = 1.0 / (np.rint(1.0 / (depth * step)) * step)
        depth = np.rint(depth / camera.depth_step_m) * camera.depth_step_m
        low, high = camera.depth_range_m
        return np.asarray(np.where((depth >= low) & (depth <= high), depth, np.nan))


def stereo_view(scene: Scene, camera: StereoCamera, rng: np.random.Generator, *, threads: int = 1) -> StereoView:
    """Render a scene and match it.

    Args:
        scene: The scene.
        camera: The camera.
        rng: Of what stays over the frames.
        threads: Of the ray caster; they change nothing but the time.
    """
    render_rng, match_rng, noise_rng, patch_rng = rng.spawn(4)
    # The scale drifts over hours: it is one for all captures of a scene.
    scale = 1 + camera.scale_std * float(np.random.default_rng([look_seed(scene), 1]).standard_normal())
    coloured = dressed(scene)
    k = camera.intrinsics
    radiance = render(coloured.parts, coloured.light, k, render_rng).radiance
    surfaces = Surfaces(((mesh, Material(1.0)) for mesh in coloured.with_depth), threads)
    depth = exact_depth_m(surfaces, camera)
    depth = matched_depth_m(camera, depth, texture_of(radiance), match_rng)
    depth *= scale
    depth += depth_error_m(camera, depth, noise_rng, temporal=False)
    patches = smooth_field((k.height, k.width), PATCH_PX, patch_rng)
    return StereoView(camera, radiance, depth, patches, int(render_rng.integers(2**62)))


def stereo_frames(
    scene: Scene, camera: StereoCamera, rng: np.random.Generator, count: int = 1, *, threads: int = 1
) -> Iterator[RgbdFrame]:
    """Frames of a scene that does not move, one by one.

    Args:
        scene: The scene.
        camera: The camera.
        rng: Source of randomness; frame k does not depend on their number.
        count: How many.
        threads: Of the ray caster; they change nothing but the time.
    """
    view_rng, frames_rng = rng.spawn(2)
    view = stereo_view(scene, camera, view_rng, threads=threads)
    for _ in range(count):
        yield view.frame(frames_rng.spawn(1)[0])


def exact_depth_m(surfaces: Surfaces, camera: StereoCamera) -> FloatArray:
    """Depth (H, W) of the first surface on the line of sight of every pixel's centre, metres; NaN without any."""
    k = camera.intrinsics
    rays = k.rays().reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    depth = np.empty(len(rays))
    for start in range(0, len(rays), TILE_RAYS):
        tile = slice(start, start + TILE_RAYS)
        hits = surfaces.cast(np.zeros_like(rays[tile]), rays[tile])
        depth[tile] = np.where(np.isfinite(hits.distance_m), hits.points_m[:, 2], np.nan)
    return np.asarray(depth.reshape(k.height, k.width))


def texture_of(radiance: NDArray[np.float32]) -> FloatArray:
    """What every pixel gives to match by, shape (H, W): 0 black or glaring, 1 bright and matte.

    A matcher's costs are compared with the noise of dark pixels, and a highlight lies elsewhere for each imager.
    """
    light = radiance.mean(axis=2)
    bright = max(float(np.quantile(light, BRIGHT_QUANTILE)), 1e-6)
    share = cv2.blur(light / bright, (3, 3)).astype(float)
    lit = share**2 / (share**2 + HALF_TEXTURE**2)
    return np.asarray(lit * np.clip((GLARE - share) / (0.5 * GLARE), 0, 1) ** 2)


def _upper(share: float) -> float:
    """Value that a normal variable exceeds with a given probability."""
    from scipy.stats import norm

    return float(norm.isf(share)) if share > 0 else float("inf")
