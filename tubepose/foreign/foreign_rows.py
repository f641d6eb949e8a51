"""One file of results, whatever its format, as rows of estimates.csv; a file of truth as rows of ground_truth.csv."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tubepose.errors import ConfigError
from tubepose.foreign.bop_results import BOP_COLUMNS, numbers, read_bop_results, read_cells
from tubepose.foreign.mapping import ForeignMapping
from tubepose.labware import TubeModel
from tubepose.pose_errors import COVARIANCE_COLUMNS
from tubepose.records import ESTIMATE_COLUMNS, POSE_COLUMNS, Row, pose_columns, to_table, transform_of
from tubepose.truth_tables import TRUTH_COLUMNS

REQUIRED_COLUMNS = ("trial", *POSE_COLUMNS)
"""What a file in our columns has to have; all others of estimates.csv are optional."""
TUM_COLUMNS = ("timestamp", "tx", "ty", "tz", "qx", "qy", "qz", "qw")
_STATUSES = ("ok", "rejected", "failed")
_UNIT_LENGTH = 1e-2
_NUMBERS = (*POSE_COLUMNS, "confidence", "score", "seed", "frame", "timestamp_ns", "tilt_deg", *COVARIANCE_COLUMNS)


def read_estimates(path: Path, mapping: ForeignMapping, tubes: Mapping[str, TubeModel]) -> pd.DataFrame:
    """Read results of any estimator.

    Formats, by content: a CSV file with the columns of a BOP results file; a CSV file in our columns; a JSON list of
    objects with our columns as keys, or an object that has such a list under ``estimates``; a text file of rows
    ``trial tx ty tz qx qy qz qw`` (TUM order, the trial in place of the stamp; a tube's name may follow), metres.

    Args:
        path: The file.
        mapping: Names and conventions; `origin`, `axis` and `unit` hold for every format.
        tubes: Models by name, those of the truth.

    Returns:
        Rows of estimates.csv.

    Raises:
        ConfigError: The file, a column or a value is not as expected.
    """
    if path.suffix.lower() == ".json":
        rows = _our_rows(path, pd.DataFrame(_json_rows(path)).astype("object"), mapping, tubes)
    elif path.suffix.lower() in (".txt", ".tum"):
        rows = _our_rows(path, _tum_cells(path), mapping, tubes)
    else:
        cells = read_cells(path)
        if set(BOP_COLUMNS[:3]) <= set(cells.columns):
            rows = read_bop_results(path, mapping, tubes)
        else:
            rows = _our_rows(path, cells, mapping, tubes)
    filled = [{**_defaults(), **row, "confidence": _confidence(row)} for row in rows]
    table = to_table(filled, ESTIMATE_COLUMNS)
    texts = ["session", "trial", "capture", "method", "slot", "tube", "status", "reason"]
    return table.astype({**dict.fromkeys(texts, "object"), **dict.fromkeys(("confidence", *POSE_COLUMNS), "float64")})


def _defaults() -> Row:
    return {
        "session": "", "capture": "", "frame": 0, "seed": None, "slot": None, "tube": None, "status": "ok",
        "reason": "", "reason_code": "", "rack_marks": "", "ambiguous": False,
        **dict.fromkeys((*POSE_COLUMNS, "tilt_deg", *COVARIANCE_COLUMNS), float("nan")),
    }  # fmt: skip


def _confidence(row: Row) -> float:
    """A probability is kept; a score of any other scale orders claims to a slot, and is none."""
    value = row.get("confidence", row.get("score"))
    return float("nan") if value is None else float(value)


def _our_rows(path: Path, cells: pd.DataFrame, mapping: ForeignMapping, tubes: Mapping[str, TubeModel]) -> list[Row]:
    missing = [name for name in REQUIRED_COLUMNS if name not in cells]
    if missing:
        found = ", ".join(map(str, cells.columns[:12])) or "none"
        raise ConfigError(
            f"{path}: column {', '.join(missing)} is missing (found: {found}); required are "
            f"{', '.join(REQUIRED_COLUMNS)}, see docs/evaluation.md"
        )
    rows = []
    for number, entry in enumerate(cells.to_dict("records"), start=1):
        where = f"{path}: row {number}"
        row: Row = {
            str(name): _cell(where, str(name), value) for name, value in entry.items() if name in _known_columns()
        }
        row = {name: value for name, value in row.items() if value is not None}
        row.setdefault("status", "ok")
        row.setdefault("method", mapping.method or path.stem)
        if row["status"] not in _STATUSES:
            raise ConfigError(f"{where}: status '{row['status']}'; expected {', '.join(_STATUSES)}")
        rows.append(row | _pose(where, row, mapping, tubes))
    return rows


def _known_columns() -> set[str]:
    return {*ESTIMATE_COLUMNS, "score"}


def _cell(where: str, name: str, value: Any) -> Any:
    if value is None or (isinstance(value, float) and np.isnan(value)) or str(value).strip() == "":
        return None
    if name not in _NUMBERS:
        return str(value).strip()
    if name in ("seed", "frame", "timestamp_ns"):
        try:
            return int(str(value).strip())
        except ValueError:
            raise ConfigError(f"{where}: {name} '{value}'; expected a whole number") from None
    return float(numbers(where, name, value, 1)[0])


def _pose(where: str, row: Row, mapping: ForeignMapping, tubes: Mapping[str, TubeModel]) -> Row:
    there = [name for name in POSE_COLUMNS if name in row]
    if len(there) < len(POSE_COLUMNS):
        if there or row["status"] == "ok":
            gone = next(name for name in POSE_COLUMNS if name not in row)
            raise ConfigError(f"{where}: {gone} is empty; give the whole pose, or status failed and none of it")
        return {}
    length = float(np.linalg.norm([row[name] for name in POSE_COLUMNS[3:]]))
    if abs(length - 1) > _UNIT_LENGTH:
        raise ConfigError(f"{where}: the quaternion's length is {length:.4g}; expected 1 (columns qw, qx, qy, qz)")
    tube = tubes.get(row.get("tube", ""))
    T = transform_of(row)
    T[:3, 3] *= 1e-3 if mapping.unit == "mm" else 1.0
    return pose_columns(T @ mapping.to_tube(tube))


def _json_rows(path: Path) -> list[dict[str, Any]]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, ValueError, RecursionError) as problem:
        raise ConfigError(f"{path}: cannot be read as JSON: {problem}") from None
    rows = data.get("estimates") if isinstance(data, dict) else data
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise ConfigError(f"{path}: expected a list of objects, or an object with such a list as 'estimates'")
    return rows


def _tum_cells(path: Path) -> pd.DataFrame:
    """Rows of a TUM file: the stamp's place holds the trial; a ninth word is the tube."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, ValueError) as problem:
        raise ConfigError(f"{path}: cannot be read: {problem}") from None
    rows = []
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) not in (8, 9):
            raise ConfigError(
                f"{path}: line {number} has {len(words)} words; expected TRIAL tx ty tz qx qy qz qw [TUBE], metres"
            )
        values = dict(zip(("tx_m", "ty_m", "tz_m", "qx", "qy", "qz", "qw"), words[1:8], strict=True))
        rows.append({"trial": words[0], **values, "tube": words[8] if len(words) == 9 else ""})
    return pd.DataFrame(rows, columns=["trial", *POSE_COLUMNS, "tube"])


def read_truth(path: Path) -> pd.DataFrame:
    """Read ground_truth.csv, or truth of others in its columns session, trial, slot, tube and the pose.

    Raises:
        ConfigError: The file, a column or a value is not as expected.
    """
    cells = read_cells(path)
    missing = [name for name in ("trial", "slot", "tube", *POSE_COLUMNS) if name not in cells]
    if missing:
        raise ConfigError(
            f"{path}: column {', '.join(missing)} is missing; expected a ground_truth.csv as gt writes it"
        )
    rows: list[Row] = []
    for number, entry in enumerate(cells.to_dict("records"), start=2):
        where = f"{path}: line {number}"
        row: Row = {
            name: str(entry.get(name, "")) for name in ("session", "trial", "capture", "slot", "tube", "reason")
        }
        row["status"] = str(entry.get("status", "ok"))
        pose = {name: float("nan") for name in POSE_COLUMNS}
        if row["status"] == "ok":
            pose = {name: float(numbers(where, name, entry[name], 1)[0]) for name in POSE_COLUMNS}
        rows.append(row | pose)
    truth = to_table(rows, TRUTH_COLUMNS)
    twice = truth[truth.duplicated(["session", "trial", "slot"])]
    if len(twice):
        trial, slot = twice[["trial", "slot"]].iloc[0]
        raise ConfigError(f"{path}: trial {trial}, slot {slot} is there twice; expected one row per tube")
    return truth
