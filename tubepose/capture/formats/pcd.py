"""PCD clouds of the Point Cloud Library: ascii, binary and binary_compressed (PCD file format, version 0.7)."""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.formats.cloud import CloudFile, colours_of, packed_colours
from tubepose.capture.formats.text_numbers import read_rows, whole_number
from tubepose.capture.images import read_bytes
from tubepose.errors import CaptureError

_KINDS = {"F": (4, 8), "U": (1, 2, 4, 8), "I": (1, 2, 4, 8)}
_DATA = ("ascii", "binary", "binary_compressed")
_MAX_HEADER_BYTES = 65536
_LONGEST_COPY = 264
"""Bytes that three bytes of LZF can stand for."""


@dataclass(frozen=True, slots=True)
class _Field:
    name: str
    kind: str
    count: int


@dataclass(frozen=True, slots=True)
class _Header:
    fields: tuple[_Field, ...]
    size: tuple[int, int]
    points: int
    data: str
    body: int

    @property
    def record(self) -> np.dtype[np.void]:
        """Layout of one point; fields are numbered, since PCL calls all padding `_`."""
        return np.dtype([(f"{i}", f.kind, (f.count,)) for i, f in enumerate(self.fields)])


def read_pcd(path: Path) -> CloudFile:
    """Read a PCD file; colours are those of `rgb` or `rgba`, else of `intensity`.

    Raises:
        CaptureError: Missing, cut, or no PCD with x, y and z.
    """
    data = read_bytes(path)
    header = _read_header(path, data)
    columns = {"ascii": _read_ascii, "binary": _read_binary}.get(header.data, _read_compressed)(path, data, header)
    missing = [axis for axis in "xyz" if axis not in columns]
    if missing:
        raise CaptureError(f"{path}: expected the fields x, y and z, found {', '.join(columns) or 'none'}")
    with np.errstate(invalid="ignore"):  # signalling NaN
        xyz = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
    packed = next((columns[name] for name in ("rgb", "rgba") if name in columns), None)
    colours = colours_of(columns) if packed is None else packed_colours(_as_bits(packed))
    # One row is how a cloud without pixels is written.
    return CloudFile(xyz, colours, header.size if min(header.size) > 1 else None)


def _read_header(path: Path, data: bytes) -> _Header:
    end = re.search(rb"(?:^|\n)DATA[ \t]+(\S+)[ \t]*\r?\n", data[:_MAX_HEADER_BYTES])
    if end is None:
        raise CaptureError(f"{path}: expected a PCD file, found no line 'DATA ascii|binary|binary_compressed' in it")
    entries: dict[str, list[str]] = {}
    for line in data[: end.start()].decode("latin-1").splitlines():
        words = line.split()
        if words and not words[0].startswith("#"):
            entries[words[0].upper()] = words[1:]
    kind = end[1].decode("latin-1").lower()
    if kind not in _DATA:
        raise CaptureError(f"{path}: expected DATA {', '.join(_DATA)} in the PCD header, found {kind[:40]!r}")
    fields = _fields(path, entries)
    width, height = (_number(path, entries, key, None) for key in ("WIDTH", "HEIGHT"))
    points = _number(path, entries, "POINTS", width * height)
    if width * height != points:
        raise CaptureError(f"{path}: WIDTH {width} x HEIGHT {height} are not the {points} POINTS of the header")
    return _Header(fields, (width, height), points, kind, end.end())


def _number(path: Path, entries: dict[str, list[str]], key: str, default: int | None) -> int:
    words = entries.get(key)
    if words is None and default is not None:
        return default
    number = whole_number(words[0]) if words is not None and len(words) == 1 else None
    if number is None:
        found = "no such line" if words is None else repr(" ".join(words)[:40])
        raise CaptureError(f"{path}: expected '{key} NUMBER' in the PCD header, found {found}")
    return number


def _fields(path: Path, entries: dict[str, list[str]]) -> tuple[_Field, ...]:
    names = entries.get("FIELDS") or entries.get("COLUMNS") or []
    sizes, kinds = entries.get("SIZE", []), entries.get("TYPE", [])
    counts = entries.get("COUNT") or ["1"] * len(names)
    if not names or not len(names) == len(sizes) == len(kinds) == len(counts):
        raise CaptureError(
            f"{path}: expected FIELDS, SIZE, TYPE and COUNT of one length in the PCD header, found {len(names)}, "
            f"{len(sizes)}, {len(kinds)} and {len(counts)} words"
        )
    fields = []
    for name, size, kind, count in zip(names, sizes, kinds, counts, strict=True):
        known, times = whole_number(size), whole_number(count)
        if known not in _KINDS.get(kind, ()) or times is None or not 0 < times <= _MAX_HEADER_BYTES:
            raise CaptureError(
                f"{path}: field {name[:40]}: expected TYPE F, U or I, its SIZE in bytes and a COUNT, found "
                f"{kind[:10]}, {size[:20]} and {count[:20]}"
            )
        fields.append(_Field(name, f"<{kind.lower()}{known}", times))
    return tuple(fields)


def _read_ascii(path: Path, data: bytes, header: _Header) -> dict[str, NDArray[np.generic]]:
    width = sum(field.count for field in header.fields)
    try:
        rows = read_rows(data[header.body :], (0, 0), header.points, width)
    except ValueError:
        raise CaptureError(f"{path}: a point is cut or no number; expected {width} numbers in each line") from None
    if len(rows) < header.points:
        raise _cut(path, header.points, len(rows))
    columns: dict[str, NDArray[np.generic]] = {}
    at = 0
    for field in header.fields:
        column = rows[:, at]
        # Whole numbers are colours; as floats 32 bits of them have lost nothing.
        columns[field.name] = column if field.kind[1] == "f" else np.nan_to_num(column).astype(np.int64)
        if field.kind == "<f4":
            columns[field.name] = column.astype(np.float32) if field.name in ("rgb", "rgba") else column
        at += field.count
    return columns


def _read_binary(path: Path, data: bytes, header: _Header) -> dict[str, NDArray[np.generic]]:
    record = header.record
    whole = (len(data) - header.body) // record.itemsize
    if whole < header.points:
        raise _cut(path, header.points, whole)
    table = np.frombuffer(data, record, count=header.points, offset=header.body)
    return {field.name: table[f"{i}"][:, 0] for i, field in enumerate(header.fields)}


def _read_compressed(path: Path, data: bytes, header: _Header) -> dict[str, NDArray[np.generic]]:
    """Two lengths, then LZF of all values of the first field, then all of the second, and so on."""
    from tubepose.capture.formats.lzf_kernels import expand

    if len(data) < header.body + 8:
        raise _cut(path, header.points, 0)
    packed, size = struct.unpack_from("<II", data, header.body)
    wanted = header.points * header.record.itemsize
    if header.body + 8 + packed > len(data) or size > packed * _LONGEST_COPY or size < wanted:
        raise CaptureError(
            f"{path}: truncated or damaged: {packed} compressed bytes of {size} are promised for {wanted}, the file "
            f"holds {len(data) - header.body - 8}; copy or record it again"
        )
    plain = expand(np.frombuffer(data, np.uint8, count=packed, offset=header.body + 8), size)
    if len(plain) < wanted:
        raise CaptureError(f"{path}: damaged: {len(plain)} of {size} bytes can be decompressed; record it again")
    columns: dict[str, NDArray[np.generic]] = {}
    at = 0
    for field in header.fields:
        values = np.frombuffer(plain, field.kind, header.points * field.count, at)
        columns[field.name] = values.reshape(header.points, field.count)[:, 0]
        at += values.nbytes
    return columns


def _as_bits(values: NDArray[np.generic]) -> NDArray[np.uint32]:
    """PCL's colours: the bits of a float of 32 bits, or a whole number of any size."""
    if values.dtype == np.float32:
        return np.ascontiguousarray(values).view(np.uint32)
    if values.dtype.kind == "f":
        return values.astype(np.float32).view(np.uint32)
    return (values.astype(np.int64) & 0xFFFFFFFF).astype(np.uint32)


def _cut(path: Path, promised: int, found: int) -> CaptureError:
    return CaptureError(
        f"{path}: truncated: the header promises {promised} points, the file holds {found}; copy or record it again"
    )
