"""MCAP files record by record: what is in them, and every whole message even of a cut file."""

from __future__ import annotations

import struct
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import zstandard
from mcap.exceptions import EndOfFile, InvalidMagic, McapError, RecordLengthLimitExceeded
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import MCAP0_MAGIC
from mcap_ros2.decoder import DecoderFactory

from tubepose.capture.message_types import DEFINITIONS
from tubepose.capture.topics import Topic
from tubepose.errors import CaptureError

METADATA_NAME = "tubepose"

# What a cut or damaged file makes mcap and its decompressors raise (lz4: RuntimeError; checksums and text: ValueError).
_BROKEN = (McapError, zstandard.ZstdError, struct.error, ValueError, RuntimeError)
# Decoding one message: lengths and text that do not fit.
_UNDECODABLE = (McapError, struct.error, ValueError, IndexError)


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """What a first pass over a file finds.

    Attributes:
        topics: Topics of the message types that are read, by name, in file order.
        metadata: What our own writer noted (sensor, simulated).
        broken: What ended the pass before the end of the file; None for a whole file.
    """

    topics: dict[str, Topic]
    metadata: dict[str, str]
    broken: Exception | None

    def broken_text(self, path: Path, frames: int) -> str:
        """One line about the cut, with the number of frames before it."""
        cut = isinstance(self.broken, EndOfFile | RecordLengthLimitExceeded | struct.error)
        reason = f" ({self.broken})" if str(self.broken) and not isinstance(self.broken, struct.error) else ""
        what = "truncated" if cut else "truncated or damaged"
        if frames == 0:
            return f"{path}: {what} before the end of its first frame{reason}; copy or record it again"
        return f"{path}: {what} after {frames} whole frame(s){reason}; copy or record it again to have the rest"


@dataclass(frozen=True, slots=True, eq=False)
class StampedMessage:
    """One message: its topic, its stamp in nanoseconds (None without one), and its decoded fields."""

    topic: str
    stamp_ns: int | None
    fields: Any


@dataclass(frozen=True, slots=True, eq=False)
class _Entry:
    schema: Schema
    channel: Channel
    message: Message


def index_recording(path: Path) -> Recording:
    """Find the topics of a file, their stamps, and whether the file is whole.

    Raises:
        CaptureError: No MCAP, or no message of a type that is read.
    """
    topics: dict[str, Topic] = {}
    metadata: dict[str, str] = {}
    others: set[str] = set()
    broken: Exception | None = None
    try:
        for entry in _entries(path):
            if isinstance(entry, Metadata):
                metadata |= entry.metadata if entry.name == METADATA_NAME else {}
            elif entry.schema.name not in DEFINITIONS:
                others.add(entry.schema.name)
            else:
                name = entry.channel.topic
                if name not in topics:
                    topics[name] = Topic(name, entry.schema.name, _decode(entry, path))
                topics[name].stamps_ns.append(_stamp_ns(entry.message))
    except InvalidMagic:
        raise CaptureError(f"{path}: expected an MCAP file, found other content; check the path") from None
    except _BROKEN as problem:
        broken = problem
    if not topics and broken is None:
        raise CaptureError(_nothing_text(path, others))
    return Recording(topics, metadata, broken)


def read_messages(path: Path, topics: Collection[str]) -> Iterator[StampedMessage]:
    """Every whole message of some topics in file order; a break just ends them (`index_recording` saw it)."""
    try:
        for entry in _entries(path):
            if isinstance(entry, _Entry) and entry.channel.topic in topics:
                fields = _decode(entry, path)
                yield StampedMessage(entry.channel.topic, _stamp_ns(entry.message), fields)
    except _BROKEN:
        return


def _entries(path: Path) -> Iterator[_Entry | Metadata]:
    """Read a file from its start, without its index: a cut file has none."""
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    try:
        stream = path.open("rb")
    except OSError as problem:
        raise CaptureError(f"{path}: cannot be read: {problem.strerror}") from None
    with stream:
        if not MCAP0_MAGIC.startswith(stream.read(len(MCAP0_MAGIC))):
            raise InvalidMagic(b"")
        stream.seek(0)
        for record in StreamReader(stream, validate_crcs=True).records:
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Metadata):
                yield record
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None:
                    raise McapError(f"a message of the unknown channel {record.channel_id}")
                yield _Entry(schemas.get(channel.schema_id, _NO_SCHEMA), channel, record)


_NO_SCHEMA = Schema(id=0, name="messages without a schema", encoding="", data=b"")


def _decode(entry: _Entry, path: Path) -> Any:
    """Fields of a message of a type that is read, by our own definition of it."""
    schema, channel = entry.schema, entry.channel
    if channel.message_encoding != MessageEncoding.CDR:
        raise CaptureError(
            f"{path}: {channel.topic} is encoded as {channel.message_encoding or 'nothing'}; "
            "expected cdr, as 'ros2 bag record -s mcap' writes it"
        )
    try:
        return _decoder(schema.name)(entry.message.data)
    except _UNDECODABLE as problem:
        raise CaptureError(
            f"{path}: a message of {channel.topic} is not the {schema.name} it claims to be: {problem}"
        ) from None


@cache
def _decoder(name: str) -> Callable[[bytes], Any]:
    schema = Schema(id=1, name=name, encoding=SchemaEncoding.ROS2, data=DEFINITIONS[name].encode())
    decoder = DecoderFactory().decoder_for(MessageEncoding.CDR, schema)
    assert decoder is not None, f"no decoder of {name}"
    return decoder


def _stamp_ns(message: Message) -> int | None:
    """Stamp of the header, which every type that is read starts with; the log time where the header has none."""
    order = "<" if message.data[1:2] == b"\x01" else ">"
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", message.data, 4) if len(message.data) >= 12 else (0, 0)
    return (int(seconds) * 1_000_000_000 + int(nanoseconds)) or message.log_time or None


def _nothing_text(path: Path, others: set[str]) -> str:
    expected = "expected ROS 2 sensor_msgs/msg/PointCloud2, or Image with depth and CameraInfo"
    foxglove = sorted(name for name in others if name.startswith("foxglove."))
    if foxglove:
        return f"{path}: {', '.join(foxglove)} messages are not read yet; {expected}; record the ROS topics"
    return f"{path}: nothing to make a frame of; {expected}, found {', '.join(sorted(others)) or 'no messages'}"
