"""What a recording holds, found in a first pass over it, and its messages in a second one."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from tubepose.capture.formats.containers import parts_before, read_raw, recording_suffix
from tubepose.capture.formats.decoding import decode_message, stamp_ns, type_of
from tubepose.capture.formats.raw_messages import BrokenRecordingError, Note, RawMessage
from tubepose.capture.message_types import CAMERA_INFO, FLOAT32, STRING, TRANSFORM, TRANSFORMS
from tubepose.capture.realsense import DepthUnits, stream_extrinsics
from tubepose.capture.static_transforms import StaticTransforms
from tubepose.capture.topics import Topic, told_types
from tubepose.errors import CaptureError

METADATA_NAME = "tubepose"


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """What a first pass over a recording finds.

    Attributes:
        topics: Topics of pictures, depth, clouds and cameras, by name, in file order.
        unread: Names of the types of all other topics, by topic.
        metadata: What our own writer noted (sensor, simulated).
        transforms: Between coordinate frames that do not move against each other.
        units: Metres per count of depth images that the RealSense SDK recorded.
        broken: What ended the pass before the end of the file; None for a whole file.
        problems: Messages of the types that are read that could not be.
    """

    topics: dict[str, Topic] = field(default_factory=dict)
    unread: dict[str, str] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)
    transforms: StaticTransforms = field(default_factory=StaticTransforms)
    units: DepthUnits = field(default_factory=DepthUnits)
    broken: BrokenRecordingError | None = None
    problems: list[str] = field(default_factory=list)

    def broken_text(self, path: Path, frames: int) -> str:
        """One line about the cut, with the number of frames before it."""
        reason = f" ({self.broken.reason})" if self.broken is not None and self.broken.reason else ""
        what = "truncated" if self.broken is not None and self.broken.cut else "truncated or damaged"
        if frames == 0:
            return f"{path}: {what} before the end of its first frame{reason}; copy or record it again"
        return f"{path}: {what} after {frames} whole frame(s){reason}; copy or record it again to have the rest"


@dataclass(frozen=True, slots=True, eq=False)
class StampedMessage:
    """One message.

    Attributes:
        topic: Its topic.
        stamp_ns: Its stamp, nanoseconds; None without one.
        fields: What it says; None where it cannot be read.
        problem: Why it cannot be read; empty otherwise.
    """

    topic: str
    stamp_ns: int | None
    fields: Any
    problem: str = ""


def index_recording(path: Path) -> Recording:
    """Find the topics of a recording, their stamps, calibrations, transforms and units, and whether it is whole.

    A part of a split recording that holds no calibration has that of the other parts beside it.

    Raises:
        CaptureError: No recording, or no message of a type that is read.
    """
    found = Recording()
    broken: BrokenRecordingError | None = None
    try:
        for entry in read_raw(path):
            _note(found, entry, path)
    except BrokenRecordingError as problem:
        broken = problem
    for name in [name for name, topic in found.topics.items() if topic.first is None]:
        del found.topics[name]
    if not found.topics and broken is None:
        raise CaptureError(found.problems[0] if found.problems else _nothing_text(path, found.unread))
    if path.is_file() and not any(topic.infos for topic in found.topics.values()):
        for part in parts_before(path):
            with suppress(BrokenRecordingError):
                for entry in read_raw(part):
                    if isinstance(entry, RawMessage) and type_of(entry) in (CAMERA_INFO, TRANSFORMS, STRING, FLOAT32):
                        _note(found, entry, part)
            if any(topic.infos for topic in found.topics.values()):
                break
    return replace(found, broken=broken)


def read_messages(path: Path, topics: Collection[str]) -> Iterator[StampedMessage]:
    """Every whole message of some topics in file order; a break just ends them (`index_recording` saw it)."""
    with suppress(BrokenRecordingError):
        for entry in _messages(read_raw(path)):
            kind = type_of(entry) if entry.topic in topics else None
            if kind is None:
                continue
            try:
                stamp = stamp_ns(entry, kind, str(path))
                yield StampedMessage(entry.topic, stamp, decode_message(entry, kind, str(path)))
            except CaptureError as problem:
                yield StampedMessage(entry.topic, None, None, str(problem))


def _messages(entries: Iterable[RawMessage | Note]) -> Iterator[RawMessage]:
    return (entry for entry in entries if isinstance(entry, RawMessage))


def _note(found: Recording, entry: RawMessage | Note, path: Path) -> None:
    """Add what one message tells to what was found."""
    if isinstance(entry, Note):
        found.metadata.update(entry.values if entry.name == METADATA_NAME else {})
        return
    kind = type_of(entry)
    if kind in (TRANSFORMS, TRANSFORM, STRING, FLOAT32):
        _note_small(found, entry, kind, str(path))
    if kind is None or kind in (STRING, FLOAT32, TRANSFORM, TRANSFORMS):
        found.unread.setdefault(entry.topic, entry.schema)
        return
    known = found.topics.get(entry.topic)
    stamp, fields = None, None
    try:
        stamp = stamp_ns(entry, kind, str(path))
        if kind == CAMERA_INFO or known is None or known.first is None:
            fields = decode_message(entry, kind, str(path))
    except CaptureError as problem:
        found.problems.append(str(problem))
    if known is None:
        known = found.topics[entry.topic] = Topic(entry.topic, kind, fields)
    elif known.first is None:
        known = found.topics[entry.topic] = replace(known, first=fields)
    known.stamps_ns.append(stamp)
    known.log_times_ns.append(entry.log_time_ns)
    if kind == CAMERA_INFO and fields is not None:
        known.note_info(stamp, fields)


def _note_small(found: Recording, entry: RawMessage, kind: str, where: str) -> None:
    """What transforms and texts tell; one that cannot be read tells nothing."""
    extrinsics = stream_extrinsics(entry.topic) if kind == TRANSFORM else None
    if kind == TRANSFORM and extrinsics is None:
        return
    if kind in (STRING, FLOAT32) and not found.units.is_told_by(entry.topic):
        return
    with suppress(CaptureError):
        fields = decode_message(entry, kind, where)
        if kind == TRANSFORMS:
            for one in fields.transforms:
                found.transforms.add(one.header.frame_id, one.child_frame_id, one.transform)
        elif extrinsics is not None:
            found.transforms.add_inverse(*extrinsics, fields)
        else:
            found.units.note(entry.topic, fields.data)


def _nothing_text(path: Path, unread: dict[str, str]) -> str:
    found = told_types(unread) or "no messages"
    kind = "ROS 1 or " if recording_suffix(path) == ".bag" else ""
    return (
        f"{path}: nothing to make a frame of; expected {kind}ROS 2 sensor_msgs/msg/PointCloud2, or Image with "
        f"depth and CameraInfo, or Foxglove's PointCloud or images, found {found}; record one of these, decompressed"
    )
