"""PTX clouds: columns, rows, the scanner's pose, then one point a line: x y z intensity [r g b].

Which of the two numbers is the picture's width, and whether its rows or its columns follow each other, is not the same
for all writers: the points themselves tell it.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tubepose.capture.formats.cloud import CloudFile, colours_of
from tubepose.capture.formats.text_numbers import read_rows, whole_number
from tubepose.capture.images import read_bytes
from tubepose.errors import CaptureError
from tubepose.transforms import FloatArray

_NAMES = ("x", "y", "z", "intensity", "red", "green", "blue")
# Words of the header's lines: columns, rows, position, three axes, four rows of a transform.
_WORDS = [1, 1, 3, 3, 3, 3, 4, 4, 4, 4]
_LONGEST_HEADER = 4096
_MIN_STEPS = 100
"""So many pairs of neighbours tell how the points follow each other."""


def read_ptx(path: Path) -> CloudFile:
    """Read a PTX file of one scan: its points stay in the scanner's frame, its pose is passed over.

    Raises:
        CaptureError: Missing, cut, no PTX, or more than one scan.
    """
    data = read_bytes(path)
    head = [line.split() for line in data[:_LONGEST_HEADER].splitlines()[: len(_WORDS)]]
    sides = [whole_number(words[0].decode("latin-1")) for words in head[:2] if words]
    if [len(words) for words in head] != _WORDS or None in sides:
        raise CaptureError(
            f"{path}: expected a PTX file: a line with the number of columns, one with that of rows, 4 lines of 3 "
            "numbers, 4 lines of 4, then the points"
        )
    first, second = (side or 0 for side in sides)
    rows = _read_points(path, data.split(b"\n", len(_WORDS))[-1], first * second)
    colours = colours_of({name: rows[:, i] for i, name in enumerate(_NAMES[: rows.shape[1]])})
    if min(first, second) < 2:
        return CloudFile(rows[:, :3], colours, None, asks_unit=True)
    width, by_columns = _order(rows[:, :3], (first, second))
    runs = np.arange(len(rows)).reshape(-1, width)
    if by_columns:
        runs, width = runs.T, len(rows) // width
    order = runs.ravel()
    size = (width, len(rows) // width)
    return CloudFile(rows[order, :3], None if colours is None else colours[order], size, asks_unit=True)


def _read_points(path: Path, body: bytes, count: int) -> FloatArray:
    columns = min(len(_NAMES), len(body[:_LONGEST_HEADER].split(b"\n", 1)[0].split()))
    if columns < 3 and count:
        raise CaptureError(f"{path}: truncated: the header promises {count} points, the file holds none")
    try:
        rows = read_rows(body, (0, 0), count + 1, columns)
    except ValueError:
        rows = None
    if rows is not None and len(rows) < count:
        raise CaptureError(
            f"{path}: truncated: the header promises {count} points, the file holds {len(rows)}; copy or save it again"
        )
    if rows is None or len(rows) > count:
        raise CaptureError(
            f"{path}: expected {count} lines of {columns} numbers after the header and nothing more; a PTX of several "
            "scans, or a damaged one: save one scan a file"
        )
    return rows


def _order(xyz: FloatArray, sides: tuple[int, int]) -> tuple[int, bool]:
    """Points of one run of neighbours, and whether such a run is a column of the picture.

    Runs are as long as one of the two sides: the one with which what follows a run lies beside it.
    """
    measured = np.where(((xyz == 0).all(axis=1) | ~np.isfinite(xyz).all(axis=1))[:, None], np.nan, xyz)
    apart = {}
    for run in dict.fromkeys(sides):
        steps = np.linalg.norm(measured[run:] - measured[:-run], axis=1)
        steps = steps[np.isfinite(steps)]
        apart[run] = float(np.median(steps)) if len(steps) >= _MIN_STEPS else np.inf
    run = min(apart, key=lambda side: apart[side])
    with np.errstate(divide="ignore", invalid="ignore"):
        tangents = measured[:, :2] / measured[:, 2:]
    grid = tangents.reshape(-1, run, 2)
    steps = np.abs(np.diff(grid, axis=1)).reshape(-1, 2)
    steps = steps[np.isfinite(steps).all(axis=1)]
    along = np.median(steps, axis=0) if len(steps) >= _MIN_STEPS else np.array([1.0, 0.0])
    return run, bool(along[1] > along[0])
