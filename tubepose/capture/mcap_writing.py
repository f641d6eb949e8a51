"""Frames written as an MCAP recording: ROS 2 `sensor_msgs` in CDR, compressed with zstd."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from mcap_ros2.writer import Writer
from numpy.typing import NDArray

from tubepose.capture.compressed_depth import DEPTH_STEP_M, FORMAT, encode_compressed_depth
from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.capture.images import encode_jpeg, encode_png
from tubepose.capture.message_types import CAMERA_INFO, COMPRESSED_IMAGE, DEFINITIONS, IMAGE, POINT_CLOUD
from tubepose.capture.recording import METADATA_NAME
from tubepose.capture.writing import is_depth_image
from tubepose.errors import CaptureError
from tubepose.transforms import FloatArray

CLOUD_TOPIC = "/camera/points"
DEPTH_TOPIC = "/camera/aligned_depth_to_color/image_raw"
IMAGE_TOPIC = "/camera/color/image_raw"
INFO_TOPIC = "/camera/color/camera_info"

PictureFormat = Literal["png", "jpeg"]

_FRAME_ID = "camera_color_optical_frame"
_POINT_BYTES = 12
# A float32 depth is exact to this, metres; a cloud that is farther from its lines of sight is not written as depth.
_DEPTH_TOLERANCE_M = 1.0e-6
_MAX_COUNT = 65535
# Depth this near to whole millimetres is whole millimetres: rounding of a float.
_WHOLE_M = 1.0e-9


@dataclass(frozen=True, slots=True)
class _Compression:
    picture: PictureFormat
    depth_step_m: float
    exact_depth: bool


def write_mcap(
    path: Path,
    frames: Iterable[RgbdFrame],
    *,
    as_depth: bool = False,
    compressed: bool = False,
    picture: PictureFormat = "jpeg",
    depth_step_m: float = DEPTH_STEP_M,
    exact_depth: bool = False,
) -> None:
    """Write frames as one recording; the same frames give the same bytes.

    Args:
        path: The file; it is replaced only when all frames are written.
        frames: One sensor's frames, in time order.
        as_depth: Write depth images (32FC1, metres) instead of organised clouds of float32.
        compressed: Write pictures, and depth images, as CompressedImage instead of Image. Clouds stay as they are.
        picture: Of compressed pictures: PNG keeps every pixel, JPEG of quality 95 has a third of the size.
        depth_step_m: Of compressed depth: difference of neighbouring counts at the farthest point; finer nearer.
            The depth that is read back is off by up to half of it.
        exact_depth: Compress pictures alone; depth is written as 16UC1 where it is whole millimetres, else as 32FC1.

    Raises:
        CaptureError: `as_depth` for a frame without intrinsics, or with points off the lines of sight of their pixels;
            compressed depth that 16 bits do not hold.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f".{path.name}.part")
    try:
        with aside.open("wb") as stream:
            compression = _Compression(picture, depth_step_m, exact_depth) if compressed else None
            _write(stream, path, frames, as_depth, compression)
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def _write(
    stream: Any, path: Path, frames: Iterable[RgbdFrame], as_depth: bool, compression: _Compression | None
) -> None:
    writer = Writer(stream)
    schemas = {name: writer.register_msgdef(name, text) for name, text in DEFINITIONS.items()}
    for number, frame in enumerate(frames):
        if number == 0:
            noted = {"sensor": frame.sensor, "simulated": "true" if frame.simulated else "false"}
            writer.add_metadata(METADATA_NAME, noted)
        if as_depth and not is_depth_image(frame, _DEPTH_TOLERANCE_M):
            raise CaptureError(
                f"{path}: frame {number} cannot be written as a depth image; expected intrinsics and points on the "
                "lines of sight of their pixels; write it as a cloud"
            )
        for topic, schema, message in _messages(frame, f"{path}: frame {number}", as_depth, compression):
            stamp = frame.timestamp_ns or 0
            writer.write_message(topic, schemas[schema], message, log_time=stamp, publish_time=stamp, sequence=number)
    writer.finish()  # type: ignore[no-untyped-call]


def _messages(
    frame: RgbdFrame, where: str, as_depth: bool, compression: _Compression | None
) -> Iterable[tuple[str, str, dict[str, Any]]]:
    """(topic, message type, message) of one frame, small ones first."""
    seconds, nanoseconds = divmod(frame.timestamp_ns or 0, 1_000_000_000)
    header = {"header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": _FRAME_ID}}
    if frame.intrinsics is not None:
        yield INFO_TOPIC, CAMERA_INFO, header | _info(frame.intrinsics)
    if frame.image is not None and compression is not None:
        yield f"{IMAGE_TOPIC}/compressed", COMPRESSED_IMAGE, header | _shot(frame.image, compression.picture)
    elif frame.image is not None:
        yield IMAGE_TOPIC, IMAGE, header | _image(frame.image, "rgb8" if frame.image.ndim == 3 else "mono8")
    if as_depth and compression is not None and not compression.exact_depth:
        data = encode_compressed_depth(frame.cloud_m[..., 2], where, compression.depth_step_m)
        yield f"{DEPTH_TOPIC}/compressedDepth", COMPRESSED_IMAGE, header | {"format": FORMAT, "data": data}
    elif as_depth:
        yield DEPTH_TOPIC, IMAGE, header | _depth(frame.cloud_m[..., 2], compression is not None)
    else:
        yield CLOUD_TOPIC, POINT_CLOUD, header | _cloud(frame)


def _shot(pixels: NDArray[np.uint8], kind: PictureFormat) -> dict[str, Any]:
    encoding = "rgb8" if pixels.ndim == 3 else "mono8"
    data = encode_png(pixels) if kind == "png" else encode_jpeg(pixels)
    return {"format": f"{encoding}; {kind} compressed {encoding.replace('rgb', 'bgr')}", "data": data}


def _depth(depth_m: FloatArray, counted: bool) -> dict[str, Any]:
    """Depth in metres, or in whole millimetres where they are that and are asked for."""
    counts = np.rint(np.nan_to_num(depth_m) * 1e3)
    off_m = np.nanmax(np.abs(counts * 1e-3 - depth_m), initial=0.0)
    if counted and counts.max(initial=0.0) < _MAX_COUNT and off_m < _WHOLE_M:
        return _image(counts.astype("<u2"), "16UC1")
    return _image(depth_m.astype("<f4"), "32FC1")


def _image(pixels: NDArray[Any], encoding: str) -> dict[str, Any]:
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels).tobytes()
    step = len(data) // height
    return {"height": height, "width": width, "encoding": encoding, "is_bigendian": 0, "step": step, "data": data}


def _cloud(frame: RgbdFrame) -> dict[str, Any]:
    height, width = frame.cloud_m.shape[:2]
    fields = [{"name": axis, "offset": 4 * i, "datatype": 7, "count": 1} for i, axis in enumerate("xyz")]
    return {
        "height": height,
        "width": width,
        "fields": fields,
        "is_bigendian": False,
        "point_step": _POINT_BYTES,
        "row_step": _POINT_BYTES * width,
        "data": frame.cloud_m.astype("<f4").tobytes(),
        "is_dense": False,
    }


def _info(camera: CameraIntrinsics) -> dict[str, Any]:
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    return {
        "height": camera.height,
        "width": camera.width,
        "distortion_model": "plumb_bob",
        "d": [0.0] * 5,
        "k": k,
        "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "p": [*k[0:3], 0.0, *k[3:6], 0.0, *k[6:9], 0.0],
        "binning_x": 0,
        "binning_y": 0,
        "roi": {},
    }
