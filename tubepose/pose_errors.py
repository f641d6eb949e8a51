"""How far an estimated tube pose is from the true one, when the spin about the tube's axis is free.

Every error is computed from ``D = inv(T_camera_truth) @ T_camera_estimate`` alone, so it is stated in the truth's own
frame (origin at the tube's bottom, z along the tube, x turned to the rack's x) and moving the camera changes nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tubepose.transforms import FloatArray

MM_PER_M = 1e3
UPSIDE_DOWN_DEG = 90.0


def upper_half(axes: Sequence[str]) -> tuple[str, ...]:
    """Names of the columns that hold the upper half of a covariance, row by row."""
    return tuple(f"cov_{a}_{b}" for i, a in enumerate(axes) for b in axes[i:])


COVARIANCE_AXES = ("rx", "ry", "tx", "ty", "tz")
"""Order of a pose's covariance: small turns about the tube's x and y, shifts along its x, y and z, at its bottom."""
COVARIANCE_COLUMNS = upper_half(COVARIANCE_AXES)
"""Its upper half, row by row, as columns of result files."""
_ANGLES = 72
_SPIN_STEPS = 33
_SPIN_LEVELS = 4
_ADDS_ANGLES = 24
_ADDS_SPACING_M = 2e-3


@dataclass(frozen=True, slots=True, eq=False)
class PoseErrors:
    """Errors of N poses in the truth's frame; NaN where a pose is not finite.

    Attributes:
        rx_deg: Swing about x, shape (N,), signed; NaN also when upside down.
        ry_deg: Swing about y, shape (N,), signed; NaN also when upside down.
        tilt_deg: Angle between the two axes, shape (N,), 0 to 180; hypot(rx, ry) where these exist.
        tx_mm: Offset of the tube's bottom along x, shape (N,), signed, estimate minus truth.
        ty_mm: Along y, signed.
        tz_mm: Along the tube, signed.
        lateral_mm: hypot(tx, ty), shape (N,).
        axial_mm: abs(tz), shape (N,).
        cap_mm: Distance between the two places of the axis point at the tube's height, where a gripper meets the cap,
            shape (N,); NaN without heights.
    """

    rx_deg: FloatArray
    ry_deg: FloatArray
    tilt_deg: FloatArray
    tx_mm: FloatArray
    ty_mm: FloatArray
    tz_mm: FloatArray
    lateral_mm: FloatArray
    axial_mm: FloatArray
    cap_mm: FloatArray


def pose_errors(
    T_camera_truth: FloatArray, T_camera_estimate: FloatArray, heights_m: FloatArray | None = None
) -> PoseErrors:
    """Rotation error by swing and translation error, both per axis of the truth's frame.

    The rotation that turns the true axis onto the estimated one by the shortest way has no part about z, so any spin of
    the estimate gives the same numbers. Euler angles and the rotation vector of the full rotation do not have that.

    Args:
        T_camera_truth: Array of shape (N, 4, 4), metres.
        T_camera_estimate: Array of shape (N, 4, 4), metres.
        heights_m: Heights of the tubes, shape (N,), metres, for the error at the cap.
    """
    D = _relative(T_camera_truth, T_camera_estimate)
    swing_deg = np.rad2deg(_swing_rad(D[:, :3, 2]))
    x_mm, y_mm, z_mm = (D[:, :3, 3] * MM_PER_M).T
    tilt_deg = np.linalg.norm(swing_deg, axis=1)
    per_axis = np.where((tilt_deg > UPSIDE_DOWN_DEG)[:, None], np.nan, swing_deg)
    return PoseErrors(
        rx_deg=per_axis[:, 0],
        ry_deg=per_axis[:, 1],
        tilt_deg=tilt_deg,
        tx_mm=x_mm,
        ty_mm=y_mm,
        tz_mm=z_mm,
        lateral_mm=np.hypot(x_mm, y_mm),
        axial_mm=np.abs(z_mm),
        cap_mm=_cap_error_mm(D, heights_m),
    )


def mssd_mm(T_camera_truth: FloatArray, T_camera_estimate: FloatArray, profile_m: FloatArray) -> FloatArray:
    """Maximum symmetry-aware surface distance of a body of revolution, shape (N,), mm.

    The largest distance between a surface point in the two poses, least over all spins about the tube's axis. The
    largest distance is reached at a vertex of the profile; its circle is sampled at 72 angles, which loses at most
    0.1 %. The spin is searched over the full circle, down to 5e-5 rad.

    Args:
        T_camera_truth: Array of shape (N, 4, 4), metres.
        T_camera_estimate: Array of shape (N, 4, 4), metres.
        profile_m: Rows (z, r) of the tube's outside, shape (P, 2), metres.
    """
    points = _revolve(profile_m, _ANGLES)
    return _per_pose(T_camera_truth, T_camera_estimate, lambda Q, t: _mssd_m(Q, t, points))


def add_s_mm(T_camera_truth: FloatArray, T_camera_estimate: FloatArray, profile_m: FloatArray) -> FloatArray:
    """Mean distance from the estimated surface to the nearest point of the true one (ADD-S), shape (N,), mm.

    The estimated surface is sampled (2 mm along the profile, 24 angles, weighted by area); the true one is exact: the
    nearest point of a surface of revolution is found in the plane of its profile.

    Args:
        T_camera_truth: Array of shape (N, 4, 4), metres.
        T_camera_estimate: Array of shape (N, 4, 4), metres.
        profile_m: Rows (z, r) of the tube's outside, shape (P, 2), metres.
    """
    samples, weights = _area_samples(np.asarray(profile_m, dtype=float))
    points, weights = _revolve(samples, _ADDS_ANGLES), np.repeat(weights, _ADDS_ANGLES)
    return _per_pose(
        T_camera_truth,
        T_camera_estimate,
        lambda Q, t: float(weights @ _distance_to_profile_m(points @ Q.T + t, profile_m) / weights.sum()),
    )


def squared_mahalanobis(
    T_camera_truth: FloatArray, T_camera_estimate: FloatArray, covariance: FloatArray
) -> FloatArray:
    """Squared errors of poses in units of their stated covariance, shape (N,); NaN without a pose or a covariance.

    The error is the swing about x and y and the shift along x, y and z that take the estimate to the truth, in the
    estimate's frame, as the covariance is stated. If that is honest, the squares follow the chi-square law with 5
    degrees of freedom: 95 % of them are below 11.07.

    Args:
        T_camera_truth: Array of shape (N, 4, 4), metres.
        T_camera_estimate: Array of shape (N, 4, 4), metres.
        covariance: Array of shape (N, 5, 5), over (rx, ry, tx, ty, tz), rad and metres.
    """
    D = _relative(T_camera_estimate, T_camera_truth)
    error = np.column_stack([_swing_rad(D[:, :3, 2])[:, :2], D[:, :3, 3]])
    known = np.flatnonzero(np.isfinite(error).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)))
    known = known[np.linalg.eigvalsh(covariance[known])[:, 0] > 0]
    squares = np.full(len(error), np.nan)
    if len(known):
        solved = np.linalg.solve(covariance[known], error[known][..., None])[..., 0]
        squares[known] = np.einsum("ni,ni->n", error[known], solved)
    return squares


def _relative(T_camera_truth: FloatArray, T_camera_estimate: FloatArray) -> FloatArray:
    """``inv(T_camera_truth) @ T_camera_estimate`` for arrays of shape (N, 4, 4)."""
    truth, estimate = np.asarray(T_camera_truth, dtype=float), np.asarray(T_camera_estimate, dtype=float)
    if truth.shape != estimate.shape or truth.shape[1:] != (4, 4):
        raise ValueError(f"expected two arrays of shape (N, 4, 4), found {truth.shape} and {estimate.shape}")
    R_t = truth[:, :3, :3].transpose(0, 2, 1)
    D = np.tile(np.eye(4), (len(truth), 1, 1))
    D[:, :3, :3] = R_t @ estimate[:, :3, :3]
    D[:, :3, 3] = (R_t @ (estimate[:, :3, 3] - truth[:, :3, 3])[..., None])[..., 0]
    return D


def _cap_error_mm(D: FloatArray, heights_m: FloatArray | None) -> FloatArray:
    if heights_m is None:
        return np.full(len(D), np.nan)
    cap_m = np.asarray(heights_m, dtype=float)[:, None] * np.array([0.0, 0.0, 1.0])
    moved_m = (D[:, :3, :3] @ cap_m[..., None])[..., 0] + D[:, :3, 3]
    return np.asarray(np.linalg.norm(moved_m - cap_m, axis=1) * MM_PER_M)


def _swing_rad(axis: FloatArray) -> FloatArray:
    """Rotation vectors (N, 3) without z part that turn e_z onto unit axes (N, 3); about x where the axis is -z."""
    sine = np.hypot(axis[:, 0], axis[:, 1])
    angle = np.arctan2(sine, axis[:, 2])
    with np.errstate(divide="ignore", invalid="ignore"):
        direction = np.stack([-axis[:, 1] / sine, axis[:, 0] / sine, np.zeros(len(axis))], axis=1)
    direction = np.where((sine == 0)[:, None], [1.0, 0.0, 0.0], direction)
    return np.asarray(angle[:, None] * direction)


def _per_pose(
    T_camera_truth: FloatArray, T_camera_estimate: FloatArray, distance_m: Callable[[FloatArray, FloatArray], float]
) -> FloatArray:
    """Apply a distance to the swing (3, 3) and the offset (3,) of every pose; NaN where a pose is not finite."""
    D = _relative(T_camera_truth, T_camera_estimate)
    found = np.full(len(D), np.nan)
    for i in np.flatnonzero(np.isfinite(D).all(axis=(1, 2))):
        # The spin is dropped here, once, so that no sampling of the circle can bring it back.
        swing = Rotation.from_rotvec(_swing_rad(D[i : i + 1, :3, 2])[0]).as_matrix()
        found[i] = distance_m(swing, D[i, :3, 3]) * MM_PER_M
    return found


def _mssd_m(swing: FloatArray, offset_m: FloatArray, points_m: FloatArray) -> float:
    moved = points_m @ swing.T + offset_m
    # |moved - Rz(s) p|^2 = constant - 2 (a cos s + b sin s), so a spin costs two products per point.
    constant = (moved**2).sum(axis=1) + (points_m**2).sum(axis=1) - 2 * moved[:, 2] * points_m[:, 2]
    a = moved[:, 0] * points_m[:, 0] + moved[:, 1] * points_m[:, 1]
    b = moved[:, 1] * points_m[:, 0] - moved[:, 0] * points_m[:, 1]
    best, half = 0.0, np.pi
    largest = np.empty(0)
    for _ in range(_SPIN_LEVELS):
        spins = best + np.linspace(-half, half, _SPIN_STEPS)
        squared = constant - 2 * (np.cos(spins)[:, None] * a + np.sin(spins)[:, None] * b)
        largest = squared.max(axis=1)
        best, half = float(spins[np.argmin(largest)]), half / 16
    return float(np.sqrt(max(largest.min(), 0.0)))


def _revolve(profile_m: FloatArray, angles: int) -> FloatArray:
    """Points (P * angles, 3) on the circles of a profile (P, 2) of rows (z, r), circle by circle."""
    phi = np.arange(angles) * 2 * np.pi / angles
    z, r = np.asarray(profile_m, dtype=float).T
    x, y = np.outer(r, np.cos(phi)), np.outer(r, np.sin(phi))
    return np.stack([x, y, np.repeat(z[:, None], angles, axis=1)], axis=-1).reshape(-1, 3)


def _area_samples(profile_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Midpoints (S, 2) of short pieces of a profile (P, 2), and the area that each sweeps (up to 2 pi)."""
    starts, ends, pieces = profile_m[:-1], profile_m[1:], []
    lengths = np.linalg.norm(ends - starts, axis=1)
    for start, end, length in zip(starts, ends, lengths, strict=True):
        count = max(1, int(np.ceil(length / _ADDS_SPACING_M)))
        middle = (np.arange(count) + 0.5)[:, None] / count
        points = start + middle * (end - start)
        pieces.append(np.column_stack([points, points[:, 1] * length / count]))
    rows = np.vstack(pieces)
    return rows[:, :2], rows[:, 2]


def _distance_to_profile_m(points_m: FloatArray, profile_m: FloatArray) -> FloatArray:
    """Distance of points (N, 3) to the surface of revolution of a profile (P, 2) of rows (z, r), shape (N,)."""
    z, r = points_m[:, 2], np.hypot(points_m[:, 0], points_m[:, 1])
    nearest2 = np.full(len(points_m), np.inf)
    for (z0, r0), (along_z, along_r) in zip(profile_m[:-1], np.diff(profile_m, axis=0), strict=True):
        length2 = max(along_z**2 + along_r**2, np.finfo(float).tiny)
        share = np.clip(((z - z0) * along_z + (r - r0) * along_r) / length2, 0, 1)
        np.minimum(nearest2, (z - z0 - share * along_z) ** 2 + (r - r0 - share * along_r) ** 2, out=nearest2)
    return np.asarray(np.sqrt(nearest2))
