"""MCAP files record by record: every whole message, even of a cut file (https://mcap.dev/spec)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import IO

import zstandard
from mcap.exceptions import EndOfFile, McapError, RecordLengthLimitExceeded
from mcap.records import Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import MCAP0_MAGIC

from tubepose.capture.formats.raw_messages import BrokenRecordingError, Note, RawMessage, inflate

# What a cut or damaged file makes mcap and its decompressors raise (lz4: RuntimeError; checksums and text: ValueError).
_BROKEN = (McapError, zstandard.ZstdError, struct.error, ValueError, RuntimeError)
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
        for record in StreamReader(stream, validate_crcs=True).records:
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


def _raw(record: Message, channel: Channel, schema: Schema) -> RawMessage:
    data = inflate(record.data) if channel.message_encoding == "cdr" else record.data
    return RawMessage(channel.topic, schema.name, channel.message_encoding, schema.data, data, record.log_time)
