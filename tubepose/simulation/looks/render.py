"""A fast renderer for pictures to learn from: one ray a pixel, lamps with soft shadows, walls that are seen through.

It is made for looks, not for light: no depth, no refraction, no light that bounces between surfaces but a constant
share. `tubepose.simulation` is the place for physics. What it must get right is which pixel shows which object, and
that is exact: boxes are those of the object that a pixel's ray meets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics
from tubepose.simulation.looks.appearance import NOTHING, Float32Array, Light, Part
from tubepose.simulation.raycast import ray_tensor

_LAYERS = 6
_OFFSET_M = 5e-5
_OCCLUSION_M = 0.10
"""Surfaces nearer than this darken each other."""


@dataclass(frozen=True, slots=True, eq=False)
class Rendered:
    """A picture and what it shows.

    Attributes:
        radiance: Array of shape (H, W, 3), linear light, 1 is white paper in full light.
        seen: One array of owners (H, W) per layer, from the front: `NOTHING` where no object is met.
        points_m: For every layer the points that are met, shape (H, W, 3), camera frame; NaN where none is.
        clear: For every layer the share of its light that the layers before it let through, shape (H, W).
    """

    radiance: Float32Array
    seen: list[NDArray[np.int32]] = field(default_factory=list)
    points_m: list[Float32Array] = field(default_factory=list)
    clear: list[Float32Array] = field(default_factory=list)


class _Solids:
    """Parts in a ray casting scene, with their looks as arrays by geometry."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self.parts = list(parts)
        self.scene = o3d.t.geometry.RaycastingScene(nthreads=1)
        for part in self.parts:
            self.scene.add_triangles(
                o3d.core.Tensor.from_numpy(part.mesh.vertices_m.astype(np.float32)),
                o3d.core.Tensor.from_numpy(part.mesh.triangles.astype(np.uint32)),
            )
        self.albedo = np.array([part.surface.albedo for part in self.parts], np.float32).reshape(-1, 3)
        self.gloss = np.array([part.surface.gloss for part in self.parts], np.float32)
        self.sharpness = np.array([part.surface.sharpness for part in self.parts], np.float32)
        self.owner = np.array([part.owner for part in self.parts], np.int32)
        through = [part.surface.transmission or (0.0, 0.0, 0.0) for part in self.parts]
        self.transmission = np.array(through, np.float32).reshape(-1, 3)

    def cast(self, origins: Float32Array, rays: Float32Array) -> tuple[Float32Array, NDArray[np.intp], Float32Array]:
        """Distance (inf: nothing), part and normal of the first hit of each ray."""
        if not self.parts or not len(rays):
            n = len(rays)
            return np.full(n, np.inf, np.float32), np.zeros(n, np.intp), np.zeros((n, 3), np.float32)
        found = self.scene.cast_rays(ray_tensor(origins, rays), nthreads=1)
        distance = found["t_hit"].numpy()
        part = np.where(np.isfinite(distance), found["geometry_ids"].numpy(), 0).astype(np.intp)
        return distance, part, found["primitive_normals"].numpy()

    def free(self, origins: Float32Array, towards: Float32Array, far: float) -> Float32Array:
        """1 where nothing opaque lies between origins and origins + far * towards, else 0."""
        if not self.parts or not len(origins):
            return np.ones(len(origins), np.float32)
        hit = self.scene.test_occlusions(ray_tensor(origins, towards), tnear=0.0, tfar=far, nthreads=1).numpy()
        return np.asarray(~hit, np.float32)


def render(parts: Sequence[Part], light: Light, intrinsics: CameraIntrinsics, rng: np.random.Generator) -> Rendered:
    """Render a scene as the camera sees it, one ray a pixel.

    Args:
        parts: Everything in the scene, camera frame.
        light: Lamps and room.
        intrinsics: Size and projection of the picture.
        rng: Where rays pass their pixels, where on its lamp a shadow's ray ends.
    """
    solid = _Solids([part for part in parts if part.surface.transmission is None])
    walls = _Solids([part for part in parts if part.surface.transmission is not None])
    height, width = intrinsics.height, intrinsics.width
    rays = _pixel_rays(intrinsics, rng)
    zeros = np.zeros_like(rays)
    distance, part, normals = solid.cast(zeros, rays)
    radiance = _environment(light, rays)
    rows = np.flatnonzero(np.isfinite(distance))
    points = np.full_like(rays, np.nan)
    points[rows] = rays[rows] * distance[rows, None]
    radiance[rows] = _opaque(solid, light, rays, points, normals, part, rows, (height, width), rng)
    owner = np.where(np.isfinite(distance), solid.owner[part] if len(solid.owner) else NOTHING, NOTHING)
    layers, clear = _look_through(walls, light, rays, distance, radiance)
    layers.append((owner.astype(np.int32), points, clear))
    return Rendered(
        radiance.reshape(height, width, 3),
        [layer[0].reshape(height, width) for layer in layers],
        [layer[1].reshape(height, width, 3) for layer in layers],
        [layer[2].reshape(height, width) for layer in layers],
    )


def _pixel_rays(intrinsics: CameraIntrinsics, rng: np.random.Generator) -> Float32Array:
    v, u = np.mgrid[: intrinsics.height, : intrinsics.width].astype(np.float32)
    u += rng.random(u.shape, np.float32) - np.float32(0.5)
    v += rng.random(v.shape, np.float32) - np.float32(0.5)
    rays = np.stack(
        [(u - intrinsics.cx) / intrinsics.fx, (v - intrinsics.cy) / intrinsics.fy, np.ones_like(u)], axis=-1
    ).reshape(-1, 3)
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True), np.float32)


def _environment(light: Light, rays: Float32Array) -> Float32Array:
    """What lies in a direction beyond everything: the picture around the scene, by two angles."""
    height, width = light.environment.shape[:2]
    up = light.up.astype(np.float32)
    rise = np.clip(rays @ up, -1, 1)
    turn = np.arctan2(rays[:, 1], rays[:, 0])
    row = ((0.5 - 0.5 * rise) * (height - 1)).astype(np.intp)
    column = ((turn / np.float32(2 * np.pi) + np.float32(0.5)) * (width - 1)).astype(np.intp)
    return np.asarray(light.environment[row, column], np.float32)


def _albedo(solid: _Solids, points: Float32Array, part: NDArray[np.intp]) -> Float32Array:
    albedo = solid.albedo[part]
    for index, found in enumerate(solid.parts):
        texture = found.surface.texture
        if texture is None:
            continue
        rows = np.flatnonzero(part == index)
        uv = points[rows] @ texture.to_uv[:, :3].T.astype(np.float32) + texture.to_uv[:, 3].astype(np.float32)
        height, width = texture.image.shape[:2]
        column, row = np.mod(uv[:, 0], width).astype(np.intp) % width, np.mod(uv[:, 1], height).astype(np.intp) % height
        albedo[rows] = texture.image[row, column]
    return np.asarray(albedo, np.float32)


def _opaque(
    solid: _Solids,
    light: Light,
    rays: Float32Array,
    points: Float32Array,
    normals: Float32Array,
    part: NDArray[np.intp],
    rows: NDArray[np.intp],
    shape: tuple[int, int],
    rng: np.random.Generator,
) -> Float32Array:
    """Light that the opaque surfaces at `rows` send back."""
    at, ray, normal, part = points[rows], rays[rows], normals[rows], part[rows]
    normal = np.where(np.sum(normal * ray, axis=1, keepdims=True) > 0, -normal, normal)
    start = at + normal * np.float32(_OFFSET_M)
    open_share = _openness(solid, start, normal, rows, shape, rng)
    above = np.float32(0.6) + np.float32(0.4) * (normal @ light.up.astype(np.float32))
    lit = np.array(light.room, np.float32) * (above * open_share)[:, None]
    shine = np.zeros_like(lit)
    for lamp in light.lamps:
        way = lamp.position_m.astype(np.float32) - at
        way += rng.normal(0.0, lamp.radius_m, way.shape).astype(np.float32)
        length = np.linalg.norm(way, axis=1, keepdims=True)
        cosine = np.maximum(np.sum(way * normal, axis=1, keepdims=True) / length, 0.0)
        reaches = np.zeros((len(rows), 1), np.float32)
        facing = np.flatnonzero(cosine[:, 0] > 0)
        reaches[facing, 0] = solid.free(start[facing], way[facing], 0.999)
        if lamp.radius_m > 0.02 * float(np.median(length)):
            reaches = _smooth(reaches[:, 0], rows, shape)[:, None]
        arriving = np.array(lamp.color, np.float32) * reaches / length**2
        lit += arriving * cosine
        shine += arriving * _highlight(way / length, ray, normal, solid.sharpness[part])[:, None]
    gloss = solid.gloss[part][:, None]
    mirror = ray - 2 * np.sum(ray * normal, axis=1, keepdims=True) * normal
    around = _environment(light, np.asarray(mirror, np.float32))
    fresnel = 0.04 + 0.96 * (1 - np.clip(-np.sum(ray * normal, axis=1, keepdims=True), 0, 1)) ** 5
    color = _albedo(solid, at, part) * lit
    return np.asarray(color + gloss * (shine + fresnel * around * open_share[:, None]), np.float32)


def _openness(
    solid: _Solids,
    start: Float32Array,
    normal: Float32Array,
    rows: NDArray[np.intp],
    shape: tuple[int, int],
    rng: np.random.Generator,
) -> Float32Array:
    """Share of the room that a point sees: one ray a pixel into the half space, smoothed over the picture."""
    towards = rng.normal(0.0, 1.0, normal.shape).astype(np.float32)
    towards = normal + towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-6) * np.float32(0.98)
    free = solid.free(start, towards * np.float32(_OCCLUSION_M), 1.0)
    return np.asarray(0.15 + 0.85 * _smooth(free, rows, shape), np.float32)


def _smooth(values: Float32Array, rows: NDArray[np.intp], shape: tuple[int, int]) -> Float32Array:
    """What single rays say, averaged over neighbouring pixels."""
    picture = np.ones(shape, np.float32)
    picture.reshape(-1)[rows] = values
    return np.asarray(cv2.blur(picture, (5, 5)).reshape(-1)[rows], np.float32)


def _highlight(to_lamp: Float32Array, ray: Float32Array, normal: Float32Array, sharpness: Float32Array) -> Float32Array:
    half = to_lamp - ray
    half /= np.maximum(np.linalg.norm(half, axis=1, keepdims=True), 1e-6)
    cosine = np.clip(np.sum(half * normal, axis=1), 0, 1)
    return np.asarray(cosine**sharpness * (sharpness + 8) / np.float32(25.0), np.float32)


def _look_through(
    walls: _Solids, light: Light, rays: Float32Array, limit: Float32Array, radiance: Float32Array
) -> tuple[list[tuple[NDArray[np.int32], Float32Array, Float32Array]], Float32Array]:
    """Lay see-through walls over what lies behind them (in place).

    Returns:
        Owners, points and clearness by layer from the front, and the clearness of what lies behind all walls.
    """
    layers = []
    pixels = np.arange(len(rays)) if walls.parts else np.empty(0, np.intp)
    before = np.zeros(len(rays), np.float32)
    weight, added = np.ones_like(radiance), np.zeros_like(radiance)
    for _ in range(_LAYERS):
        distance, part, normal = walls.cast(rays[pixels] * before[pixels, None], rays[pixels])
        distance = distance + before[pixels]
        hit = distance < limit[pixels]
        pixels, distance, part, normal = pixels[hit], distance[hit], part[hit], normal[hit]
        if not len(pixels):
            break
        ray = rays[pixels]
        point = ray * distance[:, None]
        owner = np.full(len(rays), NOTHING, np.int32)
        owner[pixels] = walls.owner[part]
        where = np.full_like(rays, np.nan)
        where[pixels] = point
        layers.append((owner, where, weight.mean(axis=1)))
        normal = np.where(np.sum(normal * ray, axis=1, keepdims=True) > 0, -normal, normal)
        through, color = _wall(walls, light, ray, point, normal, part)
        added[pixels] += weight[pixels] * color
        weight[pixels] *= through
        before[pixels] = distance + np.float32(2e-4)
    radiance *= weight
    radiance += added
    return layers, weight.mean(axis=1)


def _wall(
    walls: _Solids, light: Light, ray: Float32Array, at: Float32Array, normal: Float32Array, part: NDArray[np.intp]
) -> tuple[Float32Array, Float32Array]:
    """What a wall lets through, and what it sends back itself (both (N, 3)); it casts and takes no shadow."""
    cosine = np.clip(-np.sum(ray * normal, axis=1, keepdims=True), 0.08, 1.0)
    through = walls.transmission[part] ** (1 / cosine)
    lit = np.broadcast_to(np.array(light.room, np.float32), ray.shape).copy()
    shine = np.zeros_like(lit)
    for lamp in light.lamps:
        way = lamp.position_m.astype(np.float32) - at
        length = np.linalg.norm(way, axis=1, keepdims=True)
        arriving = np.array(lamp.color, np.float32) / length**2
        # A wall that scatters glows on both of its sides.
        lit += arriving * (0.25 + 0.75 * np.abs(np.sum(way * normal, axis=1, keepdims=True)) / length)
        shine += arriving * _highlight(way / length, ray, normal, walls.sharpness[part])[:, None]
    fresnel = 0.04 + 0.96 * (1 - cosine) ** 5
    mirror = np.asarray(ray - 2 * np.sum(ray * normal, axis=1, keepdims=True) * normal, np.float32)
    own = walls.albedo[part] * lit * (1 - through)
    own += walls.gloss[part][:, None] * (shine + fresnel * _environment(light, mirror))
    return np.asarray(through * (1 - fresnel), np.float32), np.asarray(own, np.float32)
