"""The projector: a point of light whose every direction carries a projector column."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from tubepose.simulation.camera import PERIODS, StructuredLightCamera
from tubepose.simulation.structured_light.compiled import inlined
from tubepose.transforms import FloatArray, invert_transform

assert PERIODS == (1024.0, 128.0, 16.0), "tagged() takes each period for an eighth of the one before"


class Projector(NamedTuple):
    """The projector in the rack frame.

    Attributes:
        position_m: Shape (3,).
        axes: Unit x, y, z as rows, shape (3, 3); columns count along x.
        numbers: Columns per unit of tangent, column of the axis, largest tangent along x and y, and radiant intensity:
            a white Lambertian surface that faces it at the working distance has the radiance 1. Shape (4,).
    """

    position_m: FloatArray
    axes: FloatArray
    numbers: FloatArray


def projector_of(camera: StructuredLightCamera, T_camera_rack: FloatArray) -> Projector:
    """The projector of a camera that sees a rack."""
    T_rack_camera = invert_transform(T_camera_rack)
    x, z = camera.projector_axes
    axes = np.array([x, np.cross(z, x), z]) @ T_rack_camera[:3, :3].T
    position = T_rack_camera[:3, :3] @ camera.projector_m + T_rack_camera[:3, 3]
    intensity = math.pi * camera.working_distance_m**2
    numbers = [camera.columns_per_tangent, PERIODS[0] / 2, camera.projector_half_field, intensity]
    return Projector(position, np.ascontiguousarray(axes), np.array(numbers))


@inlined
def tagged(column, tags):
    """Fill tags (6,) with the cosine and sine of a column's phase in the three periods."""
    c, s = math.cos(2.0 * math.pi / 1024.0 * column), math.sin(2.0 * math.pi / 1024.0 * column)
    for i in range(3):
        tags[2 * i], tags[2 * i + 1] = c, s
        if i < 2:
            for _ in range(3):
                c, s = c * c - s * s, 2.0 * c * s


@inlined
def towards(projector, x, y, z):
    """Direction and distance to the projector, and the column that lights a point; -1 outside the projector's field."""
    px, py, pz = projector.position_m[0], projector.position_m[1], projector.position_m[2]
    vx, vy, vz = px - x, py - y, pz - z
    distance = math.sqrt(vx * vx + vy * vy + vz * vz)
    ux, uy, uz = vx / distance, vy / distance, vz / distance
    a = projector.axes
    forward = -(vx * a[2, 0] + vy * a[2, 1] + vz * a[2, 2])
    if forward <= 0.0:
        return ux, uy, uz, distance, -1.0
    tx = -(vx * a[0, 0] + vy * a[0, 1] + vz * a[0, 2]) / forward
    ty = -(vx * a[1, 0] + vy * a[1, 1] + vz * a[1, 2]) / forward
    limit = projector.numbers[2]
    if abs(tx) >= limit or abs(ty) >= limit:
        return ux, uy, uz, distance, -1.0
    return ux, uy, uz, distance, projector.numbers[1] + projector.numbers[0] * tx
