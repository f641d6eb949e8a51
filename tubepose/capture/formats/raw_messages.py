"""What every recording gives, whatever it is stored in: messages as bytes, and where it breaks off."""

from __future__ import annotations

import struct
from dataclasses import dataclass

from tubepose.errors import CaptureError

# A message of more bytes is none: the largest clouds of today's sensors have 0.3 GB.
MAX_MESSAGE_BYTES = 1 << 30
# Images do not compress further than this; what does is made to fill memory.
MOST_INFLATED = 200
LEAST_LIMIT_BYTES = 64 << 20
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True, slots=True, eq=False)
class RawMessage:
    """One message as it is stored.

    Attributes:
        topic: Its topic.
        schema: Name of its type, as the recording has it.
        encoding: How `data` is encoded: ``cdr``, ``ros1``, ``protobuf``, ``json``, or another word.
        definition: The type's definition in the file; empty where it has none.
        data: The message.
        log_time_ns: When it was recorded, nanoseconds; 0 where that is not known.
    """

    topic: str
    schema: str
    encoding: str
    definition: bytes
    data: bytes
    log_time_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Note:
    """What the writer of a recording noted beside the messages (MCAP's metadata record)."""

    name: str
    values: dict[str, str]


class BrokenRecordingError(Exception):
    """A recording ends here; what came before is whole.

    Attributes:
        reason: What was found; may be empty.
        cut: Whether the file just ends, with nothing wrong before.
    """

    def __init__(self, reason: str = "", *, cut: bool) -> None:
        super().__init__(reason)
        self.reason = reason
        self.cut = cut


def inflate(data: bytes) -> bytes:
    """A message without the compression of rosbag2's `compression_mode: message`; others as they are.

    A message in CDR starts with a zero byte, so that zstd's magic number tells it.

    Raises:
        BrokenRecordingError: No whole zstd frame, or more than `MAX_MESSAGE_BYTES`.
    """
    import zstandard

    if data[:4] != _ZSTD_MAGIC:
        return data
    try:
        stated = zstandard.frame_content_size(data)
        if stated > MAX_MESSAGE_BYTES:
            raise BrokenRecordingError(f"a message that claims {stated} bytes", cut=False)
        with zstandard.ZstdDecompressor().stream_reader(data) as reader:
            whole = reader.read(MAX_MESSAGE_BYTES + 1)
    except zstandard.ZstdError as problem:
        raise BrokenRecordingError(f"a compressed message: {problem}", cut=False) from None
    if len(whole) > MAX_MESSAGE_BYTES:
        raise BrokenRecordingError(f"a message of more than {MAX_MESSAGE_BYTES} bytes", cut=False)
    if 0 <= stated != len(whole):
        raise BrokenRecordingError("a compressed message that is cut", cut=False)
    return whole


def header_stamp_ns(message: RawMessage) -> int | None:
    """Stamp of the header that a ROS message starts with; the time of recording where the header has none.

    Only for types that start with a `std_msgs/Header`, encoded as ``cdr`` or ``ros1``.
    """
    data = message.data
    if message.encoding == "ros1":
        order, at = "<", 4  # after the sequence number
    else:
        order, at = "<" if data[1:2] == b"\x01" else ">", 4  # after the encapsulation
    seconds, nanoseconds = struct.unpack_from(f"{order}iI", data, at) if len(data) >= at + 8 else (0, 0)
    return (int(seconds) * 1_000_000_000 + int(nanoseconds)) or message.log_time_ns or None


def unreadable(path: object, problem: OSError) -> CaptureError:
    """What to say of a file that the operating system does not open."""
    return CaptureError(f"{path}: cannot be read: {problem.strerror or problem}")
