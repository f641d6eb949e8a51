"""Runs to compare: folders that bench or evaluate wrote, and small baseline files to commit."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any, cast

import pandas as pd

from tubepose.errors import ConfigError
from tubepose.evaluation import ERROR_COLUMNS
from tubepose.report.writing import csv_text, write_json

BASELINE_FORMAT = 1
_BASELINE_COLUMNS = (
    "session", "trial", "method", "seed", "slot", "tube", "outcome", "tube_estimated", "type_correct", "right",
    "tilt_deg", "cap_mm", "lateral_mm", "axial_mm", "mahalanobis2",
)  # fmt: skip
_DIGITS = 6
_TEXTS = ("session", "trial", "capture", "method", "slot", "tube", "outcome", "reason", "tube_estimated")


@dataclass(frozen=True, slots=True, eq=False)
class Run:
    """One run, as far as it is compared.

    Attributes:
        name: How tables call it.
        errors: Rows of errors.csv; of a baseline file, columns that pairing does not need are missing values.
        times_ms: Median time per tube and method, warm-up left out, ms; empty where none was taken.
        fingerprint: Digests and versions: code, data, labware, versions, cpu; empty where they are not known.
    """

    name: str
    errors: pd.DataFrame
    times_ms: dict[str, float]
    fingerprint: dict[str, Any]

    @property
    def methods(self) -> list[str]:
        """Methods with rows, in their order."""
        return [str(name) for name in self.errors["method"].unique()]


def read_run(path: Path | str) -> Run:
    """Read the folder of a run, or a baseline file (.json).

    Raises:
        ConfigError: It holds no run that was judged.
    """
    place = Path(path)
    if place.is_file():
        return _read_baseline(place)
    file = place / "errors.csv"
    if not file.is_file():
        raise ConfigError(f"{place}: no errors.csv there; expected a folder of bench or evaluate, or a baseline")
    return Run(place.name or str(place), _errors(file, file.read_text(encoding="utf-8")), _times(place), _print(place))


def _errors(file: Path, text: str) -> pd.DataFrame:
    try:
        table = pd.read_csv(StringIO(text), dtype=dict.fromkeys(_TEXTS, "str"))
    except ValueError as problem:
        raise ConfigError(f"{file}: cannot be read as a CSV file: {problem}") from None
    missing = [name for name in _BASELINE_COLUMNS if name not in table]
    if missing:
        raise ConfigError(f"{file}: column {', '.join(missing)} is missing; expected an errors.csv of this version")
    texts = {name: table[name].fillna("") for name in ("session", "trial", "method", "outcome")}
    table = table.reindex(columns=list(ERROR_COLUMNS)).assign(**texts)
    try:
        for name in ("right", "type_correct"):
            table[name] = table[name].map({True: True, False: False, "True": True, "False": False}).astype("boolean")
        return table.astype({"seed": "Int64", **dict.fromkeys(("tilt_deg", "cap_mm", "mahalanobis2"), "float64")})
    except (TypeError, ValueError) as problem:
        raise ConfigError(f"{file}: a number is none: {problem}") from None


def tube_times_ms(timings: pd.DataFrame) -> dict[str, float]:
    """Median time per tube and method, warm-up left out, ms.

    Args:
        timings: Rows of timings.csv.
    """
    rows = timings[(timings["stage"] == "tube") & ~timings["warmup"].astype(bool)]
    return {str(name): float(value) for name, value in rows.groupby("method")["duration_ms"].median().items()}


def _times(folder: Path) -> dict[str, float]:
    file = folder / "timings.csv"
    return tube_times_ms(pd.read_csv(file)) if file.is_file() else {}


def _print(folder: Path) -> dict[str, Any]:
    file = folder / "run.json"
    if not file.is_file():
        return {}
    try:
        return fingerprint(json.loads(file.read_text(encoding="utf-8")))
    except ValueError as problem:
        raise ConfigError(f"{file}: cannot be read as JSON: {problem}") from None


def fingerprint(record: Mapping[str, Any]) -> dict[str, Any]:
    """What makes two runs comparable, from the record of one (`run.json`).

    Returns:
        ``code`` (digest of the library's files), ``data`` (digests of what went in, without their places), ``labware``,
        ``versions`` and ``cpu``.
    """
    return {
        "code": code_sha256(),
        "data": sorted(set(record.get("inputs_sha256", {}).values())),
        "labware": dict(sorted(record.get("labware_sha256", {}).items())),
        "versions": {"tubepose": record.get("tubepose", ""), **record.get("versions", {})},
        "cpu": record.get("machine", {}).get("cpu", ""),
    }


def code_sha256() -> str:
    """SHA-256 over the library's Python files and their names."""
    root, digest = Path(__file__).resolve().parent.parent, hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()


def differences(before: Mapping[str, Any], after: Mapping[str, Any]) -> list[str]:
    """Which parts of two fingerprints differ, of those that make runs incomparable: data, labware, versions.

    Parts that one of the two does not know are no difference.
    """
    names = ("data", "labware", "versions")
    return [name for name in names if before.get(name) and after.get(name) and before[name] != after[name]]


def write_baseline(path: Path, run: Run) -> None:
    """Write a run as a small JSON file: counts, rows for pairing (rounded to 6 digits), times, fingerprint.

    Raises:
        ConfigError: The place cannot be written.
    """
    rows = run.errors[list(_BASELINE_COLUMNS)].copy()
    numbers = rows.select_dtypes("float").columns
    rows[numbers] = rows[numbers].map(lambda value: float(f"{value:.{_DIGITS}g}"))
    counts = pd.crosstab(run.errors["method"], run.errors["outcome"])
    write_json(
        path,
        {
            "tubepose_baseline": BASELINE_FORMAT,
            "counts": {str(m): {str(k): int(v) for k, v in row.items()} for m, row in counts.to_dict("index").items()},
            "times_ms": {name: float(f"{value:.4g}") for name, value in run.times_ms.items()},
            "fingerprint": run.fingerprint,
            "rows": csv_text(rows).splitlines(),
        },
    )


def _read_baseline(path: Path) -> Run:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as problem:
        raise ConfigError(f"{path}: cannot be read as a baseline: {problem}") from None
    if not isinstance(data, dict) or data.get("tubepose_baseline") != BASELINE_FORMAT:
        raise ConfigError(
            f"{path}: no baseline of format {BASELINE_FORMAT}; write one with bench --write-baseline FILE"
        )
    rows, times, marks = data.get("rows"), data.get("times_ms", {}), data.get("fingerprint", {})
    if not isinstance(rows, list) or not isinstance(times, dict) or not isinstance(marks, dict):
        raise ConfigError(f"{path}: 'rows', 'times_ms' or 'fingerprint' is none; write the baseline again")
    return Run(path.stem, _errors(path, "\n".join(map(str, rows))), cast("dict[str, float]", times), marks)
