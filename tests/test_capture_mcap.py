from __future__ import annotations

import re
import struct
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap.writer import Writer as RawWriter
from mcap_ros2.writer import Writer

from tubepose.batch import trial_capture
from tubepose.capture import CameraIntrinsics, RgbdFrame, open_captures, write_mcap
from tubepose.capture import mcap_writing as writing
from tubepose.capture.compressed_depth import FORMAT, decode_compressed_depth, encode_compressed_depth
from tubepose.capture.message_types import CAMERA_INFO, COMPRESSED_IMAGE, DEFINITIONS, IMAGE, POINT_CLOUD
from tubepose.capture.ros import cloud_arrays, image_array
from tubepose.capture.session import load_session
from tubepose.errors import CaptureError

STAMP_NS = 1_700_000_000_123_456_789
SECOND_NS = 1_000_000_000
CAMERA = CameraIntrinsics(width=32, height=24, fx=40.0, fy=41.0, cx=15.25, cy=11.75)
WIDE = CameraIntrinsics(width=64, height=48, fx=80.0, fy=82.0, cx=31.0, cy=24.0)


def make_frame(seed: int = 1, **changes) -> RgbdFrame:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.5, 1.2, (24, 32))
    depth[3, 4] = np.nan
    frame = RgbdFrame(
        cloud_m=CAMERA.backproject(depth),
        image=rng.integers(0, 256, (24, 32, 3)).astype(np.uint8),
        intrinsics=CAMERA,
        timestamp_ns=STAMP_NS + seed * SECOND_NS,
        capture="shots",
        sensor="PhoXi M",
        simulated=True,
    )
    return replace(frame, **changes)


def record(path: Path, messages: list[tuple[str, str, dict[str, Any]]], **options) -> Path:
    """Write (topic, schema, message) with log times that say nothing about the stamps."""
    with path.open("wb") as stream, Writer(stream, **options) as writer:
        schemas = {name: writer.register_msgdef(name, text) for name, text in DEFINITIONS.items()}
        for number, (topic, schema, message) in enumerate(messages):
            writer.write_message(topic, schemas[schema], message, log_time=number + 1)
    return path


def header(stamp_ns: int = STAMP_NS, frame_id: str = "camera") -> dict[str, Any]:
    sec, nanosec = divmod(stamp_ns, SECOND_NS)
    return {"header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id}}


def cloud_message(cloud: np.ndarray, **where) -> dict[str, Any]:
    return header(**where) | writing._cloud(make_frame(cloud_m=cloud))


def image_message(pixels: np.ndarray, encoding: str, **where) -> dict[str, Any]:
    return header(**where) | writing._image(pixels, encoding)


def info_message(camera: CameraIntrinsics = CAMERA, **where) -> dict[str, Any]:
    return header(**where) | writing._info(camera)


def in_cdr(schema: str, message: dict[str, Any]) -> bytes:
    """The bytes of a message as a recording holds them."""
    stream = BytesIO()
    with Writer(stream) as writer:
        writer.write_message("/t", writer.register_msgdef(schema, DEFINITIONS[schema]), message)
    stream.seek(0)
    (data,) = (record.data for record in StreamReader(stream).records if isinstance(record, Message))
    return data


def read_all(path: Path, **options) -> list[RgbdFrame]:
    (capture,) = open_captures(path, **options)
    return list(capture.frames())


GRAY = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32).astype(np.uint8)


# Round trips ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_depth", [False, True])
@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("gray", [False, True])
def test_frames_survive_the_round_trip(tmp_path, as_depth, compressed, gray):
    frames = [make_frame(seed, image=GRAY) if gray else make_frame(seed) for seed in range(3)]
    write_mcap(tmp_path / "shots.mcap", frames, as_depth=as_depth, compressed=compressed, picture="png")
    # Compressed depth of 1.2 m is off by up to half a step of 0.05 mm, and x and y with it.
    tolerance = 2.6e-5 if as_depth and compressed else 1e-7
    again = read_all(tmp_path / "shots.mcap")
    assert [frame.timestamp_ns for frame in again] == [STAMP_NS + i * SECOND_NS for i in range(3)]
    assert [(frame.capture, frame.index) for frame in again] == [("shots", 0), ("shots", 1), ("shots", 2)]
    for frame, found in zip(frames, again, strict=True):
        np.testing.assert_allclose(found.cloud_m, frame.cloud_m, rtol=0, atol=tolerance)
        np.testing.assert_array_equal(found.image, frame.image)
        assert (found.intrinsics, found.organised, found.sensor, found.simulated) == (CAMERA, True, "PhoXi M", True)


def test_frame_of_a_cloud_alone_survives(tmp_path):
    cloud = make_frame().cloud_m.reshape(1, -1, 3)
    frame = make_frame(cloud_m=cloud, image=None, intrinsics=None, organised=False, timestamp_ns=None, simulated=False)
    write_mcap(tmp_path / "a.mcap", [frame])
    (again,) = read_all(tmp_path / "a.mcap")
    np.testing.assert_allclose(again.cloud_m, cloud, atol=1e-7)
    assert (again.organised, again.image, again.intrinsics) == (False, None, None)
    assert (again.timestamp_ns, again.simulated) == (None, False)


@pytest.mark.parametrize("compressed", [False, True])
def test_same_frames_give_same_bytes_and_nothing_partial(tmp_path, compressed):
    for name in ("a.mcap", "b.mcap"):
        write_mcap(tmp_path / name, [make_frame(0), make_frame(1)], as_depth=compressed, compressed=compressed)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()
    with pytest.raises(CaptureError, match="frame 1 cannot be written as a depth image"):
        write_mcap(tmp_path / "c.mcap", [make_frame(0), make_frame(1, intrinsics=None)], as_depth=True)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.mcap", "b.mcap"]


# Layouts -------------------------------------------------------------------------------------------------------------


@settings(max_examples=60)
@given(
    height=st.integers(1, 4),
    width=st.integers(1, 5),
    big=st.booleans(),
    kind=st.sampled_from([(7, "f4"), (8, "f8"), (3, "i2")]),
    gaps=st.tuples(*[st.integers(0, 5)] * 4),
    row_pad=st.integers(0, 7),
    order=st.permutations("xyz"),
)
def test_every_point_cloud_layout_gives_its_points(height, width, big, kind, gaps, row_pad, order):
    number, name = kind
    item = np.dtype((">" if big else "<") + name)
    offsets, at = {}, 0
    for axis, gap in zip(order, gaps, strict=False):
        offsets[axis] = at + gap
        at = offsets[axis] + item.itemsize
    point_step = at + gaps[3]
    row_step = point_step * width + row_pad
    expected = np.arange(height * width * 3).reshape(height, width, 3) + 1.0
    data = bytearray(b"\xab" * (row_step * height))
    for v in range(height):
        for u in range(width):
            for i, axis in enumerate("xyz"):
                start = v * row_step + u * point_step + offsets[axis]
                data[start : start + item.itemsize] = np.array(expected[v, u, i], item).tobytes()
    fields = [SimpleNamespace(name=axis, offset=offsets[axis], datatype=number, count=1) for axis in order]
    message = SimpleNamespace(
        height=height, width=width, fields=fields, is_bigendian=big, point_step=point_step, row_step=row_step
    )
    message.data = bytes(data)
    np.testing.assert_array_equal(cloud_arrays(message, "here")[0], expected)
    message.data = bytes(data[: (height - 1) * row_step + width * point_step - 1])
    with pytest.raises(CaptureError, match="it is cut, or its layout is wrong"):
        cloud_arrays(message, "here")


def test_packed_colours_become_the_picture(tmp_path):
    message = cloud_message(make_frame().cloud_m)
    table = np.zeros((24, 32), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("rgb", "<u4")])
    table["z"], table["rgb"] = 1, 0x00C86405
    message["fields"] = [*message["fields"], {"name": "rgb", "offset": 12, "datatype": 7, "count": 1}]
    message |= {"point_step": 16, "row_step": 16 * 32, "data": table.tobytes()}
    (frame,) = read_all(record(tmp_path / "a.mcap", [("/points", POINT_CLOUD, message)]))
    np.testing.assert_array_equal(frame.image[5, 5], [200, 100, 5])


def test_zeros_are_invalid_and_the_unit_can_be_told(tmp_path):
    cloud = make_frame().cloud_m * 1000
    cloud[0, 0] = 0
    path = record(tmp_path / "a.mcap", [("/points", POINT_CLOUD, cloud_message(cloud))])
    (frame,) = read_all(path, unit="mm")
    assert np.isnan(frame.cloud_m[0, 0]).all()
    np.testing.assert_allclose(frame.cloud_m[5:], make_frame().cloud_m[5:], atol=1e-6)


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("mono8", GRAY, GRAY),
        ("8UC1", GRAY, GRAY),
        ("rgb8", np.tile(np.uint8([1, 2, 3]), (24, 32, 1)), [1, 2, 3]),
        ("bgr8", np.tile(np.uint8([1, 2, 3]), (24, 32, 1)), [3, 2, 1]),
        ("bgra8", np.tile(np.uint8([1, 2, 3, 9]), (24, 32, 1)), [3, 2, 1]),
        ("rgba8", np.tile(np.uint8([1, 2, 3, 9]), (24, 32, 1)), [1, 2, 3]),
    ],
)
def test_picture_encodings(tmp_path, encoding, pixels, expected):
    path = record(
        tmp_path / "a.mcap",
        [
            ("/points", POINT_CLOUD, cloud_message(make_frame().cloud_m)),
            ("/texture", IMAGE, image_message(pixels, encoding)),
        ],
    )
    (frame,) = read_all(path)
    np.testing.assert_array_equal(frame.image, np.broadcast_to(expected, frame.image.shape))


def test_16_bit_picture_is_stretched_and_a_reflection_does_not_blacken_it(tmp_path):
    pixels = np.linspace(1000, 2000, 24 * 32).reshape(24, 32).astype(np.uint16)
    pixels[0, 0] = 65535
    messages = [
        ("/points", POINT_CLOUD, cloud_message(make_frame().cloud_m)),
        ("/texture", IMAGE, image_message(pixels, "mono16")),
    ]
    (frame,) = read_all(record(tmp_path / "a.mcap", messages))
    assert frame.image.dtype == np.uint8
    assert int(frame.image[12, 16]) == pytest.approx(128, abs=6)


@pytest.mark.parametrize(("suffix", "form"), [(".jpg", "rgb8; jpeg compressed bgr8"), (".png", "png")])
def test_compressed_pictures(tmp_path, suffix, form):
    picture = np.zeros((24, 32, 3), np.uint8)
    picture[..., 2] = 200
    data = cv2.imencode(suffix, picture)[1].tobytes()
    messages = [
        ("/points", POINT_CLOUD, cloud_message(make_frame().cloud_m)),
        ("/color/compressed", COMPRESSED_IMAGE, header() | {"format": form, "data": data}),
    ]
    (frame,) = read_all(record(tmp_path / "a.mcap", messages))
    assert frame.image.shape == (24, 32, 3)
    assert frame.image[..., 0].mean() > 150 > frame.image[..., 2].mean()


@pytest.mark.parametrize(("encoding", "kind", "per_metre"), [("16UC1", np.uint16, 1000), ("32FC1", np.float32, 1)])
def test_depth_images_of_both_encodings(tmp_path, encoding, kind, per_metre):
    depth = np.full((24, 32), 0.7 * per_metre).astype(kind)
    depth[0, 0] = 0
    messages = [
        ("/camera/depth/image_rect_raw", IMAGE, image_message(depth, encoding)),
        ("/camera/depth/camera_info", CAMERA_INFO, info_message()),
    ]
    (frame,) = read_all(record(tmp_path / "a.mcap", messages))
    assert np.isnan(frame.cloud_m[0, 0]).all()
    np.testing.assert_allclose(frame.cloud_m[1:, :, 2], 0.7, atol=1e-6)
    assert frame.intrinsics == CAMERA


def test_big_endian_image_with_padded_rows():
    pixels = np.arange(6, dtype=">u2").reshape(2, 3)
    data = b"".join(row.tobytes() + b"\xff\xff" for row in pixels)
    message = SimpleNamespace(height=2, width=3, encoding="16UC1", is_bigendian=1, step=8, data=data)
    np.testing.assert_array_equal(image_array(message, "here"), pixels)


def test_a_picture_that_claims_to_be_huge_is_refused_in_one_line(tmp_path):
    jpeg = cv2.imencode(".jpg", GRAY)[1].tobytes()
    frame = jpeg.index(b"\xff\xc0") + 5  # start of frame: height and width
    huge = jpeg[:frame] + b"\xff\xff\xff\xff" + jpeg[frame + 4 :]
    messages = [*clouds([0]), ("/texture", COMPRESSED_IMAGE, header() | {"format": "jpeg", "data": huge})]
    (frame,) = read_all(record(tmp_path / "a.mcap", messages))
    assert frame.image is None
    assert re.search(r"without its picture: /texture: claims more than [0-9]+ pixels", "".join(frame.notes))


# Compressed depth ----------------------------------------------------------------------------------------------------


def ros_inverse_depth(depth: np.ndarray, quantization: float = 100.0, farthest: float = 10.0) -> bytes:
    """Data of a message as compressed_depth_image_transport makes it of 32FC1, with its default parameters."""
    a = quantization * (quantization + 1)
    b = 1 - a / farthest
    counts = np.where(depth < farthest, a / depth + b, 0).astype(np.uint16)
    return struct.pack("<iff", 0, a, b) + cv2.imencode(".png", counts)[1].tobytes()


def raw_depth(counts: np.ndarray) -> bytes:
    return struct.pack("<iff", 0, 0.0, 0.0) + cv2.imencode(".png", counts)[1].tobytes()


def depth_message(data: bytes, form: str = FORMAT) -> list[tuple[str, str, dict[str, Any]]]:
    return [
        ("/camera/depth/image_raw/compressedDepth", COMPRESSED_IMAGE, header() | {"format": form, "data": data}),
        ("/camera/depth/camera_info", CAMERA_INFO, info_message()),
    ]


@pytest.mark.parametrize("form", [FORMAT, "32FC1; compressedDepth", "32FC1;compressedDepth png "])
def test_inverse_depth_as_ros_writes_it(tmp_path, form):
    depth = np.random.default_rng(0).uniform(0.5, 1.2, (24, 32))
    depth[0, 0], depth[0, 1] = np.nan, 11.0
    (frame,) = read_all(record(tmp_path / "a.mcap", depth_message(ros_inverse_depth(depth), form)))
    assert np.isnan(frame.cloud_m[0, :2]).all()
    assert frame.intrinsics == CAMERA
    # ROS cuts the fraction of a count off: up to one step, 1.44 / 10100 m at 1.2 m, too far.
    off = (frame.cloud_m[..., 2] - depth)[1:]
    assert -1e-6 < off.min() < off.max() < 1.2**2 / 10100 * 1.01


@pytest.mark.parametrize("form", ["16UC1; compressedDepth png", "16UC1; compressedDepth"])
def test_compressed_depth_of_16_bits_is_in_millimetres(tmp_path, form):
    counts = np.arange(500, 500 + 24 * 32, dtype=np.uint16).reshape(24, 32)
    counts[0, 0], counts[0, 1] = 0, 65535
    (frame,) = read_all(record(tmp_path / "a.mcap", depth_message(raw_depth(counts), form)))
    assert np.isnan(frame.cloud_m[0, :2]).all()
    np.testing.assert_allclose(frame.cloud_m[1:, :, 2], counts[1:] / 1000)


def test_the_raw_depth_goes_before_its_compressed_twin(tmp_path):
    raw = image_message(np.full((24, 32), 0.9, np.float32), "32FC1")
    compressed = depth_message(ros_inverse_depth(np.full((24, 32), 0.5)))
    path = record(tmp_path / "a.mcap", [("/camera/depth/image_raw", IMAGE, raw), *compressed])
    np.testing.assert_allclose(read_all(path)[0].cloud_m[..., 2], 0.9)
    (frame,) = read_all(path, depth_topic=compressed[0][0])
    np.testing.assert_allclose(frame.cloud_m[..., 2], 0.5, atol=1e-4)


@settings(max_examples=60)
@given(
    near=st.floats(0.35, 1.1),
    span=st.floats(0, 0.75),
    step_m=st.floats(4e-5, 1e-3),
    seed=st.integers(0, 99),
)
def test_compressed_depth_comes_back_within_half_a_step(near, span, step_m, seed):
    depth = np.random.default_rng(seed).uniform(near, min(near + span, 1.1), (5, 7))
    depth[2, 3] = np.nan
    again = decode_compressed_depth(FORMAT, encode_compressed_depth(depth, "here", step_m), "here")
    np.testing.assert_array_equal(np.isnan(again), np.isnan(depth))
    far = np.nanmax(depth)
    assert (np.abs(again - depth) <= 0.501 * step_m * (depth / far) ** 2 + 1e-7)[np.isfinite(depth)].all()


def test_a_frame_without_any_point_can_be_compressed():
    nothing = np.full((3, 4), np.nan)
    again = decode_compressed_depth(FORMAT, encode_compressed_depth(nothing, "here"), "here")
    np.testing.assert_array_equal(again, nothing)


def test_depth_that_16_bits_do_not_hold_is_refused_with_a_step_that_works(tmp_path):
    depth = np.full((24, 32), 0.2)
    depth[0, 0] = 3.0
    frame = make_frame(cloud_m=CAMERA.backproject(depth))
    with pytest.raises(CaptureError, match=r"frame 0: depth from 0\.200 to 3\.000 m .* allow a step of 0\.64 mm"):
        write_mcap(tmp_path / "a.mcap", [frame], as_depth=True, compressed=True)
    write_mcap(tmp_path / "a.mcap", [frame], as_depth=True, compressed=True, depth_step_m=0.65e-3)
    assert abs(read_all(tmp_path / "a.mcap")[0].cloud_m[..., 2] - depth).max() < 0.33e-3


WHOLE = ros_inverse_depth(np.full((24, 32), 0.7))


@pytest.mark.parametrize(
    ("form", "data", "message"),
    [
        (FORMAT, b"", "holds 0 bytes, expected a header of 12 bytes and a PNG"),
        (FORMAT, WHOLE[:12], "holds 12 bytes, expected a header of 12 bytes and a PNG"),
        (FORMAT, WHOLE[:-8], "truncated or damaged; expected a whole PNG"),
        (FORMAT, WHOLE[:12] + b"nothing", "cannot be decoded; expected a whole PNG"),
        (FORMAT, struct.pack("<iff", 0, np.nan, 0.0) + WHOLE[12:], "A = nan and B = 0; expected numbers with A above"),
        (FORMAT, struct.pack("<iff", 0, 0.0, 0.0) + WHOLE[12:], "A = 0 and B = 0; expected numbers with A above 0"),
        (FORMAT, raw_depth(np.zeros((24, 32), np.uint8)), "16 bits and 1 channel .*, found 8 bits"),
        (FORMAT, ros_inverse_depth(np.full((12, 16), 0.7)), "depth image is 16 x 12 pixels, its CameraInfo 32 x 24"),
        ("16UC1; compressedDepth rvl", WHOLE, "format '16UC1; compressedDepth rvl' is not read; expected .* as png"),
        ("8UC1; compressedDepth png", WHOLE, "format '8UC1; compressedDepth png' is not read"),
    ],
)
def test_compressed_depth_that_cannot_be_read_is_one_line(tmp_path, form, data, message):
    path = record(tmp_path / "a.mcap", depth_message(data, form))
    with pytest.raises(CaptureError, match=message) as caught:
        read_all(path)
    assert "\n" not in str(caught.value)
    assert "/camera/depth/image_raw/compressedDepth, message 1" in str(caught.value)


def test_compressed_depth_is_no_picture(tmp_path):
    messages = depth_message(WHOLE)
    with pytest.raises(CaptureError, match="is the depth that the frames are made of; name a picture"):
        read_all(record(tmp_path / "a.mcap", messages), image_topic=messages[0][0])
    with pytest.raises(CaptureError, match="is a compressed depth image, no picture; choose another"):
        read_all(record(tmp_path / "a.mcap", [*clouds([0]), *messages]), image_topic=messages[0][0])


def test_jpeg_pictures_are_nearly_the_same_and_smaller(tmp_path):
    rng = np.random.default_rng(0)
    smooth = cv2.resize(rng.integers(60, 200, (4, 5, 3)).astype(np.uint8), (32, 24), interpolation=cv2.INTER_CUBIC)
    noisy = np.clip(smooth + rng.normal(0, 2, smooth.shape), 0, 255).astype(np.uint8)
    for picture in ("png", "jpeg"):
        write_mcap(tmp_path / f"{picture}.mcap", [make_frame(image=noisy)], compressed=True, picture=picture)
    (frame,) = read_all(tmp_path / "jpeg.mcap")
    assert np.abs(frame.image.astype(int) - noisy).mean() < 4
    assert np.abs(frame.image.astype(int) - smooth).mean(axis=(0, 1)).max() < 4
    assert (tmp_path / "jpeg.mcap").stat().st_size < (tmp_path / "png.mcap").stat().st_size


# Pairing and registration --------------------------------------------------------------------------------------------


def shots(offsets_ms: list[float]) -> list[tuple[str, str, dict[str, Any]]]:
    return [
        ("/texture", IMAGE, image_message(np.full((24, 32), i, np.uint8), "mono8", stamp_ns=STAMP_NS + int(ms * 1e6)))
        for i, ms in enumerate(offsets_ms)
    ]


def clouds(offsets_ms: list[float]) -> list[tuple[str, str, dict[str, Any]]]:
    cloud = make_frame().cloud_m
    return [("/points", POINT_CLOUD, cloud_message(cloud, stamp_ns=STAMP_NS + int(ms * 1e6))) for ms in offsets_ms]


def test_picture_nearest_in_time_is_taken_wherever_it_lies_in_the_file(tmp_path):
    path = record(tmp_path / "a.mcap", [*clouds([0, 1000]), *shots([-40, 980, 10, 1030]), *clouds([2000])])
    frames = read_all(path)
    found = [None if frame.image is None else int(frame.image[0, 0]) for frame in frames]
    assert found == [2, 1, None]
    assert [frame.timestamp_ns for frame in frames] == [STAMP_NS, STAMP_NS + SECOND_NS, STAMP_NS + 2 * SECOND_NS]


def test_clocks_that_differ_are_reported(tmp_path):
    path = record(tmp_path / "a.mcap", [*clouds([0, 100]), *shots([400])])
    with pytest.raises(CaptureError, match="within 50 ms of one of /points, the nearest is 300 ms away"):
        read_all(path)


def test_cloud_of_another_size_is_projected_by_the_camera_info(tmp_path):
    picture = np.zeros((48, 64), np.uint8)
    messages = [
        ("/points", POINT_CLOUD, cloud_message(make_frame().cloud_m)),
        ("/color/image_raw", IMAGE, image_message(picture, "mono8")),
        ("/color/camera_info", CAMERA_INFO, info_message(WIDE)),
    ]
    (frame,) = read_all(record(tmp_path / "a.mcap", messages))
    assert frame.cloud_m.shape == (48, 64, 3)
    assert frame.intrinsics == WIDE
    v, u = np.nonzero(frame.valid.reshape(48, 64))
    assert len(v) > 600
    assert np.abs(WIDE.project(frame.cloud_m[v, u]) - np.stack([u, v], 1)).max() <= 0.5


@pytest.mark.parametrize(
    ("image_frame", "with_info"), [("camera", False), ("other_camera", True)], ids=["no calibration", "other frame"]
)
def test_cloud_of_another_size_without_calibration_is_refused(tmp_path, image_frame, with_info):
    messages = [
        ("/points", POINT_CLOUD, cloud_message(make_frame().cloud_m)),
        ("/color/image_raw", IMAGE, image_message(np.zeros((48, 64), np.uint8), "mono8", frame_id=image_frame)),
    ]
    messages += [("/color/camera_info", CAMERA_INFO, info_message(WIDE, frame_id=image_frame))] if with_info else []
    with pytest.raises(CaptureError, match=r"the image is 64 x 48 pixels in frame '.*', the cloud 32 x 24 in frame"):
        read_all(record(tmp_path / "a.mcap", messages))


def test_depth_of_another_camera_at_the_same_size_is_not_taken_for_aligned(tmp_path):
    other = replace(CAMERA, fx=60.0, fy=60.0)
    messages = [
        ("/depth/image_raw", IMAGE, image_message(np.full((24, 32), 700, np.uint16), "16UC1", frame_id="depth")),
        ("/depth/camera_info", CAMERA_INFO, info_message(other, frame_id="depth")),
        ("/color/image_raw", IMAGE, image_message(GRAY, "mono8", frame_id="color")),
        ("/color/camera_info", CAMERA_INFO, info_message(frame_id="color")),
    ]
    with pytest.raises(CaptureError, match="not pixel to pixel; record the cloud in the image's frame"):
        read_all(record(tmp_path / "a.mcap", messages))


# Topics --------------------------------------------------------------------------------------------------------------


def test_usual_names_are_chosen(tmp_path):
    depth = np.full((24, 32), 700, np.uint16)
    messages = [
        ("/camera/camera/depth/image_rect_raw", IMAGE, image_message(depth * 2, "16UC1")),
        ("/camera/camera/aligned_depth_to_color/image_raw", IMAGE, image_message(depth, "16UC1")),
        ("/camera/camera/aligned_depth_to_color/camera_info", CAMERA_INFO, info_message()),
        ("/camera/camera/infra1/image_rect_raw", IMAGE, image_message(GRAY * 0, "mono8")),
        ("/camera/camera/color/image_raw", IMAGE, image_message(GRAY, "mono8")),
        ("/camera/camera/color/image_raw/compressed", COMPRESSED_IMAGE, header() | {"format": "png", "data": b"no"}),
        ("/camera/camera/color/camera_info", CAMERA_INFO, info_message()),
        ("/camera/camera/depth/camera_info", CAMERA_INFO, info_message(WIDE)),
    ]
    (frame,) = read_all(record(tmp_path / "a.mcap", messages))
    np.testing.assert_allclose(np.nanmax(frame.cloud_m[..., 2]), 0.7)
    np.testing.assert_array_equal(frame.image, GRAY)
    assert frame.intrinsics == CAMERA


def test_several_topics_are_listed_as_options_to_paste(tmp_path):
    cloud = make_frame().cloud_m
    messages = [
        ("/left/points", POINT_CLOUD, cloud_message(cloud)),
        ("/right/points", POINT_CLOUD, cloud_message(cloud * 2)),
    ]
    path = record(tmp_path / "a.mcap", messages)
    with pytest.raises(CaptureError, match="add --cloud-topic /left/points or --cloud-topic /right/points"):
        read_all(path)
    (frame,) = read_all(path, cloud_topic="/right/points")
    np.testing.assert_allclose(frame.cloud_m, cloud * 2, atol=1e-6)
    with pytest.raises(CaptureError, match="no topic /up that can be the cloud topic; found /left/points, /right"):
        read_all(path, cloud_topic="/up")


def test_a_session_names_the_unit_and_the_topics_of_its_captures(tmp_path):
    cloud = make_frame().cloud_m
    messages = [
        ("/left/points", POINT_CLOUD, cloud_message(cloud)),
        ("/right/points", POINT_CLOUD, cloud_message(cloud * 2000)),
    ]
    record(tmp_path / "a.mcap", messages)
    keys = {
        "format": 1, "name": "monday", "origin": "recorded", "rack": "chen2023-soft-5x10", "unit": "mm",
        "topics": {"cloud": "/right/points"}, "trials": [{"name": "one", "tubes": {}, "original": "a.mcap"}],
    }  # fmt: skip
    (tmp_path / "session.yaml").write_text(yaml.safe_dump(keys))
    session = load_session(tmp_path)
    (frame,) = trial_capture(session, session.trials[0], "a.mcap").frames()
    np.testing.assert_allclose(frame.cloud_m, cloud * 2, rtol=1e-6)
    for wrong, found in (({"unit": "cm"}, "unit"), ({"topics": {"clouds": "/x"}}, "topics.clouds")):
        (tmp_path / "session.yaml").write_text(yaml.safe_dump(keys | wrong))
        with pytest.raises(CaptureError, match=found):
            load_session(tmp_path)


def test_named_topics_go_before_guessed_ones(tmp_path):
    messages = [
        ("/points", POINT_CLOUD, cloud_message(make_frame().cloud_m)),
        ("/depth/image_raw", IMAGE, image_message(np.full((24, 32), 700, np.uint16), "16UC1")),
        ("/a/texture", IMAGE, image_message(GRAY, "mono8")),
        ("/b/texture", IMAGE, image_message(GRAY[::-1], "mono8")),
        ("/a/info", CAMERA_INFO, info_message(WIDE)),
        ("/b/info", CAMERA_INFO, info_message()),
    ]
    path = record(tmp_path / "a.mcap", messages)
    with pytest.raises(CaptureError, match="add --image-topic /a/texture or --image-topic /b/texture"):
        read_all(path)
    (frame,) = read_all(path, depth_topic="/depth/image_raw", image_topic="/b/texture", info_topic="/b/info")
    np.testing.assert_allclose(frame.cloud_m[..., 2], 0.7)
    np.testing.assert_array_equal(frame.image, GRAY[::-1])
    with pytest.raises(CaptureError, match="its CameraInfo 64 x 48; name the one that fits with --info-topic"):
        read_all(path, depth_topic="/depth/image_raw", image_topic="/b/texture", info_topic="/a/info")
    with pytest.raises(CaptureError, match="both given"):
        read_all(path, depth_topic="/depth/image_raw", cloud_topic="/points")


def test_depth_without_camera_info_is_refused(tmp_path):
    messages = [("/depth/image_raw", IMAGE, image_message(np.full((24, 32), 700, np.uint16), "16UC1"))]
    with pytest.raises(CaptureError, match="a depth image needs the CameraInfo of its camera, found none"):
        read_all(record(tmp_path / "a.mcap", messages))


def test_pictures_alone_make_no_frame(tmp_path):
    path = record(tmp_path / "a.mcap", [("/texture", IMAGE, image_message(GRAY, "mono8"))])
    with pytest.raises(CaptureError, match=r"expected a PointCloud2, or 16UC1 .* found /texture"):
        read_all(path)


# Broken files --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keep", [0.45, 0.7, 0.97])
def test_cut_file_gives_its_whole_frames_and_then_the_error(tmp_path, keep):
    path = tmp_path / "shots.mcap"
    write_mcap(path, [make_frame(seed) for seed in range(4)])
    messages = [("/points", POINT_CLOUD, cloud_message(make_frame().cloud_m, stamp_ns=STAMP_NS + i)) for i in range(8)]
    record(path, messages, chunk_size=1024)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * keep)])
    (capture,) = open_captures(path)
    frames = []
    with pytest.raises(CaptureError, match=r"shots\.mcap: truncated after \d whole frame") as caught:
        frames.extend(capture.frames())
    assert "\n" not in str(caught.value)
    assert f"after {len(frames)} whole" in str(caught.value)
    assert 2 <= len(frames) <= 8
    for frame in frames:
        np.testing.assert_allclose(frame.cloud_m, make_frame().cloud_m, atol=1e-7)


@settings(max_examples=40)
@given(keep=st.floats(0, 1))
def test_file_cut_anywhere_ends_in_one_clear_error(tmp_path_factory, keep):
    path = tmp_path_factory.mktemp("cut") / "a.mcap"
    record(path, [*clouds([0, 100]), *shots([0, 100])], chunk_size=1024)
    whole = path.read_bytes()
    path.write_bytes(whole[: int((len(whole) - 1) * keep)])
    with pytest.raises(CaptureError, match=r"truncated (after|before)|expected an MCAP file"):
        read_all(path)


def test_damaged_chunk_is_noticed(tmp_path):
    path = record(tmp_path / "a.mcap", clouds([0, 100, 200]), chunk_size=1024)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(bytes(data))
    with pytest.raises(CaptureError, match="truncated or damaged after"):
        read_all(path)


@pytest.mark.parametrize("content", [b"not a recording at all", b"short"])
def test_other_content_is_no_mcap(tmp_path, content):
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(CaptureError, match="expected an MCAP file, found other content"):
        read_all(tmp_path / "a.mcap")


def with_definition(
    path: Path,
    definition: bytes,
    schema: str = POINT_CLOUD,
    encoding: str = "ros2msg",
    message: bytes = b"\x00\x01\x00\x00" + bytes(200),
) -> Path:
    """A file of one message on /t, whose schema holds this text."""
    with path.open("wb") as stream:
        writer = RawWriter(stream)
        writer.start()
        channel = writer.register_channel("/t", "cdr", writer.register_schema(schema, encoding, definition))
        writer.add_message(channel, 1, message, 1)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("schema", "encoding", "message"),
    [
        (
            "foxglove.CompressedPointCloud",
            "protobuf",
            r"nothing to make a frame of; .* \(foxglove\.CompressedPointCloud\)",
        ),
        ("std_msgs/msg/String", "ros2msg", r"nothing to make a frame of; .* found /t \(std_msgs/msg/String\)"),
        (POINT_CLOUD, "ros2msg", "a message of /t is not the sensor_msgs/msg/PointCloud2 it claims to be"),
    ],
)
def test_messages_of_other_kinds_are_refused_by_name(tmp_path, schema, encoding, message):
    definition = DEFINITIONS.get(schema, "string data").encode()
    path = with_definition(tmp_path / "a.mcap", definition, schema, encoding, b"\x00\x01\x00\x00" + b"\xff" * 20)
    with pytest.raises(CaptureError, match=message):
        read_all(path)


def test_messages_of_another_encoding_are_refused(tmp_path):
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = RawWriter(stream)
        writer.start()
        channel = writer.register_channel("/t", "json", writer.register_schema(POINT_CLOUD, "jsonschema", b"{}"))
        writer.add_message(channel, 1, b"{}", 1)
        writer.finish()
    with pytest.raises(CaptureError, match=r"a\.mcap: /t is encoded as json; expected cdr, as 'ros2 bag record"):
        read_all(tmp_path / "a.mcap")


@pytest.mark.parametrize(
    ("encoding", "definition"),
    [
        ("ros2msg", DEFINITIONS[POINT_CLOUD].encode()),
        ("ros2msg", DEFINITIONS[POINT_CLOUD].replace("fields", "ields").encode()),  # names that no one reads
        ("ros2msg", DEFINITIONS[POINT_CLOUD].replace("uint32", "\xff[=").encode()),
        ("ros2idl", b"module sensor_msgs { module msg { struct PointCloud2 {"),
        ("", b""),  # what ros2 bag writes where it finds no definition
    ],
)
def test_the_definition_in_a_file_changes_nothing(tmp_path, capsys, encoding, definition):
    message = in_cdr(POINT_CLOUD, cloud_message(make_frame().cloud_m))
    (frame,) = read_all(with_definition(tmp_path / "a.mcap", definition, encoding=encoding, message=message))
    np.testing.assert_array_equal(frame.cloud_m, make_frame().cloud_m.astype(np.float32))
    assert capsys.readouterr() == ("", "")


SMALL_CLOUD = in_cdr(POINT_CLOUD, cloud_message(np.ones((2, 3, 3))))


@settings(max_examples=100)
@given(st.integers(0, len(SMALL_CLOUD)), st.integers(0, 12), st.binary(max_size=8))
def test_any_damaged_message_gives_frames_or_one_line(tmp_path_factory, start, length, junk):
    damaged = SMALL_CLOUD[:start] + junk + SMALL_CLOUD[start + length :]
    path = with_definition(tmp_path_factory.mktemp("message") / "a.mcap", b"", message=damaged)
    try:
        read_all(path)
    except CaptureError as told:
        assert str(told).isprintable()  # noqa: PT017  # frames are as good


def test_unreadable_encoding_and_missing_fields_are_named(tmp_path):
    image = image_message(GRAY, "mono8") | {"encoding": "hologram"}
    path = record(tmp_path / "a.mcap", [*clouds([0]), ("/texture", IMAGE, image)])
    (frame,) = read_all(path)
    assert frame.image is None
    assert "/texture: image encoding 'hologram' is not read; record one of mono8" in frame.notes[0]
    cloud = cloud_message(make_frame().cloud_m)
    cloud["fields"] = cloud["fields"][:2]
    with pytest.raises(CaptureError, match="expected the fields x, y and z in a PointCloud2, found x, y"):
        read_all(record(tmp_path / "b.mcap", [("/points", POINT_CLOUD, cloud)]))
