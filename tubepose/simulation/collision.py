"""Whether two tubes that stand side by side cut into each other, with their own caps or with printed ones."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from tubepose.labware import CapModel
from tubepose.simulation.scene import PlacedTube
from tubepose.transforms import FloatArray, transform_points

CLEARANCE_M = 2e-5
"""Solids that are nearer than this touch."""
PROFILE_SPACING_M = 3e-3


@dataclass(frozen=True, slots=True, eq=False)
class Turned:
    """A solid of revolution as discs along its axis, rack frame.

    Attributes:
        axis: Unit axis, shape (3,).
        origin_m: The point of the axis that its heights count from, shape (3,), metres.
        profile_m: Profile (z, r), shape (N, 2), metres.
    """

    axis: FloatArray
    origin_m: FloatArray
    profile_m: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """A placed tube with its own and with its printed cap, as they are made, rack frame.

    Attributes:
        body: The tube under a printed cap: a closed cap is off, a flange stays.
        cap: Its own closed cap, or None.
        plate_axis: Unit normal of the printed cap's plate, shape (3,).
        plate_top_m: Corners of the plate's top, counter-clockwise, shape (4, 3), metres.
        plate_bottom_m: Corners of its lower side in the same order, shape (4, 3), metres.
        center_m: Centre of the plate's top, shape (3,), metres.
        reach_m: Generous radius about that centre that holds the whole tube, seen from above.
    """

    body: Turned
    cap: Turned | None
    plate_axis: FloatArray
    plate_top_m: FloatArray
    plate_bottom_m: FloatArray
    center_m: FloatArray
    reach_m: float


def solid_of(tube: PlacedTube, cap: CapModel) -> Solid:
    """The shape of a tube with its own and with its printed cap."""
    T, model = tube.T_rack_tube, tube.model
    profile = (model.outer_profile_m if model.is_open else model.body_profile_m)(PROFILE_SPACING_M)
    own = None if model.is_open else _turned(T @ tube.T_tube_own_cap, tube.own_cap_profile_m())
    T_rack_cap = T @ tube.T_tube_cap
    corners = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * cap.square_m / 2
    top = transform_points(T_rack_cap, corners + np.array([0.0, 0.0, cap.offset_m(model)]))
    plate_axis = T_rack_cap[:3, 2]
    body = _turned(T, profile)
    return Solid(
        body=body,
        cap=own,
        plate_axis=plate_axis,
        plate_top_m=top,
        plate_bottom_m=top - cap.thickness_mm * 1e-3 * plate_axis,
        center_m=top.mean(axis=0),
        reach_m=_reach_m((body,) if own is None else (body, own), cap),
    )


def _turned(T_rack_part: FloatArray, profile_m: FloatArray) -> Turned:
    return Turned(T_rack_part[:3, 2], T_rack_part[:3, 3], profile_m)


def collide(a: Solid, b: Solid, cap: CapModel) -> bool:
    """Whether two tubes touch, with their own caps or with their printed ones."""
    if math.dist(a.center_m[:2], b.center_m[:2]) > a.reach_m + b.reach_m:
        return False
    if any(_turned_touch(p, q) for p in _own_parts(a) for q in _own_parts(b)):
        return True
    lean_m = cap.square_m * (np.hypot(*a.plate_axis[:2]) + np.hypot(*b.plate_axis[:2]))
    level = abs(a.center_m[2] - b.center_m[2]) < cap.thickness_mm * 1e-3 + lean_m
    sides = ((a.plate_top_m, b.plate_top_m), (a.plate_bottom_m, b.plate_bottom_m))
    if level and any(polygons_overlap(p[:, :2], q[:, :2]) for p, q in sides):
        return True
    return _plate_hits_body(a, b.body) or _plate_hits_body(b, a.body)


def _own_parts(solid: Solid) -> tuple[Turned, ...]:
    return (solid.body,) if solid.cap is None else (solid.body, solid.cap)


def _reach_m(parts: tuple[Turned, ...], cap: CapModel) -> float:
    lean_m = max(float(np.hypot(*part.axis[:2])) for part in parts) * float(parts[-1].profile_m[-1, 0])
    widest = max(float(part.profile_m[:, 1].max()) for part in parts)
    return max(widest, cap.square_m * 0.75) + lean_m


def _turned_touch(a: Turned, b: Turned) -> bool:
    """Compare two solids of revolution disc by disc at the heights where either of their profiles turns."""
    breaks = np.concatenate([part.origin_m[2] + part.profile_m[:, 0] * part.axis[2] for part in (a, b)])
    # A leaning cap's edge is up to radius * sin(tilt) off its centre's height: look a little above and below.
    heights = np.concatenate([breaks - 3e-4, breaks + 3e-4])
    xa, ra = _discs(a, heights)
    xb, rb = _discs(b, heights)
    both = (ra > 0) & (rb > 0)
    gap = np.linalg.norm(xa - xb, axis=1) - (ra + rb)
    return bool(np.any(gap[both] < CLEARANCE_M))


def _discs(part: Turned, heights_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centres (N, 2) and radii (N,) of a solid's discs at heights of the rack frame; radius 0 off the solid."""
    along = (heights_m - part.origin_m[2]) / part.axis[2]
    centers = part.origin_m[:2] + along[:, None] * part.axis[:2]
    # At a step of the profile either side may answer: callers look a little above and below it.
    radii = np.interp(along, part.profile_m[:, 0], part.profile_m[:, 1], left=0.0, right=0.0)
    return centers, radii / part.axis[2]


def _plate_hits_body(plate: Solid, body: Turned) -> bool:
    """Whether a printed plate cuts into the bare body of a taller neighbour."""
    for depth in (0.0, 0.5, 1.0):
        corners = plate.plate_top_m + depth * (plate.plate_bottom_m - plate.plate_top_m)
        center, radius = _discs(body, corners[:, 2].mean(keepdims=True))
        if radius[0] > 0 and _distance_to_polygon(center[0], corners[:, :2]) < radius[0] + CLEARANCE_M:
            return True
    return False


def _distance_to_polygon(point: FloatArray, corners: FloatArray) -> float:
    """Distance of a point (2,) to a convex counter-clockwise polygon (K, 2); 0 inside."""
    edges = np.roll(corners, -1, axis=0) - corners
    to_point = point - corners
    if np.all(edges[:, 0] * to_point[:, 1] - edges[:, 1] * to_point[:, 0] >= 0):
        return 0.0
    share = np.clip(np.sum(to_point * edges, axis=1) / np.sum(edges**2, axis=1), 0, 1)
    return float(np.linalg.norm(to_point - share[:, None] * edges, axis=1).min())


def polygons_overlap(a: FloatArray, b: FloatArray) -> bool:
    """Whether two convex polygons (K, 2) share area, by separating axes."""
    for corners in (a, b):
        edges = np.roll(corners, -1, axis=0) - corners
        for normal in np.column_stack([edges[:, 1], -edges[:, 0]]):
            pa, pb = a @ normal, b @ normal
            if pa.max() <= pb.min() or pb.max() <= pa.min():
                return False
    return True
