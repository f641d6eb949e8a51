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

from tubepose.capture.description import Unit
from tubepose.capture.formats.cloud import CloudFile, colours_of
from tubepose.capture.formats.text_numbers import read_rows, whole_number
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
_SIZE_LINE = re.compile(
    r"(?:obj_info|comment)\s+(?:num_)?(cols|rows|width|height)\s*[:=]?\s*([0-9]{1,15})\s*$", re.IGNORECASE
)
# PhoXi Control: obj_info Photoneo PLY PointCloud ( Width = 2064; Height = 1544; Ordered)
_SIZE_PAIR = re.compile(
    r"(?:obj_info|comment)\b.*\bwidth\s*[:=]\s*([0-9]{1,15})\b.*\bheight\s*[:=]\s*([0-9]{1,15})\b", re.IGNORECASE
)
_UNIT_LINE = re.compile(r"(?:obj_info|comment)\b.*\bunits?\s*(?:[:=]|is)?\s*([a-z]+)\s*$", re.IGNORECASE)
_UNITS: dict[str, Unit] = {
    **dict.fromkeys(("m", "metre", "metres", "meter", "meters"), "m"),
    **dict.fromkeys(("mm", "millimetre", "millimetres", "millimeter", "millimeters"), "mm"),
}
# PhoXi Control and Zivid's programs write millimetres; a line that only names the camera is somebody else's.
_MILLIMETRE_WRITERS = re.compile(
    r"obj_info\s+(?:photoneo|zivid)\b|comment\s+(?:created|generated|written|exported)\s+(?:by|with)\s+(?:photoneo|phoxi"
    r"|zivid)\b",
    re.IGNORECASE,
)
_MAX_HEADER_BYTES = 65536
# PCL's `camera` has viewportx and viewporty, PhoXi Control's `phoxi_frame_params` frame_width and frame_height.
_SIZE_PROPERTIES = (("viewportx", "viewporty"), ("frame_width", "frame_height"))


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
    unit: Unit | None = None


def read_ply(path: Path) -> CloudFile:
    """Read the vertices of a PLY file.

    Of other elements only the size of the picture is read, where PCL or PhoXi Control wrote it there.

    Raises:
        CaptureError: Missing, cut, or no PLY with x, y and z.
    """
    data = read_bytes(path)
    header = _read_header(path, data)
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        raise CaptureError(f"{path}: expected a PLY with 'element vertex', found {', '.join(names) or 'no element'}")
    at = names.index("vertex")
    vertex = header.elements[at]
    properties = [name for name, _ in vertex.properties]
    missing = [axis for axis in "xyz" if axis not in properties]
    if missing:
        found = ", ".join(properties) or "none"
        raise CaptureError(f"{path}: expected the vertex properties x, y and z, found {found}")
    table = _read_element(path, data, header, at)
    if len(table[properties[0]]) < vertex.count:
        raise _cut(path, vertex.count, len(table[properties[0]]))
    with np.errstate(invalid="ignore"):  # signalling NaN
        xyz = np.stack([table[axis].astype(np.float64) for axis in "xyz"], axis=1)
    return CloudFile(xyz, colours_of(table), _size(path, data, header, vertex.count), header.unit)


def _read_header(path: Path, data: bytes) -> _Header:
    if not data.startswith(b"ply"):
        raise CaptureError(f"{path}: expected a PLY file (first line 'ply'), found {data[:16]!r}")
    end = re.search(rb"\nend_header[ \t]*\r?\n", data[:_MAX_HEADER_BYTES])
    if end is None:
        raise CaptureError(f"{path}: truncated: the PLY header has no 'end_header' line; copy the file again")
    order: str | None = None
    elements: list[_Element] = []
    size: dict[str, int] = {}
    unit: Unit | None = None
    for line in data[: end.start()].decode("latin-1").splitlines():
        words = line.split()
        if words[:1] in (["comment"], ["obj_info"]):
            size |= _stated_size(line.strip())
            unit = _stated_unit(line.strip()) or unit
        elif words[:1] == ["format"] and len(words) > 1:
            order = _ORDERS.get(words[1])
        elif words[:1] == ["element"]:
            elements.append(_Element(words[1] if len(words) > 1 else "", _count(path, words), []))
        elif words[:1] == ["property"] and elements:
            elements[-1].properties.append(_property(path, words))
    if order is None:
        raise CaptureError(f"{path}: expected a PLY of format {', '.join(_ORDERS)}; found none of them in its header")
    return _Header(order, elements, size, end.end(), unit)


def _stated_size(line: str) -> dict[str, int]:
    if both := _SIZE_PAIR.match(line):
        return {"cols": int(both[1]), "rows": int(both[2])}
    if one := _SIZE_LINE.match(line):
        return {{"width": "cols", "height": "rows"}.get(one[1].lower(), one[1].lower()): int(one[2])}
    return {}


def _stated_unit(line: str) -> Unit | None:
    if said := _UNIT_LINE.match(line):
        return _UNITS.get(said[1].lower())
    return "mm" if _MILLIMETRE_WRITERS.match(line) else None


def _count(path: Path, words: list[str]) -> int:
    count = whole_number(words[2]) if len(words) == 3 else None
    if count is None:
        raise CaptureError(f"{path}: expected 'element NAME COUNT' in the PLY header, found {' '.join(words)[:80]!r}")
    return count


def _property(path: Path, words: list[str]) -> tuple[str, str]:
    if words[1:2] == ["list"]:
        return words[-1], "list"
    if len(words) != 3 or words[1] not in _TYPES:
        raise CaptureError(f"{path}: expected 'property TYPE NAME' in the PLY header, found {' '.join(words)[:80]!r}")
    return words[2], _TYPES[words[1]]


def _record(path: Path, header: _Header, element: _Element) -> np.dtype[np.void]:
    """Layout of one binary record; the names are numbered, since a file may use a name twice."""
    if any(kind == "list" for _, kind in element.properties):
        raise CaptureError(f"{path}: element {element.name} holds a list, which cannot be read; save the points alone")
    return np.dtype([(f"{i}", header.order + kind) for i, (_, kind) in enumerate(element.properties)])


def _read_element(path: Path, data: bytes, header: _Header, at: int) -> dict[str, NDArray[np.generic]]:
    """Columns of an element by name; shorter than the header says where the file ends before."""
    layout = _record(path, header, header.elements[at])
    before = [(element.count, _record(path, header, element)) for element in header.elements[:at]]
    count = header.elements[at].count
    names = [name for name, _ in header.elements[at].properties]
    if not header.order:
        skipped = sum(n for n, _ in before), sum(n * len(record.names or ()) for n, record in before)
        try:
            rows = read_rows(data[header.body :], skipped, count, len(names))
        except ValueError:
            raise CaptureError(
                f"{path}: a {header.elements[at].name} line is cut or no number; expected {len(names)} "
                f"numbers in each of {count} lines"
            ) from None
        return {name: rows[:, i] for i, name in enumerate(names)}
    start = min(len(data), header.body + sum(n * record.itemsize for n, record in before))
    whole = (len(data) - start) // layout.itemsize if layout.itemsize else 0
    table = np.frombuffer(data, layout, count=min(count, whole), offset=start)
    return {name: table[f"{i}"] for i, name in enumerate(names)}


def _cut(path: Path, promised: int, found: int) -> CaptureError:
    return CaptureError(
        f"{path}: truncated: the header promises {promised} vertices, the file holds {found}; copy or record it again"
    )


def _size(path: Path, data: bytes, header: _Header, count: int) -> tuple[int, int] | None:
    """Width and height by the header's lines, else by an element beside the vertices."""
    stated = [(header.size.get("cols", 0), header.size.get("rows", 0))]
    for at, element in enumerate(header.elements):
        kinds = dict(element.properties)
        pair = next((names for names in _SIZE_PROPERTIES if set(names) <= kinds.keys()), None)
        if pair is not None and element.count == 1 and not _has_list(header.elements[: at + 1]):
            values = [_read_element(path, data, header, at)[name] for name in pair]
            if all(len(value) and 0 < float(value[0]) < 2**31 for value in values):
                stated.append((int(values[0][0]), int(values[1][0])))
    # One row or one column is how a cloud without pixels is written.
    return next(((w, h) for w, h in stated if min(w, h) > 1 and w * h == count), None)


def _has_list(elements: list[_Element]) -> bool:
    return any(kind == "list" for element in elements for _, kind in element.properties)


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
