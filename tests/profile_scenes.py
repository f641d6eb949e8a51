"""Frames with known poses for the tests of the estimator `profile`: ray cast, or points of surfaces."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import scenes

from tubepose.capture.frame import RgbdFrame
from tubepose.config import Config
from tubepose.labware import RackModel, TubeModel
from tubepose.pose_errors import PoseErrors, pose_errors, squared_mahalanobis
from tubepose.profile import ProfileTube, fit_profiles
from tubepose.simulation import raycast
from tubepose.simulation.camera import default_camera
from tubepose.simulation.scene import PlacedTube, Scene
from tubepose.transforms import FloatArray, transform_points

CONFIG = Config()
Placed = Mapping[str, tuple[TubeModel, FloatArray]]


def rendered(
    rack: RackModel, placed: Placed, T_camera_rack: FloatArray, resolution: int = 700, seed: int = 0
) -> RgbdFrame:
    """A ray cast frame."""
    tubes = tuple(PlacedTube(slot, tube, T_rack_tube) for slot, (tube, T_rack_tube) in placed.items())
    scene = Scene(rack, T_camera_rack, tubes)
    return raycast.render(scene, default_camera(resolution), np.random.default_rng(seed), threads=1)


def sampled(
    rack: RackModel, placed: Placed, T_camera_rack: FloatArray, extra_m: FloatArray | None = None, seed: int = 0
) -> RgbdFrame:
    """A frame without pixels: points of the rack's top, of tubes that may stand close together, and others."""
    view = scenes.towards_camera(T_camera_rack)
    points = [scenes.rack_top(rack, seed)]
    points += [
        scenes.tube_surface(tube, T, rack.height_m, seed=seed + i, seen_from=view, spacing_m=0.35e-3)
        for i, (tube, T) in enumerate(placed.values())
    ]
    points += [extra_m] if extra_m is not None else []
    return scenes.unorganised(transform_points(T_camera_rack, np.vstack(points)))


def fit(
    frame: RgbdFrame, T_camera_rack: FloatArray, rack: RackModel, tubes: Sequence[TubeModel], **more: object
) -> tuple[ProfileTube, ...]:
    return fit_profiles(frame, frame.intrinsics, T_camera_rack, rack, tubes, CONFIG, **more)


def by_slot(found: Sequence[ProfileTube]) -> dict[str | None, ProfileTube]:
    """Tubes by slot; every slot once."""
    slots = [entry.slot for entry in found]
    assert len(set(slots)) == len(slots), slots
    return {entry.slot: entry for entry in found}


def errors_of(found: Sequence[ProfileTube], placed: Placed) -> tuple[PoseErrors, FloatArray]:
    """Errors and squared Mahalanobis distances of the tubes, in the order of `placed`; every slot must have a pose."""
    tubes = by_slot(found)
    truth = np.array([T for _, T in placed.values()])
    estimate = np.array([tubes[slot].pose.T_rack_tube for slot in placed])
    covariance = np.array([tubes[slot].pose.covariance for slot in placed])
    heights_m = np.array([tube.height_m for tube, _ in placed.values()])
    return pose_errors(truth, estimate, heights_m), squared_mahalanobis(truth, estimate, covariance)
