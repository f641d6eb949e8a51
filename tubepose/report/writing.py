"""Result files: written aside and then renamed, full precision, the same bytes for the same rows."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import BaseModel

from tubepose.errors import ConfigError
from tubepose.report.tables import Table


def make_folder(path: Path) -> None:
    """Make a folder for results before any work is done.

    Raises:
        ConfigError: It cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise ConfigError(
            f"{path}: cannot be a folder for results ({problem.strerror}); choose another place"
        ) from None


def remove_files(folder: Path, names: Iterable[str]) -> None:
    """Remove results of an earlier run that this one has none of: they would lie beside results they do not belong to.

    Raises:
        ConfigError: One of them cannot be removed.
    """
    for name in names:
        try:
            (folder / name).unlink(missing_ok=True)
        except OSError as problem:
            raise ConfigError(
                f"{folder / name}: of an earlier run, and cannot be removed ({problem.strerror}); choose another folder"
            ) from None


@contextmanager
def write_aside(path: Path) -> Iterator[Path]:
    """Give a path beside `path` to write to, and rename it to `path` when the block ends well.

    The path aside keeps the suffix, for writers that choose their format by it. Folders are made as needed. A reader
    never sees half a file, and an earlier one stays if the block fails.

    Raises:
        ConfigError: The place cannot be written.
    """
    aside = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield aside
        os.replace(aside, path)
    except OSError as problem:
        why = problem.strerror or str(problem)
        raise ConfigError(
            f"{path}: cannot be written ({why}); expected a folder to write in, choose another one"
        ) from None
    finally:
        with suppress(OSError):
            aside.unlink()


def write_bytes(path: Path, data: bytes) -> None:
    """Write bytes, as of a picture.

    Raises:
        ConfigError: The place cannot be written.
    """
    with write_aside(path) as aside:
        aside.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8 with plain newlines.

    Raises:
        ConfigError: The place cannot be written.
    """
    write_bytes(path, text.encode("utf-8"))


def write_csv(path: Path, rows: pd.DataFrame) -> None:
    """Write a table as CSV: shortest floats that read back the same, empty cells for what is missing, no index.

    Raises:
        ConfigError: The place cannot be written.
        ValueError: A stamp column (``_ns``) is not of an integer type and has lost digits.
    """
    write_text(path, csv_text(rows))


def csv_text(rows: pd.DataFrame) -> str:
    """The text that `write_csv` writes."""
    for name in rows.columns:
        if str(name).endswith("_ns") and len(rows) and not pd.api.types.is_integer_dtype(rows[name]):
            raise ValueError(f"column {name} has type {rows[name].dtype}; expected whole nanoseconds (Int64)")
    return str(rows.to_csv(index=False, lineterminator="\n"))


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a record as JSON, in its own order; models and NumPy values become plain ones, a NaN becomes null.

    Raises:
        ConfigError: The place cannot be written.
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
        ConfigError: The place cannot be written.
    """
    csv, markdown, latex = (folder / f"{name}.{suffix}" for suffix in ("csv", "md", "tex"))
    write_csv(csv, table.values)
    write_text(markdown, table.markdown())
    write_text(latex, table.latex())
    return csv, markdown, latex
