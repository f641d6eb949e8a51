"""Rigid transforms as (4, 4) arrays, and the rotation of Eq. 1.

Names read as chains: ``T_camera_tube = T_camera_rack @ T_rack_tube``; ``T_a_b`` maps points of frame b into frame a.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

FloatArray = NDArray[np.float64]
HALF_TURN: FloatArray = np.diag([-1.0, -1.0, 1.0, 1.0])
"""Half a turn about z, shape (4, 4)."""
QUARTER_TURN: FloatArray = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""A quarter turn about z, shape (4, 4)."""


def make_transform(rotation: FloatArray, translation_m: FloatArray) -> FloatArray:
    """Compose a (4, 4) transform from a (3, 3) rotation and a (3,) translation in metres."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation_m
    return T


def translation(offset_m: ArrayLike) -> FloatArray:
    """The (4, 4) transform that shifts by three numbers, metres."""
    return make_transform(np.eye(3), np.asarray(offset_m, dtype=np.float64))


def parts(T: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Rotation (3, 3) and translation (3,), metres, of a transform: arrays of their own, as compiled loops want."""
    return np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3])


def invert_transform(T: FloatArray) -> FloatArray:
    """Invert a rigid (4, 4) transform."""
    R = T[:3, :3]
    return make_transform(R.T, -R.T @ T[:3, 3])


def transform_points(T: FloatArray, points_m: FloatArray) -> FloatArray:
    """Map points of shape (..., 3) by a (4, 4) transform; NaN stays NaN."""
    return np.asarray(points_m @ T[:3, :3].T + T[:3, 3])


def tilt_rotation(alpha_rad: float, beta_rad: float) -> FloatArray:
    """Rotation of Eq. 1, ``Ry(beta) Rx(alpha)``, shape (3, 3); its third column is the axis in the rack frame."""
    ca, sa, cb, sb = np.cos(alpha_rad), np.sin(alpha_rad), np.cos(beta_rad), np.sin(beta_rad)
    return np.array([[cb, sb * sa, sb * ca], [0.0, ca, -sa], [-sb, cb * sa, cb * ca]])


def axis_rotation(axis: FloatArray) -> FloatArray:
    """Rotation of Eq. 1 whose third column is the given axis.

    This is the fixed spin rule of every tube pose: the tube's x axis lies in the rack's x-z plane.

    Args:
        axis: Array of shape (3,), rack frame; normalised here.
    """
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    alpha = float(np.arctan2(-y, np.hypot(x, z)))
    beta = float(np.arctan2(x, z))
    return tilt_rotation(alpha, beta)


def axis_rotations(axes: FloatArray) -> FloatArray:
    """`axis_rotation` of many axes (N, 3) at once, shape (N, 3, 3), without the angles: equal but for rounding."""
    x, y, z = (axes / np.linalg.norm(axes, axis=1, keepdims=True)).T
    flat = np.hypot(x, z)
    # An axis along y has no part in the x-z plane, and no turn about y.
    cos, sin = np.where(flat > 0, z, 1.0) / np.where(flat > 0, flat, 1.0), x / np.where(flat > 0, flat, 1.0)
    zero = np.zeros_like(x)
    return np.asarray(np.stack([cos, -sin * y, x, zero, flat, y, -sin, -cos * y, z], axis=1).reshape(-1, 3, 3))


def quaternion_wxyz(T: FloatArray) -> tuple[float, float, float, float]:
    """Unit quaternion (qw >= 0) of a (4, 4) transform, in the order of the output columns qw qx qy qz."""
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat(canonical=True)
    return float(w), float(x), float(y), float(z)


def tilt_rad(axis: FloatArray, up: FloatArray) -> float:
    """Angle between two directions of shape (3,), radians, accurate near 0 and near pi."""
    a, b = axis / np.linalg.norm(axis), up / np.linalg.norm(up)
    return float(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b))
