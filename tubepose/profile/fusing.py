"""Poses from what was measured of tops and walls, and from slots: how they are weighed, and how well they are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tubepose.config import ProfileConfig
from tubepose.labware import RackModel, TubeModel
from tubepose.profile.closed_tops import Measured
from tubepose.profile.posterior import FEW_SAMPLES, Evidence, Posterior, combine, evidence, per_model
from tubepose.profile.top_noise import TopNoise
from tubepose.profile.wall import WallNoise, wall_evidence
from tubepose.transforms import FloatArray


def fuse(
    measured: Measured,
    models: Sequence[TubeModel],
    rack: RackModel,
    config: ProfileConfig,
    wall_noise: WallNoise | None = None,
) -> Posterior:
    """Axes from tops and slots, then from the walls near them too; those have noise of their own at least."""
    slots = [rack.all_slots[i] for i in measured.tops.slot]
    centers = rack.slot_centers_m[measured.tops.slot]
    tops = top_evidence(measured, models, rack, config)
    start = combine(tops, slots, models, rack, config, FEW_SAMPLES)
    walls = wall_evidence(measured.points, measured.label, start.mean, centers, models, rack, config, wall_noise)
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


def rise_m(
    measured: Measured, models: Sequence[TubeModel], rack: RackModel, config: ProfileConfig, noise: TopNoise
) -> FloatArray:
    """How far tubes stand above the floor, shape (T,), metres: the floor's height and a closed top's, weighed."""
    expected = rack.floor_m + per_model(models, lambda tube: tube.height_m)
    seen = np.nan_to_num(measured.planes.height_m - expected)
    return np.asarray(seen * _rise_gain(measured, rack, config, noise))


def _rise_gain(measured: Measured, rack: RackModel, config: ProfileConfig, noise: TopNoise) -> FloatArray:
    """Weight of a top's height against the floor's, shape (T,): 0 for open tops, whose light comes from below them."""
    floor2 = (rack.floor_tolerance_mm * 1e-3) ** 2
    gain = floor2 / (floor2 + config.cap_height_m**2 + noise.height_var_m2)
    return np.where(np.isfinite(measured.planes.height_m), gain, 0.0)


def pose_covariance(
    posterior: Posterior,
    measured: Measured,
    models: Sequence[TubeModel],
    rack: RackModel,
    config: ProfileConfig,
    rack_covariance: FloatArray | None,
    noise: TopNoise,
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
    covariance[:, 4, 4] += (1 - _rise_gain(measured, rack, config, noise)) * (rack.floor_tolerance_mm * 1e-3) ** 2
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
