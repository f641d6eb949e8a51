"""The estimator `profile`: every tube of a frame at once, from its top, its wall and its slot (docs/method.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.config import Config, ProfileConfig
from tubepose.labware import RackModel, TubeModel
from tubepose.preprocessing import TALLEST_TUBE_M
from tubepose.profile.bowed import FaceBow, SlotFrame, in_rack_frame, slot_frame
from tubepose.profile.closed_tops import Measured
from tubepose.profile.floor import SETTLED_MM, settle_floor
from tubepose.profile.kernels import grouped
from tubepose.profile.leftovers import Leftover, find_leftovers
from tubepose.profile.measure import measure_tops
from tubepose.profile.plane import top_spacing_m
from tubepose.profile.posterior import FEW_SAMPLES, Evidence, Posterior, combine, evidence, per_model
from tubepose.profile.standing import Standing, gather_standing
from tubepose.profile.tops import top_radius_m
from tubepose.profile.verdict import rejection, score
from tubepose.profile.wall import wall_evidence
from tubepose.transforms import FloatArray, axis_rotations, transform_points
from tubepose.tube import TubePose, TubeStatus


@dataclass(frozen=True, slots=True, eq=False)
class ProfileTube:
    """One tube, or something that looks like none.

    Attributes:
        slot: Name of its slot, or None where it stands in none.
        tube: Its type, or None where it is unknown.
        support: Share of its top that was seen less that of its surroundings, 0 to 1; NaN where it has no top.
        points_m: Its points, rack frame, shape (N, 3), metres.
        pose: Its pose in the rack frame, with covariance; or why there is none.
    """

    slot: str | None
    tube: TubeModel | None
    support: float
    points_m: FloatArray
    pose: TubePose


def fit_profiles(
    frame: RgbdFrame,
    intrinsics: CameraIntrinsics | None,
    T_camera_rack: FloatArray,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    config: Config,
    *,
    rack_covariance: FloatArray | None = None,
    allowed: NDArray[np.bool_] | None = None,
    bow: FaceBow | None = None,
) -> tuple[ProfileTube, ...]:
    """Poses of all tubes of a frame.

    Args:
        frame: The frame.
        intrinsics: Of its image, where there is one.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
        rack: The rack.
        tubes: Types that can stand in it.
        config: Sections profile and slots are used.
        rack_covariance: Of the rack's pose, shape (6, 6), as `RackPose.covariance`; None counts as exact.
        allowed: Which type may stand in which slot, shape (K, S), where a detector says; all by default.
        bow: Of the rack's face; None counts as flat.

    Returns:
        Tubes by slot, then what is left over; without types, all that stands there is.
    """
    if tubes and rack.floor_tolerance_mm > SETTLED_MM:
        rack = settle_floor(_all_standing(frame, intrinsics, T_camera_rack, rack, config), rack, tubes, config.profile)
    if bow is None or not bow.bow_m.any():
        return _fit_flat(frame, intrinsics, T_camera_rack, rack, tubes, config, rack_covariance, allowed)
    found: list[ProfileTube] = []
    for index in range(len(rack.all_slots)):
        local = slot_frame(rack, index, bow, rack_covariance)
        may = None if allowed is None else allowed[:, local.rows]
        there = _fit_flat(
            frame, intrinsics, T_camera_rack @ local.T_rack_local, local.rack, tubes, config, local.covariance, may
        )
        found += [_of_rack(tube, local) for tube in there if _is_of(tube, local.rack)]
    return (*(tube for tube in found if tube.tube is not None), *(tube for tube in found if tube.tube is None))


def _is_of(tube: ProfileTube, local: RackModel) -> bool:
    """Whether something belongs to the first slot of a neighbourhood and not to its neighbours."""
    if tube.slot is not None:
        return tube.slot == local.all_slots[0].name
    middle = tube.points_m[:, :2].mean(axis=0)
    return bool(np.linalg.norm(local.slot_centers_m - middle, axis=1).argmin() == 0)


def _of_rack(tube: ProfileTube, local: SlotFrame) -> ProfileTube:
    """Something of a slot's frame, in the rack's frame."""
    points_m = transform_points(local.T_rack_local, tube.points_m)
    T = tube.pose.T_rack_tube
    pose = tube.pose if T is None else replace(tube.pose, T_rack_tube=in_rack_frame(T, local))
    return replace(tube, points_m=points_m, pose=pose)


def _fit_flat(
    frame: RgbdFrame,
    intrinsics: CameraIntrinsics | None,
    T_camera_rack: FloatArray,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    config: Config,
    rack_covariance: FloatArray | None,
    allowed: NDArray[np.bool_] | None,
) -> tuple[ProfileTube, ...]:
    """Poses of all tubes in a rack with a flat face; arguments as of `fit_profiles`."""
    if not tubes:
        standing = _all_standing(frame, intrinsics, T_camera_rack, rack, config)
        unknown = find_leftovers(standing, np.full(len(standing.points_m), -1), (), rack, ())
        return tuple(_no_tube(left, standing, rack) for left in unknown)
    measured = measure_tops(frame, intrinsics, T_camera_rack, rack, tubes, config, allowed)
    models = [tubes[k] for k in measured.tops.tube]
    taken = [*measured.tops.slot.tolist(), *(left.slot for left in measured.strangers if left.slot is not None)]
    leftovers = find_leftovers(measured.points, measured.label, taken, rack, tubes)
    posterior = fuse(measured, models, rack, config.profile)
    covariance = pose_covariance(posterior, measured, models, rack, config.profile, rack_covariance)
    rise = _rise_m(measured, models, rack, config.profile)
    clouds = _clouds(measured, len(models))
    found = []
    poses = _poses(measured, posterior, covariance, rise, clouds, models, rack, config.profile)
    for i, (tube, pose) in enumerate(zip(models, poses, strict=True)):
        slot = rack.all_slots[measured.tops.slot[i]]
        crowd = next((left.reason for left in leftovers if left.slot == measured.tops.slot[i]), "")
        if crowd and pose.status is TubeStatus.OK:
            pose = _rejected(pose, f"two tubes in one slot: {crowd}")
        found.append(ProfileTube(slot.name, tube, float(measured.tops.support[i]), clouds[i], pose))
    return (*found, *(_no_tube(left, measured.points, rack) for left in (*measured.strangers, *leftovers)))


def _clouds(measured: Measured, count: int) -> list[FloatArray]:
    """The points of every tube, shape (N, 3) each."""
    ordered, ends = grouped(measured.points.points_m, measured.label, count)
    return [ordered[ends[i] : ends[i + 1]] for i in range(count)]


def _all_standing(
    frame: RgbdFrame, intrinsics: CameraIntrinsics | None, T_camera_rack: FloatArray, rack: RackModel, config: Config
) -> Standing:
    """All points above a rack whose floor, and so the height of its tubes, is not known."""
    lowest_m = rack.height_m + config.slots.clearance_m
    return gather_standing(frame, intrinsics, T_camera_rack, rack, lowest_m, lowest_m + TALLEST_TUBE_M)


def fuse(measured: Measured, models: Sequence[TubeModel], rack: RackModel, config: ProfileConfig) -> Posterior:
    """Axes from tops and slots, then from the walls near them too."""
    slots = [rack.all_slots[i] for i in measured.tops.slot]
    centers = rack.slot_centers_m[measured.tops.slot]
    tops = top_evidence(measured, models, rack, config)
    start = combine(tops, slots, models, rack, config, FEW_SAMPLES)
    walls = wall_evidence(measured.points, measured.label, start.mean, centers, models, rack, config)
    return combine(tops + walls, slots, models, rack, config)


def top_evidence(measured: Measured, models: Sequence[TubeModel], rack: RackModel, config: ProfileConfig) -> Evidence:
    """What tops say of axes: the axis through the circle's middle, along the normal but for the cap's seat."""
    count = len(models)
    centers = rack.slot_centers_m[measured.tops.slot]
    lever = measured.level_m - rack.floor_m - per_model(models, lambda tube: tube.pivot_height_m)
    through = np.zeros((count, 2, 4))
    through[:, [0, 1], [0, 1]] = 1.0
    through[:, [0, 1], [2, 3]] = lever[:, None]
    along = np.zeros((count, 2, 4))
    along[:, [0, 1], [2, 3]] = 1.0
    variance = measured.planes.slope_var + config.cap_tilt_rad**2
    return evidence(through, measured.center_m - centers, measured.circles.covariance_m2) + evidence(
        along, -measured.planes.slope, variance[:, None, None] * np.eye(2)
    )


def _rise_m(measured: Measured, models: Sequence[TubeModel], rack: RackModel, config: ProfileConfig) -> FloatArray:
    """How far tubes stand above the floor, shape (T,), metres: the floor's height and a closed top's, weighed."""
    expected = rack.floor_m + per_model(models, lambda tube: tube.height_m)
    seen = np.nan_to_num(measured.planes.height_m - expected)
    return np.asarray(seen * _rise_gain(measured, rack, config))


def _rise_gain(measured: Measured, rack: RackModel, config: ProfileConfig) -> FloatArray:
    """Weight of a top's height against the floor's, shape (T,): 0 for open tops, whose light comes from below them."""
    floor2 = (rack.floor_tolerance_mm * 1e-3) ** 2
    gain = floor2 / (floor2 + config.cap_height_m**2)
    return np.where(np.isfinite(measured.planes.height_m), gain, 0.0)


def pose_covariance(
    posterior: Posterior,
    measured: Measured,
    models: Sequence[TubeModel],
    rack: RackModel,
    config: ProfileConfig,
    rack_covariance: FloatArray | None,
) -> FloatArray:
    """Covariance of poses over (rotation about x, about y; translation along x, y, z), shape (T, 5, 5), rad and metres.

    The axes are the tube's own at its bottom. The rack's error moves the floor and not what was seen of the top: it
    shifts the bottom, and turns the axis by that shift over the distance between them.
    """
    count = len(models)
    held, height = per_model(models, lambda tube: (tube.pivot_height_m, tube.height_m)).reshape(-1, 2).T
    J = np.zeros((count, 5, 4))
    J[:, 0, 3], J[:, 1, 2] = -1.0, 1.0
    J[:, [2, 3], [0, 1]] = 1.0
    J[:, [2, 3], [2, 3]] = -held[:, None]
    covariance = np.einsum("tij,tjk,tlk->til", J, posterior.covariance, J)
    covariance[:, 4, 4] += (1 - _rise_gain(measured, rack, config)) * (rack.floor_tolerance_mm * 1e-3) ** 2
    if rack_covariance is None:
        return np.asarray(covariance)
    arm = np.column_stack([rack.slot_centers_m[measured.tops.slot], np.full(count, rack.floor_m - rack.height_m)])
    moved = np.zeros((count, 3, 6))
    moved[:, :, 3:] = np.eye(3)
    moved[:, 0, 1], moved[:, 0, 2] = arm[:, 2], -arm[:, 1]
    moved[:, 1, 0], moved[:, 1, 2] = -arm[:, 2], arm[:, 0]
    moved[:, 2, 0], moved[:, 2, 1] = arm[:, 1], -arm[:, 0]
    K = np.zeros((count, 5, 3))
    K[:, 0, 1], K[:, 1, 0] = 1 / height, -1 / height
    K[:, [2, 3, 4], [0, 1, 2]] = 1.0
    chain = np.einsum("tij,tjk->tik", K, moved)
    return np.asarray(covariance + np.einsum("tij,jk,tlk->til", chain, rack_covariance, chain))


def _poses(
    measured: Measured,
    posterior: Posterior,
    covariance: FloatArray,
    rise_m: FloatArray,
    clouds: Sequence[FloatArray],
    models: Sequence[TubeModel],
    rack: RackModel,
    config: ProfileConfig,
) -> list[TubePose]:
    """Pose and verdict of every tube."""
    tops, circles = measured.tops, measured.circles
    held, height, is_open = per_model(
        models, lambda tube: (tube.pivot_height_m, tube.height_m, tube.is_open)
    ).reshape(-1, 3).T  # fmt: skip
    axis = np.column_stack([posterior.mean[:, 2:], np.ones(len(models))])
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    foot = np.column_stack([rack.slot_centers_m[tops.slot] + posterior.mean[:, :2], rack.floor_m + held + rise_m])
    T = np.tile(np.eye(4), (len(models), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = axis_rotations(axis), foot - held[:, None] * axis
    tilt_std = np.sqrt(covariance[:, 0, 0] + covariance[:, 1, 1])
    verdicts = {
        "sectors": circles.sectors,
        "allowed": posterior.allowed,
        "high_m": measured.planes.height_m - rack.floor_m - height,
        "tilt_std_rad": tilt_std,
        "looked_at": (is_open == 0) | np.isfinite(circles.widening_m),
        "runner_up": tops.runner_up / tops.support,
        "spacing_m": top_spacing_m(measured.planes, per_model(models, top_radius_m)),
    }
    columns = [values.tolist() for values in verdicts.values()]
    found = []
    for i, (tube, *values) in enumerate(zip(models, *columns, strict=True)):
        said = dict(zip(verdicts, values, strict=True))
        reason = rejection(**said, tube=tube, rack=rack, slot=rack.all_slots[tops.slot[i]].name, config=config)
        found.append(
            TubePose(
                TubeStatus.REJECTED if reason else TubeStatus.OK,
                reason,
                T[i],
                score=score(said["tilt_std_rad"], said["sectors"], said["allowed"], config),
                inlier_rmse_m=float(measured.planes.rms_m[i]),
                fitness=said["sectors"],
                n_points=len(clouds[i]),
                covariance=covariance[i],
            )
        )
    return found


def _rejected(pose: TubePose, reason: str) -> TubePose:
    return TubePose(
        TubeStatus.REJECTED,
        reason,
        pose.T_rack_tube,
        pose.score,
        pose.inlier_rmse_m,
        pose.fitness,
        pose.n_points,
        pose.covariance,
    )


def _no_tube(left: Leftover, standing: Standing, rack: RackModel) -> ProfileTube:
    """What is left over, as a tube without a pose."""
    points_m = standing.points_m[left.rows]
    slot = rack.all_slots[left.slot].name if left.slot is not None else None
    return ProfileTube(
        slot, None, float("nan"), points_m, TubePose(TubeStatus.REJECTED, left.reason, n_points=len(points_m))
    )
