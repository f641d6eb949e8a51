"""ROS 1 bags (`.bag`, format 2.0), by the package rosbags."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from tubepose.capture.formats.raw_messages import BrokenRecordingError, RawMessage

MAGIC = b"#ROSBAG V"


def read_ros1_bag(path: Path) -> Iterator[RawMessage]:
    """Read the messages of a bag in the order of the times at which they were recorded.

    Raises:
        BrokenRecordingError: The bag is cut, damaged, or was not closed, so that its index is missing.
    """
    from rosbags.rosbag1 import Reader, ReaderError

    try:
        with Reader(path) as reader:
            for connection, time_ns, data in reader.messages():
                yield RawMessage(
                    connection.topic, connection.msgtype, "ros1", connection.msgdef.data.encode(), data, time_ns
                )
    except (ReaderError, ValueError, KeyError, IndexError, EOFError, AssertionError, RuntimeError, OSError) as problem:
        raise BrokenRecordingError(str(problem) or type(problem).__name__, cut=False) from None
