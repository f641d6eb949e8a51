"""ROS 2 bags in SQLite (`.db3`), as `ros2 bag record` of Humble and the RealSense SDK since 2.58 write them.

The messages are read in the order in which they were stored, without the index of times: it lies behind the break of a
cut file.
"""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import quote

from tubepose.capture.formats.raw_messages import BrokenRecordingError, RawMessage, inflate
from tubepose.errors import CaptureError

MAGIC = b"SQLite format 3\x00"
_HEADER_BYTES = 100


def read_sqlite_bag(path: Path, shown: Path) -> Iterator[RawMessage]:
    """Read the messages of a bag in the order in which they were stored.

    Args:
        path: The file.
        shown: What error messages call it.

    Raises:
        CaptureError: A database that is no ROS 2 bag.
        BrokenRecordingError: The file is cut or damaged; all before was whole.
    """
    try:
        # A bag that was not closed has its last messages in a log beside it, which only a changeable database has.
        log = path.with_name(f"{path.name}-wal")
        changing = log.is_file() and log.stat().st_size > 0
        connection = _open(path, "mode=ro" if changing else "mode=ro&immutable=1")
    except sqlite3.Error as problem:
        raise BrokenRecordingError(str(problem), cut=False) from None
    try:
        yield from _without_last(_messages(connection, shown)) if _is_cut(path) else _messages(connection, shown)
    except (sqlite3.Error, OverflowError) as problem:
        raise BrokenRecordingError(str(problem), cut="malformed" in str(problem)) from None
    finally:
        connection.close()


def _is_cut(path: Path) -> bool:
    """Whether a database is shorter than the pages that its header counts (https://sqlite.org/fileformat2.html)."""
    with path.open("rb") as stream:
        header = stream.read(_HEADER_BYTES)
    if len(header) < _HEADER_BYTES:
        return True
    (page_bytes,), (pages,) = struct.unpack_from(">H", header, 16), struct.unpack_from(">I", header, 28)
    return bool(pages * (65536 if page_bytes == 1 else page_bytes) > path.stat().st_size)


def _without_last(messages: Iterator[RawMessage]) -> Iterator[RawMessage]:
    """Messages of a database that is cut: SQLite reads what is missing of its last page as zeros.

    Raises:
        BrokenRecordingError: Always, after all but the last one.
    """
    held: RawMessage | None = None
    try:
        for message in messages:
            if held is not None:
                yield held
            held = message
    except sqlite3.Error:
        pass
    raise BrokenRecordingError("", cut=True)


def _open(path: Path, options: str) -> sqlite3.Connection:
    connection = sqlite3.connect(f"file:{quote(str(path.resolve()))}?{options}", uri=True)
    # Without it SQLite opens no file that is shorter than its header says.
    connection.execute("PRAGMA writable_schema = ON")
    return connection


def _messages(connection: sqlite3.Connection, shown: Path) -> Iterator[RawMessage]:
    tables = {str(name) for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
    if not {"topics", "messages"} <= tables:
        raise CaptureError(
            f"{shown}: an SQLite database, but no ROS 2 bag: expected the tables topics and messages, found "
            f"{', '.join(sorted(tables)) or 'none'}"
        )
    topics = {
        row[0]: (str(row[1]), str(row[2]), str(row[3]))
        for row in connection.execute("SELECT id, name, type, serialization_format FROM topics")
    }
    for topic_id, stamp_ns, data in connection.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
        if topic_id not in topics or not isinstance(data, bytes) or not isinstance(stamp_ns, int):
            raise BrokenRecordingError(f"a message of the unknown topic {topic_id}, or without data", cut=False)
        name, schema, encoding = topics[topic_id]
        yield RawMessage(name, schema, encoding, b"", inflate(data), stamp_ns)
