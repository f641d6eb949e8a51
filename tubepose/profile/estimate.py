"""The estimator `profile`: every tube of a frame at once, from its top, its wall and its slot (docs/method.md)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.checks import Check, first_reason, said, sentence
from tubepose.confidence import confidence
from tubepose.config import Config, ProfileConfig
from tubepose.labware import RackModel, TubeModel
from tubepose.preprocessing import TALLEST_TUBE_M
from tubepose.profile.bowed import FaceBow, SlotFrame, in_rack_frame, slot_frame
from tubepose.profile.closed_tops import Measured, filled_share, higher_share, top_measures
from tubepose.profile.floor import SETTLED_MM, settle_floor
from tubepose.profile.fusing import fuse, pose_covariance, rise_m
from tubepose.profile.kernels import grouped
from tubepose.profile.leftovers import Leftover, find_leftovers
from tubepose.profile.measure import measure_tops
from tubepose.profile.plane import top_spacing_m
from tubepose.profile.posterior import Posterior, per_model
from tubepose.profile.standing import Standing, gather_standing
from tubepose.profile.top_noise import TopNoise, believed, cap_discs, height_limit_m, noisy_config, wall_noise
from tubepose.profile.tops import top_radius_m
from tubepose.profile.verdict import p_type, tube_checks
from tubepose.sensor import SensorNoise, prior_noise
from tubepose.sensor.caps import CapDisc, seen_on_caps
from tubepose.transforms import FloatArray, axis_rotations, transform_points
from tubepose.tube import TopMeasure, TubePose, TubeStatus


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


@dataclass(frozen=True, slots=True, eq=False)
class ProfileFit:
    """What `profile` says of a frame.

    Attributes:
        tubes: Tubes by slot, then what is left over.
        noise: Of the sensor, as it was used.
    """

    tubes: tuple[ProfileTube, ...]
    noise: SensorNoise


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """A flat rack, or the neighbourhood of a slot of a bowed one, and the tops in it."""

    T_camera_rack: FloatArray
    rack: RackModel
    covariance: FloatArray | None
    measured: Measured
    local: SlotFrame | None

    def models(self, tubes: Sequence[TubeModel]) -> list[TubeModel]:
        """Types of the tops."""
        return [tubes[k] for k in self.measured.tops.tube]


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
    noise: SensorNoise | None = None,
) -> tuple[ProfileTube, ...]:
    """Poses of all tubes of a frame: `fit_frame`, the tubes alone."""
    return fit_frame(
        frame, intrinsics, T_camera_rack, rack, tubes, config,
        rack_covariance=rack_covariance, allowed=allowed, bow=bow, noise=noise,
    ).tubes  # fmt: skip


def fit_frame(
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
    noise: SensorNoise | None = None,
) -> ProfileFit:
    """Poses of all tubes of a frame, and the noise that they were judged with.

    Args:
        frame: The frame.
        intrinsics: Of its image, where there is one.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
        rack: The rack.
        tubes: Types that can stand in it.
        config: Sections profile, sensor and slots are used.
        rack_covariance: Of the rack's pose, shape (6, 6), as `RackPose.covariance`; None counts as exact.
        allowed: Which type may stand in which slot, shape (K, S), where a detector says; all by default.
        bow: Of the rack's face; None counts as flat.
        noise: Of the sensor, as `measure_noise` has it; None takes the prior of section sensor. The caps of the
            frame are asked too.

    Returns:
        Tubes by slot, then what is left over; without types, all that stands there is.
    """
    noise = prior_noise(config.sensor, "not measured") if noise is None else noise
    if not tubes:
        standing = _all_standing(frame, intrinsics, T_camera_rack, rack, config)
        unknown = find_leftovers(standing, np.full(len(standing.points_m), -1), (), rack, ())
        return ProfileFit(tuple(_no_tube(left, standing, rack) for left in unknown), noise)
    if rack.floor_tolerance_mm > SETTLED_MM:
        rack = settle_floor(_all_standing(frame, intrinsics, T_camera_rack, rack, config), rack, tubes, config.profile)
    config = noisy_config(config, noise, T_camera_rack, rack)
    parts: list[_Part] = []
    if bow is None or not bow.bow_m.any():
        measured = measure_tops(frame, intrinsics, T_camera_rack, rack, tubes, config, allowed)
        parts.append(_Part(T_camera_rack, rack, rack_covariance, measured, None))
    else:
        for index in range(len(rack.all_slots)):
            local = slot_frame(rack, index, bow, rack_covariance)
            may, T = None if allowed is None else allowed[:, local.rows], T_camera_rack @ local.T_rack_local
            measured = measure_tops(frame, intrinsics, T, local.rack, tubes, config, may)
            parts.append(_Part(T, local.rack, local.covariance, measured, local))
    noise = seen_on_caps(noise, [disc for part in parts for disc in _cap_discs(part, tubes)])
    found = [tube for part in parts for tube in _fit_part(part, tubes, noise, config.profile)]
    known, unknown_things = ([tube for tube in found if (tube.tube is None) is none] for none in (False, True))
    return ProfileFit((*known, *unknown_things), noise)


def _cap_discs(part: _Part, tubes: Sequence[TubeModel]) -> list[CapDisc]:
    """The flat tops of a part's caps; of a slot's neighbourhood, its own."""
    discs = cap_discs(part.measured, part.models(tubes), part.T_camera_rack)
    if part.local is None:
        return list(discs.values())
    return [disc for i, disc in discs.items() if part.measured.tops.slot[i] == 0]


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


def _fit_part(part: _Part, tubes: Sequence[TubeModel], noise: SensorNoise, config: ProfileConfig) -> list[ProfileTube]:
    """Poses of all tubes in a rack with a flat face, in the frame of the rack that it is a part of."""
    rack, models, strangers = part.rack, part.models(tubes), part.measured.strangers
    taken = [*part.measured.tops.slot.tolist(), *(left.slot for left in strangers if left.slot is not None)]
    leftovers = find_leftovers(part.measured.points, part.measured.label, taken, rack, tubes)
    measured, top_noise = believed(part.measured, models, part.T_camera_rack, rack, noise, config, part.covariance)
    posterior = fuse(measured, models, rack, config, wall_noise(measured.points.camera_m, rack, noise))
    covariance = pose_covariance(posterior, measured, models, rack, config, part.covariance, top_noise)
    rise = rise_m(measured, models, rack, config, top_noise)
    clouds = _clouds(measured, len(models))
    found = []
    middles = (higher_share(measured, tubes, rack), filled_share(measured, tubes, rack))
    poses = _poses(measured, posterior, covariance, rise, clouds, models, rack, config, top_noise, middles)
    for i, (tube, pose) in enumerate(zip(models, poses, strict=True)):
        slot = rack.all_slots[measured.tops.slot[i]]
        crowd = next((left.reason for left in leftovers if left.slot == measured.tops.slot[i]), "")
        if crowd and pose.status is TubeStatus.OK:
            pose = _rejected(pose, said("two_in_slot", crowd))
        found.append(ProfileTube(slot.name, tube, float(measured.tops.support[i]), clouds[i], pose))
    found += [_no_tube(left, measured.points, rack) for left in (*strangers, *leftovers)]
    if part.local is None:
        return found
    return [_of_rack(tube, part.local) for tube in found if _is_of(tube, rack)]


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


def _poses(
    measured: Measured,
    posterior: Posterior,
    covariance: FloatArray,
    rise_m: FloatArray,
    clouds: Sequence[FloatArray],
    models: Sequence[TubeModel],
    rack: RackModel,
    config: ProfileConfig,
    noise: TopNoise,
    middles: tuple[FloatArray, FloatArray],
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
        "higher": middles[0],
        "filled": middles[1],
        "high_m": measured.planes.height_m - rack.floor_m - height,
        "tilt_std_rad": tilt_std,
        "looked_at": (is_open == 0) | np.isfinite(circles.widening_m),
        "runner_up": tops.runner_up / tops.support,
        "spacing_m": top_spacing_m(measured.planes, per_model(models, top_radius_m)),
    }
    columns = [values.tolist() for values in verdicts.values()]
    sure, measures = confidence(covariance), top_measures(measured, axis[:, 2], models, rack)
    odds = np.full(len(models), np.nan) if measured.type_odds is None else measured.type_odds
    of_type = [p_type(tops.support[i], tops.runner_up[i], top_radius_m(tube), odds[i]) for i, tube in enumerate(models)]
    limits = height_limit_m(noise.height_var_m2, config).tolist()
    found = []
    for i, (tube, *values) in enumerate(zip(models, *columns, strict=True)):
        told = dict(zip(verdicts, values, strict=True))
        gates = config.model_copy(update={"max_height_error_m": limits[i]})
        checks = tube_checks(**told, tube=tube, rack=rack, slot=rack.all_slots[tops.slot[i]].name, config=gates)
        reason = first_reason(checks, tube.name)
        found.append(
            TubePose(
                TubeStatus.REJECTED if reason else TubeStatus.OK,
                reason,
                T[i],
                confidence=float(sure[i]) * of_type[i],
                top_rms_m=float(measured.planes.rms_m[i]),
                top_seen_share=told["sectors"],
                n_points=len(clouds[i]),
                covariance=covariance[i],
                checks=checks,
                top=measures[i],
            )
        )
    return found


def _rejected(pose: TubePose, check: Check) -> TubePose:
    return replace(pose, status=TubeStatus.REJECTED, reason=sentence(check, ""), checks=(*pose.checks, check))


def _no_tube(left: Leftover, standing: Standing, rack: RackModel) -> ProfileTube:
    """What is left over, as a tube without a pose."""
    points_m = standing.points_m[left.rows]
    slot = rack.all_slots[left.slot].name if left.slot is not None else None
    check = said(left.code, left.reason)
    top = TopMeasure(float(np.median(points_m[:, 2])) - rack.floor_m) if left.slot is not None else None
    pose = TubePose(TubeStatus.REJECTED, left.reason, n_points=len(points_m), checks=(check,), top=top)
    return ProfileTube(slot, None, float("nan"), points_m, pose)
