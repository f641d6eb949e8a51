"""Recordings by their content: MCAP, ROS 2 SQLite, ROS 1 bag, compressed as a file or not, and folders of parts."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import yaml
import zstandard

from tubepose.capture.formats import mcap_file, ros1_bag, sqlite_bag
from tubepose.capture.formats.raw_messages import (
    LEAST_LIMIT_BYTES,
    MOST_INFLATED,
    BrokenRecordingError,
    Note,
    RawMessage,
    unreadable,
)
from tubepose.errors import CaptureError

SUFFIXES = (".mcap", ".db3", ".bag")
"""Endings of recordings; each may be followed by one of `COMPRESSED`."""
COMPRESSED = (".zstd", ".zst")
METADATA_FILE = "metadata.yaml"
# What rosbag leaves behind the name of a bag that was not closed.
_UNFINISHED = ".active"

_INFORMATION = "rosbag2_bagfile_information"
_START_BYTES = 16
_BLOCK_BYTES = 1 << 20
_MOST_METADATA_BYTES = 16 << 20


def is_recording(path: Path) -> bool:
    """True for a file whose name ends like a recording's, and for a folder with rosbag2's `metadata.yaml`."""
    if path.is_dir():
        return bool(_listed_parts(path))
    return recording_suffix(path) in SUFFIXES


def recording_suffix(path: Path) -> str:
    """Ending of a recording's name in small letters, without that of its compression."""
    suffix = path.suffix.lower()
    return Path(path.stem).suffix.lower() if suffix in (*COMPRESSED, _UNFINISHED) else suffix


def read_raw(path: Path) -> Iterator[RawMessage | Note]:
    """Every whole message of a recording, in the order in which it was stored; parts of a folder follow each other.

    Raises:
        CaptureError: No recording, or a part that is not there.
        BrokenRecordingError: A file is cut or damaged. Of a folder all other parts are read before it is said.
    """
    if not path.is_dir():
        yield from _read_file(path)
        return
    broken: BrokenRecordingError | None = None
    for part in recorded_parts(path):
        try:
            yield from _read_file(part)
        except BrokenRecordingError as problem:
            reason = f"{part.name}: {problem.reason}".removesuffix(": ")
            broken = broken or BrokenRecordingError(reason, cut=problem.cut)
    if broken is not None:
        raise broken


def recorded_parts(folder: Path) -> list[Path]:
    """Files of a recording in a folder, in the order of its `metadata.yaml`.

    Raises:
        CaptureError: One of them is not there, or none is listed.
    """
    parts = _listed_parts(folder)
    missing = [part.name for part in parts if not part.is_file()]
    if missing or not parts:
        told = f"lists {missing[0]}, which is not there" if missing else "lists no file"
        raise CaptureError(f"{folder / METADATA_FILE}: {told}; copy the whole folder, or give its files one by one")
    return parts


def parts_before(path: Path) -> list[Path]:
    """Other files of the split recording that a file is a part of, those before it first; none where it is whole."""
    parts = _listed_parts(path.parent)
    if path.name not in [part.name for part in parts]:
        return []
    at = [part.name for part in parts].index(path.name)
    return [part for part in [*reversed(parts[:at]), *parts[at + 1 :]] if part.is_file()]


def _listed_parts(folder: Path) -> list[Path]:
    """Paths by the `metadata.yaml` of a folder, whether they are there or not; none where it has no such file."""
    place = folder / METADATA_FILE
    try:
        if not place.is_file() or place.stat().st_size > _MOST_METADATA_BYTES:
            return []
        loaded = yaml.safe_load(place.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError, yaml.YAMLError):
        return []
    found = loaded.get(_INFORMATION) if isinstance(loaded, dict) else None
    names = found.get("relative_file_paths") if isinstance(found, dict) else None
    if not isinstance(names, list):
        return []
    # Old versions write the folder's own name before the file's.
    return [folder / Path(name).name for name in names if isinstance(name, str) and Path(name).name]


def _read_file(path: Path) -> Iterator[RawMessage | Note]:
    try:
        with path.open("rb") as stream:
            if path.suffix.lower() not in COMPRESSED:
                yield from _read_stream(stream, path, path)
                return
            with tempfile.NamedTemporaryFile(prefix="tubepose-", suffix=path.stem) as whole:
                cut = _inflate_file(stream, whole, path)
                whole.seek(0)
                yield from _read_stream(whole, Path(whole.name), path)
                if cut:
                    raise BrokenRecordingError("", cut=True)
    except OSError as problem:
        raise unreadable(path, problem) from None


def _read_stream(stream: IO[bytes], path: Path, shown: Path) -> Iterator[RawMessage | Note]:
    """Messages of an open file, which is told by its first bytes."""
    start = stream.read(_START_BYTES)
    stream.seek(0)
    if mcap_file.is_mcap(start):
        yield from mcap_file.read_mcap(stream)
    elif start == sqlite_bag.MAGIC:
        yield from sqlite_bag.read_sqlite_bag(path, shown)
    elif start.startswith(ros1_bag.MAGIC):
        yield from ros1_bag.read_ros1_bag(stream)
    else:
        kinds = {".mcap": "an MCAP file", ".db3": "a ROS 2 bag in SQLite", ".bag": "a ROS 1 bag"}
        expected = kinds.get(recording_suffix(shown), "an MCAP file, a ROS 2 bag in SQLite or a ROS 1 bag")
        raise CaptureError(f"{shown}: expected {expected}, found other content; check the path")


def _inflate_file(stream: IO[bytes], whole: IO[bytes], path: Path) -> bool:
    """Write what a zstd file holds into another one; True where it is cut.

    Raises:
        CaptureError: No zstd, or more than any recording.
    """
    limit = max(MOST_INFLATED * path.stat().st_size, LEAST_LIMIT_BYTES)
    written = 0
    try:
        with zstandard.ZstdDecompressor().stream_reader(stream) as reader:
            while block := reader.read(_BLOCK_BYTES):
                written += whole.write(block)
                if written > limit:
                    raise CaptureError(
                        f"{path}: holds more than {MOST_INFLATED} times its own size, as no recording does; check it, "
                        f"or decompress it first: zstd -d {path.name}"
                    )
    except zstandard.ZstdError as problem:
        if written == 0:
            raise CaptureError(f"{path}: expected a recording compressed with zstd: {problem}; check it") from None
        return True
    whole.flush()
    return False
