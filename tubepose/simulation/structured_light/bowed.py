"""A bowed rack for a sensor whose shapes are plane: the light of the flat rack, moved to where the bowed one is seen.

Light is followed with the tubes where they stand in the bowed rack, but with the rack itself flat. Every pixel that
sees the bowed rack, or the table under it, then takes the light of the pixel that sees the same spot of the flat one.
Its projector column is corrected to the one that lights the spot where it is now. So geometry is that of the bowed
rack, of meshes; shadows, reflections and what is seen through plastic are the flat rack's.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from tubepose.simulation.bent_meshes import base_height_m, bent_shell, bent_wells
from tubepose.simulation.bow import FLAT, Bow
from tubepose.simulation.camera import PERIODS, Float32Array, StructuredLightCamera
from tubepose.simulation.meshes import Mesh, flat_polygon, merge
from tubepose.simulation.raycast import Surfaces, ray_tensor
from tubepose.simulation.scene import MATERIALS, TABLE_HALF_SIZE_M, Scene, tube_parts
from tubepose.transforms import FloatArray

SAME_SPOT_M = 1e-3
"""A pixel of the flat rack shows a spot if what it sees is this near to it in depth: less than any rim is high, more
than the face is inclined within the pixel that a spot is rounded to."""


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """First hits of all pixels: distance (N,), inf for none; triangle (N,) and weights of its corners (N, 3)."""

    distance_m: FloatArray
    triangle: NDArray[np.intp]
    weights: FloatArray


def bowed_sums(scene: Scene, camera: StructuredLightCamera, sums: Float32Array, threads: int = 1) -> Float32Array:
    """Sums of light paths of a scene with a bowed rack.

    Args:
        scene: The scene, with its bow.
        camera: The camera.
        sums: Sums of the same scene with a flat rack, shape (CHANNELS, H, W).
        threads: Threads of the ray caster; they change nothing but the time.

    Returns:
        Array of shape (CHANNELS, H, W). A spot that the flat rack's light does not show is dark.
    """
    k = camera.intrinsics
    rays = k.rays().reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    bent, flat = _ground(scene, scene.bow), _ground(scene, FLAT)
    tubes_m = _tube_distance_m(scene, rays, threads)
    now, before = (_cast(mesh, rays, threads) for mesh in (bent, flat))
    seen = np.flatnonzero(now.distance_m < tubes_m)
    spot = _points(flat, now.triangle[seen], now.weights[seen])
    source, inside = _pixel_of(camera, spot)
    lit_from = rays[source] * before.distance_m[source, None]
    shown = inside & (before.distance_m[source] < tubes_m[source])
    shown &= np.abs(lit_from[:, 2] - spot[:, 2]) < SAME_SPOT_M
    place = _points(bent, now.triangle[seen], now.weights[seen])
    shift = camera.column(place) - camera.column(lit_from)
    shown &= np.isfinite(shift)
    moved = sums.reshape(len(sums), -1).copy()
    moved[:, seen] = np.where(shown, _shifted(moved[:, source], np.where(shown, shift, 0.0)), 0.0)
    return np.ascontiguousarray(moved.reshape(sums.shape))


def _shifted(sums: FloatArray | Float32Array, columns: FloatArray) -> Float32Array:
    """Sums (CHANNELS, N) of light whose projector columns are greater by so many (N,)."""
    turned = np.array(sums, dtype=np.float32)
    for i, period in enumerate(PERIODS):
        cosine, sine = sums[2 + 2 * i], sums[3 + 2 * i]
        angle = 2 * np.pi / period * columns
        turned[2 + 2 * i] = cosine * np.cos(angle) - sine * np.sin(angle)
        turned[3 + 2 * i] = cosine * np.sin(angle) + sine * np.cos(angle)
    return turned


def _ground(scene: Scene, bow: Bow) -> Mesh:
    """Rack and table, camera frame; of the same triangles whatever the bow."""
    base_m = 0.0 if bow.flat else base_height_m(scene.rack, bow)
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * TABLE_HALF_SIZE_M
    parts = [bent_shell(scene.rack, bow, base_m), bent_wells(scene.rack, bow), flat_polygon([corners], base_m)]
    return merge(parts).transformed(scene.T_camera_rack)


def _tube_distance_m(scene: Scene, rays: FloatArray, threads: int) -> FloatArray:
    """Distance (N,) of the first tube or cap on each ray, metres; inf for none."""
    parts = [
        (mesh.transformed(scene.T_camera_rack @ tube.T_rack_tube), material)
        for tube in scene.tubes
        for mesh, material in tube_parts(tube, scene.printed_cap, MATERIALS, scene.finishes)
    ]
    return Surfaces(parts, threads).cast(np.zeros_like(rays), rays).distance_m


def _cast(mesh: Mesh, rays: FloatArray, threads: int) -> _Seen:
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        o3d.core.Tensor.from_numpy(mesh.vertices_m.astype(np.float32)),
        o3d.core.Tensor.from_numpy(mesh.triangles.astype(np.uint32)),
    )
    found = scene.cast_rays(ray_tensor(np.zeros_like(rays), rays), nthreads=threads)
    distance = found["t_hit"].numpy().astype(float)
    triangle = np.where(np.isfinite(distance), found["primitive_ids"].numpy(), 0).astype(np.intp)
    uv = found["primitive_uvs"].numpy().astype(float)
    return _Seen(distance, triangle, np.column_stack([1 - uv.sum(axis=1), uv]))


def _points(mesh: Mesh, triangle: NDArray[np.intp], weights: FloatArray) -> FloatArray:
    return np.asarray(np.einsum("nk,nkc->nc", weights, mesh.vertices_m[mesh.triangles[triangle]]))


def _pixel_of(camera: StructuredLightCamera, points_m: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Row-major number of the pixel that points (N, 3) fall on, and whether they fall into the image."""
    k = camera.intrinsics
    u, v = np.rint(k.project(points_m)).T
    inside = (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height)
    return np.where(inside, v * k.width + u, 0).astype(np.intp), inside
