"""Racks, tubes and frames with known poses for the tests of the estimators: sampled surfaces, no sensor."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.spatial.transform import Rotation

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.labware import RackModel, TubeModel
from tubepose.transforms import FloatArray, invert_transform, make_transform, tilt_rotation, transform_points

SPACING_M = 0.8e-3
TUBE_SPACING_M = 0.5e-3
NOISE_M = 0.1e-3
CAMERA = CameraIntrinsics(640, 480, 1100.0, 1100.0, 319.5, 239.5)


def rack_top(rack: RackModel, seed: int = 0, spacing_m: float = SPACING_M, noise_m: float = NOISE_M) -> FloatArray:
    """Points on the solid part of the top, rack frame, in random order."""
    rng = np.random.default_rng(seed)
    axes = [(np.arange(n := round(side / spacing_m)) + 0.5) / n * side - side / 2 for side in rack.outline_m]
    xy = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 2)
    xy += rng.uniform(-0.3, 0.3, xy.shape) * spacing_m
    xy = rng.permutation(xy[rack.top_signed_distance_m(xy) < 0])
    return np.column_stack([xy, np.full(len(xy), rack.height_m)]) + rng.normal(0, noise_m, (len(xy), 3))


def hidden_by(top: FloatArray, places: Iterable[tuple[float, float]], reach_m: float) -> FloatArray:
    """The points of a top, rack frame, less what is under discs about some places."""
    for place in places:
        top = top[np.hypot(*(top[:, :2] - place).T) > reach_m]
    return top


def slot_floors(rack: RackModel, seed: int = 0, spacing_m: float = 1.5e-3) -> FloatArray:
    """Points on the floors of all slots, rack frame."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-rack.outline_m / 2, rack.outline_m / 2, (int(np.prod(rack.outline_m) / spacing_m**2), 2))
    inside = np.min([slot.signed_distance_m(xy) for slot in rack.all_slots], axis=0) < 0
    return np.column_stack([xy[inside], np.full(inside.sum(), rack.floor_m)])


def seen_past_the_top(points_m: FloatArray, rack: RackModel, T_camera_rack: FloatArray) -> FloatArray:
    """The points of shape (N, 3), camera frame, whose line of sight does not meet the solid part of a rack's top."""
    local = transform_points(invert_transform(T_camera_rack), points_m)
    camera = invert_transform(T_camera_rack)[:3, 3]
    share = (local[:, 2] - rack.height_m) / (local[:, 2] - camera[2])
    crossing = local[:, :2] + share[:, None] * (camera[:2] - local[:, :2])
    return points_m[(local[:, 2] > rack.height_m) | (rack.top_signed_distance_m(crossing) > 0)]


def tube_pose(
    rack: RackModel, slot: str, alpha_rad: float = 0.0, beta_rad: float = 0.0, off_m: tuple[float, float] = (0.0, 0.0)
) -> FloatArray:
    """T_rack_tube of a tube that stands on a slot's floor, leaning by Eq. 1, its bottom `off_m` from the centre."""
    origin = rack.bottom_center_m(rack.slot(slot)) + np.array([*off_m, 0.0])
    return make_transform(tilt_rotation(alpha_rad, beta_rad), origin)


def tube_surface(
    tube: TubeModel,
    T_rack_tube: FloatArray,
    above_m: float,
    seed: int = 0,
    spacing_m: float = TUBE_SPACING_M,
    noise_m: float = NOISE_M,
    seen_from: FloatArray | None = None,
) -> FloatArray:
    """Points on the outside of a tube that are higher than `above_m`, rack frame, in random order.

    The profile is turned about the axis with the same number of points per area everywhere. With `seen_from`, a unit
    direction in the rack frame, points thin out with the cosine of incidence and the far side has none, as pixels do.
    """
    rng = np.random.default_rng(seed)
    profile = tube.outer_profile_m()
    (z0, r0), (z1, r1) = profile[:-1].T, profile[1:].T
    length = np.hypot(z1 - z0, r1 - r0)
    area = np.pi * length * (r0 + r1)
    k = rng.choice(len(area), int(area.sum() / spacing_m**2), p=area / area.sum())
    # Even in area: the share of the segment below t grows with the square of the radius.
    u = rng.uniform(size=len(k))
    r = np.sqrt(r0[k] ** 2 + u * (r1[k] ** 2 - r0[k] ** 2))
    flat = np.isclose(r0[k], r1[k])
    t = np.where(flat, u, (r - r0[k]) / np.where(flat, 1.0, r1[k] - r0[k]))
    z = z0[k] + t * (z1[k] - z0[k])
    turn = rng.uniform(0, 2 * np.pi, len(k))
    local = np.column_stack([r * np.cos(turn), r * np.sin(turn), z])
    points = transform_points(T_rack_tube, local) + rng.normal(0, noise_m, local.shape)
    kept = points[:, 2] > above_m
    if seen_from is not None:
        n_r, n_z = (z1 - z0)[k] / length[k], -(r1 - r0)[k] / length[k]
        normals = np.column_stack([n_r * np.cos(turn), n_r * np.sin(turn), n_z]) @ T_rack_tube[:3, :3].T
        kept &= normals @ seen_from > rng.uniform(size=len(k))
    return points[kept]


def towards_camera(T_camera_rack: FloatArray) -> FloatArray:
    """Unit direction from the rack to the camera, rack frame."""
    return np.asarray(-T_camera_rack[2, :3])


def camera_from_rack(
    rack: RackModel, yaw_rad: float = 0.0, tilt_rad: float = 0.0, distance_m: float = 0.6
) -> FloatArray:
    """T_camera_rack of a rack whose top's centre is on the optical axis, turned by yaw, seen `tilt_rad` off its normal.

    At yaw 0 the rack's x points along the image's u, its y up in the image.
    """
    R = (Rotation.from_euler("x", np.pi + tilt_rad) * Rotation.from_euler("z", yaw_rad)).as_matrix()
    return make_transform(R, np.array([0.0, 0.0, distance_m]) - rack.height_m * R[:, 2])


def unorganised(points_m: FloatArray) -> RgbdFrame:
    """A frame of points without pixels."""
    return RgbdFrame(points_m[None], None, None, None, "test", organised=False)


def organised(points_m: FloatArray, camera: CameraIntrinsics = CAMERA) -> RgbdFrame:
    """A frame in which every pixel holds the nearest of the points that fall on it; NaN without any."""
    cloud = np.full((camera.height, camera.width, 3), np.nan)
    far_first = points_m[np.argsort(-points_m[:, 2], kind="stable")]
    u, v = np.rint(camera.project(far_first)).astype(int).T
    seen = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    cloud[v[seen], u[seen]] = far_first[seen]
    return RgbdFrame(cloud, None, camera, None, "test")


def angle_deg(R_a: FloatArray, R_b: FloatArray) -> float:
    """Angle between two rotations, degrees."""
    return float(np.rad2deg(Rotation.from_matrix(R_a.T @ R_b).magnitude()))
