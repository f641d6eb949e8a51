"""Meshes of a bowed rack: face, sides and wells, with edges short enough that the face really bends."""

from __future__ import annotations

import numpy as np

from tubepose.labware import RackModel
from tubepose.simulation.bow import Bow
from tubepose.simulation.meshes import Mesh, flat_polygon, merge, upright_walls
from tubepose.transforms import FloatArray, transform_points

LONGEST_EDGE_M = 4e-3
"""Edges of a bent face are no longer. The face of a rack that is 95 mm wide and bowed by 2.5 mm both ways is then
within 0.01 mm of its surface: a tenth of the noise of the best scanner that real scans are known from."""


def bent_shell(rack: RackModel, bow: Bow, base_m: float) -> Mesh:
    """Face with its openings and outer sides of a bowed rack, rack frame, metres.

    The face is raised by the bow; openings keep their x and y. The sides follow it and end at the height `base_m`.
    """
    outline = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * rack.outline_m / 2
    holes = [slot.boundary_m()[::-1] for slot in rack.all_slots]
    face = subdivided(flat_polygon([outline, *holes], rack.height_m), LONGEST_EDGE_M)
    xy = face.vertices_m[:, :2]
    raised = face.vertices_m + _upwards(bow.height_m(rack, xy))
    sides = subdivided(upright_walls(outline, base_m, rack.height_m), LONGEST_EDGE_M)
    share = (sides.vertices_m[:, 2] - base_m) / (rack.height_m - base_m)
    lifted = sides.vertices_m + _upwards(share * bow.height_m(rack, sides.vertices_m[:, :2]))
    return merge(
        [Mesh(raised, bow.normals(rack, xy), face.triangles), Mesh(lifted, sides.normals, sides.triangles)],
    )


def bent_wells(rack: RackModel, bow: Bow) -> Mesh:
    """Walls and floors of all slots of a bowed rack, rack frame, metres.

    A floor moves with the frame of its slot. A wall runs straight from there to the rim of the opening in the bent
    face. So a well is a little wider than its slot at the rim (less than 0.05 mm at a slope of 5 deg), never narrower.
    """
    parts = []
    for slot in rack.all_slots:
        outline = slot.boundary_m()
        walls = upright_walls(outline[::-1], rack.floor_m, rack.height_m)
        well = subdivided(merge([walls, flat_polygon([outline], rack.floor_m)]), LONGEST_EDGE_M)
        share = ((well.vertices_m[:, 2] - rack.floor_m) / rack.depth_m)[:, None]
        xy = well.vertices_m[:, :2]
        low = np.column_stack([xy, np.full(len(xy), rack.floor_m)])
        high = np.column_stack([xy, rack.height_m + bow.height_m(rack, xy)])
        T = bow.slot_frame(rack, slot)
        vertices = (1 - share) * transform_points(T, low) + share * high
        parts.append(Mesh(vertices, well.normals @ T[:3, :3].T, well.triangles))
    return merge(parts)


def base_height_m(rack: RackModel, bow: Bow) -> float:
    """Height of the table under a bowed rack, rack frame, metres: no part of the rack is below it.

    A flat rack's base is at 0. One whose sides or floors hang lower than that needs a lower table.
    """
    line = np.linspace(-0.5, 0.5, 41)
    hanging = bow.height_m(rack, np.stack(np.meshgrid(line, line), axis=-1) * rack.outline_m)
    below = rack.floor_m
    floors = bent_wells(rack, bow).vertices_m[:, 2] - below
    return min(0.0, float(hanging.min()), float(floors.min()))


def subdivided(mesh: Mesh, longest_m: float) -> Mesh:
    """The same surface with no edge longer than `longest_m`, measured across z.

    Longest-edge bisection: an edge that is too long is halved in both of its triangles, sooner or later, so that they
    still meet. Upright edges are left alone, as the bow bends nothing along z.
    """
    corners, normals = mesh.vertices_m[mesh.triangles], mesh.normals[mesh.triangles]
    done_corners, done_normals = [], []
    while len(corners):
        length = np.linalg.norm((np.roll(corners, -1, axis=1) - corners)[..., :2], axis=2)
        short = length.max(axis=1) <= longest_m
        done_corners.append(corners[short])
        done_normals.append(normals[short])
        # Each left triangle as (a, b, c) with its longest edge from a to b.
        turn = (length[~short].argmax(axis=1)[:, None] + np.arange(3)) % 3
        corners = _halved(np.take_along_axis(corners[~short], turn[:, :, None], axis=1))
        normals = _halved(np.take_along_axis(normals[~short], turn[:, :, None], axis=1))
        normals /= np.linalg.norm(normals, axis=2, keepdims=True)
    vertices, up = np.concatenate(done_corners), np.concatenate(done_normals)
    return Mesh(vertices.reshape(-1, 3), up.reshape(-1, 3), np.arange(3 * len(vertices)).reshape(-1, 3))


def _halved(corners: FloatArray) -> FloatArray:
    a, b, c = np.moveaxis(corners, 1, 0)
    middle = (a + b) / 2
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


def _upwards(height_m: FloatArray) -> FloatArray:
    return np.column_stack([np.zeros((len(height_m), 2)), height_m])
