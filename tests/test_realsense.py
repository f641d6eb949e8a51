"""Recordings of the RealSense SDK by its topics; tests/test_genuine_writers.py has those of its own recorder."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from recordings import (
    CAMERA,
    STAMP_NS,
    WIDE,
    bag1,
    bag2,
    header,
    image_message,
    info_message,
    mcap,
    read_all,
    tf_message,
)

from tubepose.capture.message_types import CAMERA_INFO, COMPRESSED_IMAGE, FLOAT32, IMAGE, STRING, TRANSFORM, TRANSFORMS
from tubepose.errors import CaptureError
from tubepose.transforms import translation

DEPTH_TOPIC = "/device_0/sensor_0/Depth_0/image/data/compressedDepth"
UNIT_TOPIC = "/device_0/sensor_0/option/Depth_Units/value"
METADATA_TOPIC = "/device_0/sensor_0/Depth_0/image/metadata"


def recording(*told: tuple[str, str], T_depth_color=None) -> list:
    counts = np.full((24, 32), 3000, np.uint16)
    depth = bytes(12) + cv2.imencode(".png", counts)[1].tobytes()
    colour = cv2.imencode(".png", np.full((48, 64, 3), 90, np.uint8))[1].tobytes()
    depth_frame, colour_frame = header(frame_id="Depth"), header(frame_id="Color")
    color_info = ("/device_0/sensor_1/Color_0/image/camera_info", CAMERA_INFO, info_message(WIDE, frame_id="Color"))
    messages = [(topic, STRING, {"data": data}) for topic, data in told]
    if T_depth_color is not None:
        messages += [
            ("/tf_static", TRANSFORMS, tf_message("ref_1", "Depth", np.eye(4))),
            ("/tf_static", TRANSFORMS, tf_message("ref_1", "Color", T_depth_color)),
        ]
    return [
        *messages,
        (DEPTH_TOPIC, COMPRESSED_IMAGE, depth_frame | {"format": "16UC1; compressedDepth png", "data": depth}),
        ("/device_0/sensor_0/Depth_0/image/camera_info", CAMERA_INFO, info_message(frame_id="Depth")),
        (
            "/device_0/sensor_1/Color_0/image/data/compressed",
            COMPRESSED_IMAGE,
            colour_frame | {"format": "rgb8; png compressed bgr8", "data": colour},
        ),
        color_info,
    ]


@pytest.mark.parametrize(
    ("told", "unit_m"),
    [
        ([(UNIT_TOPIC, "0.000100")], 1e-4),
        ([(UNIT_TOPIC, "0.001000")], 1e-3),
        ([(UNIT_TOPIC, "0.000250")], 2.5e-4),
        ([(METADATA_TOPIC, "Frame number=0;timestamp=0.0;depth_units=0.000100;Actual Fps=3")], 1e-4),
        ([(METADATA_TOPIC, "depth_units=0.001"), (UNIT_TOPIC, "9.9999997e-05")], 1e-4),
    ],
)
def test_the_unit_of_depth_is_in_texts(tmp_path, told, unit_m):
    (frame,) = read_all(bag2(tmp_path / "scan", recording(*told, T_depth_color=translation((0.02, 0, 0)))))
    np.testing.assert_allclose(frame.measured_m[:, 2], 3000 * unit_m)
    assert frame.intrinsics == WIDE
    assert frame.image.shape == (48, 64, 3)
    assert frame.timestamp_ns == STAMP_NS
    # The colour camera is 20 mm to the right of the depth camera: points move to the left.
    expected = CAMERA.backproject(np.full((24, 32), 3000 * unit_m))[..., 0] - 0.02
    assert np.isin(np.round(frame.measured_m[:, 0], 6), np.round(expected, 6)).all()


@pytest.mark.parametrize("told", [[], [(UNIT_TOPIC, "0.000000")], [(UNIT_TOPIC, "unknown")], [(METADATA_TOPIC, "a=1")]])
def test_a_unit_that_is_not_told_is_asked_for_and_the_option_works(tmp_path, told):
    path = mcap(tmp_path / "a.mcap", recording(*told, T_depth_color=translation((0.02, 0, 0))))
    with pytest.raises(
        CaptureError, match=r"does not say how long one count of depth is; give --depth-scale"
    ) as caught:
        read_all(path)
    scale = float(str(caught.value).split("--depth-scale ")[1].split()[0])
    (frame,) = read_all(path, depth_scale_m=scale)
    np.testing.assert_allclose(frame.measured_m[:, 2], 3000 * scale)
    (frame,) = read_all(path, unit="mm")
    np.testing.assert_allclose(frame.measured_m[:, 2], 3.0)


def test_the_option_goes_before_the_recording(tmp_path):
    path = mcap(tmp_path / "a.mcap", recording((UNIT_TOPIC, "0.0001"), T_depth_color=np.eye(4)))
    np.testing.assert_allclose(read_all(path, depth_scale_m=1e-3)[0].measured_m[:, 2], 3.0)
    np.testing.assert_allclose(read_all(path, unit="mm")[0].measured_m[:, 2], 0.3)


def test_the_unit_of_another_sensor_is_not_taken(tmp_path):
    other = UNIT_TOPIC.replace("sensor_0", "sensor_2")
    path = mcap(tmp_path / "a.mcap", recording((other, "0.0001"), T_depth_color=np.eye(4)))
    with pytest.raises(CaptureError, match="does not say how long one count"):
        read_all(path)


def test_cameras_without_a_transform_are_not_registered_by_guess(tmp_path):
    path = mcap(tmp_path / "a.mcap", recording((UNIT_TOPIC, "0.0001")))
    with pytest.raises(CaptureError, match=r"in frame 'Color', the cloud 32 x 24 in frame 'Depth'.*or /tf_static"):
        read_all(path)


def test_other_recordings_keep_the_unit_of_ros(tmp_path):
    messages = [
        ("/device_0/depth/image_raw", IMAGE, image_message(np.full((24, 32), 300, np.uint16), "16UC1")),
        ("/device_0/depth/camera_info", CAMERA_INFO, info_message()),
    ]
    (frame,) = read_all(mcap(tmp_path / "a.mcap", messages))
    np.testing.assert_allclose(frame.cloud_m[..., 2], 0.3)


# ROS 1 bags, as the SDK's recorder wrote them before 2.58 ------------------------------------------------------------


def old_recording(unit_m: float | None = 1e-4, name: str = "Depth_Units") -> list:
    """Topics and fields of a bag of librealsense 2.55: infos without frames, P of zeros, transforms in topics."""
    device = "/device_0"
    depth = image_message(np.full((24, 32), 3000, np.uint16), "mono16", frame_id="1")
    colour = image_message(np.full((48, 64, 3), 90, np.uint8), "rgb8", frame_id="1")
    zeros = {"distortion_model": "None", "r": [0.0] * 9, "p": [0.0] * 12}
    still = tf_message("", "", np.eye(4))["transforms"][0]["transform"]
    moved = tf_message("", "", translation((-0.02, 0, 0)))["transforms"][0]["transform"]
    messages = [
        (f"{device}/sensor_0/Depth_0/info/camera_info", CAMERA_INFO, info_message(CAMERA, changes=zeros, frame_id="")),
        (f"{device}/sensor_1/Color_0/info/camera_info", CAMERA_INFO, info_message(WIDE, changes=zeros, frame_id="")),
        (f"{device}/sensor_0/Depth_0/image/data", IMAGE, depth),
        (f"{device}/sensor_0/Depth_0/tf/0", TRANSFORM, still),
        (f"{device}/sensor_1/Color_0/image/data", IMAGE, colour),
        (f"{device}/sensor_1/Color_0/tf/0", TRANSFORM, moved),
    ]
    if unit_m is not None:
        messages.insert(0, (f"{device}/sensor_0/option/{name}/value", FLOAT32, {"data": unit_m}))
    return messages


@pytest.mark.parametrize("name", ["Depth_Units", "Depth Units"])
@pytest.mark.parametrize("behind", [b"", bytes(4)])
def test_an_old_bag_is_registered_to_colour(tmp_path, name, behind):
    """The SDK left some bytes behind its images."""
    (frame,) = read_all(bag1(tmp_path / "a.bag", old_recording(name=name), behind=behind))
    np.testing.assert_allclose(frame.measured_m[:, 2], 0.3)
    assert frame.intrinsics == WIDE
    expected = CAMERA.backproject(np.full((24, 32), 0.3))[..., 0] - 0.02
    assert np.isin(np.round(frame.measured_m[:, 0], 6), np.round(expected, 6)).all()


def test_an_old_bag_without_a_unit_asks_for_it(tmp_path):
    with pytest.raises(CaptureError, match="give --depth-scale"):
        read_all(bag1(tmp_path / "a.bag", old_recording(unit_m=None)))
