"""Whether two tubes that stand side by side cut into each other, with their own caps or with printed ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tubepose.labware import CapModel
from tubepose.simulation.scene import PlacedTube
from tubepose.transforms import FloatArray, transform_points

CLEARANCE_M = 2e-5
"""Solids that are nearer than this touch."""
PROFILE_SPACING_M = 3e-3


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """A placed tube as discs along its axis and as the plate of its printed cap, rack frame.

    Attributes:
        axis: Unit axis, shape (3,).
        origin_m: Its bottom, shape (3,), metres.
        own_m: Profile (z, r) with its own cap, shape (N, 2), metres.
        bare_m: Profile under a printed cap: a closed cap is off, a flange stays.
        plate_center_m: Centre of the plate's top, shape (3,).
        plate_corners_m: Corners of the plate's top, counter-clockwise, shape (4, 3).
    """

    axis: FloatArray
    origin_m: FloatArray
    own_m: FloatArray
    bare_m: FloatArray
    plate_center_m: FloatArray
    plate_corners_m: FloatArray


def solid_of(tube: PlacedTube, cap: CapModel) -> Solid:
    """The shape of a tube with its own and with its printed cap."""
    T = tube.T_rack_tube
    half, top = cap.square_m / 2, cap.offset_m(tube.model)
    corners = np.array([[1, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]]) * half + [0, 0, top]
    own = tube.model.outer_profile_m(PROFILE_SPACING_M)
    bare = own if tube.model.is_open else tube.model.body_profile_m(PROFILE_SPACING_M)
    return Solid(
        axis=T[:3, 2],
        origin_m=T[:3, 3],
        own_m=own,
        bare_m=bare,
        plate_center_m=transform_points(T, np.array([0.0, 0.0, top])),
        plate_corners_m=transform_points(T @ tube.T_tube_cap, corners),
    )


def collide(a: Solid, b: Solid, cap: CapModel) -> bool:
    """Whether two tubes touch, with their own caps or with their printed ones."""
    if np.hypot(*(a.plate_center_m - b.plate_center_m)[:2]) > _reach(a, cap) + _reach(b, cap):
        return False
    if _bodies_touch(a, b):
        return True
    lean_m = cap.square_m * (np.hypot(*a.axis[:2]) + np.hypot(*b.axis[:2]))
    level = abs(a.plate_center_m[2] - b.plate_center_m[2]) < cap.thickness_mm * 1e-3 + lean_m
    if level and polygons_overlap(a.plate_corners_m[:, :2], b.plate_corners_m[:, :2]):
        return True
    return _plate_hits_body(a, b, cap) or _plate_hits_body(b, a, cap)


def _reach(solid: Solid, cap: CapModel) -> float:
    """Generous radius about the plate's centre that holds the tube, seen from above."""
    lean_m = float(np.hypot(*solid.axis[:2])) * solid.own_m[-1, 0]
    return float(max(solid.own_m[:, 1].max(), cap.square_m * 0.75) + lean_m)


def _bodies_touch(a: Solid, b: Solid) -> bool:
    """Compare two profiles (z, r) disc by disc at the heights where either of them turns."""
    breaks = np.concatenate([a.origin_m[2] + a.own_m[:, 0] * a.axis[2], b.origin_m[2] + b.own_m[:, 0] * b.axis[2]])
    # A leaning cap's edge is up to radius * sin(tilt) off its centre's height: look a little above and below.
    heights = np.concatenate([breaks - 3e-4, breaks + 3e-4])
    xa, ra = _discs(a, a.own_m, heights)
    xb, rb = _discs(b, b.own_m, heights)
    both = (ra > 0) & (rb > 0)
    gap = np.linalg.norm(xa - xb, axis=1) - (ra + rb)
    return bool(np.any(gap[both] < CLEARANCE_M))


def _discs(solid: Solid, profile: FloatArray, heights_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centres (N, 2) and radii (N,) of a tube's discs at heights of the rack frame; radius 0 off the tube."""
    along = (heights_m - solid.origin_m[2]) / solid.axis[2]
    centers = solid.origin_m[:2] + along[:, None] * solid.axis[:2]
    # At a step of the profile either side may answer: callers look a little above and below it.
    radii = np.interp(along, profile[:, 0], profile[:, 1], left=0.0, right=0.0)
    return centers, radii / solid.axis[2]


def _plate_hits_body(plate: Solid, body: Solid, cap: CapModel) -> bool:
    """Whether a printed plate cuts into the bare body of a taller neighbour."""
    heights = plate.plate_center_m[2] - np.linspace(0, cap.thickness_mm * 1e-3, 3)
    centers, radii = _discs(body, body.bare_m, heights)
    corners = plate.plate_corners_m[:, :2]
    return any(
        _distance_to_polygon(center, corners) < radius + CLEARANCE_M
        for center, radius in zip(centers, radii, strict=True)
        if radius > 0
    )


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
