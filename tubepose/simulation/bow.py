"""Bow of a rack: its face is a low-order surface, and every slot has a frame of its own."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tubepose.labware import RackModel, SlotModel
from tubepose.transforms import FloatArray, axis_rotation, make_transform


@dataclass(frozen=True, slots=True)
class Bow:
    """How far a rack's face is off its plane, zero at the centre of the face; positive is away from the base.

    With u = 2 x / L_x and v = 2 y / L_y, which are 1 at the outline, the face is raised by
    ``along_x_m u^2 + along_y_m v^2 + twist_m u v``.

    Attributes:
        along_x_m: Height of the middles of the two sides at x = -L_x / 2 and L_x / 2 over the centre, metres.
        along_y_m: The same for the sides at y = -L_y / 2 and L_y / 2.
        twist_m: Height of the corner at (+, +) over what the other two terms make of it.
    """

    along_x_m: float = 0.0
    along_y_m: float = 0.0
    twist_m: float = 0.0

    @property
    def flat(self) -> bool:
        """Whether the face is a plane."""
        return self.along_x_m == self.along_y_m == self.twist_m == 0.0

    def height_m(self, rack: RackModel, xy_m: FloatArray) -> FloatArray:
        """How far the face is raised at points (..., 2) of the rack frame, shape (...), metres."""
        u, v = np.moveaxis(2 * np.asarray(xy_m) / rack.outline_m, -1, 0)
        return np.asarray(self.along_x_m * u**2 + self.along_y_m * v**2 + self.twist_m * u * v)

    def slope(self, rack: RackModel, xy_m: FloatArray) -> FloatArray:
        """Slopes dz/dx and dz/dy of the face at points (..., 2) of the rack frame, shape (..., 2)."""
        per_m = 2 / rack.outline_m
        u, v = np.moveaxis(per_m * np.asarray(xy_m), -1, 0)
        along_x = 2 * self.along_x_m * u + self.twist_m * v
        along_y = 2 * self.along_y_m * v + self.twist_m * u
        return np.asarray(np.stack([along_x * per_m[0], along_y * per_m[1]], axis=-1))

    def normals(self, rack: RackModel, xy_m: FloatArray) -> FloatArray:
        """Unit normals of the face at points (..., 2) of the rack frame, shape (..., 3)."""
        slope = self.slope(rack, xy_m)
        up = np.concatenate([-slope, np.ones((*slope.shape[:-1], 1))], axis=-1)
        return np.asarray(up / np.linalg.norm(up, axis=-1, keepdims=True))

    def slot_frame(self, rack: RackModel, slot: SlotModel) -> FloatArray:
        """Rigid motion (4, 4) of a slot and of what stands in it, rack frame, metres.

        The slot is raised by the face's height at its centre and turned, about the centre of its opening, until its
        axis is the face's normal there. So its floor follows the face: it lies parallel to the face at the slot's
        centre, at the depth that the rack's definition says. The turn has no part about the axis.
        """
        centre = np.array([*slot.center_m, rack.height_m])
        raised = centre + np.array([0.0, 0.0, float(self.height_m(rack, slot.center_m))])
        rotation = axis_rotation(self.normals(rack, slot.center_m))
        return make_transform(rotation, raised - rotation @ centre)

    def moved(self, rack: RackModel, slot: SlotModel, T_rack_tube: FloatArray) -> FloatArray:
        """Pose (4, 4) in the bowed rack of a tube that stands in the flat one; its spin is that of every tube pose."""
        if self.flat:
            return T_rack_tube
        T = self.slot_frame(rack, slot) @ T_rack_tube
        return make_transform(axis_rotation(T[:3, 2]), T[:3, 3])


FLAT = Bow()
