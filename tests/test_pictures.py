"""Pictures and depth as recordings encode them."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from recordings import (
    CAMERA,
    DEPTH,
    GRAY,
    SECOND_NS,
    STAMP_NS,
    assert_same,
    cdr,
    cloud_message,
    cloud_shots,
    header,
    image_message,
    info_message,
    mcap,
    read_all,
    shots,
)

from tubepose.capture.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POINT_CLOUD
from tubepose.capture.raw_pictures import ENCODINGS
from tubepose.capture.ros import picture
from tubepose.errors import CaptureError

MILLIMETRES = np.rint(DEPTH * 1000).astype(np.uint16)
DEPTH_TOPIC = "/camera/aligned_depth_to_color/image_raw"


def smooth() -> np.ndarray:
    """A colourful picture (24, 32, 3), RGB, without edges: what sharing colours among pixels keeps."""
    v, u = np.mgrid[:24, :32]
    return np.stack([40 + 5 * u, 30 + 6 * v, 220 - 3 * u - 2 * v], axis=-1).astype(np.uint8)


def mosaic(pattern: str, kind: type = np.uint8) -> np.ndarray:
    """One colour per pixel, by the names of ROS: the first row's first two, then the second row's."""
    rgb, found = smooth(), np.empty((24, 32), np.uint8)
    for index, colour in enumerate(pattern):
        v, u = divmod(index, 2)
        found[v::2, u::2] = rgb[v::2, u::2, "rgb".index(colour)]
    return found.astype(kind) * (257 if kind is np.uint16 else 1)


def shared(code: int) -> np.ndarray:
    return cv2.cvtColor(smooth(), code)


def yuv_planes(order: str) -> np.ndarray:
    """NV12, NV21 or I420: rows of brightness, and rows of colours below, from OpenCV's I420."""
    planes = shared(cv2.COLOR_RGB2YUV_I420)
    y, u, v = planes[:24], planes[24:30].reshape(12, 16), planes[30:].reshape(12, 16)
    if order == "i420":
        return planes
    pair = (u, v) if order == "nv12" else (v, u)
    return np.vstack([y, np.stack(pair, axis=-1).reshape(12, 32)])


def image_of(encoding: str, stored: np.ndarray) -> dict:
    message = image_message(stored, encoding)
    return message | {"height": 24, "width": 32}


def packed_yuv(order: str) -> np.ndarray:
    y, u, v = (shared(cv2.COLOR_RGB2YUV)[..., k] for k in range(3))
    colours = np.empty((24, 32), np.uint8)
    colours[:, 0::2], colours[:, 1::2] = u[:, 0::2], v[:, 0::2]
    return np.stack([y, colours] if order == "yuyv" else [colours, y], axis=-1)


@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
def test_mosaics(pattern, kind):
    bits = 8 * np.dtype(kind).itemsize
    message = SimpleNamespace(**image_of(f"bayer_{pattern}{bits}", mosaic(pattern, kind)))
    found = picture(message, IMAGE, "here")
    inner = (slice(2, -2), slice(2, -2))
    if kind is np.uint8:
        assert np.abs(found[inner].astype(int) - smooth()[inner]).max() <= 6
    else:  # stretched to 8 bits: the order of the colours is kept
        for channel in range(3):
            kept = np.corrcoef(found[inner][..., channel].ravel(), smooth()[inner][..., channel].ravel())
            assert kept[0, 1] > 0.99


@pytest.mark.parametrize("encoding", ["nv12", "nv21", "i420", "yuv422", "uyvy", "yuv422_yuy2", "yuyv"])
def test_brightness_and_shared_colours(encoding):
    planar = encoding in ("nv12", "nv21", "i420")
    stored = yuv_planes(encoding) if planar else packed_yuv("yuyv" if "yuy" in encoding else "uyvy")
    found = picture(SimpleNamespace(**image_of(encoding, stored)), IMAGE, "here")
    assert found.shape == (24, 32, 3)
    # Full range against video range of brightness: a factor and an offset.
    for channel in range(3):
        both = np.corrcoef(found[..., channel].ravel(), smooth()[..., channel].ravel())
        assert both[0, 1] > 0.98
    assert found[..., 0].astype(int).mean() < found[..., 2].astype(int).mean() + 60


@pytest.mark.parametrize(("encoding", "order"), [("rgb16", slice(None)), ("bgr16", slice(None, None, -1))])
def test_colours_of_16_bits(encoding, order):
    stored = smooth()[..., order].astype(np.uint16) * 200
    found = picture(SimpleNamespace(**image_of(encoding, stored)), IMAGE, "here")
    for channel in range(3):
        assert np.corrcoef(found[..., channel].ravel(), smooth()[..., channel].ravel())[0, 1] > 0.999


def test_a_mosaic_compressed_as_it_is():
    data = cv2.imencode(".png", mosaic("rggb"))[1].tobytes()
    message = SimpleNamespace(**header(), format="bayer_rggb8; png compressed ", data=data)
    found = picture(message, COMPRESSED_IMAGE, "here")
    assert np.abs(found[2:-2, 2:-2].astype(int) - smooth()[2:-2, 2:-2]).max() <= 6


@pytest.mark.parametrize("encoding", sorted(ENCODINGS))
def test_every_encoding_that_a_message_names_is_read(encoding):
    layout = ENCODINGS[encoding]
    stored = np.zeros((layout.rows(24), 32, layout.channels), layout.kind)
    found = picture(SimpleNamespace(**image_of(encoding, stored)), IMAGE, "here")
    assert found.shape[:2] == (24, 32)
    assert found.dtype == np.uint8


def test_a_size_that_an_encoding_cannot_have_is_named():
    message = SimpleNamespace(**image_message(np.zeros((35, 31), np.uint8), "nv12") | {"height": 24, "width": 31})
    message.data = bytes(31 * 36)
    with pytest.raises(CaptureError, match="do not fit their encoding; expected an even number"):
        picture(message, IMAGE, "here")


# A picture that cannot be read ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [shots, cloud_shots])
def test_a_picture_that_cannot_be_read_costs_the_picture_of_its_frame(tmp_path, make):
    later = STAMP_NS + SECOND_NS
    cut = ("/camera/color/image_raw", IMAGE, image_message(GRAY, "mono8", stamp_ns=later) | {"height": 5000})
    second = [message for message in make(stamp_ns=later) if "/color/image" not in message[0]]
    frames = read_all(mcap(tmp_path / "a.mcap", [*make(), cut, *second]))
    assert_same(frames[0])
    assert frames[0].notes == ()
    assert frames[1].image is None
    assert (
        frames[1].notes[0].startswith("frame without its picture: /camera/color/image_raw: the message holds 768 bytes")
    )
    np.testing.assert_allclose(frames[1].cloud_m, frames[0].cloud_m, atol=1e-6)


def test_compressed_video_beside_a_cloud_leaves_the_cloud(tmp_path):
    data = {"format": "h264", "data": b"\x00\x00\x00\x01\x67" + bytes(40)}
    messages = [cloud_shots()[0], ("/color/compressed", COMPRESSED_IMAGE, header() | data)]
    (frame,) = read_all(mcap(tmp_path / "a.mcap", messages))
    assert frame.image is None
    assert "/color/compressed: cannot be decoded" in frame.notes[0]


# Depth ---------------------------------------------------------------------------------------------------------------


def test_depth_as_mono16_is_told_by_its_name(tmp_path):
    (frame,) = read_all(mcap(tmp_path / "a.mcap", shots(encoding="mono16", depth=MILLIMETRES)))
    np.testing.assert_allclose(frame.cloud_m[..., 2], MILLIMETRES / 1000)
    np.testing.assert_array_equal(frame.image, GRAY)


def test_depth_as_mono16_of_another_name_is_asked_for_and_the_option_works(tmp_path):
    messages = [
        ("/range/image_raw", IMAGE, image_message(MILLIMETRES, "mono16")),
        ("/range/camera_info", CAMERA_INFO, info_message()),
    ]
    path = mcap(tmp_path / "a.mcap", messages)
    with pytest.raises(CaptureError, match="if /range/image_raw holds depth, add --depth-topic /range/image_raw"):
        read_all(path)
    (frame,) = read_all(path, depth_topic="/range/image_raw")
    np.testing.assert_allclose(frame.cloud_m[..., 2], MILLIMETRES / 1000)


@pytest.mark.parametrize("form", ["png", "16UC1; png compressed ", "mono16; png compressed "])
def test_depth_as_a_png_of_16_bits(tmp_path, form):
    data = cv2.imencode(".png", MILLIMETRES)[1].tobytes()
    messages = [
        *shots()[:2],
        (f"{DEPTH_TOPIC}/compressed", COMPRESSED_IMAGE, header() | {"format": form, "data": data}),
    ]
    (frame,) = read_all(mcap(tmp_path / "a.mcap", messages))
    np.testing.assert_allclose(frame.cloud_m[..., 2], MILLIMETRES / 1000)
    np.testing.assert_array_equal(frame.image, GRAY)


def test_depth_as_a_tiff_of_floats(tmp_path):
    """What compressed_image_transport makes of 32FC1."""
    data = cv2.imencode(".tiff", DEPTH)[1].tobytes()
    message = header() | {"format": "32FC1; tiff compressed ", "data": data}
    messages = [*shots()[:2], (f"{DEPTH_TOPIC}/compressed", COMPRESSED_IMAGE, message)]
    (frame,) = read_all(mcap(tmp_path / "a.mcap", messages))
    np.testing.assert_allclose(frame.cloud_m[..., 2], DEPTH)


def test_a_coloured_picture_of_depth_is_no_depth(tmp_path):
    data = cv2.imencode(".png", smooth())[1].tobytes()
    name = "/camera/depth/image_coloured/compressed"
    messages = [
        cloud_shots()[0],
        (name, COMPRESSED_IMAGE, header() | {"format": "rgb8; png compressed bgr8", "data": data}),
    ]
    (frame,) = read_all(mcap(tmp_path / "a.mcap", messages))
    assert frame.image is None
    assert f"passed over {name} (rgb8; png compressed bgr8)" in frame.notes[0]


@pytest.mark.parametrize(
    ("name", "encoding"), [("texture", "32FC1"), ("ir/image_raw", "16UC1"), ("intensity", "32FC1")]
)
def test_beside_a_cloud_floats_named_texture_are_the_picture(tmp_path, name, encoding):
    levels = GRAY.astype(np.float32 if encoding == "32FC1" else np.uint16) * 3
    messages = [
        ("/phoxi_camera/pointcloud", POINT_CLOUD, cloud_message(CAMERA.backproject(DEPTH))),
        (f"/phoxi_camera/{name}", IMAGE, image_message(levels, encoding)),
        ("/phoxi_camera/depth_map", IMAGE, image_message(DEPTH, "32FC1")),
        ("/phoxi_camera/normal_map", IMAGE, image_message(DEPTH, "32FC1")),
    ]
    (frame,) = read_all(mcap(tmp_path / "a.mcap", messages))
    assert np.corrcoef(frame.image.ravel(), GRAY.ravel())[0, 1] > 0.99
    assert frame.notes == ()


def test_what_is_passed_over_beside_a_cloud_is_told_and_the_option_works(tmp_path):
    messages = [cloud_shots()[0], ("/sensor/map", IMAGE, image_message(GRAY.astype(np.float32), "32FC1"))]
    path = mcap(tmp_path / "a.mcap", messages)
    (frame,) = read_all(path)
    assert frame.image is None
    assert frame.notes == ("no picture: passed over /sensor/map (32FC1); --image-topic names one",)
    (frame,) = read_all(path, image_topic="/sensor/map")
    assert np.corrcoef(frame.image.ravel(), GRAY.ravel())[0, 1] > 0.99


@pytest.mark.parametrize(
    ("depth", "encoding", "options"),
    [
        (np.rint(DEPTH * 1e4).astype(np.uint16), "16UC1", {"depth_scale_m": 1e-4}),
        (np.rint(DEPTH * 1e4).astype(np.uint16), "mono16", {"depth_scale_m": 1e-4}),
        (MILLIMETRES, "16UC1", {}),
        (MILLIMETRES, "16UC1", {"unit": "mm"}),
        (MILLIMETRES, "16UC1", {"unit": "m"}),  # no count is a metre
        (DEPTH * 1000, "32FC1", {"unit": "mm"}),
        (DEPTH * 1000, "32FC1", {"depth_scale_m": 1e-3}),
        (DEPTH, "32FC1", {"unit": "m"}),
    ],
)
def test_scales_of_recorded_depth(tmp_path, depth, encoding, options):
    (frame,) = read_all(mcap(tmp_path / "a.mcap", shots(encoding=encoding, depth=depth)), **options)
    np.testing.assert_allclose(frame.cloud_m[..., 2], DEPTH, atol=0.51e-3)


def test_a_video_beside_a_cloud_is_named(tmp_path):
    from mcap.writer import Writer

    mcap(tmp_path / "made.mcap", cloud_shots()[:1])
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, schema, encoding, data in (
            ("/points", POINT_CLOUD, "cdr", cdr(*cloud_shots()[0][1:])),
            ("/video", "foxglove.CompressedVideo", "protobuf", b"\x00"),
        ):
            number = writer.register_schema(schema, "ros2msg", b"")
            writer.add_message(writer.register_channel(topic, encoding, number), 1, data, 1)
        writer.finish()
    (frame,) = read_all(tmp_path / "a.mcap")
    assert frame.notes == ("no picture: not read: /video (foxglove.CompressedVideo)",)


def test_a_depth_scale_is_of_depth_and_not_of_clouds(tmp_path):
    path = mcap(tmp_path / "a.mcap", cloud_shots())
    with pytest.raises(CaptureError, match="--depth-scale is of depth images, and this is a point cloud; give --unit"):
        read_all(path, depth_scale_m=1e-4)


@pytest.mark.parametrize("scale", [0, -1e-3, float("nan"), 2])
def test_a_scale_that_is_none_is_refused(tmp_path, scale):
    path = mcap(tmp_path / "a.mcap", shots())
    with pytest.raises(CaptureError, match="depth scale"):
        read_all(path, depth_scale_m=scale)


def test_types_that_are_not_read_are_named_beside_the_others(tmp_path):
    from recordings import STRING

    messages = [*shots()[:2], ("/points/draco", STRING, {"data": "not a cloud"})]
    with pytest.raises(CaptureError, match=r"found /camera/color/camera_info .*; not read: /points/draco \(std_msgs"):
        read_all(mcap(tmp_path / "a.mcap", messages))
