"""Numbers in text: clouds in ASCII, with every spelling of NaN that C libraries print."""

from __future__ import annotations

import re
import warnings

import numpy as np

from tubepose.transforms import FloatArray

# C99 prints nan, -nan(ind), nan(0x8000). Microsoft's library before 2015 printed -1.#IND, 1.#QNAN and 1.#INF, filled up
# with zeros, and rounded to few places as if they were digits: 1.#R, -1.#J, 1.$.
_NAN = re.compile(rb"[-+]?(?:1\.[#$][0-9A-Z]*|nan\([^()\s]*\))", re.IGNORECASE)
_WHOLE = re.compile(r"[0-9]{1,15}")
_BLANK = b" \t\r\n\f\v"


def whole_number(text: str) -> int | None:
    """A number of a header: ASCII digits, at most 15 of them; None for all else."""
    return int(text) if _WHOLE.fullmatch(text) else None


def plain_numbers(data: bytes) -> bytes:
    """The text with every NaN and infinity of Windows spelled `nan`: neither is a measurement."""
    return _NAN.sub(b"nan", data) if any(mark in data for mark in (b"#", b"$", b"(")) else data


def read_rows(data: bytes, skipped: tuple[int, int], rows: int, columns: int) -> FloatArray:
    """Rows of numbers in text, one row a line; or in any number of lines, where the first line has no whole row.

    Args:
        data: The text.
        skipped: Rows, and the numbers in them, before the first row that is wanted.
        rows: Rows that are wanted.
        columns: Numbers of a row; what follows them in a line is passed over.

    Returns:
        Array of shape (N, columns); N is smaller than `rows` where the text ends before.

    Raises:
        ValueError: A row is cut, or holds what is no number.
    """
    # A number takes a digit and a blank: nothing larger than the text is asked for.
    rows = min(rows, len(data) // max(1, columns) + 1)
    skipped_rows, skipped_numbers = skipped
    data = plain_numbers(data)
    lines = [line for line in data.decode("latin-1").splitlines() if line.strip()][skipped_rows:][:rows]
    if not lines or not columns:
        return np.empty((0, columns))
    if len(lines[0].split()) >= columns:
        return np.asarray(np.loadtxt(lines, dtype=np.float64, comments=None, ndmin=2, usecols=range(columns)))
    numbers = read_numbers(data)[skipped_numbers:]
    rows = min(rows, len(numbers) // columns)
    return numbers[: rows * columns].reshape(rows, columns)


def read_numbers(data: bytes) -> FloatArray:
    """All numbers of a text, shape (N,).

    Raises:
        ValueError: Something in it is no number.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            return np.asarray(np.fromstring(plain_numbers(data).strip(_BLANK), dtype=np.float64, sep=" "))
        except DeprecationWarning as problem:
            raise ValueError(str(problem)) from None
