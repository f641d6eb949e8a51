"""Triangle meshes of labware with outward normals, as the ray caster needs them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from tubepose.labware import RackModel
from tubepose.transforms import FloatArray, transform_points

SEGMENTS = 96
# Edges of a profile or outline that turn by less are one smooth surface.
SMOOTH_COS = np.cos(np.deg2rad(30.0))


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Triangles with one normal per vertex.

    Attributes:
        vertices_m: Array of shape (V, 3), metres.
        normals: Array of shape (V, 3), unit, out of the solid.
        triangles: Array of shape (T, 3), rows of `vertices_m`.
    """

    vertices_m: FloatArray
    normals: FloatArray
    triangles: NDArray[np.intp]

    def transformed(self, T: FloatArray) -> Mesh:
        """The mesh mapped by a rigid (4, 4) transform."""
        return Mesh(transform_points(T, self.vertices_m), self.normals @ T[:3, :3].T, self.triangles)


def merge(meshes: Sequence[Mesh]) -> Mesh:
    """One mesh of all triangles, in order."""
    starts = np.cumsum([0] + [len(mesh.vertices_m) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices_m for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([mesh.triangles + start for mesh, start in zip(meshes, starts, strict=True)]),
    )


def _edge_normals(points: FloatArray, closed: bool) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Edges (E, 2, 2) of a line and the normals at their starts and ends: right of it, smooth where it bends little."""
    loop = np.vstack([points, points[:1]]) if closed else points
    edges = np.stack([loop[:-1], loop[1:]], axis=1)
    along = edges[:, 1] - edges[:, 0]
    length = np.linalg.norm(along, axis=1)
    edges, along = edges[length > 0], along[length > 0] / length[length > 0, None]
    own = np.column_stack([along[:, 1], -along[:, 0]])
    starts, ends = own.copy(), own.copy()
    for i in range(len(own)):
        j = (i + 1) % len(own)
        if (j != 0 or closed) and own[i] @ own[j] > SMOOTH_COS:
            mean = own[i] + own[j]
            ends[i] = starts[j] = mean / np.linalg.norm(mean)
    return edges, starts, ends


def revolve(profile_zr_m: FloatArray, segments: int = SEGMENTS) -> Mesh:
    """Surface of revolution about z.

    Args:
        profile_zr_m: Rows (z, r), shape (N, 2), metres; the solid lies on the left of r over z, so an outer wall is
            listed upwards and a cavity downwards.
        segments: Number of facets around the axis.
    """
    edges, starts, ends = _edge_normals(profile_zr_m[:, ::-1], closed=False)
    angles = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    rings = np.concatenate([edges[:, 0], edges[:, 1]])
    ring_normals = np.concatenate([starts, ends])
    vertices = np.concatenate([_ring(circle, r, z) for r, z in rings])
    normals = np.concatenate([_ring(circle, r, z) for r, z in ring_normals])
    k = np.arange(segments)
    after = (k + 1) % segments
    triangles = []
    for edge in range(len(edges)):
        a, b = edge * segments, (len(edges) + edge) * segments
        triangles += [np.column_stack([a + k, a + after, b + after]), np.column_stack([a + k, b + after, b + k])]
    return _without_slivers(Mesh(vertices, normals, np.concatenate(triangles)))


def _ring(circle: FloatArray, r: float, z: float) -> FloatArray:
    return np.column_stack([r * circle, np.full(len(circle), z)])


def _without_slivers(mesh: Mesh) -> Mesh:
    corners = mesh.vertices_m[mesh.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return Mesh(mesh.vertices_m, mesh.normals, mesh.triangles[area > 0])


def wall_patch(
    low_zr_m: tuple[float, float], high_zr_m: tuple[float, float], start_rad: float, span_rad: float
) -> Mesh:
    """Part of a cylinder's or cone's wall about z, facing outwards.

    Args:
        low_zr_m: Height and radius of the lower edge, metres.
        high_zr_m: Height and radius of the upper edge.
        start_rad: Where the patch begins, from x towards y.
        span_rad: How far it goes around, at most a full turn.
    """
    steps = max(1, int(np.ceil(span_rad / (2 * np.pi) * SEGMENTS)))
    angles = start_rad + np.linspace(0, span_rad, steps + 1)
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    rise, widening = np.subtract(high_zr_m, low_zr_m)
    across, up = np.array([rise, -widening]) / np.hypot(rise, widening)
    normals = _ring(circle, across, up)
    a = np.arange(steps)
    b, c, d = a + 1, a + steps + 2, a + steps + 1
    return Mesh(
        np.concatenate([_ring(circle, r, z) for z, r in (low_zr_m, high_zr_m)]),
        np.concatenate([normals, normals]),
        np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]),
    )


def box(size_m: Sequence[float], center_m: Sequence[float]) -> Mesh:
    """Axis-parallel box with flat faces; `size_m` and `center_m` are (x, y, z) in metres."""
    half = np.asarray(size_m) / 2
    faces = []
    for axis in range(3):
        u, v = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        for sign in (1.0, -1.0):
            normal = sign * np.eye(3)[axis]
            corners = [normal + a * u + sign * b * v for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            vertices = np.array(corners) * half + np.asarray(center_m)
            faces.append(Mesh(vertices, np.tile(normal, (4, 1)), np.array([[0, 1, 2], [0, 2, 3]])))
    return merge(faces)


def flat_polygon(rings_m: Sequence[FloatArray], z_m: float) -> Mesh:
    """Level polygon facing up: the first ring is its outline, the others are holes; rings are (N, 2), metres."""
    flat = np.concatenate(rings_m)
    ends = np.cumsum([len(ring) for ring in rings_m]).astype(np.uint32)
    triangles = mapbox_earcut.triangulate_float64(flat, ends).reshape(-1, 3).astype(np.intp)
    vertices = np.column_stack([flat, np.full(len(flat), z_m)])
    return Mesh(vertices, np.tile([0.0, 0.0, 1.0], (len(flat), 1)), triangles)


def upright_walls(outline_m: FloatArray, z_low_m: float, z_high_m: float) -> Mesh:
    """Vertical walls along a closed outline (N, 2), facing right of its direction: clockwise for a well."""
    edges, starts, ends = _edge_normals(outline_m, closed=True)
    low, high = np.full(len(edges), z_low_m), np.full(len(edges), z_high_m)
    corners = [(0, low, starts), (1, low, ends), (1, high, ends), (0, high, starts)]
    vertices = np.concatenate([np.column_stack([edges[:, end], z]) for end, z, _ in corners])
    level = np.zeros(len(edges))
    normals = np.concatenate([np.column_stack([normal, level]) for _, _, normal in corners])
    a = np.arange(len(edges))
    b, c, d = a + len(edges), a + 2 * len(edges), a + 3 * len(edges)
    return Mesh(vertices, normals, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]))


def rack_shell(rack: RackModel) -> Mesh:
    """Top surface with its openings and the outer sides of a rack, rack frame, metres."""
    outline = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * rack.outline_m / 2
    holes = [slot.boundary_m()[::-1] for slot in rack.all_slots]
    return merge([flat_polygon([outline, *holes], rack.height_m), upright_walls(outline, 0.0, rack.height_m)])


def rack_wells(rack: RackModel) -> Mesh:
    """Walls and floors of all slots of a rack, rack frame, metres."""
    parts = []
    for slot in rack.all_slots:
        outline = slot.boundary_m()
        parts.append(upright_walls(outline[::-1], rack.floor_m, rack.height_m))
        parts.append(flat_polygon([outline], rack.floor_m))
    return merge(parts)
