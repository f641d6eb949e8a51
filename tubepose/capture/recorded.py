"""Captures in recordings: ROS 1, ROS 2 and Foxglove messages, any number of frames in a file or folder."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.alignment import Views, align
from tubepose.capture.description import Unit
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.frame_cameras import depth_camera, optional_camera, picture_camera, told_lenses
from tubepose.capture.lens import PixelCamera
from tubepose.capture.message_types import POINT_CLOUD
from tubepose.capture.pairing import PAIRING_TOLERANCE_NS, pair_by_stamp
from tubepose.capture.realsense import UNIT_HINT, is_sdk_topic, sdk_frame
from tubepose.capture.recording import Recording, StampedMessage, index_recording, read_messages
from tubepose.capture.registration import METRES_PER_UNIT, clean_cloud
from tubepose.capture.ros import cloud_arrays, depth_image, picture
from tubepose.capture.static_transforms import matrix_of
from tubepose.capture.topics import Chosen, Topic, TopicChoice, choose_topics
from tubepose.errors import CaptureError
from tubepose.transforms import FloatArray, transform_points

_CLAIMS_ALIGNMENT = ("aligned", "registered", "depth_to_")


@dataclass(frozen=True, slots=True)
class RecordedCapture:
    """All frames of one recording.

    Attributes:
        name: As the tables show it.
        path: The file, or the folder of a split recording.
        unit: Unit of PointCloud2 coordinates and of depth; None means metres and, of depth of 16 bits, millimetres,
            as ROS has it.
        topics: Topics that the user named.
        depth_scale_m: Metres per count of depth images, or per unit of those of floats; goes before all else.
        max_stamp_difference_ns: Of a picture and its cloud.
    """

    name: str
    path: Path
    unit: Unit | None = None
    topics: TopicChoice = field(default_factory=TopicChoice)
    depth_scale_m: float | None = None
    max_stamp_difference_ns: int = PAIRING_TOLERANCE_NS

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield one frame per cloud (or depth image), with the picture nearest in time, else without.

        A cut recording gives every frame that is whole, and the error after them.

        Raises:
            CaptureError: No recording, cut, nothing that makes a frame, several topics that could, or a unit or
                calibration that is missing.
        """
        recording = index_recording(self.path)
        where = str(self.path)
        try:
            chosen = choose_topics(recording.topics.values(), self.topics, where, recording.unread)
        except CaptureError:
            # What is missing lies behind the cut.
            if recording.broken is not None:
                raise CaptureError(recording.broken_text(self.path, 0)) from None
            if recording.problems and self.topics == TopicChoice():
                raise CaptureError(recording.problems[0]) from None
            raise
        pairs = pair_by_stamp(chosen.source, chosen.image, self.max_stamp_difference_ns, where)
        count = 0
        for cloud, shot in _paired(self.path, chosen, pairs):
            try:
                frame = self._frame(recording, chosen, count, cloud, shot)
            except CaptureError as problem:
                if recording.broken is None:
                    raise
                raise CaptureError(f"{problem}; {recording.broken_text(self.path, count)}") from None
            yield frame
            count += 1
        if recording.broken is not None:
            raise CaptureError(recording.broken_text(self.path, count))

    def _frame(
        self, recording: Recording, chosen: Chosen, index: int, message: StampedMessage, shot: StampedMessage | None
    ) -> RgbdFrame:
        where = f"{self.path}, {chosen.source.name}, message {index + 1}"
        if message.problem:
            raise CaptureError(message.problem)
        image, notes = _picture(chosen, shot)
        views, colours = self._views(recording, chosen, message, shot if image is not None else None, image, where)
        notes += told_lenses(chosen, views)
        aligned = align(views, where)
        organised = aligned.cloud_m.shape[0] > 1
        if aligned.note:
            notes.append(aligned.note)
        return RgbdFrame(
            cloud_m=aligned.cloud_m,
            image=colours if aligned.image is None and organised else aligned.image,
            intrinsics=aligned.camera,
            timestamp_ns=message.stamp_ns,
            capture=self.name,
            index=index,
            organised=organised,
            sensor=recording.metadata.get("sensor", "unknown"),
            simulated=recording.metadata.get("simulated") == "true",
            notes=tuple(notes),
        )

    def _views(
        self,
        recording: Recording,
        chosen: Chosen,
        message: StampedMessage,
        shot: StampedMessage | None,
        image: NDArray[np.uint8] | None,
        where: str,
    ) -> tuple[Views, NDArray[np.uint8] | None]:
        """Both views of a moment, and the colours of a cloud that has its own."""
        image_camera = picture_camera(chosen, shot, image, where)
        is_depth = chosen.source.schema != POINT_CLOUD
        colours, source_camera = None, None
        frame_id = _frame_id(recording, chosen.source, message)
        if is_depth:
            cloud, source_camera = self._depth_cloud(recording, chosen, message, image_camera, where)
        else:
            cloud, colours = self._point_cloud(message, where)
            source_camera = optional_camera(chosen.source_info, chosen.source, message, _pixels_of(cloud), where)
        shot_frame = _frame_id(recording, chosen.image, shot) if shot is not None and chosen.image is not None else ""
        if not shot_frame:
            info = chosen.image_info if image is not None else chosen.source_info
            shot_frame = (info.frame_id if info is not None else "") or frame_id
        T_image_cloud = np.eye(4) if shot_frame == frame_id else recording.transforms.between(shot_frame, frame_id)
        views = Views(
            cloud_m=cloud,
            image=image,
            source_camera=source_camera,
            image_camera=image_camera,
            T_image_cloud=T_image_cloud,
            source=(chosen.source.name, frame_id),
            shot=(chosen.image.name if chosen.image is not None else "", shot_frame),
            is_depth=is_depth,
            claims_alignment=any(word in chosen.source.name.lower() for word in _CLAIMS_ALIGNMENT),
            infos=_info_names(chosen),
        )
        return views, colours

    def _point_cloud(self, message: StampedMessage, where: str) -> tuple[FloatArray, NDArray[np.uint8] | None]:
        if self.depth_scale_m is not None:
            raise CaptureError(
                f"{where}: --depth-scale is of depth images, and this is a point cloud; give --unit m or mm"
            )
        xyz, colours = cloud_arrays(message.fields, where)
        cloud = clean_cloud(xyz, METRES_PER_UNIT[self.unit or "m"])
        pose = getattr(message.fields, "pose", None)
        T_frame_cloud = matrix_of(pose) if pose is not None else None
        return (cloud if T_frame_cloud is None else transform_points(T_frame_cloud, cloud)), colours

    def _depth_cloud(
        self,
        recording: Recording,
        chosen: Chosen,
        message: StampedMessage,
        image_camera: PixelCamera | None,
        where: str,
    ) -> tuple[FloatArray, PixelCamera]:
        """Points of a depth image (H, W, 3) in the pixels as they were recorded, and its camera."""
        count_m, number_m = self._depth_scales(recording, chosen.source.name, where)
        depth = depth_image(message.fields, chosen.source.schema, where, count_m, number_m)
        camera = depth_camera(chosen, message, image_camera, (depth.shape[0], depth.shape[1]), where)
        return camera.backproject(depth), camera

    def _depth_scales(self, recording: Recording, topic: str, where: str) -> tuple[float, float]:
        """Metres per count of whole numbers, and metres per unit of floats (REP 118 where nothing else is told)."""
        if self.depth_scale_m is not None:
            return self.depth_scale_m, self.depth_scale_m
        number_m = METRES_PER_UNIT[self.unit or "m"]
        recorded_m = recording.units.of(topic)
        if recorded_m is not None:
            return recorded_m, number_m
        if is_sdk_topic(topic) and self.unit != "mm":
            raise CaptureError(
                f"{where}: a recording of the RealSense SDK that does not say how long one count of depth is; give "
                f"{UNIT_HINT}"
            )
        return METRES_PER_UNIT["mm"], number_m


def _picture(chosen: Chosen, shot: StampedMessage | None) -> tuple[NDArray[np.uint8] | None, list[str]]:
    """The picture of a frame, and what is to be told of it; one that cannot be read costs the picture alone."""
    notes = list(chosen.notes)
    if chosen.image is None:
        return None, notes
    if shot is None:
        return None, [*notes, f"frame without picture: none of {chosen.image.name} is near in time"]
    try:
        if shot.problem:
            raise CaptureError(shot.problem)
        return picture(shot.fields, chosen.image.schema, chosen.image.name), notes
    except CaptureError as problem:
        return None, [*notes, f"frame without its picture: {problem}"]


def _pixels_of(cloud: FloatArray) -> tuple[int, int] | None:
    return (cloud.shape[0], cloud.shape[1]) if cloud.shape[0] > 1 else None


def _frame_id(recording: Recording, topic: Topic, message: StampedMessage) -> str:
    """Coordinate frame of a message; ROS 1 bags of the RealSense SDK have it in the topic's name."""
    by_name = sdk_frame(topic.name)
    if by_name is not None and recording.transforms.knows(by_name):
        return by_name
    return str(message.fields.header.frame_id)


def _info_names(chosen: Chosen) -> tuple[str, str]:
    infos = (chosen.source_info, chosen.image_info)
    return (infos[0].name if infos[0] is not None else "", infos[1].name if infos[1] is not None else "")


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
