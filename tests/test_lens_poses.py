"""Poses of a capture that was taken through a distorting lens equal those of one without it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from recordings import image_message, info_message, mcap
from scenes import angle_deg

from tubepose.batch import Job, run_jobs
from tubepose.capture import CameraIntrinsics, open_captures
from tubepose.capture.lens import PixelCamera
from tubepose.capture.message_types import CAMERA_INFO, IMAGE
from tubepose.config import Config
from tubepose.detection.geometric import GeometricDetector
from tubepose.labware import load_cap, load_rack, load_tube
from tubepose.provenance import pinned_threads
from tubepose.records import transform_of
from tubepose.simulation.camera import default_camera
from tubepose.simulation.random_scene import random_scene
from tubepose.simulation.raycast import Surfaces
from tubepose.simulation.variation import SceneVariation
from tubepose.transforms import FloatArray

RACK = load_rack("chen2023-soft-5x10")
TUBE = load_tube("chen2023-tube-3")
# The middle of a structured-light camera's picture, and lenses that move its corners by some 10 pixels.
CAMERA = CameraIntrinsics(640, 560, 1564.0, 1564.0, 318.5, 281.25)
LENSES = {
    "plumb_bob": (-0.36, 0.2, -0.0008, 0.0003, -0.1),
    "rational_polynomial": (0.1, -0.1, 0.0008, -0.0005, 0.01, 0.5, -0.05, 0.01),
}


@pytest.fixture(scope="module")
def surfaces() -> Surfaces:
    cap = load_cap("printed-square-16.7")
    sensor = replace(default_camera(), intrinsics=CAMERA)
    scene = random_scene(RACK, [TUBE], cap, sensor, np.random.default_rng(5), SceneVariation(fill=(0.12, 0.16)))
    return Surfaces(part for part in scene.parts() if part[1].plastic is None)


def depth_of(surfaces: Surfaces, camera: PixelCamera) -> FloatArray:
    """Depth (H, W) in metres with errors that depend on the place alone, as sensors' do, 0.1 mm."""
    rays = camera.rays().reshape(-1, 3)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    hits = surfaces.cast(np.zeros_like(unit), unit)
    z = hits.distance_m * unit[:, 2]
    x, y = hits.points_m[:, 0], hits.points_m[:, 1]
    z = z + 1e-4 * np.sin(2 * np.pi * x / 9.1e-3) * np.sin(2 * np.pi * y / 7.7e-3)
    return np.where(np.isfinite(z), z, 0).reshape(camera.pinhole.height, camera.pinhole.width)


def recording(path: Path, depth: FloatArray, camera: CameraIntrinsics, name: str, d: tuple[float, ...]) -> Path:
    info = info_message(camera, changes={"d": list(d), "distortion_model": name})
    depth_image = image_message(depth.astype(np.float32), "32FC1")
    return mcap(path, [("/depth/camera_info", CAMERA_INFO, info), ("/depth/image_raw", IMAGE, depth_image)])


def poses(path: Path) -> dict[str, FloatArray]:
    config = Config()
    job = Job(open_captures(path)[0], RACK, (TUBE,))
    with pinned_threads(1):
        tables = run_jobs(
            [job], ["profile"], lambda rack, tubes: GeometricDetector(rack, tubes, config), config, fail_fast=True
        )
    found = {row["slot"]: transform_of(row) for row in tables.estimates if row["status"] == "ok"}
    return found | {"rack": transform_of(tables.racks[0])}


@pytest.fixture(scope="module")
def without_lens(surfaces: Surfaces, tmp_path_factory: pytest.TempPathFactory) -> dict[str, FloatArray]:
    depth = depth_of(surfaces, PixelCamera(CAMERA))
    return poses(recording(tmp_path_factory.mktemp("pinhole") / "a.mcap", depth, CAMERA, "plumb_bob", ()))


@pytest.mark.parametrize("name", LENSES)
def test_poses_are_those_without_the_lens(surfaces, without_lens, tmp_path, name):
    camera = PixelCamera(CAMERA, "polynomial", LENSES[name])
    found = poses(recording(tmp_path / "a.mcap", depth_of(surfaces, camera), CAMERA, name, LENSES[name]))
    assert len(without_lens) > 4
    assert found.keys() == without_lens.keys()
    for slot, T in found.items():
        assert np.linalg.norm(T[:3, 3] - without_lens[slot][:3, 3]) < 0.05e-3, slot
        assert angle_deg(T[:3, :3], without_lens[slot][:3, :3]) < 0.05, slot
