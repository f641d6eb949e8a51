"""Tubes in a bowed rack: every slot has a frame of its own, level with the face around it.

A rack that is bowed by 2 mm over its short side leans by 5 deg at its edge, and its tubes with it. So the slot and its
neighbours are a small flat rack that stands as the face does there; its floor is taken to follow the face.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tubepose.labware import RackModel
from tubepose.labware.racks import SlotModel
from tubepose.transforms import FloatArray, axis_rotation, make_transform, translation

NEIGHBOURS = 1.8
"""Slots nearer than so many pitches hide parts of a tube, or touch it."""


@dataclass(frozen=True, slots=True, eq=False)
class FaceBow:
    """The bow of a rack's face: b(x, y) = b_x u^2 + b_y v^2 + b_xy u v, u and v 1 at the ends of the outline.

    Attributes:
        bow_m: The three parts, shape (3,), metres.
        std_m: Their standard deviations, shape (3,).
    """

    bow_m: FloatArray
    std_m: FloatArray

    def terms(self, rack: RackModel, xy_m: FloatArray) -> FloatArray:
        """How height and slopes along x and y at a place (2,) change with the three parts, shape (3, 3)."""
        half = rack.outline_m / 2
        u, v = xy_m / half
        return np.array([[u * u, v * v, u * v], [2 * u / half[0], 0, v / half[0]], [0, 2 * v / half[1], u / half[1]]])


@dataclass(frozen=True, slots=True, eq=False)
class SlotFrame:
    """A slot, its neighbours, and how they stand in the rack's frame.

    Attributes:
        rack: The slot (its first one) and its neighbours as a rack of their own, the slot's centre at its origin.
        rows: Their indices among the rack's slots.
        T_rack_local: Frame of that rack, shape (4, 4), metres.
        covariance: Of a rack's pose and bow, shape (6, 6), moved to the slot: about the centre of its opening.
    """

    rack: RackModel
    rows: NDArray[np.intp]
    T_rack_local: FloatArray
    covariance: FloatArray | None


def slot_frame(rack: RackModel, index: int, bow: FaceBow, rack_covariance: FloatArray | None) -> SlotFrame:
    """The frame of one slot of a bowed rack.

    Args:
        rack: The rack.
        index: Of the slot.
        bow: Of its face.
        rack_covariance: Of its pose, shape (6, 6), about the centre of its top; None counts as exact.
    """
    local, rows = _neighbourhood(rack, index)
    center = rack.slot_centers_m[index]
    terms = bow.terms(rack, center)
    height, slope_x, slope_y = terms @ bow.bow_m
    normal = np.array([-slope_x, -slope_y, 1.0])
    axis = np.cross([0.0, 0.0, 1.0], normal / np.linalg.norm(normal))
    R = Rotation.from_rotvec(axis * (np.arcsin(np.linalg.norm(axis)) / max(float(np.linalg.norm(axis)), 1e-12)))
    T = make_transform(R.as_matrix(), np.array([*center, rack.height_m + height])) @ translation([0, 0, -rack.height_m])
    if rack_covariance is None:
        return SlotFrame(local, rows, T, None)
    arm = np.array([center[0], center[1], height])
    J = np.eye(6)
    J[3:, :3] = -np.array([[0, -arm[2], arm[1]], [arm[2], 0, -arm[0]], [-arm[1], arm[0], 0]])
    covariance = J @ rack_covariance @ J.T
    # Turns about x and y that the slopes' errors make, and the height's.
    B = np.zeros((6, 3))
    B[0], B[1], B[5] = terms[2], -terms[1], terms[0]
    covariance = covariance + B @ np.diag(np.minimum(bow.std_m, 1e-3) ** 2) @ B.T
    axes = np.kron(np.eye(2), R.as_matrix())
    return SlotFrame(local, rows, T, np.asarray(axes.T @ covariance @ axes))


@lru_cache(maxsize=2048)
def _neighbourhood(rack: RackModel, index: int) -> tuple[RackModel, NDArray[np.intp]]:
    centers = rack.slot_centers_m
    apart = np.linalg.norm(centers - centers[index], axis=1)
    rows = np.flatnonzero(apart < NEIGHBOURS * rack.pitches_m[index])
    rows = np.concatenate([[index], rows[rows != index]])
    moved = tuple(_moved(rack.all_slots[k], centers[index]) for k in rows)
    reach_mm = np.max([np.abs(slot.center_mm) + np.array(slot.size_mm) / 2 for slot in moved], axis=0)
    outline_mm = (float(2 * reach_mm[0] + 4), float(2 * reach_mm[1] + 4))
    # Not checked again: parts of a rack that was.
    local = RackModel.model_construct(
        kind="rack", name=rack.name, description="", source="", outline_mm=outline_mm, height_mm=rack.height_mm,
        floor_mm=rack.floor_mm, floor_play_mm=rack.floor_play_mm, floor_tolerance_mm=rack.floor_tolerance_mm, grid=None,
        slots=moved,
    )  # fmt: skip
    return local, rows


def _moved(slot: SlotModel, center_m: FloatArray) -> SlotModel:
    # Rounded, so that all inner slots of a grid share one neighbourhood but for names.
    x, y = (round(slot.center_mm[k] - 1e3 * float(center_m[k]), 6) for k in range(2))
    return slot.model_copy(update={"center_mm": (x, y)})


def in_rack_frame(T_local_tube: FloatArray, frame: SlotFrame) -> FloatArray:
    """T_rack_tube (4, 4) of a tube in its slot's frame, its spin by the rule of `axis_rotation`."""
    T = frame.T_rack_local @ T_local_tube
    return make_transform(axis_rotation(T[:3, 2]), T[:3, 3])
