"""Rays against the analytic shapes of a scene: the nearest hit, its normal, and whether a straight line is free.

Compiled by Numba. `s` is a `Shapes`; rays start at (ox, oy, oz) in the rack frame, metres, with unit directions.
"""

from __future__ import annotations

import math

from numba import njit

from tubepose.simulation.structured_light.compiled import COMPILE, INLINE

NOTHING, TABLE, RACK_TOP, RACK_SIDE, WELL_WALL, WELL_FLOOR, REVOLVED, BOX, LIQUID = range(9)
OPAQUE, OUTSIDE, CAVITY = range(3)
LINE, FLAT, SPHERE = range(3)
# Hits nearer than this are the surface that the ray leaves.
NEAREST_M = 1e-7
_TOP_MARGIN_M = 1e-9
_FAR = 1e30


@njit(**INLINE)
def slot_at(s, x, y):
    """The slot whose opening holds a point of the rack frame, or -1."""
    column, row = int(math.floor((x - s.grid[0]) / s.grid[2])), int(math.floor((y - s.grid[1]) / s.grid[2]))
    if column < 0 or row < 0 or column >= s.cells[0] or row >= s.cells[1]:
        return -1
    cell = row * s.cells[0] + column
    for i in range(s.slot_start[cell], s.slot_start[cell + 1]):
        k = s.slot_list[i]
        hx, hy, radius = s.slots[k, 2], s.slots[k, 3], s.slots[k, 4]
        qx, qy = abs(x - s.slots[k, 0]), abs(y - s.slots[k, 1])
        if qx < hx and qy < hy:
            px, py = qx - (hx - radius), qy - (hy - radius)
            if px <= 0.0 or py <= 0.0 or px * px + py * py < radius * radius:
                return k
    return -1


@njit(**INLINE)
def _nearest_slot(s, x, y):
    """The slot whose centre is nearest, in units of its size: for points that rounding has put on a well's wall."""
    best, found = _FAR, -1
    for k in range(len(s.slots)):
        away = max(abs(x - s.slots[k, 0]) / s.slots[k, 2], abs(y - s.slots[k, 1]) / s.slots[k, 3])
        if away < best:
            best, found = away, k
    return found if best < 1.001 else -1


@njit(**INLINE)
def _out_of_well(s, k, ox, oy, oz, dx, dy, dz):
    """Where a ray that is, or comes, inside a well meets its wall or floor: distance and code."""
    hx, hy, radius = s.slots[k, 2], s.slots[k, 3], s.slots[k, 4]
    qx, qy = ox - s.slots[k, 0], oy - s.slots[k, 1]
    tx = ((hx if dx > 0.0 else -hx) - qx) / dx if abs(dx) > 1e-14 else _FAR
    ty = ((hy if dy > 0.0 else -hy) - qy) / dy if abs(dy) > 1e-14 else _FAR
    t = min(tx, ty)
    if radius > 0.0 and t < _FAR:
        px, py = qx + t * dx, qy + t * dy
        if abs(px) > hx - radius and abs(py) > hy - radius:
            mx = qx - (hx - radius if px > 0.0 else radius - hx)
            my = qy - (hy - radius if py > 0.0 else radius - hy)
            a, b, c = dx * dx + dy * dy, mx * dx + my * dy, mx * mx + my * my - radius * radius
            t = (-b + math.sqrt(max(0.0, b * b - a * c))) / a
    if dz < 0.0:
        to_floor = (s.rack[3] - oz) / dz
        if to_floor < t:
            return to_floor, WELL_FLOOR
    if oz + t * dz > s.rack[2]:
        return _FAR, NOTHING
    return t, WELL_WALL


@njit(**COMPILE)
def hit_rack(s, ox, oy, oz, dx, dy, dz):
    """Distance, code and index (slot, or side 0 to 3) of the rack's surface that a ray meets first."""
    hx, hy, height = s.rack[0], s.rack[1], s.rack[2]
    if hx <= 0.0:
        return _FAR, NOTHING, -1
    if oz < height - _TOP_MARGIN_M and abs(ox) < hx - 1e-9 and abs(oy) < hy - 1e-9:
        k = slot_at(s, ox, oy)
        if k < 0:
            k = _nearest_slot(s, ox, oy)
        if k < 0:
            return _FAR, NOTHING, -1
        t, code = _out_of_well(s, k, ox, oy, oz, dx, dy, dz)
        return t, code, k
    enter, leave, axis = -_FAR, _FAR, -1
    for i in range(3):
        o, d = (ox, dx) if i == 0 else ((oy, dy) if i == 1 else (oz, dz))
        low, high = (-hx, hx) if i == 0 else ((-hy, hy) if i == 1 else (0.0, height))
        if abs(d) < 1e-14:
            if o <= low or o >= high:
                return _FAR, NOTHING, -1
            continue
        near, far = (low - o) / d, (high - o) / d
        if near > far:
            near, far = far, near
        if near > enter:
            enter, axis = near, i
        leave = min(leave, far)
    if enter < 1e-9 or enter >= leave:
        return _FAR, NOTHING, -1
    if axis == 2:
        if dz > 0.0:
            return _FAR, NOTHING, -1
        k = slot_at(s, ox + enter * dx, oy + enter * dy)
        if k < 0:
            return enter, RACK_TOP, -1
        t, code = _out_of_well(s, k, ox, oy, oz, dx, dy, dz)
        return t, code, k
    side = 2 * axis + (0 if (dx if axis == 0 else dy) < 0.0 else 1)
    return enter, RACK_SIDE, side


@njit(**INLINE)
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


@njit(**INLINE)
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


@njit(**INLINE)
def into(s, k, x, y, z):
    """A point of the rack frame in the frame of solid k."""
    m = s.solids[k]
    return (
        m[0] * x + m[1] * y + m[2] * z + m[9],
        m[3] * x + m[4] * y + m[5] * z + m[10],
        m[6] * x + m[7] * y + m[8] * z + m[11],
    )


@njit(**INLINE)
def turned_into(s, k, x, y, z):
    """A direction of the rack frame in the frame of solid k."""
    m = s.solids[k]
    return m[0] * x + m[1] * y + m[2] * z, m[3] * x + m[4] * y + m[5] * z, m[6] * x + m[7] * y + m[8] * z


@njit(**INLINE)
def turned_back(s, k, x, y, z):
    """A direction of the frame of solid k in the rack frame."""
    m = s.solids[k]
    return m[0] * x + m[3] * y + m[6] * z, m[1] * x + m[4] * y + m[7] * z, m[2] * x + m[5] * y + m[8] * z


@njit(**INLINE)
def _hit_solid(s, k, ox, oy, oz, dx, dy, dz, limit):
    px, py, pz = into(s, k, ox, oy, oz)
    ex, ey, ez = turned_into(s, k, dx, dy, dz)
    b, c = px * ex + py * ey, px * px + py * py - s.solids[k, 12] * s.solids[k, 12]
    if c > 0.0 and (b > 0.0 or b * b < (ex * ex + ey * ey) * c):
        return _FAR, -1
    if (pz > s.solids[k, 14] and ez >= 0.0) or (pz < s.solids[k, 13] and ez <= 0.0):
        return _FAR, -1
    return hit_own(s, k, px, py, pz, ex, ey, ez, limit)


@njit(**INLINE)
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


@njit(**COMPILE)
def _hit_items(s, ox, oy, oz, dx, dy, dz, limit, any_hit):
    """Nearest tube, cap or box: distance, code, index of segment or face, solid or box. Walks the cells under the ray."""
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


@njit(**COMPILE)
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


@njit(**COMPILE)
def blocked(s, ox, oy, oz, dx, dy, dz, distance):
    """Whether anything, see-through or not, lies on the way within a distance."""
    if hit_rack(s, ox, oy, oz, dx, dy, dz)[0] < distance:
        return True
    return _hit_items(s, ox, oy, oz, dx, dy, dz, distance, True)[1] != NOTHING


@njit(**INLINE)
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


@njit(**INLINE)
def well_normal(s, k, x, y):
    """Unit normal into the well, across z, at a point on the wall of slot k."""
    hx, hy, radius = s.slots[k, 2], s.slots[k, 3], s.slots[k, 4]
    qx, qy = x - s.slots[k, 0], y - s.slots[k, 1]
    px, py = abs(qx) - (hx - radius), abs(qy) - (hy - radius)
    if px > 0.0 and py > 0.0:
        away = 1.0 / math.sqrt(px * px + py * py)
        return -math.copysign(px * away, qx), -math.copysign(py * away, qy)
    if hx - abs(qx) < hy - abs(qy):
        return -math.copysign(1.0, qx), 0.0
    return 0.0, -math.copysign(1.0, qy)


@njit(**COMPILE)
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


@njit(**COMPILE)
def first_hits(s, origins, directions, distance, code, index, owner):
    """Fill what N rays meet first; arrays of shape (N, 3) in, (N,) out. A miss has the code NOTHING."""
    for i in range(len(origins)):
        o, d = origins[i], directions[i]
        distance[i], code[i], index[i], owner[i] = closest(s, o[0], o[1], o[2], d[0], d[1], d[2])
