"""The light that plastic sent somewhere: a map of texels over every opaque surface and through every see-through wall.

Photons add their power, tagged with their projector column, to the texel they meet; camera paths read it back, linearly
interpolated, as power over area (or, in walls, as power times track length over volume: the fluence). Power and area
are interpolated apart, so that a texel that lies half over an edge is not dark.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tubepose.simulation.structured_light.codes import BOX, FLAT, RACK_SIDE, RACK_TOP, REVOLVED, WELL_FLOOR, WELL_WALL
from tubepose.simulation.structured_light.compiled import inlined, kernel
from tubepose.simulation.structured_light.intersection import into
from tubepose.simulation.structured_light.parts import PROFILE_STEP_M
from tubepose.simulation.structured_light.rack_intersection import well_normal
from tubepose.simulation.structured_light.shapes import Shapes
from tubepose.transforms import FloatArray

Float32Array = NDArray[np.float32]

TEXEL_M = 1.0e-3
TABLE_TEXEL_M = 2.0e-3
TABLE_MARGIN_M = 0.15
LAYERS = 2
LIGHT_CHANNELS = 7
_SUB = 8


class LightMap(NamedTuple):
    """Texels of all patches in one array.

    Attributes:
        patches: First texel, texels along u and v, layers, 1 if u goes round; shape (P, 5). Patches are, in order:
            table, rack top, four rack sides, five per slot (the walls that face +x, -x, +y, -y, and the floor), six per
            box, one per segment, one per solid (its wall).
        scale: Least u, texels per u, least v, texels per v, shape (P, 4); u and v are metres or radians.
        light: Power, its cosine and sine sums for the three periods, and the area (volume) that belongs to the texel,
            shape (T, 8).
    """

    patches: NDArray[np.int64]
    scale: FloatArray
    light: Float32Array


def make_light_map(s: Shapes) -> LightMap:
    """A dark map of a scene."""
    rows: list[tuple[int, int, int, int]] = []
    scales: list[tuple[float, float, float, float]] = []
    areas: list[FloatArray] = []

    def add(
        u: tuple[float, float], v: tuple[float, float], nu: int, nv: int, area: FloatArray, wrap: bool = False
    ) -> None:
        """`area` has shape (nv, nu) or (layers, nv, nu)."""
        layers = 1 if area.ndim == 2 else area.shape[0]
        rows.append((nu, nv, layers, int(wrap)))
        scales.append((u[0], nu / max(u[1] - u[0], 1e-9), v[0], nv / max(v[1] - v[0], 1e-9)))
        areas.append(area.reshape(-1))

    def flat(u: tuple[float, float], v: tuple[float, float], texel: float = TEXEL_M) -> None:
        nu, nv = _count(u[1] - u[0], texel), _count(v[1] - v[0], texel)
        add(u, v, nu, nv, np.full((nv, nu), (u[1] - u[0]) * (v[1] - v[0]) / (nu * nv)))

    reach = [float(half) + TABLE_MARGIN_M for half in s.rack[:2]]
    flat((-reach[0], reach[0]), (-reach[1], reach[1]), TABLE_TEXEL_M)
    half_x, half_y, height, floor = (float(value) for value in s.rack)
    nu, nv = _count(2 * half_x), _count(2 * half_y)
    solid = _solid_share(s, nu, nv)
    add((-half_x, half_x), (-half_y, half_y), nu, nv, solid * 4 * half_x * half_y / (nu * nv))
    for half in (half_y, half_y, half_x, half_x):
        flat((-half, half), (0.0, height), TABLE_TEXEL_M)
    for slot in s.slots:
        for side in range(4):
            half = float(slot[3] if side < 2 else slot[2])
            n, deep = _count(2 * half), _count(height - floor)
            along = _wall_lengths(slot, side, n)
            add((-half, half), (floor, height), n, deep, np.tile(along * (height - floor) / deep, (deep, 1)))
        n, m = _count(2 * float(slot[2])), _count(2 * float(slot[3]))
        inside = _opening_share(slot, n, m)
        add((-slot[2], slot[2]), (-slot[3], slot[3]), n, m, inside * 4 * slot[2] * slot[3] / (n * m))
    for box in s.boxes:
        for face in range(6):
            a, b = [float(box[12 + axis]) for axis in range(3) if axis != face // 2]
            flat((-a, a), (-b, b))
    for seg in s.segments:
        nu, nv, v, area = _ring_texels(seg)
        add((-math.pi, math.pi), v, nu, nv, area, wrap=True)
    for k in range(len(s.solids)):
        profile = s.profiles[s.profile_start[k] : s.profile_start[k + 1]]
        nu, nv, area = _wall_texels(profile)
        add((-math.pi, math.pi), (0.0, max(len(profile), 1) * PROFILE_STEP_M), nu, nv, area, wrap=True)
    first = np.concatenate([[0], np.cumsum([len(area) for area in areas])])
    patches = np.column_stack([first[:-1], np.array(rows)]).astype(np.int64)
    light = np.zeros((int(first[-1]), LIGHT_CHANNELS + 1), dtype=np.float32)
    light[:, LIGHT_CHANNELS] = np.concatenate(areas)
    return LightMap(patches, np.array(scales), light)


def _count(length: float, texel: float = TEXEL_M) -> int:
    return max(1, math.ceil(length / texel - 1e-6))


def _solid_share(s: Shapes, nu: int, nv: int) -> FloatArray:
    """Share of each texel of the rack's top that is no opening, shape (nv, nu)."""
    x = ((np.arange(nu * _SUB) + 0.5) / (nu * _SUB) * 2 - 1) * s.rack[0]
    y = ((np.arange(nv * _SUB) + 0.5) / (nv * _SUB) * 2 - 1) * s.rack[1]
    open_ = np.zeros((len(y), len(x)), dtype=bool)
    for slot in s.slots:
        columns = slice(*np.searchsorted(x, [slot[0] - slot[2], slot[0] + slot[2]]))
        rows = slice(*np.searchsorted(y, [slot[1] - slot[3], slot[1] + slot[3]]))
        open_[rows, columns] |= _in_opening(slot, x[None, columns] - slot[0], y[rows, None] - slot[1])
    return _blocks(~open_, nu, nv)


def _opening_share(slot: FloatArray, nu: int, nv: int) -> FloatArray:
    x = ((np.arange(nu * _SUB) + 0.5) / (nu * _SUB) * 2 - 1) * slot[2]
    y = ((np.arange(nv * _SUB) + 0.5) / (nv * _SUB) * 2 - 1) * slot[3]
    return _blocks(_in_opening(slot, x[None, :], y[:, None]), nu, nv)


def _blocks(mask: NDArray[np.bool_], nu: int, nv: int) -> FloatArray:
    return np.asarray(mask.reshape(nv, _SUB, nu, _SUB).mean(axis=(1, 3)))


def _in_opening(slot: FloatArray, qx: FloatArray, qy: FloatArray) -> NDArray[np.bool_]:
    px, py = np.abs(qx) - (slot[2] - slot[4]), np.abs(qy) - (slot[3] - slot[4])
    corner = np.hypot(np.maximum(px, 0), np.maximum(py, 0)) < slot[4]
    side = (np.maximum(px, py) < slot[4]) & (np.minimum(px, py) <= 0)
    return np.asarray(corner | side, dtype=bool)


def _wall_lengths(slot: FloatArray, side: int, n: int) -> FloatArray:
    """Length of a well's wall in each texel along one of its four sides, shape (n,): rounded corners are longer."""
    half_u, radius = float(slot[3] if side < 2 else slot[2]), float(slot[4])
    edges = np.linspace(-half_u, half_u, n + 1)

    def length(u: FloatArray) -> FloatArray:
        """Length from the middle of the side out to u, with the corner as far as it belongs to this side (45 deg)."""
        straight = half_u - radius
        beyond = np.clip(np.abs(u) - straight, 0.0, radius * np.sin(np.pi / 4))
        arc = radius * np.arcsin(beyond / radius) if radius > 0 else 0.0 * beyond
        return np.asarray(np.sign(u) * (np.minimum(np.abs(u), straight) + arc))

    return np.diff(length(edges))


def _ring_texels(seg: FloatArray) -> tuple[int, int, tuple[float, float], FloatArray]:
    """Texels (azimuth, v) of a segment and their areas; v is r of a flat ring, z of anything else."""
    r0, r1 = float(seg[2]), float(seg[4])
    if seg[0] == FLAT:
        low, high = min(r0, r1), max(r0, r1)
    else:
        low, high = float(min(seg[1], seg[3])), float(max(seg[1], seg[3]))
    widest = max(r0, r1)
    nu, nv = _count(2 * math.pi * widest), _count(high - low)
    edges = np.linspace(low, high, nv + 1)
    middle = (edges[:-1] + edges[1:]) / 2
    step = (high - low) / nv
    if seg[0] == FLAT:
        ring = math.pi * np.diff(edges**2)
    elif seg[0] == 2:
        ring = np.full(nv, 2 * math.pi * float(seg[6]) * step)
    else:
        radius = r0 + seg[5] * (middle - seg[1])
        ring = 2 * math.pi * radius * step * math.sqrt(1 + seg[5] ** 2)
    return nu, nv, (low, high), np.tile(ring[:, None] / nu, (1, nu))


def _wall_texels(profile: FloatArray) -> tuple[int, int, FloatArray]:
    """Texels (azimuth, z) of a body's wall and their volumes per layer, shape (layers, nv, nu)."""
    if len(profile) == 0:
        return 1, 1, np.zeros((LAYERS, 1, 1))
    length = len(profile) * PROFILE_STEP_M
    nu, nv = _count(2 * math.pi * float(profile[:, 0].max())), _count(length)
    row = np.minimum(((np.arange(len(profile)) + 0.5) / len(profile) * nv).astype(int), nv - 1)
    volumes = []
    for layer in range(LAYERS):
        inner = profile[:, 1] + (profile[:, 0] - profile[:, 1]) * layer / LAYERS
        outer = profile[:, 1] + (profile[:, 0] - profile[:, 1]) * (layer + 1) / LAYERS
        slices = math.pi * np.clip(outer**2 - inner**2, 0.0, None) * PROFILE_STEP_M
        volumes.append(np.bincount(row, weights=slices, minlength=nv))
    return nu, nv, np.repeat(np.array(volumes)[:, :, None] / nu, nu, axis=2)


@inlined
def locate(s, code, index, owner, x, y, z):
    """Patch and its coordinates u, v of a hit on an opaque surface, rack frame."""
    if code == RACK_TOP:
        return 1, x, y
    if code == RACK_SIDE:
        return 2 + index, y if index < 2 else x, z
    slots, boxes = len(s.slots), len(s.boxes)
    if code == WELL_WALL:
        nx, ny = well_normal(s, index, x, y)
        first = 6 + 5 * index
        if abs(nx) >= abs(ny):
            return first + (0 if nx > 0.0 else 1), y - s.slots[index, 1], z
        return first + (2 if ny > 0.0 else 3), x - s.slots[index, 0], z
    if code == WELL_FLOOR:
        return 6 + 5 * index + 4, x - s.slots[index, 0], y - s.slots[index, 1]
    if code == BOX:
        m, axis = s.boxes[owner], index // 2
        a, b = (1, 2) if axis == 0 else ((0, 2) if axis == 1 else (0, 1))
        u = m[3 * a] * x + m[3 * a + 1] * y + m[3 * a + 2] * z + m[9 + a]
        v = m[3 * b] * x + m[3 * b + 1] * y + m[3 * b + 2] * z + m[9 + b]
        return 6 + 5 * slots + 6 * owner + index, u, v
    if code == REVOLVED:
        px, py, pz = into(s, owner, x, y, z)
        v = math.sqrt(px * px + py * py) if s.segments[index, 0] == FLAT else pz
        return 6 + 5 * slots + 6 * boxes + index, math.atan2(py, px), v
    return 0, x, y


@inlined
def wall_patch(s, k):
    """The patch of the wall of solid k."""
    return 6 + 5 * len(s.slots) + 6 * len(s.boxes) + len(s.segments) + k


@inlined
def wall_depth(s, k, r, z):
    """Where a point of the object frame lies in the wall of solid k: 0 at the cavity, 1 outside."""
    first, last = s.profile_start[k], s.profile_start[k + 1] - 1
    row = min(max(first + int(z / PROFILE_STEP_M), first), last)
    outer, inner = s.profiles[row, 0], s.profiles[row, 1]
    return min(max((r - inner) / max(outer - inner, 1e-9), 0.0), 1.0)


@inlined
def texel(m, patch, u, v, w):
    """The texel that holds a point, or -1 outside the patch."""
    nu, nv, layers = m.patches[patch, 1], m.patches[patch, 2], m.patches[patch, 3]
    i = int(math.floor((u - m.scale[patch, 0]) * m.scale[patch, 1]))
    j = int(math.floor((v - m.scale[patch, 2]) * m.scale[patch, 3]))
    if i < -1 or j < -1 or i > nu or j > nv:
        return -1
    i, j = min(max(i, 0), nu - 1), min(max(j, 0), nv - 1)
    layer = min(int(w * layers), layers - 1)
    return m.patches[patch, 0] + (layer * nv + j) * nu + i


@kernel
def gather(m, patch, u, v, w, weight, sums):
    """Add `weight` times the map's power per area (fluence) at a point to sums (8,): power, -, cosines and sines."""
    nu, nv, layers = m.patches[patch, 1], m.patches[patch, 2], m.patches[patch, 3]
    first, wraps = m.patches[patch, 0], m.patches[patch, 4] == 1
    a = (u - m.scale[patch, 0]) * m.scale[patch, 1] - 0.5
    b = (v - m.scale[patch, 2]) * m.scale[patch, 3] - 0.5
    c = w * layers - 0.5
    if a < -1.5 or b < -1.5 or a > nu + 0.5 or b > nv + 0.5:
        return
    i0, j0, k0 = int(math.floor(a)), int(math.floor(b)), int(math.floor(c))
    fa, fb, fc = a - i0, b - j0, c - k0
    area = p0 = p1 = p2 = p3 = p4 = p5 = p6 = 0.0
    for k in range(2 if layers > 1 else 1):
        layer = min(max(k0 + k, 0), layers - 1)
        share_k = 1.0 if layers == 1 else (fc if k == 1 else 1.0 - fc)
        for j in range(2):
            row = min(max(j0 + j, 0), nv - 1)
            share_j = share_k * (fb if j == 1 else 1.0 - fb)
            for i in range(2):
                column = (i0 + i) % nu if wraps else min(max(i0 + i, 0), nu - 1)
                share = share_j * (fa if i == 1 else 1.0 - fa)
                texel_ = m.light[first + (layer * nv + row) * nu + column]
                area += share * texel_[7]
                p0 += share * texel_[0]
                p1 += share * texel_[1]
                p2 += share * texel_[2]
                p3 += share * texel_[3]
                p4 += share * texel_[4]
                p5 += share * texel_[5]
                p6 += share * texel_[6]
    if p0 <= 0.0 or area <= 0.0:
        return
    scale = weight / area
    sums[0] += scale * p0
    sums[2] += scale * p1
    sums[3] += scale * p2
    sums[4] += scale * p3
    sums[5] += scale * p4
    sums[6] += scale * p5
    sums[7] += scale * p6
