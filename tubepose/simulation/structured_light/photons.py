"""Projector light that crosses plastic: photons, each tagged with its projector column, followed to the light map.

A photon counts from the first see-through surface that it meets. It is refracted or reflected there at random (Fresnel)
and weakened on its way through walls. Where it arrives at an opaque surface, it is added to that surface's texel; in
walls, power times track length is added to the wall's: the fluence. A share of what is scattered, in a wall or at a
surface, goes on as walkers, which add to the walls only: so does light that comes to the walls from surfaces that the
projector lights straight. Together the walls hold all light of any order, and the surfaces what came to them from the
projector through plastic without being scattered; camera paths look for everything else, and nothing is counted twice.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numpy.typing import NDArray

from tubepose.simulation.structured_light.codes import NOTHING
from tubepose.simulation.structured_light.compiled import kernel
from tubepose.simulation.structured_light.interfaces import (
    AIR,
    PLASTIC,
    START_OFF_M,
    attenuation,
    bounced,
    cross,
    is_opaque,
    material_of,
    next_hit,
)
from tubepose.simulation.structured_light.intersection import closest, into, normal_at, turned_into
from tubepose.simulation.structured_light.light_map import LightMap, locate, texel, wall_depth, wall_patch
from tubepose.simulation.structured_light.optics import any_direction, start, uniform
from tubepose.simulation.structured_light.projector import Projector, tagged
from tubepose.simulation.structured_light.shapes import Shapes
from tubepose.transforms import FloatArray

STRANDS = 4
"""Photons are followed in so many strands, whatever the number of threads: each sums on its own, then all are added."""
MAX_EVENTS = 200
MAX_WALK = 2000
LEAST_SHARE = 0.05
SURVIVAL = 0.25
SPAWN = 0.25
"""Walkers per photon that is scattered."""
BOUNCE_SHARE = 0.04
"""Photons per area over the whole field, for light that surfaces send on, to photons per area towards the tubes."""
TRACK_STEP_M = 1.0e-3
MAX_TRACK_POINTS = 8
_AROUND = 24


def aims(s: Shapes, projector: Projector) -> tuple[FloatArray, NDArray[np.int64]]:
    """Rectangle of projector tangents (x0, x1, y0, y1) about each see-through body, shape (N, 4), and the bodies."""
    angle = np.linspace(0, 2 * np.pi, _AROUND, endpoint=False)
    limit = projector.numbers[2]
    rectangles, bodies = [], []
    for k in range(len(s.solids)):
        if s.profile_start[k + 1] == s.profile_start[k]:
            continue
        row = s.solids[k]
        # Circumscribed, so that the polygon holds the circle.
        radius = row[12] / np.cos(np.pi / _AROUND)
        ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
        points = np.vstack([np.column_stack([ring, np.full(_AROUND, z)]) for z in row[13:15]])
        seen = ((points - row[9:12]) @ row[:9].reshape(3, 3) - projector.position_m) @ projector.axes.T
        if np.any(seen[:, 2] <= 0):
            continue
        tangents = np.clip(seen[:, :2] / seen[:, 2:], -limit, limit)
        (x0, y0), (x1, y1) = tangents.min(axis=0), tangents.max(axis=0)
        if x1 > x0 and y1 > y0:
            rectangles.append([x0, x1, y0, y1])
            bodies.append(k)
    return np.array(rectangles).reshape(-1, 4), np.array(bodies, dtype=np.int64)


def light_through_plastic(
    s: Shapes, m: LightMap, projector: Projector, per_steradian: float, seed: int, threads: int
) -> None:
    """Fill a dark light map. The same seed gives the same bits whatever the number of threads.

    Args:
        s: The scene.
        m: Its dark light map.
        projector: The light.
        per_steradian: Photons per steradian (of the projector's tangents) towards every see-through body.
        seed: Of the random numbers.
        threads: Strands that run side by side.
    """
    rectangles, bodies = aims(s, projector)
    if len(bodies) == 0:
        return
    limit = projector.numbers[2]
    rectangles, bodies = np.vstack([rectangles, [-limit, limit, -limit, limit]]), np.append(bodies, -1)
    maps = [m] + [m._replace(light=np.zeros_like(m.light)) for _ in range(STRANDS - 1)]

    def follow(strand: int) -> None:
        scratch = np.empty(1, dtype=np.uint64), np.empty(6)
        for rectangle, body in zip(rectangles, bodies, strict=True):
            density = per_steradian * (BOUNCE_SHARE if body < 0 else 1.0)
            size = np.array([rectangle[1] - rectangle[0], rectangle[3] - rectangle[2]])
            cells = np.maximum(np.rint(size * np.sqrt(density)), 1).astype(np.int64)
            _follow(s, maps[strand], projector, rectangle, cells[0], cells[1], body, seed, strand, *scratch)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(follow, range(STRANDS)))
    for other in maps[1:]:
        m.light[:, :7] += other.light[:, :7]


@kernel
def _emitted(projector, state, rectangle, step_x, step_y, column, row):
    """Tangent x, direction and power of a photon from a jittered cell of a rectangle of tangents."""
    tx = rectangle[0] + (column + uniform(state)) * step_x
    ty = rectangle[2] + (row + uniform(state)) * step_y
    length = math.sqrt(1.0 + tx * tx + ty * ty)
    power = projector.numbers[3] * step_x * step_y / (length * length * length)
    a = projector.axes
    dx = (tx * a[0, 0] + ty * a[1, 0] + a[2, 0]) / length
    dy = (tx * a[0, 1] + ty * a[1, 1] + a[2, 1]) / length
    dz = (tx * a[0, 2] + ty * a[1, 2] + a[2, 2]) / length
    return tx, dx, dy, dz, power


@kernel
def _follow(s, m, projector, rectangle, columns, rows, body, seed, strand, state, tags):
    """Follow every `STRANDS`-th photon of a jittered grid of tangents; two arrays are scratch.

    With a body, photons count that meet it first, so that nothing counts twice where aims overlap; with body -1, those
    that meet an opaque surface first.
    """
    step_x, step_y = (rectangle[1] - rectangle[0]) / columns, (rectangle[3] - rectangle[2]) / rows
    px, py, pz = projector.position_m[0], projector.position_m[1], projector.position_m[2]
    for number in range(strand, columns * rows, STRANDS):
        start(state, seed, body + 2, number)
        column, row = number % columns, number // columns
        tx, dx, dy, dz, power = _emitted(projector, state, rectangle, step_x, step_y, column, row)
        t, code, index, owner = closest(s, px, py, pz, dx, dy, dz)
        if code == NOTHING:
            continue
        x, y, z = px + t * dx, py + t * dy, pz + t * dz
        opaque = is_opaque(s, code, index)
        if body < 0 and opaque:
            tagged(projector.numbers[1] + projector.numbers[0] * tx, tags)
            _bounce(s, m, state, AIR, -1, x, y, z, dx, dy, dz, code, index, owner, power, 1.0, tags)
        elif body >= 0 and not opaque and owner == body:
            tagged(projector.numbers[1] + projector.numbers[0] * tx, tags)
            _fly(s, m, state, x, y, z, dx, dy, dz, code, index, owner, power, tags)


@kernel
def _fly(s, m, state, x, y, z, dx, dy, dz, code, index, owner, full_power, tags):
    """Follow a photon, unscattered, from its first interface to the opaque surface where it ends."""
    power = full_power
    for _ in range(MAX_EVENTS):
        nx, ny, nz = normal_at(s, code, index, owner, x, y, z)
        dx, dy, dz, medium = cross(s, state, code, index, owner, x, y, z, dx, dy, dz, nx, ny, nz)
        inside = owner
        t, code, index, owner = next_hit(s, medium, inside, x, y, z, dx, dy, dz)
        if code == NOTHING:
            return
        if medium != AIR:
            scattering, absorption = attenuation(s, medium, inside)
            if medium == PLASTIC:
                _leave_track(s, m, state, inside, x, y, z, dx, dy, dz, t, scattering + absorption, power, tags)
                scattered = 1.0 - math.exp(-scattering * t)
                if uniform(state) < SPAWN * scattered * power / full_power:
                    free = -math.log(1.0 - uniform(state) * scattered) / scattering
                    left = full_power / SPAWN * math.exp(-absorption * free)
                    ex, ey, ez = any_direction(state)
                    sx, sy, sz = x + free * dx, y + free * dy, z + free * dz
                    _walk(s, m, state, PLASTIC, inside, sx, sy, sz, ex, ey, ez, left, tags)
            power *= math.exp(-(scattering + absorption) * t)
        x, y, z = x + t * dx, y + t * dy, z + t * dz
        if is_opaque(s, code, index):
            patch, u, v = locate(s, code, index, owner, x, y, z)
            _add(m, texel(m, patch, u, v, 0.0), power, tags)
            share = SPAWN * power / full_power
            _bounce(s, m, state, medium, inside, x, y, z, dx, dy, dz, code, index, owner, power, share, tags)
            return
        if power < LEAST_SHARE * full_power:
            if uniform(state) > SURVIVAL:
                return
            power /= SURVIVAL


@kernel
def _bounce(s, m, state, medium, inside, x, y, z, dx, dy, dz, code, index, owner, power, share, tags):
    """Send a share of the photons that a surface scatters on as walkers of accordingly more power."""
    if uniform(state) >= share:
        return
    nx, ny, nz = normal_at(s, code, index, owner, x, y, z)
    if dx * nx + dy * ny + dz * nz > 0.0:
        nx, ny, nz = -nx, -ny, -nz
    material = material_of(s, code, index, owner)
    dx, dy, dz, weight = bounced(s, state, material, medium != AIR, dx, dy, dz, nx, ny, nz)
    if weight > 0.0:
        x, y, z = x + START_OFF_M * nx, y + START_OFF_M * ny, z + START_OFF_M * nz
        _walk(s, m, state, medium, inside, x, y, z, dx, dy, dz, power * weight / share, tags)


@kernel
def _walk(s, m, state, medium, inside, x, y, z, dx, dy, dz, power, tags):
    """Follow scattered light until it leaves the scene or is absorbed; it adds to the walls that it crosses."""
    least = LEAST_SHARE * power
    for _ in range(MAX_WALK):
        t, code, index, owner = next_hit(s, medium, inside, x, y, z, dx, dy, dz)
        if code == NOTHING:
            return
        if medium != AIR:
            scattering, absorption = attenuation(s, medium, inside)
            free = -math.log(1.0 - uniform(state)) / scattering if scattering > 0.0 else t
            flight = min(free, t)
            if medium == PLASTIC:
                _leave_track(s, m, state, inside, x, y, z, dx, dy, dz, flight, absorption, power, tags)
            power *= math.exp(-absorption * flight)
            if free < t:
                x, y, z = x + free * dx, y + free * dy, z + free * dz
                dx, dy, dz = any_direction(state)
                continue
        x, y, z = x + t * dx, y + t * dy, z + t * dz
        nx, ny, nz = normal_at(s, code, index, owner, x, y, z)
        if not is_opaque(s, code, index):
            dx, dy, dz, medium = cross(s, state, code, index, owner, x, y, z, dx, dy, dz, nx, ny, nz)
            inside = owner
        else:
            if dx * nx + dy * ny + dz * nz > 0.0:
                nx, ny, nz = -nx, -ny, -nz
            material = material_of(s, code, index, owner)
            dx, dy, dz, weight = bounced(s, state, material, medium != AIR, dx, dy, dz, nx, ny, nz)
            if uniform(state) >= weight:
                return
            power *= max(weight, 1.0)
            x, y, z = x + START_OFF_M * nx, y + START_OFF_M * ny, z + START_OFF_M * nz
        if power < least:
            if uniform(state) > SURVIVAL:
                return
            power /= SURVIVAL


@kernel
def _leave_track(s, m, state, inside, x, y, z, dx, dy, dz, length, extinction, power, tags):
    """Add power times track length to the texels of a wall, at random points of the track's equal parts."""
    ox, oy, oz = into(s, inside, x, y, z)
    ex, ey, ez = turned_into(s, inside, dx, dy, dz)
    patch = wall_patch(s, inside)
    count = min(1 + int(length / TRACK_STEP_M), MAX_TRACK_POINTS)
    part = length / count
    for i in range(count):
        along = (i + uniform(state)) * part
        qx, qy, qz = ox + along * ex, oy + along * ey, oz + along * ez
        depth = wall_depth(s, inside, math.sqrt(qx * qx + qy * qy), qz)
        _add(m, texel(m, patch, math.atan2(qy, qx), qz, depth), power * part * math.exp(-extinction * along), tags)


@kernel
def _add(m, place, power, tags):
    if place < 0:
        return
    row = m.light[place]
    row[0] += power
    for i in range(6):
        row[1 + i] += power * tags[i]
