"""Sensor ``raycast``: direct light by ray casting, and refraction through see-through walls.

Camera rays are traced; every surface that they meet is lit by the projector along a straight line. Light that is
scattered more than once does not exist here.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from tubepose.capture.frame import RgbdFrame
from tubepose.simulation.camera import CHANNELS, PERIODS, Float32Array, StructuredLightCamera
from tubepose.simulation.meshes import Mesh, merge
from tubepose.simulation.scene import Material, Scene
from tubepose.transforms import FloatArray

# Rays start this far off the surface that they leave: more than a facet's sagitta, much less than a wall.
OFFSET_M = 3e-5
MAX_INTERFACES = 16
MIN_WEIGHT = 5e-3
BLOCK_PX = 60_000


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """First intersections of N rays; `distance_m` is inf for a miss, the other rows are then meaningless."""

    distance_m: FloatArray
    points_m: FloatArray
    normals: FloatArray
    triangle: NDArray[np.intp]


class Surfaces:
    """Meshes in a ray casting scene, with the material of every triangle."""

    def __init__(self, parts: Iterable[tuple[Mesh, Material]], threads: int = 0) -> None:
        """Build the search tree; `parts` may be empty. No more than `threads` are used later, 0: one per core."""
        listed = list(parts)
        self.threads = threads
        self.empty = not listed
        if self.empty:
            return
        self.mesh = merge([mesh for mesh, _ in listed])
        counts = [len(mesh.triangles) for mesh, _ in listed]

        def per_triangle(values: list[float]) -> FloatArray:
            return np.repeat(np.array(values), counts)

        self.albedo = per_triangle([material.albedo for _, material in listed])
        self.ambient = per_triangle([material.ambient for _, material in listed])
        plastics = [material.plastic for _, material in listed]
        self.index = per_triangle([1.0 if p is None else p.refractive_index for p in plastics])
        self.half_wall = per_triangle([1.0 if p is None else np.sqrt(p.wall_transmission) for p in plastics])
        self.scene = o3d.t.geometry.RaycastingScene()
        self.scene.add_triangles(
            o3d.core.Tensor.from_numpy(self.mesh.vertices_m.astype(np.float32)),
            o3d.core.Tensor.from_numpy(self.mesh.triangles.astype(np.uint32)),
        )

    def cast(self, origins_m: FloatArray, directions: FloatArray) -> Hits:
        """First hit of each ray; `directions` (N, 3) are unit."""
        n = len(directions)
        if self.empty or n == 0:
            nothing = np.zeros((n, 3))
            return Hits(np.full(n, np.inf), nothing, nothing, np.zeros(n, dtype=np.intp))
        answer = self.scene.cast_rays(ray_tensor(origins_m, directions), nthreads=self.threads)
        distance = answer["t_hit"].numpy().astype(float)
        hit = np.isfinite(distance)
        triangle = np.where(hit, answer["primitive_ids"].numpy(), 0).astype(np.intp)
        uv = answer["primitive_uvs"].numpy().astype(float)
        weights = np.column_stack([1 - uv.sum(axis=1), uv])
        corner_normals = self.mesh.normals[self.mesh.triangles[triangle]]
        normals = np.einsum("nk,nkc->nc", weights, corner_normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        points = origins_m + np.where(hit, distance, 0.0)[:, None] * directions
        return Hits(distance, points, normals, triangle)

    def blocked(self, starts_m: FloatArray, end_m: FloatArray) -> NDArray[np.bool_]:
        """Whether anything lies between points (N, 3) and one end point."""
        if self.empty or len(starts_m) == 0:
            return np.zeros(len(starts_m), dtype=bool)
        rays = ray_tensor(starts_m, end_m - starts_m)
        return np.asarray(self.scene.test_occlusions(rays, tnear=0.0, tfar=1.0, nthreads=self.threads).numpy())

    def transmission(self, starts_m: FloatArray, end_m: FloatArray) -> FloatArray:
        """Share of straight light from points (N, 3) to one end point that the walls in between let through."""
        share = np.ones(len(starts_m))
        rows = np.flatnonzero(self.blocked(starts_m, end_m))
        if len(rows) == 0:
            return share
        found = self.scene.list_intersections(ray_tensor(starts_m[rows], end_m - starts_m[rows]), nthreads=self.threads)
        between = found["t_hit"].numpy() < 1.0
        triangle = found["primitive_ids"].numpy()[between].astype(np.intp)
        index = self.index[triangle]
        per_interface = self.half_wall[triangle] * (1 - ((index - 1) / (index + 1)) ** 2)
        ray = found["ray_ids"].numpy()[between].astype(np.intp)
        share[rows] = np.exp(np.bincount(ray, weights=np.log(per_interface), minlength=len(rows)))
        return share


def ray_tensor(origins_m: FloatArray | Float32Array, directions: FloatArray | Float32Array) -> o3d.core.Tensor:
    """Rays as Open3D casts them: origins and directions (N, 3) side by side, shape (N, 6), float32."""
    rays = np.empty((len(directions), 6), dtype=np.float32)
    rays[:, :3], rays[:, 3:] = origins_m, directions
    return o3d.core.Tensor.from_numpy(rays)


class _Tracer:
    """Adds up the light of all paths of one scene."""

    def __init__(self, scene: Scene, camera: StructuredLightCamera, threads: int) -> None:
        parts = list(scene.parts())
        self.camera = camera
        self.opaque = Surfaces((part for part in parts if part[1].plastic is None), threads)
        self.plastic = Surfaces((part for part in parts if part[1].plastic is not None), threads)
        self.sums: Float32Array = np.zeros((CHANNELS, camera.intrinsics.height * camera.intrinsics.width), np.float32)

    def add_return(
        self, pixels: NDArray[np.intp], weight: FloatArray, surfaces: Surfaces, hits: Hits, directions: FloatArray
    ) -> None:
        """Add the diffuse return of surface points that the rays of `pixels` meet (each pixel at most once)."""
        camera = self.camera
        normals = np.where(np.sum(hits.normals * directions, axis=1, keepdims=True) > 0, -hits.normals, hits.normals)
        to_light = camera.projector_m - hits.points_m
        distance = np.linalg.norm(to_light, axis=1)
        cosine = np.sum(normals * to_light, axis=1) / distance
        # A thin scattering wall also glows when it is lit from behind; an opaque surface does not.
        cosine = np.abs(cosine) if surfaces is self.plastic else np.maximum(cosine, 0.0)
        amplitude = weight * surfaces.albedo[hits.triangle] * cosine * (camera.working_distance_m / distance) ** 2
        column = camera.column(hits.points_m)
        amplitude[np.isnan(column)] = 0.0
        starts = hits.points_m + OFFSET_M * normals
        lit = np.flatnonzero(amplitude > 0)
        lit = lit[~self.opaque.blocked(starts[lit], camera.projector_m)]
        amplitude_lit = amplitude[lit] * self.plastic.transmission(starts[lit], camera.projector_m)
        facing = np.abs(np.sum(normals * directions, axis=1))
        room = weight * surfaces.albedo[hits.triangle] * surfaces.ambient[hits.triangle] * (0.4 + 0.6 * facing)
        self.sums[1, pixels] += room.astype(np.float32)
        rows = pixels[lit]
        self.sums[0, rows] += amplitude_lit.astype(np.float32)
        for i, period in enumerate(PERIODS):
            phase = 2 * np.pi / period * column[lit]
            self.sums[2 + 2 * i, rows] += (amplitude_lit * np.cos(phase)).astype(np.float32)
            self.sums[3 + 2 * i, rows] += (amplitude_lit * np.sin(phase)).astype(np.float32)

    def trace(self, pixels: NDArray[np.intp], directions: FloatArray, through_plastic: bool) -> None:
        """Follow the rays of pixels from the camera until they meet something opaque."""
        origins = np.zeros_like(directions)
        weight = np.ones(len(pixels))
        for _ in range(MAX_INTERFACES if through_plastic else 1):
            solid = self.opaque.cast(origins, directions)
            wall = self.plastic.cast(origins, directions) if through_plastic else None
            at_wall = wall.distance_m < solid.distance_m if wall is not None else np.zeros(len(pixels), dtype=bool)
            ends = np.flatnonzero(~at_wall & np.isfinite(solid.distance_m))
            self.add_return(pixels[ends], weight[ends], self.opaque, _take(solid, ends), directions[ends])
            if wall is None or not at_wall.any():
                return
            rows = np.flatnonzero(at_wall)
            hits, pixels, directions, weight = _take(wall, rows), pixels[rows], directions[rows], weight[rows]
            entering = np.flatnonzero(np.sum(hits.normals * directions, axis=1) < 0)
            self.add_return(
                pixels[entering], weight[entering], self.plastic, _take(hits, entering), directions[entering]
            )
            index = self.plastic.index[hits.triangle]
            onward, share = cross_interface(directions, hits.normals, index)
            weight = weight * share * self.plastic.half_wall[hits.triangle]
            origins, directions = hits.points_m + OFFSET_M * onward, onward
            alive = np.flatnonzero(weight > MIN_WEIGHT)
            origins, directions, weight, pixels = origins[alive], directions[alive], weight[alive], pixels[alive]

    def run(self) -> Float32Array:
        """Sums of the whole image, shape (CHANNELS, H, W)."""
        k = self.camera.intrinsics
        rays = k.rays().reshape(-1, 3)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        behind_plastic = self._pixels_of_plastic()
        for see_through in (False, True):
            chosen = np.flatnonzero(behind_plastic == see_through)
            for start in range(0, len(chosen), BLOCK_PX):
                pixels = chosen[start : start + BLOCK_PX]
                self.trace(pixels, rays[pixels], see_through)
        return self.sums.reshape(CHANNELS, k.height, k.width)

    def _pixels_of_plastic(self) -> NDArray[np.bool_]:
        """Pixels that may see plastic: the rectangle that holds the projection of all of it, flattened."""
        k = self.camera.intrinsics
        inside = np.zeros((k.height, k.width), dtype=bool)
        if not self.plastic.empty:
            uv = k.project(self.plastic.mesh.vertices_m)
            low = np.clip(np.floor(uv.min(axis=0)), 0, None).astype(int)
            high = np.clip(np.ceil(uv.max(axis=0)) + 1, 0, None).astype(int)
            inside[low[1] : high[1], low[0] : high[0]] = True
        return inside.reshape(-1)


def _take(hits: Hits, rows: NDArray[np.intp]) -> Hits:
    return Hits(hits.distance_m[rows], hits.points_m[rows], hits.normals[rows], hits.triangle[rows])


def cross_interface(directions: FloatArray, normals: FloatArray, index: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Refract rays at a surface between air and plastic.

    Args:
        directions: Unit rays, shape (N, 3).
        normals: Unit normals out of the plastic, shape (N, 3).
        index: Refractive index of the plastic, shape (N,).

    Returns:
        Directions behind the surface, shape (N, 3), and the transmitted share of unpolarised light, shape (N,).
        At total reflection the ray stays inside the plastic and keeps all its light.
    """
    cos_in = -np.sum(directions * normals, axis=1)
    entering = cos_in > 0
    facing = np.where(entering[:, None], normals, -normals)
    cos_in = np.abs(cos_in)
    ratio = np.where(entering, 1 / index, index)
    sin2_out = ratio**2 * (1 - cos_in**2)
    total = sin2_out >= 1
    cos_out = np.sqrt(np.where(total, 0.0, 1 - sin2_out))
    refracted = ratio[:, None] * directions + (ratio * cos_in - cos_out)[:, None] * facing
    reflected = directions + 2 * cos_in[:, None] * facing
    n_in, n_out = np.where(entering, 1.0, index), np.where(entering, index, 1.0)
    across = (n_in * cos_in - n_out * cos_out) / (n_in * cos_in + n_out * cos_out)
    along = (n_in * cos_out - n_out * cos_in) / (n_in * cos_out + n_out * cos_in)
    share = np.where(total, 1.0, 1 - (across**2 + along**2) / 2)
    onward = np.where(total[:, None], reflected, refracted)
    return onward / np.linalg.norm(onward, axis=1, keepdims=True), share


def render(scene: Scene, camera: StructuredLightCamera, rng: np.random.Generator, *, threads: int = 0) -> RgbdFrame:
    """Simulate one capture of a scene; the frame's capture name is empty and its time unknown.

    The number of threads changes nothing but the time; 0: one per core.
    """
    return camera.capture(_Tracer(scene, camera, threads).run(), rng)
