"""Captures in MCAP recordings: ROS 2 `sensor_msgs` in CDR, any number of frames in a file."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.description import Unit
from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.capture.message_types import POINT_CLOUD
from tubepose.capture.recording import Recording, StampedMessage, index_recording, read_messages
from tubepose.capture.registration import METRES_PER_UNIT, clean_cloud, project_cloud
from tubepose.capture.ros import camera_of, cloud_arrays, depth_image, picture
from tubepose.capture.topics import Chosen, Topic, TopicChoice, choose_topics
from tubepose.errors import CaptureError
from tubepose.transforms import FloatArray

PAIRING_TOLERANCE_NS = 50_000_000

# A cloud whose points project this far from their pixels is not organised by that camera.
_MAX_MEDIAN_OFF_PX = 2.0


@dataclass(frozen=True, slots=True)
class McapCapture:
    """All frames of one MCAP file.

    Attributes:
        name: As the tables show it.
        path: The file.
        unit: Unit of PointCloud2 coordinates; None means metres, as ROS has it.
        topics: Topics that the user named.
    """

    name: str
    path: Path
    unit: Unit | None = None
    topics: TopicChoice = field(default_factory=TopicChoice)

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield one frame per cloud (or depth image), with the picture nearest in time within 50 ms, else without.

        A cut file gives every frame that is whole, and the error after them.

        Raises:
            CaptureError: No MCAP, cut, nothing that makes a frame, or several topics that could.
        """
        recording = index_recording(self.path)
        try:
            chosen = choose_topics(recording.topics.values(), self.topics, str(self.path))
        except CaptureError:
            # What is missing lies behind the cut.
            if recording.broken is not None:
                raise CaptureError(recording.broken_text(self.path, 0)) from None
            raise
        count = 0
        for cloud, shot in _paired(self.path, chosen, _pairs(self.path, chosen)):
            yield self._frame(recording, chosen, count, cloud, shot)
            count += 1
        if recording.broken is not None:
            raise CaptureError(recording.broken_text(self.path, count))

    def _frame(
        self, recording: Recording, chosen: Chosen, index: int, message: StampedMessage, shot: StampedMessage | None
    ) -> RgbdFrame:
        where = f"{self.path}, {chosen.source.name}, message {index + 1}"
        cloud, colours = self._cloud(chosen, message.fields, where)
        image = None
        if shot is not None and chosen.image is not None:
            image = picture(shot.fields, chosen.image.schema, f"{self.path}, {chosen.image.name}")
        cloud, camera = _registered(cloud, image, chosen, _frame_ids(message, shot, chosen), where)
        organised = cloud.shape[0] > 1
        if image is None and organised:
            image = colours
        return RgbdFrame(
            cloud_m=cloud,
            image=image,
            intrinsics=camera,
            timestamp_ns=message.stamp_ns,
            capture=self.name,
            index=index,
            organised=organised,
            sensor=recording.metadata.get("sensor", "unknown"),
            simulated=recording.metadata.get("simulated") == "true",
        )

    def _cloud(self, chosen: Chosen, fields: Any, where: str) -> tuple[FloatArray, NDArray[np.uint8] | None]:
        """Cloud (H, W, 3) in metres and its own colours."""
        if chosen.source.schema == POINT_CLOUD:
            xyz, colours = cloud_arrays(fields, where)
            return clean_cloud(xyz, METRES_PER_UNIT[self.unit or "m"]), colours
        camera = _camera(chosen.source_info, chosen.source)
        if camera is None:
            info = chosen.source_info
            found = "none" if info is None else f"{info.name}, without calibration or with lens distortion"
            raise CaptureError(
                f"{where}: a depth image needs the CameraInfo of a rectified camera, found {found}; record it with the "
                "depth, or name it with --info-topic"
            )
        depth = depth_image(fields, chosen.source.schema, where)
        _check_info(where, "depth image", depth.shape, camera)
        return camera.backproject(depth), None


def _registered(
    cloud: FloatArray, image: NDArray[np.uint8] | None, chosen: Chosen, frame_ids: tuple[str, str], where: str
) -> tuple[FloatArray, CameraIntrinsics | None]:
    """The cloud in the picture's pixels (assumption 3), and the camera that both share."""
    source_camera = _camera(chosen.source_info, chosen.source)
    if image is None or chosen.image is None:
        return cloud, source_camera if _organised_by(cloud, source_camera) else None
    camera = _camera(chosen.image_info, chosen.image)
    if camera is not None:
        _check_info(where, f"image of {chosen.image.name}", image.shape, camera)
        if _organised_by(cloud, camera):
            return cloud, camera
        if frame_ids[0] == frame_ids[1]:
            return project_cloud(cloud, np.eye(4), camera), camera
    elif cloud.shape[0] > 1 and cloud.shape[:2] == image.shape[:2]:
        return cloud, source_camera if _organised_by(cloud, source_camera) else None
    size = f"{cloud.shape[1]} x {cloud.shape[0]}" if cloud.shape[0] > 1 else f"{cloud.shape[1]} points in no order"
    raise CaptureError(
        f"{where}: the image is {image.shape[1]} x {image.shape[0]} pixels in frame '{frame_ids[1]}', the cloud {size} "
        f"in frame '{frame_ids[0]}', and they are not pixel to pixel; record the cloud in the image's frame (align the "
        "depth) and the image's CameraInfo with it"
    )


def _organised_by(cloud: FloatArray, camera: CameraIntrinsics | None) -> bool:
    """True when the points of a cloud project onto their own pixels."""
    if camera is None or cloud.shape[:2] != (camera.height, camera.width):
        return False
    v, u = np.nonzero(np.isfinite(cloud[..., 2]))
    off = np.abs(camera.project(cloud[v, u]) - np.stack([u, v], axis=1)).max(axis=1)
    return len(off) == 0 or bool(np.median(np.nan_to_num(off, nan=np.inf)) <= _MAX_MEDIAN_OFF_PX)


def _camera(info: Topic | None, topic: Topic) -> CameraIntrinsics | None:
    return camera_of(info.first, rectified="rect" in topic.base_name.split("/")[-1]) if info is not None else None


def _check_info(where: str, what: str, shape: tuple[int, ...], camera: CameraIntrinsics) -> None:
    if shape[:2] != (camera.height, camera.width):
        raise CaptureError(
            f"{where}: the {what} is {shape[1]} x {shape[0]} pixels, its CameraInfo {camera.width} x {camera.height}; "
            "name the one that fits with --info-topic"
        )


def _frame_ids(message: StampedMessage, shot: StampedMessage | None, chosen: Chosen) -> tuple[str, str]:
    """Coordinate frames of the cloud and of the picture (of its CameraInfo, where the picture does not say)."""
    source = str(message.fields.header.frame_id)
    info = chosen.image_info.first.header.frame_id if chosen.image_info is not None else source
    return source, str((shot.fields.header.frame_id if shot is not None else "") or info)


def _pairs(path: Path, chosen: Chosen) -> list[int | None]:
    """For every cloud the number of its picture in the picture's topic, or None."""
    clouds = [stamp or 0 for stamp in chosen.source.stamps_ns]
    if chosen.image is None:
        return [None] * len(clouds)
    stamps = np.array([stamp or 0 for stamp in chosen.image.stamps_ns], dtype=np.int64)
    nearest = [int(np.abs(stamps - stamp).argmin()) for stamp in clouds]
    gaps_ns = [abs(int(stamps[i]) - stamp) for i, stamp in zip(nearest, clouds, strict=True)]
    if min(gaps_ns) > PAIRING_TOLERANCE_NS:
        raise CaptureError(
            f"{path}: no message of {chosen.image.name} is within {PAIRING_TOLERANCE_NS // 1_000_000} ms of one of "
            f"{chosen.source.name}, the nearest is {min(gaps_ns) / 1e6:.0f} ms away; record both with one clock, or "
            "name another --image-topic"
        )
    return [i if gap <= PAIRING_TOLERANCE_NS else None for i, gap in zip(nearest, gaps_ns, strict=True)]


def _paired(
    path: Path, chosen: Chosen, pairs: Sequence[int | None]
) -> Iterator[tuple[StampedMessage, StampedMessage | None]]:
    """Clouds with their pictures, in file order; only messages that still wait for another are held."""
    last_use = {image: cloud for cloud, image in enumerate(pairs) if image is not None}
    waiting: deque[tuple[int, StampedMessage]] = deque()
    shots: dict[int, StampedMessage] = {}
    seen = dict.fromkeys([chosen.source.name, *([chosen.image.name] if chosen.image is not None else [])], 0)
    for message in read_messages(path, seen):
        number = seen[message.topic]
        seen[message.topic] += 1
        if message.topic == chosen.source.name:
            waiting.append((number, message))
        elif number in last_use:
            shots[number] = message
        while waiting and (pairs[waiting[0][0]] is None or pairs[waiting[0][0]] in shots):
            cloud, first = waiting.popleft()
            image = pairs[cloud]
            yield first, shots[image] if image is not None else None
            if image is not None and last_use[image] <= cloud:
                del shots[image]
