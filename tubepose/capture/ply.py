"""PLY clouds: ASCII and both binary byte orders, read and written.

Open3D's reader is not used: it fills the rest of a cut file with whatever lies in memory, reports a missing one as an
empty cloud, talks on stderr, and drops the header lines that say how the cloud is organised.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.images import read_bytes
from tubepose.errors import CaptureError
from tubepose.transforms import FloatArray

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
# Written by PhoXi tools, Zivid tools and range-scan software, as obj_info or as a comment.
_SIZE_LINE = re.compile(r"(?:obj_info|comment)\s+(?:num_)?(cols|rows|width|height)\s*[:=]?\s*(\d+)\s*$", re.IGNORECASE)
_MAX_HEADER_BYTES = 65536


@dataclass(frozen=True, slots=True, eq=False)
class PlyCloud:
    """The vertices of a PLY file.

    Attributes:
        xyz: Array of shape (N, 3) in the file's unit; invalid points as the file has them.
        rgb: Array of shape (N, 3), uint8; None without colours.
        size: (width, height) where the header says how the vertices are organised and their number agrees.
    """

    xyz: FloatArray
    rgb: NDArray[np.uint8] | None
    size: tuple[int, int] | None


@dataclass(frozen=True, slots=True)
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]]


@dataclass(frozen=True, slots=True)
class _Header:
    order: str
    elements: list[_Element]
    size: dict[str, int]
    body: int


def read_ply(path: Path) -> PlyCloud:
    """Read the vertices of a PLY file; other elements and properties are passed over.

    Raises:
        CaptureError: Missing, cut, or no PLY with x, y and z.
    """
    data = read_bytes(path)
    header = _read_header(path, data)
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        raise CaptureError(f"{path}: expected a PLY with 'element vertex', found {', '.join(names) or 'no element'}")
    at = names.index("vertex")
    before, vertex = header.elements[:at], header.elements[at]
    properties = [name for name, _ in vertex.properties]
    missing = [axis for axis in "xyz" if axis not in properties]
    if missing:
        found = ", ".join(properties) or "none"
        raise CaptureError(f"{path}: expected the vertex properties x, y and z, found {found}")
    columns = _read_ascii(path, data, header, before, vertex) if not header.order else None
    if columns is None:
        columns = _read_binary(path, data, header, before, vertex)
    xyz = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], axis=1)
    return PlyCloud(xyz, _colours(vertex, columns), _size(header, vertex.count))


def _read_header(path: Path, data: bytes) -> _Header:
    if not data.startswith(b"ply"):
        raise CaptureError(f"{path}: expected a PLY file (first line 'ply'), found {data[:16]!r}")
    end = re.search(rb"\nend_header[ \t]*\r?\n", data[:_MAX_HEADER_BYTES])
    if end is None:
        raise CaptureError(f"{path}: truncated: the PLY header has no 'end_header' line; copy the file again")
    order: str | None = None
    elements: list[_Element] = []
    size: dict[str, int] = {}
    for line in data[: end.start()].decode("latin-1").splitlines():
        words = line.split()
        match = _SIZE_LINE.match(line.strip())
        if match:
            key = {"width": "cols", "height": "rows"}.get(match[1].lower(), match[1].lower())
            size[key] = int(match[2])
        elif words[:1] == ["format"] and len(words) > 1:
            order = _ORDERS.get(words[1])
        elif words[:1] == ["element"] and len(words) == 3 and words[2].isdigit():
            elements.append(_Element(words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1].properties.append(_property(path, words))
    if order is None:
        raise CaptureError(f"{path}: expected a PLY of format {', '.join(_ORDERS)}; found none of them in its header")
    return _Header(order, elements, size, end.end())


def _property(path: Path, words: list[str]) -> tuple[str, str]:
    if words[1:2] == ["list"]:
        return words[-1], "list"
    if len(words) != 3 or words[1] not in _TYPES:
        raise CaptureError(f"{path}: expected 'property TYPE NAME' in the PLY header, found {' '.join(words)!r}")
    return words[2], _TYPES[words[1]]


def _record(path: Path, header: _Header, element: _Element) -> np.dtype[np.void]:
    """Layout of one binary record; the names are numbered, since a file may use a name twice."""
    if any(kind == "list" for _, kind in element.properties):
        raise CaptureError(f"{path}: element {element.name} holds a list, which cannot be read; save the points alone")
    return np.dtype([(f"{i}", header.order + kind) for i, (_, kind) in enumerate(element.properties)])


def _read_binary(
    path: Path, data: bytes, header: _Header, before: list[_Element], vertex: _Element
) -> dict[str, NDArray[np.generic]]:
    start = header.body + sum(e.count * _record(path, header, e).itemsize for e in before)
    layout = _record(path, header, vertex)
    whole = max(0, len(data) - start) // layout.itemsize
    if whole < vertex.count:
        raise _cut(path, vertex.count, whole)
    table = np.frombuffer(data, layout, count=vertex.count, offset=start)
    return {name: table[f"{i}"] for i, (name, _) in enumerate(vertex.properties)}


def _read_ascii(
    path: Path, data: bytes, header: _Header, before: list[_Element], vertex: _Element
) -> dict[str, NDArray[np.generic]]:
    lines = [line for line in data[header.body :].decode("latin-1").splitlines() if line.strip()]
    start = sum(element.count for element in before)
    rows = lines[start : start + vertex.count]
    if len(rows) < vertex.count:
        raise _cut(path, vertex.count, len(rows))
    wanted = len(_record(path, header, vertex).names or ())
    try:
        table = np.loadtxt(rows, dtype=np.float64, comments=None, ndmin=2, usecols=range(wanted)) if rows else None
    except (ValueError, IndexError):
        raise CaptureError(
            f"{path}: a vertex line is cut or no number; expected {wanted} numbers in each of {vertex.count} lines"
        ) from None
    if table is None:
        table = np.empty((0, wanted))
    return {name: table[:, i] for i, (name, _) in enumerate(vertex.properties)}


def _cut(path: Path, promised: int, found: int) -> CaptureError:
    return CaptureError(
        f"{path}: truncated: the header promises {promised} vertices, the file holds {found}; copy or record it again"
    )


def _colours(vertex: _Element, columns: dict[str, NDArray[np.generic]]) -> NDArray[np.uint8] | None:
    kinds = dict(vertex.properties)
    if any(kinds.get(name) != "u1" for name in ("red", "green", "blue")):
        return None
    return np.stack([columns[name].astype(np.uint8) for name in ("red", "green", "blue")], axis=1)


def _size(header: _Header, count: int) -> tuple[int, int] | None:
    width, height = header.size.get("cols", 0), header.size.get("rows", 0)
    # One row or one column is how a cloud without pixels is written.
    return (width, height) if min(width, height) > 1 and width * height == count else None


def encode_ply(points_m: FloatArray, size: tuple[int, int] | None) -> bytes:
    """Binary little-endian PLY, float32 x y z in metres, NaN kept.

    Args:
        points_m: Array of shape (N, 3), metres.
        size: (width, height) of an organised cloud; the header then says so.
    """
    lines = ["ply", "format binary_little_endian 1.0", "comment unit metre"]
    if size is not None:
        lines += [f"obj_info num_cols {size[0]}", f"obj_info num_rows {size[1]}"]
    lines += [f"element vertex {len(points_m)}", "property float x", "property float y", "property float z"]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii") + points_m.astype("<f4").tobytes()
