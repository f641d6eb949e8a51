"""ROS 1 bags (`.bag`, format 2.0) record by record, without their index: a bag that was cut or not closed has none.

Format: http://wiki.ros.org/Bags/Format/2.0.
"""

from __future__ import annotations

import bz2
import struct
from collections.abc import Iterator
from io import BytesIO
from typing import IO

import lz4.frame

from tubepose.capture.formats.raw_messages import MAX_MESSAGE_BYTES, BrokenRecordingError, RawMessage

MAGIC = b"#ROSBAG V2"

_MESSAGE, _CHUNK, _CONNECTION = 0x02, 0x05, 0x07
_MOST_HEADER_BYTES = 1 << 20
_LENGTH = struct.Struct("<I")
_TIME = struct.Struct("<II")
# What damaged headers and chunks make struct, the decompressors (lz4: RuntimeError, bz2: OSError) and text raise.
_BROKEN = (struct.error, RuntimeError, OSError, ValueError, EOFError, KeyError, IndexError)

Fields = dict[bytes, bytes]


def read_ros1_bag(stream: IO[bytes]) -> Iterator[RawMessage]:
    """Read the messages of a bag in the order in which they were stored.

    Raises:
        BrokenRecordingError: The bag is cut, damaged or encrypted; all before was whole.
    """
    stream.readline(64)
    connections: dict[bytes, tuple[str, str, bytes]] = {}
    try:
        for fields, data in _records(stream):
            if fields.get(b"encryptor"):
                raise BrokenRecordingError("an encrypted bag", cut=False)
            if data is None:
                continue  # the records of the chunk follow as they are
            if fields[b"op"][0] == _CHUNK:
                for inner, content in _records(BytesIO(_inflate(fields, data))):
                    yield from _message(inner, content or b"", connections)
            else:
                yield from _message(fields, data, connections)
    except _BROKEN as problem:
        raise BrokenRecordingError(str(problem), cut=isinstance(problem, EOFError)) from None


def _message(fields: Fields, data: bytes, connections: dict[bytes, tuple[str, str, bytes]]) -> Iterator[RawMessage]:
    """The message of a record; a record of a connection is noted, all others say nothing."""
    kind = fields[b"op"][0]
    if kind == _CONNECTION:
        told = _fields(data)
        topic, schema = fields[b"topic"].decode(), told[b"type"].decode()
        connections[fields[b"conn"]] = (topic, schema, told.get(b"message_definition", b""))
    elif kind == _MESSAGE:
        topic, schema, definition = connections[fields[b"conn"]]
        seconds, nanoseconds = _TIME.unpack(fields[b"time"])
        yield RawMessage(topic, schema, "ros1", definition, data, seconds * 1_000_000_000 + nanoseconds)


def _records(stream: IO[bytes]) -> Iterator[tuple[Fields, bytes | None]]:
    """Header fields and data of every record; None for a chunk that is not compressed: its records are yielded next.

    Raises:
        EOFError: The last one is cut.
    """
    while length := stream.read(_LENGTH.size):
        fields = _fields(_read(stream, _length(length, _MOST_HEADER_BYTES)))
        size = _length(stream.read(_LENGTH.size), MAX_MESSAGE_BYTES)
        plain = fields[b"op"][0] == _CHUNK and fields.get(b"compression") == b"none"
        yield fields, None if plain else _read(stream, size)


def _fields(header: bytes) -> Fields:
    fields: Fields = {}
    stream = BytesIO(header)
    while length := stream.read(_LENGTH.size):
        name, _, value = _read(stream, _length(length, _MOST_HEADER_BYTES)).partition(b"=")
        fields[name] = value
    return fields


def _length(data: bytes, most: int) -> int:
    if len(data) < _LENGTH.size:
        raise EOFError("the end of a record is missing")
    length = int(_LENGTH.unpack(data)[0])
    if length > most:
        raise ValueError(f"a record that claims {length} bytes")
    return length


def _read(stream: IO[bytes], size: int) -> bytes:
    data = stream.read(size)
    if len(data) < size:
        raise EOFError("the end of a record is missing")
    return data


def _inflate(fields: Fields, data: bytes) -> bytes:
    """Content of a chunk."""
    form = fields[b"compression"].decode()
    size = _length(fields[b"size"], MAX_MESSAGE_BYTES)
    if form not in ("bz2", "lz4"):
        raise ValueError(f"chunks are compressed as '{form}'; expected none, bz2 or lz4")
    decompressor = bz2.BZ2Decompressor() if form == "bz2" else lz4.frame.LZ4FrameDecompressor()
    whole: bytes = decompressor.decompress(data, max_length=size + 1)
    if len(whole) != size:
        raise ValueError(f"a chunk of {len(whole)} bytes; expected {size}")
    return whole
