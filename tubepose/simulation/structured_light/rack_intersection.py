"""Rays against the rack: its top, its sides and its wells. Compiled by Numba; see `intersection`."""

from __future__ import annotations

import math

from tubepose.simulation.structured_light.codes import NOTHING, RACK_SIDE, RACK_TOP, WELL_FLOOR, WELL_WALL
from tubepose.simulation.structured_light.compiled import inlined, kernel

_TOP_MARGIN_M = 1e-9
_FAR = 1e30


@inlined
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


@inlined
def _nearest_slot(s, x, y):
    """The slot whose centre is nearest, in units of its size: for points that rounding has put on a well's wall."""
    best, found = _FAR, -1
    for k in range(len(s.slots)):
        away = max(abs(x - s.slots[k, 0]) / s.slots[k, 2], abs(y - s.slots[k, 1]) / s.slots[k, 3])
        if away < best:
            best, found = away, k
    return found if best < 1.001 else -1


@inlined
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


@kernel
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


@inlined
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
