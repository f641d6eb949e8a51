"""Result files: written aside and then renamed, full precision, the same bytes for the same rows."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import BaseModel

from tubepose.report.tables import Table
from tubepose.result_folder import make_folder, remove_files, write_aside

__all__ = [
    "csv_text",
    "make_folder",
    "remove_files",
    "write_aside",
    "write_bytes",
    "write_csv",
    "write_json",
    "write_table",
    "write_text",
]

_FORMULA = ("=", "+", "-", "@", "\t", "\r")
"""How a cell begins that a spreadsheet would run."""


def write_bytes(path: Path, data: bytes) -> None:
    """Write bytes, as of a picture.

    Raises:
        OutputError: The place cannot be written.
    """
    with write_aside(path) as aside:
        aside.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8 with plain newlines; what a name holds that is no UTF-8 becomes an escape.

    Raises:
        OutputError: The place cannot be written.
    """
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def write_csv(path: Path, rows: pd.DataFrame) -> None:
    """Write a table as CSV: shortest floats that read back the same, empty cells for what is missing, no index.

    Raises:
        OutputError: The place cannot be written.
        ValueError: A stamp column (``_ns``) is not of an integer type and has lost digits.
    """
    write_text(path, csv_text(rows))


def csv_text(rows: pd.DataFrame) -> str:
    """The text that `write_csv` writes.

    A text that a spreadsheet would run as a formula (it begins with = + - @) has an apostrophe before it.
    """
    for name in rows.columns:
        if str(name).endswith("_ns") and len(rows) and not pd.api.types.is_integer_dtype(rows[name]):
            raise ValueError(f"column {name} has type {rows[name].dtype}; expected whole nanoseconds (Int64)")
    shown = rows.copy(deep=False)
    for name in shown.columns:
        if shown[name].dtype == object or isinstance(shown[name].dtype, pd.StringDtype):
            shown[name] = shown[name].map(_harmless)
    return str(shown.to_csv(index=False, lineterminator="\n"))


def _harmless(value: Any) -> Any:
    return f"'{value}" if isinstance(value, str) and value.startswith(_FORMULA) else value


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a record as JSON, in its own order; models and NumPy values become plain ones, a NaN becomes null.

    Raises:
        OutputError: The place cannot be written.
        TypeError: A value has no place in JSON.
    """
    write_text(path, json_text(data))


def json_text(data: Mapping[str, Any]) -> str:
    """The text that `write_json` writes.

    Raises:
        TypeError: A value has no place in JSON.
    """
    return json.dumps(_plain(data), indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, BaseModel):
        return _plain(value.model_dump())
    if is_dataclass(value) and not isinstance(value, type):
        return _plain(asdict(value))
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, Path):
        return value.as_posix()
    if isinstance(value, Sequence) and not isinstance(value, str | bytes):
        return [_plain(item) for item in value]
    if value is pd.NA or (isinstance(value, float) and not math.isfinite(value)):
        return None
    return value


def write_table(folder: Path, name: str, table: Table) -> tuple[Path, Path, Path]:
    """Write a table as ``name.csv`` (full precision), ``name.md`` and ``name.tex`` (rounded), and give their paths.

    Raises:
        OutputError: The place cannot be written.
    """
    csv, markdown, latex = (folder / f"{name}.{suffix}" for suffix in ("csv", "md", "tex"))
    write_csv(csv, table.values)
    write_text(markdown, table.markdown())
    write_text(latex, table.latex())
    return csv, markdown, latex
