"""Recordings of the programs that people use; skipped where their packages are not installed (extra `writers`)."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recordings import CAMERA, DEPTH, GRAY, STAMP_NS, assert_same, read_all
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from tubepose.capture import CameraIntrinsics
from tubepose.capture.lens import PixelCamera
from tubepose.errors import CaptureError

DEPTH_CAMERA = CameraIntrinsics(160, 120, 100.0, 101.0, 80.5, 60.25)
COLOR_CAMERA = CameraIntrinsics(200, 150, 150.0, 151.0, 101.0, 74.0)
LENS = (0.08, -0.05, 0.001, 0.002, 0.01)
R_COLOR_DEPTH = Rotation.from_euler("xyz", [2, -3, 4], degrees=True).as_matrix()
SHIFT_M = np.array([0.015, 0.001, -0.002])


def sdk(name: str) -> Any:
    """A package of the extra `writers`; the test is skipped without it."""
    return pytest.importorskip(name, reason="pip install tubepose[writers]", exc_type=ImportError)


# RealSense SDK -------------------------------------------------------------------------------------------------------


def stream(rs: Any, kind: str, camera: CameraIntrinsics, lens: tuple[float, ...] | None) -> Any:
    """A stream of the SDK with a camera's intrinsics."""
    inner = rs.intrinsics()
    inner.width, inner.height, inner.ppx, inner.ppy = camera.width, camera.height, camera.cx, camera.cy
    inner.fx, inner.fy = camera.fx, camera.fy
    inner.model = rs.distortion.inverse_brown_conrady if lens else rs.distortion.none
    inner.coeffs = list(lens or [0.0] * 5)
    made = rs.video_stream()
    made.type, made.fmt = (rs.stream.depth, rs.format.z16) if kind == "depth" else (rs.stream.color, rs.format.rgb8)
    made.index, made.uid, made.fps, made.bpp = 0, kind == "color", 30, 2 if kind == "depth" else 3
    made.width, made.height, made.intrinsics = camera.width, camera.height, inner
    return made


def realsense(path: Path, unit_m: float | None, depth_counts: np.ndarray, colour: np.ndarray, lens=None, related=True):
    """A recording of one frame by the SDK's own recorder, of a device without hardware."""
    rs = sdk("pyrealsense2")
    device = rs.software_device()
    sensors = [device.add_sensor("Depth"), device.add_sensor("Color")]
    streams = [stream(rs, "depth", DEPTH_CAMERA, None), stream(rs, "color", COLOR_CAMERA, lens)]
    profiles = [sensor.add_video_stream(one) for sensor, one in zip(sensors, streams, strict=True)]
    if unit_m is not None:
        sensors[0].add_read_only_option(rs.option.depth_units, unit_m)
    if related:
        extrinsics = rs.extrinsics()
        extrinsics.rotation = list(R_COLOR_DEPTH.T.ravel())  # column by column
        extrinsics.translation = list(SHIFT_M)
        profiles[0].register_extrinsics_to(profiles[1], extrinsics)
    recorder = rs.recorder(str(path), device)
    recorded = recorder.query_sensors()
    for sensor in recorded:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(lambda frame: None)
    for sensor, profile, pixels in zip(sensors, profiles, (depth_counts, colour), strict=True):
        frame = rs.software_video_frame()
        frame.pixels, frame.bpp = pixels, pixels.itemsize * (pixels.ndim if pixels.ndim == 3 else 1)
        frame.stride = pixels.shape[1] * frame.bpp
        frame.timestamp, frame.domain, frame.frame_number = 0.0, rs.timestamp_domain.hardware_clock, 0
        frame.profile = profile.as_video_stream_profile()
        sensor.on_video_frame(frame)
    time.sleep(0.1)
    for sensor in recorded:
        sensor.stop()
        sensor.close()
    recorder.pause()
    del recorder, recorded
    deadline = time.monotonic() + 5
    while not path.is_file() and time.monotonic() < deadline:
        time.sleep(0.05)
    return path


COUNTS = np.full((120, 160), 3000, np.uint16)
COLOUR = np.zeros((150, 200, 3), np.uint8)


@pytest.mark.parametrize(("name", "unit_m"), [("D405", 1e-4), ("D435", 1e-3), ("L515", 2.5e-4)])
def test_realsense_depth_in_its_unit_registered_to_colour(tmp_path, name, unit_m):
    path = realsense(tmp_path / f"{name}.db3", unit_m, COUNTS, COLOUR)
    (frame,) = read_all(path)
    assert frame.intrinsics == COLOR_CAMERA
    assert frame.image.shape == (150, 200, 3)
    expected = DEPTH_CAMERA.backproject(np.full((120, 160), 3000 * unit_m)).reshape(-1, 3) @ R_COLOR_DEPTH.T + SHIFT_M
    found = frame.measured_m
    assert len(found) > 1000
    assert cKDTree(expected).query(found)[0].max() < 2e-6
    v, u = np.nonzero(frame.valid.reshape(150, 200))
    assert np.abs(COLOR_CAMERA.project(frame.cloud_m[v, u]) - np.stack([u, v], axis=1)).max() <= 0.5


def test_realsense_lens_is_removed_as_the_sdk_itself_does(tmp_path):
    rs = sdk("pyrealsense2")
    camera = PixelCamera(COLOR_CAMERA, "polynomial", LENS)
    inner = stream(rs, "color", COLOR_CAMERA, LENS).intrinsics
    rays = camera.rays()
    for u, v in ((0, 0), (199, 0), (20, 130), (101, 74)):
        np.testing.assert_allclose(rays[v, u], rs.rs2_deproject_pixel_to_point(inner, [u, v], 1.0), atol=2e-4)
    colour = COLOUR.copy()
    colour[:, 100:] = 200  # an upright edge, bent by the lens
    (frame,) = read_all(realsense(tmp_path / "a.db3", 1e-3, COUNTS, colour, lens=LENS))
    expected = camera.rectify_picture(colour)
    np.testing.assert_array_equal(frame.image, expected)
    assert not np.array_equal(expected, colour)


def test_realsense_without_a_unit_asks_for_it(tmp_path):
    path = realsense(tmp_path / "a.db3", None, COUNTS, COLOUR)
    with pytest.raises(CaptureError, match=r"give --depth-scale 0\.001"):
        read_all(path)
    (frame,) = read_all(path, depth_scale_m=0.001)
    assert float(np.median(frame.measured_m[:, 2])) == pytest.approx(3.0, abs=0.2)


def test_realsense_cameras_that_are_not_related_are_not_registered(tmp_path):
    path = realsense(tmp_path / "a.db3", 1e-3, COUNTS, COLOUR, related=False)
    with pytest.raises(CaptureError, match=r"not pixel to pixel; .* or /tf_static between the frames"):
        read_all(path)


# Foxglove SDK --------------------------------------------------------------------------------------------------------


def foxglove_file(path: Path, messages: list[tuple[str, Any]]) -> Path:
    """A recording by Foxglove's own SDK."""
    foxglove = sdk("foxglove")
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        for topic, message in messages:
            kind = type(message).__name__
            channel = getattr(sdk("foxglove.channels"), f"{kind}Channel")(topic, context=context)
            channel.log(message, log_time=STAMP_NS)
    return path


def foxglove_shots(kinds: Any) -> list[tuple[str, Any]]:
    stamp = kinds.Timestamp(sec=STAMP_NS // 1_000_000_000, nsec=STAMP_NS % 1_000_000_000)
    k = [CAMERA.fx, 0, CAMERA.cx, 0, CAMERA.fy, CAMERA.cy, 0, 0, 1]
    info = kinds.CameraCalibration(timestamp=stamp, frame_id="camera", width=32, height=24, K=k)
    rest = {"timestamp": stamp, "frame_id": "camera", "width": 32, "height": 24}
    picture = kinds.RawImage(**rest, encoding="mono8", step=32, data=GRAY.tobytes())
    depth = kinds.RawImage(**rest, encoding="32FC1", step=128, data=DEPTH.astype("<f4").tobytes())
    return [("/camera/calibration", info), ("/camera/color", picture), ("/camera/depth", depth)]


def test_foxglove_depth_and_picture(tmp_path):
    kinds = sdk("foxglove.messages")
    (frame,) = read_all(foxglove_file(tmp_path / "a.mcap", foxglove_shots(kinds)))
    assert_same(frame)
    assert frame.intrinsics == CAMERA


def test_foxglove_cloud_with_pose_and_transform(tmp_path):
    kinds = sdk("foxglove.messages")
    half = math.sqrt(0.5)
    # A quarter turn about z of the sensor in the camera's frame, and a shift of the cloud in the sensor's.
    turn = kinds.Quaternion(x=0, y=0, z=half, w=half)
    points = CAMERA.backproject(DEPTH).reshape(-1, 3)
    local = points @ np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]) - (0.1, 0, 0)
    number = kinds.PackedElementFieldNumericType.Float32
    fields = [kinds.PackedElementField(name=axis, offset=4 * i, type=number) for i, axis in enumerate("xyz")]
    stamp = kinds.Timestamp(sec=STAMP_NS // 1_000_000_000, nsec=STAMP_NS % 1_000_000_000)
    still = kinds.Quaternion(x=0, y=0, z=0, w=1)
    pose = kinds.Pose(position=kinds.Vector3(x=0.1, y=0, z=0), orientation=still)
    cloud = kinds.PointCloud(
        timestamp=stamp, frame_id="sensor", pose=pose, point_stride=12, fields=fields,
        data=local.astype("<f4").tobytes(),
    )  # fmt: skip
    edge = kinds.FrameTransform(
        timestamp=stamp, parent_frame_id="camera", child_frame_id="sensor",
        translation=kinds.Vector3(x=0, y=0, z=0), rotation=turn,
    )  # fmt: skip
    messages = [("/tf", edge), ("/points", cloud), *foxglove_shots(kinds)[:2]]
    (frame,) = read_all(foxglove_file(tmp_path / "a.mcap", messages))
    assert_same(frame)
