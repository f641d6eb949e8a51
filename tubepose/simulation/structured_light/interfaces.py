"""Where light passes from one medium into the next: air, the plastic of a wall, liquid. Compiled by Numba."""

from __future__ import annotations

import math

from tubepose.simulation.structured_light.codes import BOX, CAVITY, LIQUID, NOTHING, OPAQUE, REVOLVED, TABLE
from tubepose.simulation.structured_light.compiled import inlined, kernel
from tubepose.simulation.structured_light.intersection import closest, hit_own, into, turned_into
from tubepose.simulation.structured_light.optics import (
    COAT_INDEX,
    cosine_direction,
    fresnel,
    ggx_direction,
    refracted,
    uniform,
)
from tubepose.simulation.structured_light.shapes import RACK_MATERIAL, TABLE_MATERIAL

AIR, PLASTIC, IN_LIQUID = range(3)
START_OFF_M = 1e-7
"""Light leaves an opaque surface from this far off it."""
# Gloss is followed at least this often, and not always: what it shows may be far brighter than the surface.
LEAST_GLOSSY = 0.15
_FAR = 1e30


@kernel
def next_hit(s, medium, inside, ox, oy, oz, dx, dy, dz):
    """First surface that light meets; within plastic or liquid only the solid `inside` can be met."""
    if medium == AIR:
        return closest(s, ox, oy, oz, dx, dy, dz)
    px, py, pz = into(s, inside, ox, oy, oz)
    ex, ey, ez = turned_into(s, inside, dx, dy, dz)
    t, found = hit_own(s, inside, px, py, pz, ex, ey, ez, _FAR)
    if found == -1:
        return t, NOTHING, -1, -1
    return t, REVOLVED if found >= 0 else LIQUID, found, inside


@inlined
def is_opaque(s, code, index):
    """Whether a hit ends at an opaque surface."""
    if code == LIQUID:
        return False
    return code != REVOLVED or s.segment_type[index] == OPAQUE


@inlined
def material_of(s, code, index, owner):
    """Row of `s.materials` of a hit on an opaque surface."""
    if code == TABLE:
        return TABLE_MATERIAL
    if code == REVOLVED:
        return s.segment_material[index]
    if code == BOX:
        return s.box_material[owner]
    return RACK_MATERIAL


@inlined
def coat_of(s, material, wetted, cosine):
    """Share of light that the glossy coat of a surface reflects at a cosine of incidence; 0 for a matte one.

    In contact with plastic or liquid (`wetted`) a surface has no gloss of its own.
    """
    if wetted or s.materials[material, 1] < 0.0:
        return 0.0
    return fresnel(cosine, 1.0, COAT_INDEX)


@kernel
def bounced(s, state, material, wetted, dx, dy, dz, nx, ny, nz):
    """Random direction in which an opaque surface sends light on, and its weight: BRDF times cosine over density.

    The surface is matte under a GGX coat: what the coat reflects is lost to the matte part. `n` faces the light.
    """
    albedo = s.materials[material, 0]
    coat = coat_of(s, material, wetted, -(dx * nx + dy * ny + dz * nz))
    if coat <= 0.0:
        ex, ey, ez = cosine_direction(state, nx, ny, nz)
        return ex, ey, ez, albedo
    glossy = min(max(coat, LEAST_GLOSSY), 1.0 - LEAST_GLOSSY)
    if uniform(state) < glossy:
        alpha = s.materials[material, 1]
        ex, ey, ez, share = ggx_direction(state, -dx, -dy, -dz, nx, ny, nz, alpha, COAT_INDEX)
        return ex, ey, ez, share / glossy
    ex, ey, ez = cosine_direction(state, nx, ny, nz)
    return ex, ey, ez, (1.0 - coat) * albedo / (1.0 - glossy)


@inlined
def attenuation(s, medium, inside):
    """Scattering and absorption coefficient of a medium, per metre."""
    if medium == PLASTIC:
        return s.solids[inside, 16], s.solids[inside, 17]
    if medium == IN_LIQUID:
        return 0.0, s.solids[inside, 24]
    return 0.0, 0.0


@inlined
def index_of(s, medium, inside):
    """Refractive index of a medium."""
    if medium == PLASTIC:
        return s.solids[inside, 15]
    return s.solids[inside, 23] if medium == IN_LIQUID else 1.0


@kernel
def cross(s, state, code, index, owner, x, y, z, dx, dy, dz, nx, ny, nz):
    """Reflect or refract at random at an interface (Fresnel's share).

    Args:
        s: The scene.
        state: Random numbers.
        code: Of the hit, as from `closest`.
        index: Of the hit: the segment.
        owner: Of the hit: the solid.
        x: Where, rack frame.
        y: See x.
        z: See x.
        dx: Unit direction of flight.
        dy: See dx.
        dz: See dx.
        nx: Unit normal out of the plastic, or up from the liquid.
        ny: See nx.
        nz: See nx.

    Returns:
        The new direction and the medium that it leads through.
    """
    cosine = -(dx * nx + dy * ny + dz * nz)
    entering = cosine > 0.0
    if code == LIQUID:
        outer, inner = AIR, IN_LIQUID
    else:
        outer, inner = AIR, PLASTIC
        if s.segment_type[index] == CAVITY and s.solids[owner, 18] > 0.0:
            px, py, pz = into(s, owner, x, y, z)
            m = s.solids[owner]
            if m[20] * px + m[21] * py + m[22] * (pz - m[19]) < 0.0:
                outer = IN_LIQUID
    before, behind = (outer, inner) if entering else (inner, outer)
    if not entering:
        nx, ny, nz, cosine = -nx, -ny, -nz, -cosine
    index_in, index_out = index_of(s, before, owner), index_of(s, behind, owner)
    if uniform(state) < fresnel(cosine, index_in, index_out):
        k = 2.0 * cosine
        x, y, z = dx + k * nx, dy + k * ny, dz + k * nz
        scale = 1.0 / math.sqrt(x * x + y * y + z * z)
        return x * scale, y * scale, z * scale, before
    x, y, z = refracted(dx, dy, dz, nx, ny, nz, cosine, index_in / index_out)
    return x, y, z, behind
