"""What the sensor's noise does to tops: how far their points scatter, and what that leaves of planes and circles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tubepose.config import Config, ProfileConfig
from tubepose.labware import RackModel, TubeModel
from tubepose.profile.closed_tops import ON_PLANE_SHARE, Measured
from tubepose.profile.kernels import grouped
from tubepose.profile.plane import EDGE_M
from tubepose.profile.posterior import per_model
from tubepose.profile.tops import top_radius_m
from tubepose.profile.wall import WallNoise
from tubepose.sensor import SensorNoise
from tubepose.sensor.caps import CapDisc
from tubepose.sensor.noise import PRIOR
from tubepose.transforms import FloatArray

BAND_STDS = 3.0
"""A band about a height is so many standard deviations of its points wide: 3 in 1000 are left out."""
SMALLEST_DISC_M = 2.0e-3
"""A plane through less than this of a top is as bad as through this much: four points of REAL scanners across."""

OFF_STDS = 4.0
"""Points farther off their plane than so many standard deviations are not of it (normal errors: 1 of 16 000)."""


@dataclass(frozen=True, slots=True, eq=False)
class TopNoise:
    """What is not known of the heights of tops in a frame, T tubes.

    Attributes:
        height_var_m2: Variance of a closed top's measured height above the rack's base, shape (T,): the sensor's part
            and that of the rack's pose; as if it had been seen for an open one.
        sight: How far the line of sight through a top's middle moves along x and y per height, shape (T, 2).
    """

    height_var_m2: FloatArray
    sight: FloatArray


def noisy_config(config: Config, noise: SensorNoise, T_camera_rack: FloatArray, rack: RackModel) -> Config:
    """The settings for a frame: bands of heights and noise of outlines grow with the sensor's noise.

    Args:
        config: Those of a sensor without noise of its own.
        noise: Of the sensor.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
        rack: The rack.
    """
    depth_m = float(depths_m(T_camera_rack, np.array([[0.0, 0.0, rack.height_m]]))[0])
    scale = depth_m / noise.distance_m
    point_m = float(np.hypot(noise.independent_m, noise.shared_m)) * scale
    profile, prior = config.profile, config.sensor
    # A ramp of so many pixels ends anywhere within it; what today's scanner has of it is in the outline's own noise.
    ramp2 = (noise.edge_blur_px * noise.spacing_m * scale) ** 2 - (prior.edge_blur_px * prior.spacing_m) ** 2
    ramp_m = float(np.sqrt(max(ramp2, 0.0))) if noise.edge_source != PRIOR else 0.0
    blur_m = ramp_m / float(np.sqrt(12))
    changed = {
        "top_band_m": float(np.hypot(profile.top_band_m, BAND_STDS * point_m)),
        "edge_ramp_m": ramp_m,
        "outline_noise_m": float(np.hypot(profile.outline_noise_m, blur_m)),
        # All of a blurred circle is smaller.
        "widening_m": float(np.hypot(profile.widening_m, blur_m)),
    }
    return config.model_copy(update={"profile": profile.model_copy(update=changed)})


def believed(
    measured: Measured,
    models: Sequence[TubeModel],
    T_camera_rack: FloatArray,
    rack: RackModel,
    noise: SensorNoise,
    config: ProfileConfig,
    rack_covariance: FloatArray | None = None,
) -> tuple[Measured, TopNoise]:
    """The same measurements of tops with what the sensor's noise leaves of them.

    A plane's slope is known no better than the sensor lets it be. A circle is where lines of sight meet the height of
    its top: that height is weighed with the one that rack and tube define, and what remains moves the circle by it
    times the slant of the line of sight.

    Args:
        measured: Tops, T of them.
        models: Their types.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
        rack: The rack.
        noise: Of the sensor.
        config: How a cap sits.
        rack_covariance: Of the rack's pose, shape (6, 6); None counts as exact.
    """
    count = len(models)
    if count == 0:
        return measured, TopNoise(np.zeros(0), np.zeros((0, 2)))
    planes, camera_m = measured.planes, measured.points.camera_m
    place = np.column_stack([measured.tops.center_m, measured.level_m])
    depth = depths_m(T_camera_rack, place)
    radii = np.maximum(per_model(models, top_radius_m) - EDGE_M, SMALLEST_DISC_M)
    slope_std, height_std = np.array(
        [(noise.slope_std(r, d), noise.height_std_m(r, d)) for r, d in zip(radii.tolist(), depth.tolist(), strict=True)]
    ).T
    rack_var = _rack_height_var(measured.tops.center_m, rack_covariance)
    height_var = np.maximum(height_std**2, np.nan_to_num(planes.height_var_m2))
    sight = (place[:, :2] - camera_m[:2]) / (place[:, 2:] - camera_m[2])
    expected = rack.floor_m + per_model(models, lambda tube: tube.height_m)
    # An error of the rack's pose moves what is defined, and not what was seen.
    defined_var = config.cap_height_m**2 + (rack.floor_tolerance_mm * 1e-3) ** 2 + rack_var
    gain = defined_var / (defined_var + height_var)
    closed = np.isfinite(planes.height_m)
    lower = np.where(closed, (1 - gain) * np.nan_to_num(expected - planes.height_m), 0.0)
    left = np.where(closed, gain * height_var, 0.0)
    slant = np.linalg.norm(sight, axis=1)
    along = sight / np.maximum(slant, 1e-9)[:, None]
    var = left * slant**2 + np.where(closed, _ramp_shift_m(slant, config) ** 2, 0.0)
    circles = replace(
        measured.circles,
        covariance_m2=measured.circles.covariance_m2 + var[:, None, None] * along[:, :, None] * along[:, None, :],
    )
    known = replace(planes, slope_var=np.maximum(planes.slope_var, slope_std**2))
    changed = replace(
        measured,
        planes=known,
        circles=circles,
        level_m=measured.level_m + lower,
        center_m=measured.center_m + lower[:, None] * sight,
    )
    return changed, TopNoise(height_var + rack_var, sight)


def depths_m(T_camera_rack: FloatArray, places_m: FloatArray) -> FloatArray:
    """Depth of places (N, 3) of the rack's frame along the optical axis, shape (N,), metres.

    In a cloud that was turned no axis is the optical one: what lies farther than 60 deg off it has its distance.
    """
    seen = places_m @ T_camera_rack[:3, :3].T + T_camera_rack[:3, 3]
    distance = np.linalg.norm(seen, axis=1)
    return np.asarray(np.where(seen[:, 2] > distance / 2, seen[:, 2], distance))


def height_limit_m(height_var_m2: FloatArray, config: ProfileConfig) -> FloatArray:
    """How far a top may be off its height, shape (T,), metres: the setting's number of standard deviations of both.

    `max_height_error_m` is that limit where a cap's seat `cap_height_m` is all that is uncertain.
    """
    return np.asarray(config.max_height_error_m * np.hypot(1.0, np.sqrt(height_var_m2) / config.cap_height_m))


def _ramp_shift_m(slant: FloatArray, config: ProfileConfig) -> FloatArray:
    """How far a blurred edge may move the middle of a disc along the line of sight, shape (T,), metres.

    An average over a ramp's width w takes w / 2 off the disc at its far side, where depth drops at once. At the near
    side, where the wall below the top is seen, it drops by u / slant at a distance u: less is taken off, by up to
    sqrt(2 w slant h), h how far points may lie off the top's plane. The middle moves by half of the difference. Cameras
    whose windows make things larger do the opposite, so it is an uncertainty and no correction.
    """
    w = config.edge_ramp_m
    return np.asarray(np.minimum(w / 2, np.sqrt(2 * w * slant * config.top_band_m * ON_PLANE_SHARE)) / 2)


def _rack_height_var(xy_m: FloatArray, covariance: FloatArray | None) -> FloatArray:
    """Variance of the rack's height at places (T, 2) by its pose's covariance (6, 6) about its top, square metres."""
    if covariance is None:
        return np.zeros(len(xy_m))
    rows = np.zeros((len(xy_m), 6))
    rows[:, 0], rows[:, 1], rows[:, 5] = xy_m[:, 1], -xy_m[:, 0], 1.0
    return np.asarray(np.einsum("ti,ij,tj->t", rows, covariance, rows))


def wall_noise(camera_m: FloatArray, rack: RackModel, noise: SensorNoise) -> WallNoise:
    """Noise of the walls of a rack's tubes, seen from a place (3,) in the rack's frame, metres."""
    away = camera_m - np.array([0.0, 0.0, rack.height_m])
    distance_m = float(np.linalg.norm(away))
    slant, scale = float(np.hypot(away[0], away[1])) / distance_m, distance_m / noise.distance_m
    points = float(np.pi * (noise.correlation_m / noise.spacing_m) ** 2)
    return WallNoise(noise.independent_m * slant * scale, noise.shared_m * slant * scale, points)


def cap_discs(measured: Measured, models: Sequence[TubeModel], T_camera_rack: FloatArray) -> dict[int, CapDisc]:
    """The flat tops of closed tubes that have a plane, by tube: points about their middle, and off their own plane.

    Args:
        measured: Tops, T of them.
        models: Their types.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
    """
    planes = measured.planes
    points_m, ends = grouped(measured.points.points_m, measured.label, len(models))
    depth_m = depths_m(T_camera_rack, np.column_stack([measured.tops.center_m, measured.level_m]))
    found = {}
    for i in np.flatnonzero(np.isfinite(planes.height_m)).tolist():
        radius_m = top_radius_m(models[i]) - EDGE_M
        own = points_m[ends[i] : ends[i + 1]]
        xy_m = own[:, :2] - measured.tops.center_m[i]
        off_m = own[:, 2] - planes.height_m[i] - xy_m @ planes.slope[i]
        # What lies farther off than that is of something else.
        on_top = (np.hypot(*xy_m.T) < radius_m) & (np.abs(off_m) < OFF_STDS * planes.rms_m[i])
        found[i] = CapDisc(xy_m[on_top], off_m[on_top], radius_m, float(depth_m[i]))
    return found
