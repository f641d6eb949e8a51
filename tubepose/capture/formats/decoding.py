"""Messages of the types that are read, as objects with ROS 2's field names, whatever they were encoded in."""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace
from typing import Any

from tubepose.capture.formats import foxglove
from tubepose.capture.formats.raw_messages import RawMessage, header_stamp_ns
from tubepose.capture.message_types import (
    CAMERA_INFO,
    COMPRESSED_IMAGE,
    FLOAT32,
    IMAGE,
    POINT_CLOUD,
    STRING,
    TRANSFORM,
    TRANSFORMS,
)
from tubepose.errors import CaptureError

_STAMPED = (POINT_CLOUD, IMAGE, COMPRESSED_IMAGE, CAMERA_INFO)
_READ = (*_STAMPED, TRANSFORMS, TRANSFORM, STRING, FLOAT32)
# Types of ROS 1 that another name has the same fields as.
_OTHER_NAMES = {"tf/msg/tfMessage": TRANSFORMS}
_TRANSFORMS_TEXT = "geometry_msgs/TransformStamped[] transforms\n"
# CDR that starts otherwise is of another version.
_PLAIN_CDR = (b"\x00\x00", b"\x00\x01")
# Decoding one message: lengths and text that do not fit.
_UNDECODABLE = (struct.error, ValueError, IndexError, TypeError, KeyError, AttributeError, OverflowError, MemoryError)


def type_of(message: RawMessage) -> str | None:
    """ROS 2's name of a message's type, or the name of what is like it; None for types that are not read."""
    schema = message.schema
    if schema in foxglove.LIKE:
        return foxglove.LIKE[schema]
    package, _, name = schema.partition("/")
    full = schema if name.startswith("msg/") else f"{package}/msg/{name}"
    full = _OTHER_NAMES.get(full, full)
    return full if full in _READ else None


def decode_message(message: RawMessage, kind: str, where: str) -> Any:
    """Fields of a message by the definition of its type's name; what definition the file has changes nothing.

    Args:
        message: As it is stored.
        kind: Its type by `type_of`.
        where: Start of error messages.

    Raises:
        CaptureError: Another encoding than is read, or bytes that are no such message.
    """
    decoder = _decoder(message, kind)
    if decoder is None:
        raise CaptureError(
            f"{where}: {message.topic} is encoded as {message.encoding or 'nothing'}; expected cdr, as 'ros2 bag "
            "record -s mcap' writes it, ros1, or a Foxglove message in protobuf or json"
        )
    from rosbags.serde import SerdeError

    try:
        return decoder(message.data)
    except (*_UNDECODABLE, SerdeError) as problem:
        raise CaptureError(
            f"{where}: a message of {message.topic} is not the {message.schema} it claims to be: {problem}"
        ) from None


def stamp_ns(message: RawMessage, kind: str, where: str) -> int | None:
    """Stamp of a message of a type with a header, nanoseconds; the time of recording where it has none."""
    if kind not in _STAMPED:
        return message.log_time_ns or None
    if message.encoding in ("cdr", "ros1"):
        return header_stamp_ns(message)
    stamp = decode_message(message, kind, where).header.stamp
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec) or message.log_time_ns or None


def _decoder(message: RawMessage, kind: str) -> Callable[[bytes], Any] | None:
    if message.schema in foxglove.LIKE:
        if message.encoding == "json":
            return lambda data: foxglove.from_json(message.schema, data)
        if message.encoding == "protobuf":
            return lambda data: foxglove.from_protobuf(message.schema, message.definition, data)
        return None
    if message.encoding == "cdr":
        return lambda data: _from_cdr(data, kind)
    return (lambda data: _from_ros1(data, kind)) if message.encoding == "ros1" else None


def _from_cdr(data: bytes, kind: str) -> Any:
    if data[:2] not in _PLAIN_CDR or len(data) < 4:
        raise ValueError("no plain CDR")
    definition = _ros2_types().get_msgdef(kind)
    read = definition.deserialize_cdr_le if data[1] else definition.deserialize_cdr_be
    # Some writers leave bytes behind a message; rosbags' own call would refuse it.
    return read(memoryview(data)[4:], 0, definition.cls, _ros2_types())[0]


def _from_ros1(data: bytes, kind: str) -> Any:
    definition = _ros1_types().get_msgdef(kind)
    message = definition.deserialize_ros1(memoryview(data), 0, definition.cls, _ros1_types())[0]
    if kind != CAMERA_INFO:
        return message
    names = ("header", "height", "width", "distortion_model", "binning_x", "binning_y", "roi")
    fields = {name: getattr(message, name) for name in names}
    return SimpleNamespace(**fields, d=message.D, k=message.K, r=message.R, p=message.P)


@cache
def _ros2_types() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


@cache
def _ros1_types() -> Any:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    types = get_typestore(Stores.ROS1_NOETIC)
    types.register(get_types_from_msg(_TRANSFORMS_TEXT, TRANSFORMS))
    return types
