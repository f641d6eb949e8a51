"""Counts and error statistics straight from the rows of errors.csv; failures are counted, never averaged away."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from tubepose.evaluation.matching import AXES, ERROR_VALUES, OUTCOMES, TRIAL

RECALL_LIMITS = (0.5, 1.0, 2.0, 5.0)
"""Limits of position (mm) and tilt (deg) that shares are counted within."""


def summarise(errors: pd.DataFrame, methods: Sequence[str] | None = None) -> pd.DataFrame:
    """Counts and error statistics per method and tube, straight from the rows.

    Means, medians and 95th percentiles are of absolute values over the ``ok`` rows, all seeds together; the bias is the
    signed mean. A share counts against all expected rows, so a tube that was not found lowers it.

    Args:
        errors: Result of `evaluate`.
        methods: Order of the methods; by default that of the errors.

    Returns:
        Rows of summary.csv; tubes in sorted order. False estimates count for the tube that they claim to be.
    """
    tubes = errors["tube"].fillna("unknown")
    columns = list(_summary_row("", "", errors.iloc[:0]))
    rows = []
    for method in methods if methods is not None else errors["method"].unique():
        for tube in sorted(tubes.unique()):
            rows.append(_summary_row(str(method), tube, errors[(errors["method"] == method) & (tubes == tube)]))
    return pd.DataFrame(rows, columns=columns)


def _summary_row(method: str, tube: str, rows: pd.DataFrame) -> dict[str, Any]:
    counts = rows["outcome"].value_counts()
    ok, expected = rows[rows["outcome"] == "ok"], rows[rows["outcome"] != "false"]
    row: dict[str, Any] = {"method": method, "tube": tube, "n_expected": len(expected)}
    row |= {f"n_{name}": int(counts.get(name, 0)) for name in OUTCOMES[:4]}
    for axis in AXES:
        size = ok[axis].abs()
        row |= {
            f"{axis}_mean": size.mean(),
            f"{axis}_median": size.median(),
            f"{axis}_p95": size.quantile(0.95),
            f"{axis}_bias": ok[axis].mean(),
        }
    row |= {"n_false": int(counts.get("false", 0)), "n_seeds": max(expected["seed"].nunique(), min(len(expected), 1))}
    row |= {f"{axis}_max": ok[axis].abs().max() for axis in AXES}
    offset_mm = np.sqrt((ok[["tx_mm", "ty_mm", "tz_mm"]] ** 2).sum(axis=1))
    for limit in RECALL_LIMITS:
        within = int(((offset_mm <= limit) & (ok["tilt_deg"] <= limit)).sum())
        row[f"recall_{limit:g}mm_{limit:g}deg"] = within / len(expected) if len(expected) else np.nan
    row["n_wrong_type"] = int((~ok["type_correct"].fillna(True).astype(bool)).sum())
    return row | {f"{name}_mean": ok[name].mean() for name in ERROR_VALUES if name not in AXES}


def seed_spread(errors: pd.DataFrame) -> pd.DataFrame:
    """Smallest and largest result over the seeds of every stochastic method, per tube.

    Returns:
        Rows of seeds.csv: n_seeds, then per quantity ``_min`` and ``_max`` of the value that one seed alone gives:
        n_ok, and the mean absolute error of each axis. Methods without seeds have no row.
    """
    of_seed = errors[errors["seed"].notna() & (errors["outcome"] != "false")]
    ok = of_seed["outcome"] == "ok"
    values = of_seed[list(AXES)].abs().where(ok).add_suffix("_mean").assign(n_ok=ok.astype(float))
    keys = [of_seed[name] for name in ("method", "tube", "seed")]
    each = values.groupby(keys, sort=True).agg({"n_ok": "sum", **{f"{axis}_mean": "mean" for axis in AXES}})
    rows: list[dict[str, Any]] = []
    for method in of_seed["method"].unique():
        for tube in sorted(of_seed.loc[of_seed["method"] == method, "tube"].unique()):
            block = each.loc[(method, tube)]
            row: dict[str, Any] = {"method": method, "tube": tube, "n_seeds": len(block)}
            for name in block.columns:
                whole = name == "n_ok"
                row[f"{name}_min"] = int(block[name].min()) if whole else block[name].min()
                row[f"{name}_max"] = int(block[name].max()) if whole else block[name].max()
            rows.append(row)
    names = [f"{name}_{end}" for name in ("n_ok", *(f"{axis}_mean" for axis in AXES)) for end in ("min", "max")]
    return pd.DataFrame(rows, columns=["method", "tube", "n_seeds", *names])


def slot_accuracy(slots: pd.DataFrame, declared: pd.DataFrame) -> pd.DataFrame:
    """How many occupied slots were called occupied, how many empty ones empty, and how many were not stated.

    Args:
        slots: Rows of slots.csv.
        declared: One row per session, trial and occupied slot: ground_truth.csv, refused rows too.

    Returns:
        Rows of slot_accuracy.csv: method, n_occupied, n_found, n_called_empty, n_empty, n_left_empty,
        n_called_occupied, n_not_seen, n_unclear. Slots that were not seen or are unclear count among the occupied or
        the empty ones, and as neither right nor wrong. Trials without declared tubes and frames without a rack's pose
        are left out.
    """
    trials = declared[TRIAL].drop_duplicates()
    judged = slots.merge(trials, on=TRIAL).merge(
        declared[[*TRIAL, "slot"]].assign(declared=True), how="left", on=[*TRIAL, "slot"]
    )
    holds = judged["declared"].notna()
    state = judged["state"]
    counts = pd.DataFrame(
        {
            "method": judged["method"],
            "n_occupied": holds,
            "n_found": holds & (state == "occupied"),
            "n_called_empty": holds & (state == "empty"),
            "n_empty": ~holds,
            "n_left_empty": ~holds & (state == "empty"),
            "n_called_occupied": ~holds & (state == "occupied"),
            "n_not_seen": state == "not_seen",
            "n_unclear": state == "unclear",
        }
    )
    return counts.groupby("method", sort=False).sum().astype(int).reset_index()
