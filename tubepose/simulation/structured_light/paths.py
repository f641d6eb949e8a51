"""Camera paths: light followed backwards from a pixel, collecting projector light at every scattering.

At each opaque surface that a path meets it adds the projector's light that arrives there straight through air, and the
light that photons brought through plastic (`photons`). Then it goes on in a random direction: reflections between
surfaces are of any order. In a wall it adds the wall's fluence along the way and goes on, weaker: what the wall
scatters is all in the fluence. A path that leaves the scene meets the room's light.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from tubepose.simulation.structured_light.codes import NOTHING, REVOLVED
from tubepose.simulation.structured_light.compiled import kernel
from tubepose.simulation.structured_light.interfaces import (
    AIR,
    PLASTIC,
    START_OFF_M,
    attenuation,
    bounced,
    coat_of,
    cross,
    index_of,
    is_opaque,
    material_of,
    next_hit,
)
from tubepose.simulation.structured_light.intersection import blocked, into, normal_at, turned_into
from tubepose.simulation.structured_light.light_map import gather, locate, wall_depth, wall_patch
from tubepose.simulation.structured_light.optics import (
    COAT_INDEX,
    ggx_towards,
    start,
    uniform,
)
from tubepose.simulation.structured_light.projector import tagged, towards
from tubepose.transforms import FloatArray

MAX_EVENTS = 200
FREE_BOUNCES = 0
DIM, SURVIVAL = 0.05, 0.25
# The room's light inside a wall, as a share of what it is in the open (an assumption): photons carry none of it.
ROOM_IN_WALLS = 0.6


@kernel
def _add_direct(s, projector, x, y, z, nx, ny, nz, ox, oy, oz, diffuse, alpha, index, weight, sums, tags):
    """Add projector light that reaches a surface straight through air; `diffuse` is its BRDF's matte part.

    `alpha` and `index` are those of its gloss, if `alpha` is not negative; `o` points back along the path.
    """
    ix, iy, iz, distance, column = towards(projector, x, y, z)
    cosine = ix * nx + iy * ny + iz * nz
    if column < 0.0 or cosine <= 0.0:
        return
    reflected = diffuse
    if alpha >= 0.0:
        reflected += ggx_towards(ox, oy, oz, ix, iy, iz, nx, ny, nz, alpha, index)
    amplitude = weight * reflected * cosine * projector.numbers[3] / (distance * distance)
    sx, sy, sz = x + START_OFF_M * nx, y + START_OFF_M * ny, z + START_OFF_M * nz
    if amplitude <= 0.0 or blocked(s, sx, sy, sz, ix, iy, iz, distance):
        return
    tagged(column, tags)
    sums[0] += amplitude
    for i in range(6):
        sums[2 + i] += amplitude * tags[i]


@kernel
def trace(s, m, projector, state, ox, oy, oz, dx, dy, dz, sums, tags):
    """Follow one camera path from a point in air and add what it collects to sums (8,).

    Args:
        s: The scene.
        m: Its light map.
        projector: The light.
        state: Random numbers.
        ox: Start of the path, rack frame.
        oy: See ox.
        oz: See ox.
        dx: Unit direction.
        dy: See dx.
        dz: See dx.
        sums: Projected light, room light, cosine and sine of each period.
        tags: Scratch, shape (6,).
    """
    weight, medium, inside, bounces = 1.0, AIR, -1, 0
    for event in range(MAX_EVENTS):
        t, code, index, owner = next_hit(s, medium, inside, ox, oy, oz, dx, dy, dz)
        if code == NOTHING:
            if medium == AIR and event > 0:
                sums[1] += weight
            return
        if medium != AIR:
            scattering, absorption = attenuation(s, medium, inside)
            if medium == PLASTIC and scattering > 0.0:
                _add_wall(s, m, state, inside, ox, oy, oz, dx, dy, dz, t, scattering, absorption, weight, sums)
                sums[1] += weight * (1.0 - math.exp(-scattering * t)) * ROOM_IN_WALLS
            weight *= math.exp(-(scattering + absorption) * t)
        ox, oy, oz = ox + t * dx, oy + t * dy, oz + t * dz
        nx, ny, nz = normal_at(s, code, index, owner, ox, oy, oz)
        if not is_opaque(s, code, index):
            if bounces == 0 and medium == AIR and code == REVOLVED:
                # The projector in the wall's gloss: photons cannot bring it, they would have to hit the camera.
                alpha = s.wall_roughness[0]
                if dx * nx + dy * ny + dz * nz < 0.0:
                    _add_direct(
                        s,
                        projector,
                        ox,
                        oy,
                        oz,
                        nx,
                        ny,
                        nz,
                        -dx,
                        -dy,
                        -dz,
                        0.0,
                        alpha,
                        s.solids[owner, 15],
                        weight,
                        sums,
                        tags,
                    )
            dx, dy, dz, medium = cross(s, state, code, index, owner, ox, oy, oz, dx, dy, dz, nx, ny, nz)
            inside = owner
            if weight < DIM:
                if uniform(state) > SURVIVAL:
                    return
                weight /= SURVIVAL
            continue
        if dx * nx + dy * ny + dz * nz > 0.0:
            nx, ny, nz = -nx, -ny, -nz
        material = material_of(s, code, index, owner)
        albedo, alpha = s.materials[material, 0], s.materials[material, 1]
        cos_o = -(dx * nx + dy * ny + dz * nz)
        coat = coat_of(s, material, medium != AIR, cos_o)
        diffuse = (1.0 - coat) * albedo / math.pi
        if medium == AIR:
            gloss = alpha if coat > 0.0 else -1.0
            _add_direct(
                s, projector, ox, oy, oz, nx, ny, nz, -dx, -dy, -dz, diffuse, gloss, COAT_INDEX, weight, sums, tags
            )
        patch, u, v = locate(s, code, index, owner, ox, oy, oz)
        refraction = index_of(s, medium, inside)
        gather(m, patch, u, v, 0.0, weight * diffuse / (refraction * refraction), sums)
        bounces += 1
        dx, dy, dz, share = bounced(s, state, material, medium != AIR, dx, dy, dz, nx, ny, nz)
        weight *= share
        if weight <= 0.0:
            return
        if bounces > FREE_BOUNCES:
            keep = min(0.95, max(weight, 0.1))
            if uniform(state) > keep:
                return
            weight /= keep
        ox, oy, oz = ox + START_OFF_M * nx, oy + START_OFF_M * ny, oz + START_OFF_M * nz


@kernel
def _add_wall(s, m, state, inside, ox, oy, oz, dx, dy, dz, length, scattering, absorption, weight, sums):
    """Add projector light that a wall scatters into the path once: the fluence at one random point of the way."""
    along = uniform(state) * length
    px, py, pz = into(s, inside, ox, oy, oz)
    ex, ey, ez = turned_into(s, inside, dx, dy, dz)
    px, py, pz = px + along * ex, py + along * ey, pz + along * ez
    depth = wall_depth(s, inside, math.sqrt(px * px + py * py), pz)
    index = index_of(s, PLASTIC, inside)
    # Fluence lies in the plastic: radiance shrinks by the index squared on its way out.
    scale = length * scattering * math.exp(-(scattering + absorption) * along) / (4.0 * math.pi * index * index)
    gather(m, wall_patch(s, inside), math.atan2(py, px), pz, depth, weight * scale, sums)


def scratch() -> tuple[NDArray[np.uint64], FloatArray, FloatArray]:
    """Working memory of `radiance` and `expose_pixels`: random state, tags, one path's sums. One per thread."""
    return np.empty(1, dtype=np.uint64), np.empty(6), np.empty(8)


@kernel
def radiance(s, m, projector, origins, directions, samples, seed, sums, squares, state, tags, one):
    """Add `samples` paths along each of N rays to sums (N, 8); squares (N,) get the middle period's squared length.

    The last three arrays are scratch, from `scratch`.
    """
    for i in range(len(origins)):
        for k in range(samples):
            start(state, seed, k, i)
            one[:] = 0.0
            trace(
                s, m, projector, state, origins[i, 0], origins[i, 1], origins[i, 2],
                directions[i, 0], directions[i, 1], directions[i, 2], one, tags,
            )  # fmt: skip
            for c in range(8):
                sums[i, c] += one[c]
            squares[i] += one[4] * one[4] + one[5] * one[5]


@kernel
def expose_pixels(s, m, projector, lens, rotation, pixels, width, side, first, seed, sums, squares, state, tags, one):
    """Add side * side paths, one in each cell of a square grid over the pixel, to the sums of pixels.

    Args:
        s: The scene.
        m: Its light map.
        projector: The light.
        lens: Camera's place (3), focal lengths (2) and principal point (2), shape (7,).
        rotation: Maps camera directions to rack directions, shape (3, 3).
        pixels: Numbers of the pixels, row by row, shape (N,).
        width: Pixels per row.
        side: Cells along a pixel's side.
        first: Number of the first sample: rounds of one pixel must not share any.
        seed: Of the random numbers.
        sums: Shape (pixels of the image, 8).
        squares: Squared length of the middle period's phasors, shape (pixels of the image,).
        state: Scratch, as the two below: from `scratch`.
        tags: Scratch.
        one: Scratch.
    """
    for pixel in pixels:
        for k in range(side * side):
            start(state, seed, first + k, pixel)
            x = pixel % width - 0.5 + (k % side + uniform(state)) / side
            y = pixel // width - 0.5 + (k // side + uniform(state)) / side
            cx, cy = (x - lens[5]) / lens[3], (y - lens[6]) / lens[4]
            scale = 1.0 / math.sqrt(cx * cx + cy * cy + 1.0)
            cx, cy, cz = cx * scale, cy * scale, scale
            dx = rotation[0, 0] * cx + rotation[0, 1] * cy + rotation[0, 2] * cz
            dy = rotation[1, 0] * cx + rotation[1, 1] * cy + rotation[1, 2] * cz
            dz = rotation[2, 0] * cx + rotation[2, 1] * cy + rotation[2, 2] * cz
            one[:] = 0.0
            trace(s, m, projector, state, lens[0], lens[1], lens[2], dx, dy, dz, one, tags)
            for c in range(8):
                sums[pixel, c] += one[c]
            squares[pixel] += one[4] * one[4] + one[5] * one[5]
