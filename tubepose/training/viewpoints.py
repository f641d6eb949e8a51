"""From where a picture is taken, and in what light."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from tubepose.capture.frame import CameraIntrinsics
from tubepose.simulation.camera import FULL_FOCAL_PX, FULL_RESOLUTION
from tubepose.simulation.looks.appearance import Lamp, Light, Sensor
from tubepose.simulation.looks.textures import surroundings
from tubepose.transforms import FloatArray, invert_transform, make_transform, transform_points

SENSORS: tuple[Sensor, ...] = ("projector", "lamp-gray", "color")
SENSOR_CHANCE = (0.3, 0.2, 0.5)
_SIZES = ((1.0, 1.0), (1.0, 0.75), (1.0, 0.5625), (0.75, 1.0))
"""Width and height as shares of the longer side; a projector's pictures have the first two."""


def any_camera(
    targets: Sequence[FloatArray], sensor: Sensor, long_side_px: int, rng: np.random.Generator
) -> tuple[CameraIntrinsics, FloatArray]:
    """A camera that looks at some target, from near or far, from above or aslant.

    Args:
        targets: Points of each thing to look at, (N, 3), table frame, metres; none: the table's origin.
        sensor: A projector looks from above.
        long_side_px: Longer side of the picture.
        rng: Source of randomness.

    Returns:
        The camera, and T_camera_table of shape (4, 4).
    """
    shape = _SIZES[int(rng.integers(len(_SIZES)))] if sensor != "projector" else _SIZES[int(rng.integers(2))]
    width, height = (round(long_side_px * side) for side in shape)
    half_view = np.deg2rad(rng.uniform(16, 36))
    focal = 0.5 * max(width, height) / np.tan(half_view)
    intrinsics = CameraIntrinsics(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    points = targets[int(rng.integers(len(targets)))] if targets else np.zeros((1, 3))
    middle, size = points.mean(axis=0), max(float(np.ptp(points[:, :2], axis=0).max()), 0.12)
    # The object's size as a share of the view, from far off to larger than the picture.
    distance = size / (2 * np.tan(half_view) * np.exp(rng.uniform(np.log(0.16), np.log(1.15))))
    distance = float(np.clip(distance, 0.15, 2.5))
    steep = sensor == "projector" or rng.uniform() < 0.3
    tilt = np.deg2rad(rng.uniform(0, 28) if steep else rng.uniform(10, 68))
    about = rng.uniform(0, 2 * np.pi)
    roll = rng.uniform(0, 2 * np.pi) if steep else rng.normal(0, np.deg2rad(8))
    back = np.array([np.sin(tilt) * np.cos(about), np.sin(tilt) * np.sin(about), np.cos(tilt)])
    aside = rng.uniform(-0.45, 0.45, 3) * np.array([1, 1, 0]) * distance * np.tan(half_view)
    return intrinsics, _looking(middle + aside + distance * back, back, float(roll))


def scanner_camera(
    points: FloatArray, long_side_px: int, rng: np.random.Generator
) -> tuple[CameraIntrinsics, FloatArray]:
    """A square camera with a PhoXi's angle of view above a rack, whose diagonal fills 25 to 65 % of the view's width.

    Args:
        points: Points of the rack, (N, 3), table frame, metres.
        long_side_px: Side of the picture.
        rng: Source of randomness.

    Returns:
        The camera, and T_camera_table of shape (4, 4).
    """
    half_view = np.arctan(0.5 * FULL_RESOLUTION / FULL_FOCAL_PX)
    focal = 0.5 * long_side_px / np.tan(half_view)
    middle_px = (long_side_px - 1) / 2
    intrinsics = CameraIntrinsics(long_side_px, long_side_px, focal, focal, middle_px, middle_px)
    size = float(np.hypot(*np.ptp(points[:, :2], axis=0)))
    distance = size / (2 * np.tan(half_view) * rng.uniform(0.25, 0.65))
    tilt, about = np.deg2rad(rng.uniform(0, 20)), rng.uniform(0, 2 * np.pi)
    back = np.array([np.sin(tilt) * np.cos(about), np.sin(tilt) * np.sin(about), np.cos(tilt)])
    aside = rng.uniform(-0.1, 0.1, 3) * np.array([1, 1, 0]) * size
    eye = np.array([*points[:, :2].mean(axis=0), points[:, 2].max()]) + aside + distance * back
    return intrinsics, _looking(eye, back, float(rng.uniform(0, 2 * np.pi)))


def cut_to(camera: CameraIntrinsics, points_m: FloatArray, rng: np.random.Generator) -> CameraIntrinsics:
    """A square camera's picture cut to given points with a margin of 2 to 25 % of their extent, in as many pixels.

    Args:
        camera: The camera.
        points_m: What to keep, (N, 3), camera frame, metres.
        rng: Source of randomness.
    """
    pixels = camera.project(points_m)
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    extent = float((high - low).max())
    side = extent * (1 + 2 * rng.uniform(0.02, 0.25))
    corner = (low + high - side) / 2 + rng.uniform(-1, 1, 2) * (side - extent) / 2
    zoom = camera.width / side
    cx, cy = (np.array([camera.cx, camera.cy]) - corner) * zoom
    return CameraIntrinsics(camera.width, camera.height, camera.fx * zoom, camera.fy * zoom, float(cx), float(cy))


def _looking(eye_m: FloatArray, back: FloatArray, roll_rad: float) -> FloatArray:
    """T_camera_table (4, 4) of a camera at a place of the table's frame that looks against the unit vector `back`."""
    z = -back
    x = np.cross(z, [0.0, 0.0, 1.0])
    x = x / np.linalg.norm(x) if np.linalg.norm(x) > 1e-6 else np.array([1.0, 0.0, 0.0])
    axes = np.column_stack([x, np.cross(z, x), z]) @ Rotation.from_euler("z", roll_rad).as_matrix()
    return invert_transform(make_transform(axes, eye_m))


def random_light(sensor: Sensor, T_camera_table: FloatArray, rng: np.random.Generator) -> Light:
    """A projector beside the camera in a dim room, or up to three lamps in a bright one."""
    up = T_camera_table[:3, 2]
    around = surroundings(rng)
    depth = float(np.linalg.norm(T_camera_table[:3, 3]))
    if sensor == "projector":
        dim = float(rng.uniform(0.0, 0.12))
        side = np.append(rng.normal(0, 1, 2), 0.0)
        at = side / np.linalg.norm(side) * rng.uniform(0.03, 0.35)
        strong = float(rng.uniform(0.6, 1.6)) * depth**2
        lamps = [Lamp(at, 0.002, (strong, strong, strong))]
        return Light(lamps, (dim, dim, dim), up, np.asarray(around * dim, np.float32))
    tint = rng.uniform(0.8, 1.2, 3) if sensor == "color" else np.ones(3)
    room = tint * rng.uniform(0.15, 0.9)
    lamps = []
    for _ in range(int(rng.integers(0, 4))):
        way = rng.normal(0, 1, 3)
        way[2] = abs(way[2]) + 0.3
        far = float(rng.uniform(0.5, 2.5))
        at = transform_points(T_camera_table, (way / np.linalg.norm(way) * far)[None])[0]
        power = tint * rng.uniform(0.9, 1.1, 3) * rng.uniform(0.1, 0.9) * far**2
        lamps.append(Lamp(at, float(rng.uniform(0.005, 0.3)) * far, (power[0], power[1], power[2])))
    return Light(lamps, (float(room[0]), float(room[1]), float(room[2])), up, around)
