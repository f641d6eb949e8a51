"""Frames with known answers for the tests of slots: every pixel's line of sight is followed to the first surface."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.labware import RackModel, SlotModel
from tubepose.transforms import FloatArray, invert_transform

CAMERA = CameraIntrinsics(480, 360, 800.0, 800.0, 239.5, 179.5)
STEP_M = 1.0e-3


@dataclass(frozen=True)
class Post:
    """An upright cylinder in a slot's middle, from the slot's floor.

    Attributes:
        radius_m: Its radius.
        top_m: Height of its upper end above the rack's base.
        black: Whether nothing comes back from it.
    """

    radius_m: float
    top_m: float
    black: bool = False


def looked_at(
    rack: RackModel,
    T_camera_rack: FloatArray,
    posts: Mapping[str, Post] | None = None,
    dark: Collection[str] = (),
    camera: CameraIntrinsics = CAMERA,
) -> RgbdFrame:
    """A frame of a rack on a table with posts in its slots; the `dark` slots return nothing from below the face."""
    T_rack_camera = invert_transform(T_camera_rack)
    origin = T_rack_camera[:3, 3]
    rays = camera.rays().reshape(-1, 3)
    direction = rays @ T_rack_camera[:3, :3].T
    depth = -origin[2] / direction[:, 2]  # the table
    at_face = (rack.height_m - origin[2]) / direction[:, 2]
    crossing = origin[:2] + at_face[:, None] * direction[:, :2]
    depth = np.where(rack.top_signed_distance_m(crossing) < 0, at_face, depth)
    for slot in rack.all_slots:
        rows = np.flatnonzero(slot.signed_distance_m(crossing) < 0)
        depth[rows] = np.nan if slot.name in dark else _well(rack, slot, origin, direction[rows])
    for name, post in (posts or {}).items():
        hit = _post(rack.slot(name).center_m, post, origin, direction)
        nearer = hit < np.where(np.isnan(depth), np.inf, depth)
        # A post that ends below the face is seen through its own opening alone.
        nearer &= (post.top_m > rack.height_m) | (rack.slot(name).signed_distance_m(crossing) < 0)
        depth = np.where(nearer, np.nan if post.black else hit, depth)
    cloud = (rays * depth[:, None]).reshape(camera.height, camera.width, 3)
    return RgbdFrame(cloud, None, camera, None, "test")


def _well(rack: RackModel, slot: SlotModel, origin: FloatArray, direction: FloatArray) -> FloatArray:
    """Depth at which lines into a slot end on its floor or, marching down, on its wall, shape (N,)."""
    depth = (rack.floor_m - origin[2]) / direction[:, 2]
    for z in np.arange(rack.floor_m + STEP_M, rack.height_m, STEP_M):
        at = (z - origin[2]) / direction[:, 2]
        outside = slot.signed_distance_m(origin[:2] + at[:, None] * direction[:, :2]) > 0
        depth = np.where(outside, at, depth)
    return np.asarray(depth)


def _post(center_m: FloatArray, post: Post, origin: FloatArray, direction: FloatArray) -> FloatArray:
    """Depth at which lines meet an upright cylinder: its upper end or its wall; infinite where they do not, (N,)."""
    at = (post.top_m - origin[2]) / direction[:, 2]
    on_top = np.hypot(*(origin[:2] + at[:, None] * direction[:, :2] - center_m).T) < post.radius_m
    o, d = origin[:2] - center_m, direction[:, :2]
    a, b, c = (d**2).sum(axis=1), d @ o, o @ o - post.radius_m**2
    with np.errstate(invalid="ignore", divide="ignore"):
        wall = (-b - np.sqrt(b**2 - a * c)) / a
        height = origin[2] + wall * direction[:, 2]
        on_wall = (height > 0) & (height < post.top_m)
    return np.where(on_top, at, np.where(on_wall, wall, np.inf))


def without_pixels(frame: RgbdFrame) -> RgbdFrame:
    """The points of a frame as a cloud without pixels."""
    return RgbdFrame(frame.measured_m[None], None, None, None, "test", organised=False)
