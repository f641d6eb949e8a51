"""What light does at surfaces and in plastic: Fresnel, refraction, GGX gloss, and the random numbers of the paths.

All functions are compiled by Numba and work on scalars. Directions are unit vectors; `o` points to where the camera
path comes from, `i` to where light comes from.
"""

from __future__ import annotations

import math

import numpy as np

from tubepose.simulation.structured_light.compiled import inlined, kernel

COAT_INDEX = 1.5
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1, _MIX2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S11, _S27, _S30, _S31 = np.uint64(11), np.uint64(27), np.uint64(30), np.uint64(31)
_TO_UNIT = 1.0 / 9007199254740992.0


@inlined
def mixed(x):
    """64 well-mixed bits of 64 bits (the finaliser of SplitMix64)."""
    x = (x ^ (x >> _S30)) * _MIX1
    x = (x ^ (x >> _S27)) * _MIX2
    return x ^ (x >> _S31)


@inlined
def start(state, seed, stream, number):
    """Set a generator's state (array of one uint64) to the stream of one pixel or photon: no two share numbers."""
    state[0] = mixed(mixed(mixed(np.uint64(seed)) + np.uint64(stream) * _GOLDEN) + np.uint64(number) * _GOLDEN)


@inlined
def uniform(state):
    """Next random number in [0, 1) (SplitMix64)."""
    state[0] = state[0] + _GOLDEN
    return (mixed(state[0]) >> _S11) * _TO_UNIT


@inlined
def fresnel(cos_in, index_in, index_out):
    """Reflected share of unpolarised light at a smooth interface; 1 at total reflection.

    Args:
        cos_in: Cosine of incidence, positive.
        index_in: Refractive index on the side of the ray.
        index_out: Refractive index behind the interface.
    """
    ratio = index_in / index_out
    sin2_out = ratio * ratio * (1.0 - cos_in * cos_in)
    if sin2_out >= 1.0:
        return 1.0
    cos_out = math.sqrt(1.0 - sin2_out)
    across = (index_in * cos_in - index_out * cos_out) / (index_in * cos_in + index_out * cos_out)
    along = (index_in * cos_out - index_out * cos_in) / (index_in * cos_out + index_out * cos_in)
    return 0.5 * (across * across + along * along)


@inlined
def refracted(dx, dy, dz, nx, ny, nz, cos_in, ratio):
    """Direction behind an interface (Snell), no total reflection; `n` faces the ray, `ratio` is index in over out."""
    cos_out = math.sqrt(max(0.0, 1.0 - ratio * ratio * (1.0 - cos_in * cos_in)))
    k = ratio * cos_in - cos_out
    x, y, z = ratio * dx + k * nx, ratio * dy + k * ny, ratio * dz + k * nz
    scale = 1.0 / math.sqrt(x * x + y * y + z * z)
    return x * scale, y * scale, z * scale


@inlined
def frame_of(nx, ny, nz):
    """Two unit vectors across a unit vector (Duff et al., Building an orthonormal basis, revisited)."""
    sign = 1.0 if nz >= 0.0 else -1.0
    a = -1.0 / (sign + nz)
    b = nx * ny * a
    return 1.0 + sign * nx * nx * a, sign * b, -sign * nx, b, sign + ny * ny * a, -ny


@inlined
def cosine_direction(state, nx, ny, nz):
    """Random direction about a normal, its density the cosine over pi."""
    r, phi = math.sqrt(uniform(state)), 2.0 * math.pi * uniform(state)
    x, y = r * math.cos(phi), r * math.sin(phi)
    z = math.sqrt(max(0.0, 1.0 - r * r))
    ax, ay, az, bx, by, bz = frame_of(nx, ny, nz)
    return x * ax + y * bx + z * nx, x * ay + y * by + z * ny, x * az + y * bz + z * nz


@inlined
def any_direction(state):
    """Random direction, uniform over the sphere."""
    z, phi = 2.0 * uniform(state) - 1.0, 2.0 * math.pi * uniform(state)
    r = math.sqrt(max(0.0, 1.0 - z * z))
    return r * math.cos(phi), r * math.sin(phi), z


@inlined
def _smith(cosine, alpha2):
    """Smith's Lambda of GGX."""
    c2 = cosine * cosine
    return 0.5 * (math.sqrt(1.0 + alpha2 * (1.0 - c2) / max(c2, 1e-12)) - 1.0)


@inlined
def ggx(cos_o, cos_i, cos_h, o_dot_h, alpha, index):
    """GGX reflection (BRDF, per steradian) of a dielectric coat (Walter et al. 2007, height-correlated Smith)."""
    alpha2 = alpha * alpha
    d = cos_h * cos_h * (alpha2 - 1.0) + 1.0
    density = alpha2 / (math.pi * d * d)
    shadow = 1.0 / (1.0 + _smith(cos_o, alpha2) + _smith(cos_i, alpha2))
    return fresnel(o_dot_h, 1.0, index) * density * shadow / (4.0 * cos_o * cos_i)


@inlined
def ggx_towards(ox, oy, oz, ix, iy, iz, nx, ny, nz, alpha, index):
    """GGX reflection (BRDF, per steradian) between two directions on the normal's side."""
    hx, hy, hz = ox + ix, oy + iy, oz + iz
    scale = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx * scale, hy * scale, hz * scale
    cos_o, cos_i = ox * nx + oy * ny + oz * nz, ix * nx + iy * ny + iz * nz
    return ggx(cos_o, cos_i, hx * nx + hy * ny + hz * nz, ox * hx + oy * hy + oz * hz, alpha, index)


@kernel
def ggx_direction(state, ox, oy, oz, nx, ny, nz, alpha, index):
    """Random reflection off a GGX coat: direction, and its weight (BRDF times cosine over density); 0 is no direction.

    Half vectors are drawn from those that `o` sees (Heitz 2018).
    """
    ax, ay, az, bx, by, bz = frame_of(nx, ny, nz)
    vx, vy, vz = ox * ax + oy * ay + oz * az, ox * bx + oy * by + oz * bz, ox * nx + oy * ny + oz * nz
    sx, sy, sz = alpha * vx, alpha * vy, vz
    scale = 1.0 / math.sqrt(sx * sx + sy * sy + sz * sz)
    sx, sy, sz = sx * scale, sy * scale, sz * scale
    across2 = sx * sx + sy * sy
    if across2 > 1e-14:
        k = 1.0 / math.sqrt(across2)
        tx, ty = -sy * k, sx * k
    else:
        tx, ty = 1.0, 0.0
    ux, uy, uz = -sz * ty, sz * tx, sx * ty - sy * tx
    r, phi = math.sqrt(uniform(state)), 2.0 * math.pi * uniform(state)
    p, q = r * math.cos(phi), r * math.sin(phi)
    q = 0.5 * (1.0 - sz) * math.sqrt(max(0.0, 1.0 - p * p)) + 0.5 * (1.0 + sz) * q
    w = math.sqrt(max(0.0, 1.0 - p * p - q * q))
    hx = alpha * (p * tx + q * ux + w * sx)
    hy = alpha * (p * ty + q * uy + w * sy)
    hz = max(1e-9, q * uz + w * sz)
    scale = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx * scale, hy * scale, hz * scale
    o_dot_h = vx * hx + vy * hy + vz * hz
    lx, ly, lz = 2.0 * o_dot_h * hx - vx, 2.0 * o_dot_h * hy - vy, 2.0 * o_dot_h * hz - vz
    if lz <= 0.0 or o_dot_h <= 0.0:
        return nx, ny, nz, 0.0
    lo, li = _smith(vz, alpha * alpha), _smith(lz, alpha * alpha)
    weight = fresnel(o_dot_h, 1.0, index) * (1.0 + lo) / (1.0 + lo + li)
    return (
        lx * ax + ly * bx + lz * nx,
        lx * ay + ly * by + lz * ny,
        lx * az + ly * bz + lz * nz,
        weight,
    )
