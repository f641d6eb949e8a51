"""Foxglove's messages in JSON and protobuf; tests/test_genuine_writers.py has those of its own SDK."""

from __future__ import annotations

import base64
import json

import cv2
import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from recordings import CAMERA, DEPTH, GRAY, STAMP_NS, assert_same, json_mcap, read_all

from tubepose.capture.formats import foxglove
from tubepose.errors import CaptureError
from tubepose.transforms import quaternion_wxyz

TIME = {"sec": STAMP_NS // 1_000_000_000, "nsec": STAMP_NS % 1_000_000_000}
K = [CAMERA.fx, 0, CAMERA.cx, 0, CAMERA.fy, CAMERA.cy, 0, 0, 1]


def packed(data: bytes) -> str:
    return base64.b64encode(data).decode()


def raw_image(pixels: np.ndarray, encoding: str, frame_id: str = "camera") -> dict:
    height, width = pixels.shape[:2]
    return {
        "timestamp": TIME, "frame_id": frame_id, "width": width, "height": height, "encoding": encoding,
        "step": len(pixels.tobytes()) // height, "data": packed(pixels.tobytes()),
    }  # fmt: skip


def calibration(frame_id: str = "camera", **changes) -> dict:
    info = {"timestamp": TIME, "frame_id": frame_id, "width": CAMERA.width, "height": CAMERA.height}
    return info | {"distortion_model": "", "D": [], "K": K, "R": [], "P": []} | changes


def cloud(points: np.ndarray, pose: dict | None = None, frame_id: str = "camera") -> dict:
    fields = [{"name": axis, "offset": 4 * number, "type": 7} for number, axis in enumerate("xyz")]
    return {
        "timestamp": TIME, "frame_id": frame_id, "pose": pose, "point_stride": 12, "fields": fields,
        "data": packed(points.astype("<f4").tobytes()),
    }  # fmt: skip


DEPTH_SHOTS = [
    ("/camera/calibration", "foxglove.CameraCalibration", calibration()),
    ("/camera/color", "foxglove.RawImage", raw_image(GRAY, "mono8")),
    ("/camera/depth", "foxglove.RawImage", raw_image(DEPTH, "32FC1")),
]


def test_depth_and_picture(tmp_path):
    (frame,) = read_all(json_mcap(tmp_path / "a.mcap", DEPTH_SHOTS))
    assert_same(frame)
    assert frame.intrinsics == CAMERA


def test_compressed_images(tmp_path):
    png = packed(cv2.imencode(".png", GRAY)[1].tobytes())
    counts = packed(cv2.imencode(".png", np.rint(DEPTH * 1000).astype(np.uint16))[1].tobytes())
    rest = {"timestamp": TIME, "frame_id": "camera", "format": "png"}
    messages = [
        DEPTH_SHOTS[0],
        ("/camera/color", "foxglove.CompressedImage", rest | {"data": png}),
        ("/camera/depth", "foxglove.CompressedImage", rest | {"data": counts}),
    ]
    (frame,) = read_all(json_mcap(tmp_path / "a.mcap", messages))
    np.testing.assert_allclose(frame.cloud_m[..., 2], DEPTH, atol=0.51e-3)
    np.testing.assert_array_equal(frame.image, GRAY)


def test_a_point_cloud_gets_its_rows_by_the_camera(tmp_path):
    points = CAMERA.backproject(DEPTH)
    messages = [("/points", "foxglove.PointCloud", cloud(points)), *DEPTH_SHOTS[:2]]
    (frame,) = read_all(json_mcap(tmp_path / "a.mcap", messages))
    assert_same(frame)


def test_the_pose_of_a_cloud_and_transforms_are_applied(tmp_path):
    w, x, y, z = quaternion_wxyz(np.eye(4))
    turn = {"x": x, "y": y, "z": z, "w": w}
    pose = {"position": {"x": 0.1, "y": 0, "z": 0}, "orientation": turn}
    edge = {
        "timestamp": TIME, "parent_frame_id": "camera", "child_frame_id": "sensor",
        "translation": {"x": 0, "y": 0.2, "z": 0}, "rotation": turn,
    }  # fmt: skip
    moved = CAMERA.backproject(DEPTH) - (0.1, 0.2, 0)
    messages = [
        ("/tf", "foxglove.FrameTransforms", {"transforms": [edge]}),
        ("/points", "foxglove.PointCloud", cloud(moved, pose, "sensor")),
        *DEPTH_SHOTS[:2],
    ]
    (frame,) = read_all(json_mcap(tmp_path / "a.mcap", messages))
    assert_same(frame)
    one = [("/tf", "foxglove.FrameTransform", edge), *messages[1:]]
    (frame,) = read_all(json_mcap(tmp_path / "b.mcap", one))
    assert_same(frame)


def test_numeric_types_are_foxgloves_own(tmp_path):
    """Its UINT8 is 1 and its FLOAT64 is 8; ROS's numbers of whole numbers are others."""
    table = np.zeros(
        24 * 32, [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    )
    table["x"], table["y"], table["z"] = CAMERA.backproject(DEPTH).reshape(-1, 3).T
    table["red"] = 200
    kinds = {"<f8": 8, "|u1": 1}
    fields = [
        {"name": name, "offset": table.dtype.fields[name][1], "type": kinds[table.dtype[name].str]}
        for name in table.dtype.names
    ]
    message = cloud(DEPTH) | {"point_stride": 27, "fields": fields, "data": packed(table.tobytes())}
    messages = [("/points", "foxglove.PointCloud", message), DEPTH_SHOTS[0]]
    (frame,) = read_all(json_mcap(tmp_path / "a.mcap", messages))
    np.testing.assert_allclose(frame.cloud_m, CAMERA.backproject(DEPTH), atol=1e-6)


def test_a_lens_is_removed(tmp_path):
    bent = (
        "/camera/calibration",
        "foxglove.CameraCalibration",
        calibration(distortion_model="plumb_bob", D=[-0.2, 0.1, 0, 0]),
    )
    (frame,) = read_all(json_mcap(tmp_path / "a.mcap", [bent, *DEPTH_SHOTS[1:]]))
    off = CAMERA.project(frame.measured_m) - np.argwhere(frame.valid.reshape(24, 32))[:, ::-1]
    assert np.abs(off).max() <= 0.75
    assert not np.allclose(np.nan_to_num(frame.cloud_m), CAMERA.backproject(DEPTH))


@pytest.mark.parametrize(
    ("schema", "data", "found"),
    [
        ("foxglove.PointCloud", b"[1, 2]", "expected an object, found a list"),
        ("foxglove.PointCloud", b"{", "is not the foxglove.PointCloud it claims to be"),
        ("foxglove.PointCloud", json.dumps(cloud(DEPTH) | {"point_stride": 0}).encode(), "point_stride is 0"),
        ("foxglove.PointCloud", json.dumps(cloud(DEPTH) | {"data": "!"}).encode(), "no base64"),
        ("foxglove.PointCloud", b"[" * 100000, "foxglove.PointCloud it claims to be"),
        (
            "foxglove.CompressedPointCloud",
            b"{}",
            r"\(foxglove\.CompressedPointCloud\); record one of these, decompressed",
        ),
    ],
)
def test_messages_that_cannot_be_read_are_one_line(tmp_path, schema, data, found):
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_message(writer.register_channel("/t", "json", writer.register_schema(schema, "", b"")), 1, data, 1)
        writer.finish()
    with pytest.raises(CaptureError, match=found):
        read_all(tmp_path / "a.mcap")


# Protobuf ------------------------------------------------------------------------------------------------------------

_T = FieldDescriptorProto


def message_type(name: str, *fields: tuple[str, int, int, str]) -> DescriptorProto:
    """A message type of (name, number, kind, type's name) fields; a kind below zero is repeated."""
    made = DescriptorProto(name=name)
    for field_name, number, kind, type_name in fields:
        label = _T.LABEL_REPEATED if kind < 0 else _T.LABEL_OPTIONAL
        made.field.add(name=field_name, number=number, type=abs(kind), label=label, type_name=type_name or None)
    return made


def definitions() -> bytes:
    """RawImage and CameraCalibration in files of their own, the one they need stored last."""
    time = FileDescriptorProto(name="time.proto", package="google.protobuf", syntax="proto3")
    time.message_type.append(
        message_type("Timestamp", ("seconds", 1, _T.TYPE_INT64, ""), ("nanos", 2, _T.TYPE_INT32, ""))
    )
    made = FileDescriptorProto(name="foxglove.proto", package="foxglove", syntax="proto3", dependency=["time.proto"])
    stamp = ("timestamp", 1, _T.TYPE_MESSAGE, ".google.protobuf.Timestamp")
    made.message_type.append(
        message_type(
            "RawImage", stamp, ("frame_id", 7, _T.TYPE_STRING, ""), ("width", 2, _T.TYPE_FIXED32, ""),
            ("height", 3, _T.TYPE_FIXED32, ""), ("encoding", 4, _T.TYPE_STRING, ""), ("step", 5, _T.TYPE_FIXED32, ""),
            ("data", 6, _T.TYPE_BYTES, ""),
        )
    )  # fmt: skip
    made.message_type.append(
        message_type(
            "CameraCalibration", stamp, ("frame_id", 9, _T.TYPE_STRING, ""), ("width", 2, _T.TYPE_FIXED32, ""),
            ("height", 3, _T.TYPE_FIXED32, ""), ("distortion_model", 4, _T.TYPE_STRING, ""),
            *[(name, number, -_T.TYPE_DOUBLE, "") for number, name in enumerate("DKRP", 5)],
        )
    )  # fmt: skip
    return FileDescriptorSet(file=[made, time]).SerializeToString()


def protobuf_mcap(path, messages):
    definition = definitions()
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, schema, values in messages:
            made = foxglove._message_class(schema, definition)()
            for name, value in values.items():
                if name == "timestamp":
                    made.timestamp.seconds, made.timestamp.nanos = value["sec"], value["nsec"]
                elif isinstance(value, list):
                    getattr(made, name).extend(value)
                else:
                    setattr(made, name, base64.b64decode(value) if name == "data" else value)
            schema_id = writer.register_schema(schema, "protobuf", definition)
            channel = writer.register_channel(topic, "protobuf", schema_id)
            writer.add_message(channel, 1, made.SerializeToString(), 1)
        writer.finish()
    return path


def test_protobuf_by_the_definition_in_the_file(tmp_path):
    (frame,) = read_all(protobuf_mcap(tmp_path / "a.mcap", DEPTH_SHOTS))
    assert_same(frame)
    assert frame.intrinsics == CAMERA


WHOLE_DEFINITION = definitions()


@settings(max_examples=40)
@given(st.integers(0, len(WHOLE_DEFINITION) - 1), st.integers(1, 255), st.binary(max_size=40))
def test_damaged_definitions_and_messages_are_one_line(tmp_path_factory, at, flip, data):
    damaged = bytearray(WHOLE_DEFINITION)
    damaged[at] ^= flip
    path = tmp_path_factory.mktemp("damaged") / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel(
            "/t", "protobuf", writer.register_schema("foxglove.RawImage", "protobuf", bytes(damaged))
        )
        writer.add_message(channel, 1, data, 1)
        writer.finish()
    with pytest.raises(CaptureError) as caught:
        read_all(path)
    assert str(caught.value).isprintable()
