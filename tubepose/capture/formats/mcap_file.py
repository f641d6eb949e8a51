"""MCAP files record by record: every whole message, even of a cut file (https://mcap.dev/spec)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import IO

import lz4.frame
import zstandard
from mcap.exceptions import EndOfFile, McapError, RecordLengthLimitExceeded
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import MCAP0_MAGIC

from tubepose.capture.formats.raw_messages import (
    LEAST_LIMIT_BYTES,
    MAX_MESSAGE_BYTES,
    MOST_INFLATED,
    BrokenRecordingError,
    Note,
    RawMessage,
    inflate,
)

# What a cut or damaged file makes mcap and its decompressors raise (lz4: RuntimeError; checksums and text: ValueError).
_BROKEN = (McapError, zstandard.ZstdError, struct.error, ValueError, RuntimeError, MemoryError, OverflowError)
_NO_SCHEMA = Schema(id=0, name="messages without a schema", encoding="", data=b"")


def is_mcap(start: bytes) -> bool:
    """True where a file that starts so is an MCAP file, or one that was cut within its first bytes."""
    return bool(start) and MCAP0_MAGIC.startswith(start[: len(MCAP0_MAGIC)])


def read_mcap(stream: IO[bytes]) -> Iterator[RawMessage | Note]:
    """Read a file from its start, without its index: a cut file has none.

    Raises:
        BrokenRecordingError: The file is cut or damaged; all before was whole.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    try:
        for record in _records(stream):
            if isinstance(record, Schema):
                schemas[record.id] = record
            elif isinstance(record, Channel):
                channels[record.id] = record
            elif isinstance(record, Metadata):
                yield Note(record.name, record.metadata)
            elif isinstance(record, Message):
                channel = channels.get(record.channel_id)
                if channel is None:
                    raise McapError(f"a message of the unknown channel {record.channel_id}")
                yield _raw(record, channel, schemas.get(channel.schema_id, _NO_SCHEMA))
    except _BROKEN as problem:
        cut = isinstance(problem, EndOfFile | RecordLengthLimitExceeded | struct.error)
        reason = "" if isinstance(problem, struct.error) else str(problem)
        raise BrokenRecordingError(reason, cut=cut) from None


def _records(stream: IO[bytes]) -> Iterator[McapRecord]:
    """Records of a file, those of chunks too."""
    reader = StreamReader(stream, emit_chunks=True, validate_crcs=True, record_size_limit=2 * MAX_MESSAGE_BYTES)
    for record in reader.records:
        if isinstance(record, Chunk):
            yield from breakup_chunk(_inflated(record), validate_crc=True)
        else:
            yield record


def _inflated(chunk: Chunk) -> Chunk:
    """A chunk without compression; one that claims or holds more than images can is no recording's.

    Raises:
        ValueError: It does.
    """
    if chunk.compression not in ("zstd", "lz4"):
        return chunk
    most = min(max(MOST_INFLATED * len(chunk.data), LEAST_LIMIT_BYTES), MAX_MESSAGE_BYTES)
    if chunk.uncompressed_size > most:
        raise ValueError(f"a chunk of {len(chunk.data)} bytes that claims to hold {chunk.uncompressed_size}")
    size = chunk.uncompressed_size + 1
    if chunk.compression == "zstd":
        with zstandard.ZstdDecompressor().stream_reader(chunk.data) as reader:
            data = reader.read(size)
    else:
        data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size)
    if len(data) != chunk.uncompressed_size:
        raise ValueError(f"a chunk of {len(data)} bytes or more; expected {chunk.uncompressed_size}")
    return replace(chunk, compression="", data=data)


def _raw(record: Message, channel: Channel, schema: Schema) -> RawMessage:
    data = inflate(record.data) if channel.message_encoding == "cdr" else record.data
    return RawMessage(channel.topic, schema.name, channel.message_encoding, schema.data, data, record.log_time)
