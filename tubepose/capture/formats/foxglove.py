"""Foxglove's messages in protobuf and JSON, as objects with the field names of the ROS 2 types that are like them.

Schemas: https://docs.foxglove.dev/docs/sdk/schemas. Their names of fields are the same in both encodings but for the
times (`seconds` and `nanos` in protobuf, `sec` and `nsec` in JSON); bytes are base64 in JSON.
"""

from __future__ import annotations

import base64
import binascii
import json
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

from tubepose.capture.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POINT_CLOUD, TRANSFORMS

LIKE = {
    "foxglove.PointCloud": POINT_CLOUD,
    "foxglove.RawImage": IMAGE,
    "foxglove.CompressedImage": COMPRESSED_IMAGE,
    "foxglove.CameraCalibration": CAMERA_INFO,
    "foxglove.FrameTransform": TRANSFORMS,
    "foxglove.FrameTransforms": TRANSFORMS,
}
"""Foxglove's schemas that are read, and the ROS 2 type that each is like."""

# PackedElementField's numeric types, as PointField's.
_FIELD_TYPES = {1: 2, 2: 1, 3: 4, 4: 3, 5: 6, 6: 5, 7: 7, 8: 8}
_NUMERIC_NAMES = {
    "UINT8": 1, "INT8": 2, "UINT16": 3, "INT16": 4, "UINT32": 5, "INT32": 6, "FLOAT32": 7, "FLOAT64": 8,
}  # fmt: skip


def from_json(schema: str, data: bytes) -> Any:
    """A message of a schema in `LIKE` from JSON.

    Raises:
        ValueError: No such JSON.
        KeyError: A field is missing that cannot be.
    """
    try:
        read = json.loads(data)
    except RecursionError:
        raise ValueError("lists in lists") from None
    if not isinstance(read, dict):
        raise ValueError(f"expected an object, found a {type(read).__name__}")
    return _ros_like(schema, _Json(read))


def from_protobuf(schema: str, definition: bytes, data: bytes) -> Any:
    """A message of a schema in `LIKE` from protobuf, by the definition that the file holds.

    Raises:
        ValueError: A damaged definition or message.
    """
    from google.protobuf.message import DecodeError

    try:
        message = _message_class(schema, definition)()
        message.ParseFromString(data)
    except DecodeError as problem:
        raise ValueError(str(problem)) from None
    return _ros_like(schema, message)


@lru_cache(maxsize=32)
def _message_class(schema: str, definition: bytes) -> Any:
    """The class of a schema by a serialised FileDescriptorSet, in a pool of its own."""
    from google.protobuf.descriptor_pb2 import FileDescriptorSet
    from google.protobuf.descriptor_pool import DescriptorPool
    from google.protobuf.message_factory import GetMessageClass

    pool = DescriptorPool()
    files = {file.name: file for file in FileDescriptorSet.FromString(definition).file}
    added: set[str] = set()

    def add(name: str) -> None:
        if name in added or name not in files:
            return
        added.add(name)
        for needed in files[name].dependency:
            add(needed)
        pool.Add(files[name])

    for name in files:
        add(name)
    return GetMessageClass(pool.FindMessageTypeByName(schema))


class _Json:
    """A JSON object whose keys are read as attributes; keys that are not there read as protobuf's defaults do."""

    def __init__(self, values: dict[str, Any]) -> None:
        self.values = values

    def __getattr__(self, name: str) -> Any:
        value = self.values.get(name)
        if isinstance(value, dict):
            return _Json(value)
        if isinstance(value, list):
            return [_Json(item) if isinstance(item, dict) else item for item in value]
        return value


def _ros_like(schema: str, message: Any) -> Any:
    if schema == "foxglove.FrameTransforms":
        return SimpleNamespace(transforms=[_transform(one) for one in message.transforms or ()])
    if schema == "foxglove.FrameTransform":
        return SimpleNamespace(transforms=[_transform(message)])
    header = SimpleNamespace(stamp=_stamp(message.timestamp), frame_id=str(message.frame_id or ""))
    if schema == "foxglove.CompressedImage":
        return SimpleNamespace(header=header, format=str(message.format or ""), data=_bytes(message.data))
    if schema == "foxglove.CameraCalibration":
        return _calibration(message, header)
    if schema == "foxglove.PointCloud":
        return _cloud(message, header)
    return SimpleNamespace(
        header=header,
        height=int(message.height or 0),
        width=int(message.width or 0),
        encoding=str(message.encoding or ""),
        is_bigendian=0,
        step=int(message.step or 0),
        data=_bytes(message.data),
    )


def _calibration(message: Any, header: Any) -> Any:
    return SimpleNamespace(
        header=header,
        height=int(message.height or 0),
        width=int(message.width or 0),
        distortion_model=str(message.distortion_model or ""),
        d=[float(value) for value in message.D or ()],
        k=_matrix(message.K, 9),
        r=_matrix(message.R, 9),
        p=_matrix(message.P, 12),
        binning_x=0,
        binning_y=0,
        roi=SimpleNamespace(x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def _matrix(values: Any, size: int) -> list[float]:
    numbers = [float(value) for value in values or ()]
    if numbers and len(numbers) != size:
        raise ValueError(f"a matrix of {len(numbers)} numbers; expected {size}")
    return numbers or [0.0] * size


def _cloud(message: Any, header: Any) -> Any:
    """Points in one row; `pose` maps them into the coordinate frame that the header names."""
    data = _bytes(message.data)
    stride = int(message.point_stride or 0)
    if stride <= 0:
        raise ValueError(f"point_stride is {stride}; expected the bytes of a point")
    fields = [
        SimpleNamespace(
            name=str(field.name), offset=int(field.offset or 0), datatype=_numeric_type(field.type), count=1
        )
        for field in message.fields or ()
    ]
    count = len(data) // stride
    return SimpleNamespace(
        header=header, height=1, width=count, fields=fields, is_bigendian=False, point_step=stride,
        row_step=count * stride, data=data, is_dense=False, pose=_pose(message.pose),
    )  # fmt: skip


def _numeric_type(value: Any) -> int:
    return _FIELD_TYPES.get(_NUMERIC_NAMES.get(value, 0) if isinstance(value, str) else int(value or 0), 0)


def _pose(pose: Any) -> Any:
    """Position and orientation as a ROS transform; None where there is none, or only zeros."""
    if pose is None or pose.orientation is None:
        return None
    turn = _numbers(pose.orientation, "xyzw")
    if not any(turn):
        return None
    return SimpleNamespace(translation=_vector(pose.position, "xyz"), rotation=_vector(pose.orientation, "xyzw"))


def _transform(message: Any) -> Any:
    return SimpleNamespace(
        header=SimpleNamespace(stamp=_stamp(message.timestamp), frame_id=str(message.parent_frame_id or "")),
        child_frame_id=str(message.child_frame_id or ""),
        transform=SimpleNamespace(
            translation=_vector(message.translation, "xyz"), rotation=_vector(message.rotation, "xyzw")
        ),
    )


def _vector(value: Any, axes: str) -> Any:
    return SimpleNamespace(**dict(zip(axes, _numbers(value, axes), strict=True)))


def _numbers(value: Any, axes: str) -> list[float]:
    return [float(getattr(value, axis, 0) or 0) for axis in axes]


def _stamp(stamp: Any) -> Any:
    if stamp is None:
        return SimpleNamespace(sec=0, nanosec=0)
    if isinstance(stamp, _Json):
        return SimpleNamespace(sec=int(stamp.sec or 0), nanosec=int(stamp.nsec or stamp.nanosec or 0))
    return SimpleNamespace(sec=int(stamp.seconds), nanosec=int(stamp.nanos))


def _bytes(value: Any) -> bytes:
    if isinstance(value, bytes):
        return value
    if value is None:
        return b""
    try:
        return base64.b64decode(value, validate=True)
    except binascii.Error as problem:
        raise ValueError(f"data that is no base64: {problem}") from None
