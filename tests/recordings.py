"""Recordings for tests, made by the packages rosbags and mcap of one list of (topic, type, message)."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as RawWriter
from mcap_ros2._dynamic import serialize_dynamic
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

from tubepose.capture import CameraIntrinsics, RgbdFrame, open_captures
from tubepose.capture import mcap_writing as writing
from tubepose.capture.message_types import (
    CAMERA_INFO,
    DEFINITIONS,
    FLOAT32,
    IMAGE,
    POINT_CLOUD,
    STRING,
    TRANSFORM,
    TRANSFORMS,
)
from tubepose.transforms import FloatArray, quaternion_wxyz

STAMP_NS = 1_700_000_000_123_456_789
SECOND_NS = 1_000_000_000
CAMERA = CameraIntrinsics(width=32, height=24, fx=40.0, fy=41.0, cx=15.25, cy=11.75)
WIDE = CameraIntrinsics(width=64, height=48, fx=80.0, fy=82.0, cx=31.0, cy=24.0)
GRAY = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32).astype(np.uint8)
DEPTH = np.random.default_rng(1).uniform(0.5, 1.2, (24, 32)).astype(np.float32)

_TEXTS = {
    **DEFINITIONS,
    STRING: "string data\n",
    FLOAT32: "float32 data\n",
    TRANSFORM: (
        "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n" + "=" * 80 + "\n"
        "MSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n" + "=" * 80 + "\n"
        "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n"
    ),
    TRANSFORMS: (
        "geometry_msgs/TransformStamped[] transforms\n" + "=" * 80 + "\nMSG: geometry_msgs/TransformStamped\n"
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n" + "=" * 80 + "\n"
        "MSG: geometry_msgs/Transform\ngeometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n"
        + "=" * 80 + "\nMSG: geometry_msgs/Vector3\nfloat64 x\nfloat64 y\nfloat64 z\n" + "=" * 80 + "\n"
        "MSG: geometry_msgs/Quaternion\nfloat64 x\nfloat64 y\nfloat64 z\nfloat64 w\n" + "=" * 80 + "\n"
        "MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n" + "=" * 80 + "\n"
        "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
    ),
}  # fmt: skip

Message = tuple[str, str, dict[str, Any]]


def header(stamp_ns: int = STAMP_NS, frame_id: str = "camera") -> dict[str, Any]:
    sec, nanosec = divmod(stamp_ns, SECOND_NS)
    return {"header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame_id}}


def cloud_message(cloud: np.ndarray, **where: Any) -> dict[str, Any]:
    frame = RgbdFrame(cloud_m=cloud, image=None, intrinsics=None, timestamp_ns=None, capture="")
    return header(**where) | writing._cloud(frame)


def image_message(pixels: np.ndarray, encoding: str, **where: Any) -> dict[str, Any]:
    return header(**where) | writing._image(pixels, encoding)


def info_message(camera: CameraIntrinsics = CAMERA, *, changes: dict[str, Any] | None = None, **where: Any) -> Any:
    return header(**where) | writing._info(camera) | (changes or {})


def tf_message(parent: str, child: str, T_parent_child: FloatArray) -> dict[str, Any]:
    w, x, y, z = quaternion_wxyz(T_parent_child)
    shift = dict(zip("xyz", (float(value) for value in T_parent_child[:3, 3]), strict=True))
    turn = {"x": float(x), "y": float(y), "z": float(z), "w": float(w)}
    edge = header(frame_id=parent) | {"child_frame_id": child, "transform": {"translation": shift, "rotation": turn}}
    return {"transforms": [edge]}


def shots(*, stamp_ns: int = STAMP_NS, encoding: str = "32FC1", depth: np.ndarray = DEPTH) -> list[Message]:
    """An aligned depth image and its gray picture, with one CameraInfo."""
    name = "/camera/aligned_depth_to_color/image_raw"
    return [
        ("/camera/color/camera_info", CAMERA_INFO, info_message(stamp_ns=stamp_ns)),
        ("/camera/color/image_raw", IMAGE, image_message(GRAY, "mono8", stamp_ns=stamp_ns)),
        (name, IMAGE, image_message(depth, encoding, stamp_ns=stamp_ns)),
    ]


def cloud_shots(stamp_ns: int = STAMP_NS) -> list[Message]:
    """A cloud and its gray picture."""
    cloud = CAMERA.backproject(DEPTH)
    return [
        ("/camera/points", POINT_CLOUD, cloud_message(cloud, stamp_ns=stamp_ns)),
        ("/camera/color/image_raw", IMAGE, image_message(GRAY, "mono8", stamp_ns=stamp_ns)),
    ]


@cache
def encoder(schema: str) -> Any:
    return serialize_dynamic(schema, _TEXTS[schema])[schema]


def cdr(schema: str, message: dict[str, Any]) -> bytes:
    return bytes(encoder(schema)(message))


@cache
def types() -> Any:
    return get_typestore(Stores.ROS2_HUMBLE)


def ros1(schema: str, message: dict[str, Any]) -> bytes:
    """Bytes of a message as ROS 1 has them: headers with a sequence number."""
    return bytes(types().cdr_to_ros1(cdr(schema, message), schema))


def bag2(
    folder: Path,
    messages: list[Message],
    *,
    storage: StoragePlugin = StoragePlugin.SQLITE3,
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """A ROS 2 bag of one file in a folder, written by rosbags."""
    writer = Writer2(folder, version=9, storage_plugin=storage)
    if compression is not CompressionMode.NONE:
        writer.set_compression(compression, CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for number, (topic, schema, message) in enumerate(messages):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, schema, typestore=types())
            writer.write(connections[topic], STAMP_NS + number, cdr(schema, message))
    return folder


def bag1(path: Path, messages: list[Message], compression: str | None = None, behind: bytes = b"") -> Path:
    """A ROS 1 bag, written by rosbags; `behind` is left behind every message."""
    writer = Writer1(path)
    if compression is not None:
        writer.set_compression(Writer1.CompressionFormat[compression])
    old = get_typestore(Stores.ROS1_NOETIC)
    with writer:
        connections: dict[str, Any] = {}
        for number, (topic, schema, message) in enumerate(messages):
            if topic not in connections:
                known = old if schema in old.fielddefs else types()
                connections[topic] = writer.add_connection(topic, schema, typestore=known)
            writer.write(connections[topic], STAMP_NS + number, ros1(schema, message) + behind)
    return path


def mcap(
    path: Path, messages: list[Message], *, ros: int = 2, log_times_ns: list[int] | None = None, **options: Any
) -> Path:
    """An MCAP file of ROS 2 or ROS 1 messages."""
    with path.open("wb") as stream:
        writer = RawWriter(stream, compression=CompressionType.NONE, **options)
        writer.start(profile=f"ros{ros}")
        channels: dict[str, int] = {}
        for number, (topic, schema, message) in enumerate(messages):
            if topic not in channels:
                name = schema if ros == 2 else schema.replace("/msg/", "/")
                known = writer.register_schema(name, f"ros{ros}msg", _TEXTS[schema].encode())
                channels[topic] = writer.register_channel(topic, "cdr" if ros == 2 else "ros1", known)
            data = cdr(schema, message) if ros == 2 else ros1(schema, message)
            time_ns = log_times_ns[number] if log_times_ns is not None else number + 1
            writer.add_message(channels[topic], time_ns, data, time_ns)
        writer.finish()
    return path


def json_mcap(path: Path, messages: list[tuple[str, str, dict[str, Any]]]) -> Path:
    """An MCAP file of Foxglove messages in JSON."""
    with path.open("wb") as stream:
        writer = RawWriter(stream)
        writer.start()
        for number, (topic, schema, message) in enumerate(messages):
            channel = writer.register_channel(topic, "json", writer.register_schema(schema, "jsonschema", b"{}"))
            writer.add_message(channel, number + 1, json.dumps(message).encode(), number + 1)
        writer.finish()
    return path


def read_all(path: Path, **options: Any) -> list[RgbdFrame]:
    (capture,) = open_captures(path, **options)
    return list(capture.frames())


def assert_same(frame: RgbdFrame, *, tolerance: float = 1e-6) -> None:
    """The frame of `shots` or `cloud_shots`."""
    np.testing.assert_allclose(frame.cloud_m, CAMERA.backproject(DEPTH), rtol=0, atol=tolerance)
    np.testing.assert_array_equal(frame.image, GRAY)
    assert frame.timestamp_ns == STAMP_NS


def scaled(camera: CameraIntrinsics, factor: float) -> CameraIntrinsics:
    return replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
