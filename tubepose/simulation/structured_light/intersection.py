"""Rays against the analytic shapes of a scene: the nearest hit, its normal, and whether a straight line is free.

Compiled by Numba. `s` is a `Shapes`; rays start at (ox, oy, oz) in the rack frame, metres, with unit directions.
"""

from __future__ import annotations

import math

from tubepose.simulation.structured_light.codes import (
    BOX,
    FLAT,
    LINE,
    LIQUID,
    NOTHING,
    RACK_SIDE,
    REVOLVED,
    SPHERE,
    TABLE,
    WELL_WALL,
)
from tubepose.simulation.structured_light.compiled import inlined, kernel
from tubepose.simulation.structured_light.rack_intersection import hit_rack, well_normal

# Hits nearer than this are the surface that the ray leaves.
NEAREST_M = 1e-7
_FAR = 1e30


@inlined
def _hit_segment(seg, ox, oy, oz, dx, dy, dz, limit):
    """Distance to one segment of a surface of revolution about z, object frame; `limit` or more is no hit."""
    kind = seg[0]
    low, high = min(seg[1], seg[3]), max(seg[1], seg[3])
    if kind == FLAT:
        if abs(dz) < 1e-14:
            return _FAR
        t = (seg[1] - oz) / dz
        if t < NEAREST_M or t >= limit:
            return _FAR
        x, y = ox + t * dx, oy + t * dy
        r2 = x * x + y * y
        inner, outer = min(seg[2], seg[4]), max(seg[2], seg[4])
        return t if inner * inner <= r2 <= outer * outer else _FAR
    if kind == SPHERE:
        z = oz - seg[5]
        a, b, c = 1.0, ox * dx + oy * dy + z * dz, ox * ox + oy * oy + z * z - seg[6] * seg[6]
    else:
        slope = seg[5]
        r = seg[2] + slope * (oz - seg[1])
        a = dx * dx + dy * dy - slope * slope * dz * dz
        b = ox * dx + oy * dy - slope * dz * r
        c = ox * ox + oy * oy - r * r
    disc = b * b - a * c
    if disc < 0.0:
        return _FAR
    q = -(b + math.copysign(math.sqrt(disc), b))
    t1 = q / a if abs(a) > 1e-14 else _FAR
    t2 = c / q if abs(q) > 1e-300 else _FAR
    if t1 > t2:
        t1, t2 = t2, t1
    for i in range(2):
        t = t1 if i == 0 else t2
        if t < NEAREST_M or t >= limit:
            continue
        z = oz + t * dz
        if z < low or z > high:
            continue
        if kind == LINE and seg[2] + seg[5] * (z - seg[1]) < 0.0:
            continue
        if seg[10] < 6.2831:
            angle = math.atan2(oy + t * dy, ox + t * dx) - seg[9]
            angle -= 2.0 * math.pi * math.floor(angle / (2.0 * math.pi))
            if angle > seg[10]:
                continue
        return t
    return _FAR


@inlined
def hit_own(s, k, ox, oy, oz, dx, dy, dz, limit):
    """Distance and segment of one solid of revolution, object frame; segment -2 is the surface of its liquid."""
    best, found = limit, -1
    for i in range(s.segment_start[k], s.segment_start[k + 1]):
        t = _hit_segment(s.segments[i], ox, oy, oz, dx, dy, dz, best)
        if t < best:
            best, found = t, i
    if s.solids[k, 18] > 0.0:
        gx, gy, gz = s.solids[k, 20], s.solids[k, 21], s.solids[k, 22]
        along = gx * dx + gy * dy + gz * dz
        if abs(along) > 1e-14:
            t = -(gx * ox + gy * oy + gz * (oz - s.solids[k, 19])) / along
            if NEAREST_M < t < best:
                x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
                r = s.solids[k, 26] + s.solids[k, 27] * (z - s.solids[k, 25])
                if x * x + y * y < r * r:
                    best, found = t, -2
    return best, found


@inlined
def into(s, k, x, y, z):
    """A point of the rack frame in the frame of solid k."""
    m = s.solids[k]
    return (
        m[0] * x + m[1] * y + m[2] * z + m[9],
        m[3] * x + m[4] * y + m[5] * z + m[10],
        m[6] * x + m[7] * y + m[8] * z + m[11],
    )


@inlined
def turned_into(s, k, x, y, z):
    """A direction of the rack frame in the frame of solid k."""
    m = s.solids[k]
    return m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z


@inlined
def turned_back(s, k, x, y, z):
    """A direction of the frame of solid k in the rack frame."""
    m = s.solids[k]
    return m[0] * x + m[3] * y + m[6] * z, m[1] * x + m[4] * y + m[7] * z, m[2] * x + m[5] * y + m[8] * z


@inlined
def _hit_solid(s, k, ox, oy, oz, dx, dy, dz, limit):
    px, py, pz = into(s, k, ox, oy, oz)
    ex, ey, ez = turned_into(s, k, dx, dy, dz)
    b, c = px * ex + py * ey, px * px + py * py - s.solids[k, 12] * s.solids[k, 12]
    if c > 0.0 and (b > 0.0 or b * b < (ex * ex + ey * ey) * c):
        return _FAR, -1
    if (pz > s.solids[k, 14] and ez >= 0.0) or (pz < s.solids[k, 13] and ez <= 0.0):
        return _FAR, -1
    return hit_own(s, k, px, py, pz, ex, ey, ez, limit)


@inlined
def _hit_box(s, k, ox, oy, oz, dx, dy, dz, limit):
    """Distance and face (2 axis + (0 for the low side, 1 for the high one)) of a box, seen from outside or inside."""
    m = s.boxes[k]
    enter, leave, first, last = -_FAR, _FAR, -1, -1
    for i in range(3):
        o = m[3 * i] * ox + m[3 * i + 1] * oy + m[3 * i + 2] * oz + m[9 + i]
        d = m[3 * i] * dx + m[3 * i + 1] * dy + m[3 * i + 2] * dz
        half = m[12 + i]
        if abs(d) < 1e-14:
            if abs(o) > half:
                return _FAR, -1
            continue
        near, far = (-half - o) / d, (half - o) / d
        low, high = 2 * i, 2 * i + 1
        if near > far:
            near, far, low, high = far, near, high, low
        if near > enter:
            enter, first = near, low
        if far < leave:
            leave, last = far, high
    if enter > leave:
        return _FAR, -1
    if NEAREST_M < enter < limit:
        return enter, first
    if NEAREST_M < leave < limit:
        return leave, last
    return _FAR, -1


@kernel
def _hit_items(s, ox, oy, oz, dx, dy, dz, limit, any_hit):
    """Nearest tube, cap or box: distance, code, segment or face, solid or box. Walks the cells under the ray."""
    best, code, index, owner = limit, NOTHING, -1, -1
    t0, t1 = 0.0, limit
    # Clip to the box that holds all items.
    for i in range(3):
        o, d = (ox, dx) if i == 0 else ((oy, dy) if i == 1 else (oz, dz))
        low, high = s.item_bounds[i, 0], s.item_bounds[i, 1]
        if abs(d) < 1e-14:
            if o < low or o > high:
                return best, code, index, owner
            continue
        near, far = (low - o) / d, (high - o) / d
        if near > far:
            near, far = far, near
        t0, t1 = max(t0, near), min(t1, far)
    if t0 >= t1:
        return best, code, index, owner
    size, columns, rows = s.grid[2], s.cells[0], s.cells[1]
    x, y = (ox + t0 * dx - s.grid[0]) / size, (oy + t0 * dy - s.grid[1]) / size
    column = min(max(int(math.floor(x)), 0), columns - 1)
    row = min(max(int(math.floor(y)), 0), rows - 1)
    step_x, step_y = (1 if dx > 0.0 else -1), (1 if dy > 0.0 else -1)
    per_x = size / abs(dx) if abs(dx) > 1e-14 else _FAR
    per_y = size / abs(dy) if abs(dy) > 1e-14 else _FAR
    next_x = t0 + ((column + 1 - x) if dx > 0.0 else (x - column)) * per_x if per_x < _FAR else _FAR
    next_y = t0 + ((row + 1 - y) if dy > 0.0 else (y - row)) * per_y if per_y < _FAR else _FAR
    while True:
        cell = row * columns + column
        for i in range(s.item_start[cell], s.item_start[cell + 1]):
            item = s.item_list[i]
            if item < len(s.solids):
                t, found = _hit_solid(s, item, ox, oy, oz, dx, dy, dz, best)
                if found != -1:
                    best, code, index, owner = t, REVOLVED if found >= 0 else LIQUID, found, item
            else:
                t, found = _hit_box(s, item - len(s.solids), ox, oy, oz, dx, dy, dz, best)
                if found != -1:
                    best, code, index, owner = t, BOX, found, item - len(s.solids)
            if any_hit and code != NOTHING:
                return best, code, index, owner
        leave = min(next_x, next_y)
        if best <= leave or leave >= t1:
            return best, code, index, owner
        if next_x < next_y:
            column, next_x = column + step_x, next_x + per_x
        else:
            row, next_y = row + step_y, next_y + per_y
        if column < 0 or row < 0 or column >= columns or row >= rows:
            return best, code, index, owner


@kernel
def closest(s, ox, oy, oz, dx, dy, dz):
    """First surface that a ray meets: distance, code, index (segment, face, slot or side), owner (solid or box)."""
    best, code, index = hit_rack(s, ox, oy, oz, dx, dy, dz)
    if dz < 0.0 and oz > 1e-9 and s.table[0] > 0.0:
        t = -oz / dz
        if t < best and abs(ox + t * dx) < s.table[0] and abs(oy + t * dy) < s.table[0]:
            best, code = t, TABLE
    t, found, part, item = _hit_items(s, ox, oy, oz, dx, dy, dz, best, False)
    if found != NOTHING:
        return t, found, part, item
    return best, code, index, -1


@kernel
def blocked(s, ox, oy, oz, dx, dy, dz, distance):
    """Whether anything, see-through or not, lies on the way within a distance."""
    if hit_rack(s, ox, oy, oz, dx, dy, dz)[0] < distance:
        return True
    return _hit_items(s, ox, oy, oz, dx, dy, dz, distance, True)[1] != NOTHING


@inlined
def segment_normal(s, i, x, y, z):
    """Unit normal out of the solid at a point of segment i, object frame."""
    seg = s.segments[i]
    if seg[0] == SPHERE:
        k = seg[7] / seg[6]
        return x * k, y * k, (z - seg[5]) * k
    if seg[0] == FLAT:
        return 0.0, 0.0, seg[8]
    k = seg[7] / max(math.sqrt(x * x + y * y), 1e-12)
    return x * k, y * k, seg[8]


@kernel
def normal_at(s, code, index, owner, x, y, z):
    """Unit normal of a hit in the rack frame; out of a solid, up from a liquid."""
    if code == REVOLVED:
        px, py, pz = into(s, owner, x, y, z)
        nx, ny, nz = segment_normal(s, index, px, py, pz)
        return turned_back(s, owner, nx, ny, nz)
    if code == WELL_WALL:
        nx, ny = well_normal(s, index, x, y)
        return nx, ny, 0.0
    if code == RACK_SIDE:
        sign = 1.0 if index % 2 == 0 else -1.0
        return (sign, 0.0, 0.0) if index < 2 else (0.0, sign, 0.0)
    if code == BOX:
        m, axis = s.boxes[owner], index // 2
        sign = -1.0 if index % 2 == 0 else 1.0
        return sign * m[3 * axis], sign * m[3 * axis + 1], sign * m[3 * axis + 2]
    return 0.0, 0.0, 1.0


@kernel
def first_hits(s, origins, directions, distance, code, index, owner):
    """Fill what N rays meet first; arrays of shape (N, 3) in, (N,) out. A miss has the code NOTHING."""
    for i in range(len(origins)):
        o, d = origins[i], directions[i]
        distance[i], code[i], index[i], owner[i] = closest(s, o[0], o[1], o[2], d[0], d[1], d[2])
