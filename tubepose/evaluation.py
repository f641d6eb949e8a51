"""Estimates against truth: one row per expected tube, then summaries; failures are counted, never averaged away.

All functions take and give pandas tables and change none in place; docs/outputs.md describes every column.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from tubepose.confidence import within
from tubepose.labware import TubeModel
from tubepose.pose_errors import (
    COVARIANCE_COLUMNS,
    UPSIDE_DOWN_DEG,
    PoseErrors,
    add_s_mm,
    mssd_mm,
    pose_errors,
    squared_mahalanobis,
)
from tubepose.statistics import DRAWS, paired_bootstrap
from tubepose.transforms import FloatArray

__all__ = ["PoseErrors", "compare", "evaluate", "pose_errors", "seed_spread", "summarise"]

AXES = ("rx_deg", "ry_deg", "tilt_deg", "tx_mm", "ty_mm", "tz_mm")
ERROR_VALUES = (*AXES, "lateral_mm", "axial_mm", "cap_mm", "mssd_mm", "add_s_mm")
ERROR_COLUMNS = (
    "session", "trial", "capture", "method", "seed", "slot", "tube", "outcome", "reason",
    "tube_estimated", "type_correct", "confidence", "right", *ERROR_VALUES, "mahalanobis2",
)  # fmt: skip
COMPARISON_COLUMNS = (
    "method", "reference", "tube", "error", "mean_difference", "ci95_low", "ci95_high", "n_pairs", "n_captures",
)  # fmt: skip
OUTCOMES = ("ok", "rejected", "missed", "failed", "false")
RECALL_LIMITS = (0.5, 1.0, 2.0, 5.0)
_POSE = ("tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz")
_TRIAL = ["session", "trial"]
_MATCH = [*_TRIAL, "method", "seed_key", "slot"]
_NO_SEED = -1
_PROFILE_SPACING_M = 1e-3
_RANK = {"ok": 0, "rejected": 1, "failed": 2}


def evaluate(
    estimates: pd.DataFrame, truth: pd.DataFrame, tube_models: Mapping[str, TubeModel], methods: Sequence[str],
    *, racks: pd.DataFrame | None = None, seeds: Mapping[str, Sequence[int]] | None = None,
) -> pd.DataFrame:  # fmt: skip
    """Judge every expected tube for every method and seed, and list accepted estimates that nothing was expected for.

    Expected are the slots whose truth is ok. A trial is judged on its first frame, whatever was found in it. Where
    several estimates claim one slot, an accepted one goes before a rejected one, then the higher confidence; accepted
    ones
    that are left over are false. Slots whose truth was refused are neither expected nor false; trials without truth
    are left out.

    Args:
        estimates: Rows of estimates.csv.
        truth: Rows of ground_truth.csv (or of the simulator's exact truth), one per session, trial and slot.
        tube_models: The model of every tube that the truth names, for the errors at the cap and on the surface.
        methods: Methods to judge, in the order of the result; one without estimates has all its tubes missed.
        racks: Rows of racks.csv, which know every frame; without them a trial's first frame is the first one with an
            estimate of any method.
        seeds: Seeds that stochastic methods ran with, so that one that answered nothing counts; by default those that
            have estimates.

    Returns:
        Rows of errors.csv, columns ERROR_COLUMNS: outcome ``ok``, ``rejected`` (with errors where there is a pose),
        ``missed`` (no estimate), ``failed`` (no pose, or upside down) or ``false``; errors as in `PoseErrors`.
    """
    # Tables from before covariances were stated, and methods that state none.
    stated = ("confidence", *COVARIANCE_COLUMNS)
    estimates = estimates.assign(**{name: np.nan for name in stated if name not in estimates})
    judged = _judged(estimates, truth, methods, estimates if racks is None else racks)
    best = judged[judged["slot"].notna() & ~judged.duplicated(_MATCH)]
    columns = [*_MATCH, "tube", "status", "reason", "confidence", *_POSE, *COVARIANCE_COLUMNS]
    rows = _expected(estimates, truth, judged, methods, seeds or {}).merge(
        best[columns], how="left", on=_MATCH, suffixes=("", "_estimated"), validate="one_to_one"
    )
    rows["type_correct"] = (
        (rows["tube_estimated"] == rows["tube"]).astype("boolean").mask(rows["tube_estimated"].isna())
    )
    rows = rows.assign(**_errors(rows, tube_models))
    rows["right"] = _right(rows)
    rows["outcome"], rows["reason"] = _outcomes(rows)
    table = pd.concat([_shape(rows), _shape(_false_rows(judged, truth))], ignore_index=True)
    rank = table["method"].map({method: i for i, method in enumerate(methods)})
    return table.iloc[np.argsort(rank.to_numpy(), kind="stable")].reset_index(drop=True)


def _judged(estimates: pd.DataFrame, truth: pd.DataFrame, methods: Sequence[str], frames: pd.DataFrame) -> pd.DataFrame:
    """Estimates of the named methods in trials with truth, first frame only, the best claim to a slot first."""
    unknown = sorted(set(estimates["status"]) - set(_RANK))
    if unknown:
        raise ValueError(f"expected status ok, rejected or failed, found {', '.join(map(str, unknown))}")
    trials = truth[_TRIAL].drop_duplicates()
    rows = estimates[estimates["method"].isin(list(methods))].merge(trials, on=_TRIAL)
    first = frames.groupby(_TRIAL, as_index=False)["frame"].min()
    rows = rows.merge(first, on=[*_TRIAL, "frame"])
    rows = rows.assign(seed_key=_seed_key(rows), rank=rows["status"].map(_RANK))
    return rows.sort_values(["rank", "confidence"], ascending=[True, False], kind="stable").drop(columns="rank")


def _seed_key(rows: pd.DataFrame) -> pd.Series[int]:
    """Seeds as plain integers, so that rows without a seed match each other."""
    return rows["seed"].astype("Int64").fillna(_NO_SEED).astype("int64")


def _expected(
    estimates: pd.DataFrame,
    truth: pd.DataFrame,
    judged: pd.DataFrame,
    methods: Sequence[str],
    ran: Mapping[str, Sequence[int]],
) -> pd.DataFrame:
    """Every tube with truth x method x seed, with the true pose in columns ``true_*``."""
    seeds = [
        (method, seed)
        for method in methods
        for seed in sorted({*judged.loc[judged["method"] == method, "seed_key"], *ran.get(method, ())}) or [_NO_SEED]
    ]
    pairs = pd.DataFrame(seeds, columns=["method", "seed_key"])
    tubes = truth.loc[truth["status"] == "ok", [*_TRIAL, "slot", "tube", *_POSE]]
    tubes = tubes.rename(columns={name: f"true_{name}" for name in _POSE})
    captures = estimates[[*_TRIAL, "capture"]].drop_duplicates(_TRIAL)
    return pairs.merge(tubes, how="cross").merge(captures, how="left", on=_TRIAL)


def _transforms(rows: pd.DataFrame, prefix: str = "") -> FloatArray:
    """Poses (N, 4, 4) from the columns tx_m ... qz; NaN where one of them is missing."""
    values = rows[[prefix + name for name in _POSE]].to_numpy(dtype=float)
    found = np.isfinite(values).all(axis=1)
    T = np.full((len(rows), 4, 4), np.nan)
    T[:, 3] = [0.0, 0.0, 0.0, 1.0]
    if found.any():
        T[found, :3, :3] = Rotation.from_quat(values[found][:, [4, 5, 6, 3]]).as_matrix()
        T[found, :3, 3] = values[found, :3]
    return T


def _errors(rows: pd.DataFrame, tube_models: Mapping[str, TubeModel]) -> dict[str, FloatArray]:
    T_camera_truth, T_camera_estimate = _transforms(rows, "true_"), _transforms(rows)
    tubes = rows["tube"].to_numpy()
    found = pose_errors(T_camera_truth, T_camera_estimate, np.array([tube_models[name].height_m for name in tubes]))
    values = {name: np.asarray(getattr(found, name)) for name in ERROR_VALUES if name not in ("mssd_mm", "add_s_mm")}
    values |= {name: np.full(len(rows), np.nan) for name in ("mssd_mm", "add_s_mm")}
    for name in sorted(set(tubes)):
        of, profile_m = np.flatnonzero(tubes == name), tube_models[name].outer_profile_m(_PROFILE_SPACING_M)
        truth, estimate = T_camera_truth[of], T_camera_estimate[of]
        values["mssd_mm"][of] = mssd_mm(truth, estimate, profile_m)
        values["add_s_mm"][of] = add_s_mm(truth, estimate, profile_m)
    values["mahalanobis2"] = squared_mahalanobis(T_camera_truth, T_camera_estimate, _covariances(rows))
    return values


def _right(rows: pd.DataFrame) -> pd.Series[bool]:
    """Whether poses are right as `tubepose.confidence` has it, and of the right type; NA without a pose."""
    std_along_m = np.sqrt(rows["cov_tz_tz"].to_numpy(dtype=float))
    errors = [rows[name].to_numpy(dtype=float) for name in ("tilt_deg", "lateral_mm", "axial_mm")]
    right = within(np.deg2rad(errors[0]), 1e-3 * errors[1], 1e-3 * errors[2], std_along_m)
    right &= rows["type_correct"].fillna(False).to_numpy(dtype=bool)
    return pd.Series(right, index=rows.index).astype("boolean").mask(np.isnan(errors[0]))


def _covariances(rows: pd.DataFrame) -> FloatArray:
    """Covariances (N, 5, 5) from the columns of their upper half."""
    covariance = np.empty((len(rows), 5, 5))
    i, j = np.triu_indices(5)
    covariance[:, i, j] = rows[list(COVARIANCE_COLUMNS)].to_numpy(dtype=float)
    covariance[:, j, i] = covariance[:, i, j]
    return covariance


def _outcomes(rows: pd.DataFrame) -> tuple[list[str], list[str]]:
    outcomes, reasons = [], []
    for status, reason, tilt_deg in zip(rows["status"], rows["reason"], rows["tilt_deg"], strict=True):
        outcome, why = str(status), "" if pd.isna(reason) else str(reason)
        if pd.isna(status):
            outcome, why = "missed", "no estimate for the slot"
        elif status == "ok" and not tilt_deg <= UPSIDE_DOWN_DEG:
            outcome, why = "failed", "no pose" if pd.isna(tilt_deg) else "upside down"
        outcomes.append(outcome)
        reasons.append(why)
    return outcomes, reasons


def _false_rows(judged: pd.DataFrame, truth: pd.DataFrame) -> pd.DataFrame:
    """Accepted estimates in slots that hold no tube, in no slot at all, or second in their slot."""
    held = truth[[*_TRIAL, "slot", "status"]].rename(columns={"status": "truth_status"})
    rows = judged.assign(second=judged.duplicated(_MATCH)).merge(held, how="left", on=[*_TRIAL, "slot"])
    empty = rows["truth_status"].isna()
    rows = rows[(rows["status"] == "ok") & (empty | (rows["second"] & (rows["truth_status"] == "ok")))]
    reasons = np.where(rows["truth_status"].notna(), "slot is taken", "slot holds no tube")
    reasons = np.where(rows["slot"].isna(), "stands in no slot", reasons)
    rows = rows.assign(outcome="false", reason=reasons, tube_estimated=rows["tube"], type_correct=None, right=None)
    return rows.assign(**dict.fromkeys((*ERROR_VALUES, "mahalanobis2"), np.nan)).sort_values(
        [*_TRIAL, "method", "seed_key", "slot"]
    )


def _shape(rows: pd.DataFrame) -> pd.DataFrame:
    """The columns of errors.csv, with the types that survive a file."""
    seed = rows["seed_key"].astype("Int64").mask(rows["seed_key"] == _NO_SEED)
    table = rows.assign(seed=seed)[list(ERROR_COLUMNS)]
    texts = ["session", "trial", "capture", "method", "slot", "tube", "outcome", "reason", "tube_estimated"]
    types: dict[str, Any] = {
        **dict.fromkeys(texts, "str"),
        **dict.fromkeys(("confidence", *ERROR_VALUES, "mahalanobis2"), "float64"),
    }
    return table.astype({**types, "seed": "Int64", "type_correct": "boolean", "right": "boolean"})


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


def compare(errors: pd.DataFrame, reference_method: str, draws: int = DRAWS, seed: int = 0) -> pd.DataFrame:
    """Paired differences of absolute errors, every method minus the reference, with 95 % intervals.

    Pairs are the tubes of one session, trial and slot that both methods accepted (seeds of a method averaged first), so
    a method that rejects its hard cases is compared on the easy ones: read ``n_pairs`` beside it. Whole captures
    are resampled, because the tubes of one capture share the error of its rack.

    Args:
        errors: Result of `evaluate`.
        reference_method: The method that the others are compared with.
        draws: Number of bootstrap resamples.
        seed: Seed of the bootstrap.

    Returns:
        Rows of comparison.csv, per method, tube and error; a negative difference is smaller than the reference's.
    """
    values = [*AXES, "cap_mm"]
    keys = ["tube", *_TRIAL, "slot"]
    ok = errors.loc[errors["outcome"] == "ok", ["method", *keys, *values]]
    ok = ok.assign(**{name: ok[name].abs() for name in values})
    means = ok.groupby(["method", *keys], sort=True)[values].mean().reset_index()
    reference = means[means["method"] == reference_method].drop(columns="method")
    rows: list[dict[str, Any]] = []
    for method in (name for name in errors["method"].unique() if name != reference_method):
        pairs = means[means["method"] == method].merge(reference, on=keys, suffixes=("", "_reference"))
        for tube in sorted(errors.loc[errors["outcome"] != "false", "tube"].unique()):
            of = pairs[pairs["tube"] == tube]
            groups = list(zip(of["session"], of["trial"], strict=True))
            for name in values:
                found = paired_bootstrap((of[name] - of[f"{name}_reference"]).to_numpy(), groups, draws, seed)
                rows.append(
                    {
                        "method": method,
                        "reference": reference_method,
                        "tube": tube,
                        "error": name,
                        "mean_difference": found.mean,
                        "ci95_low": found.low,
                        "ci95_high": found.high,
                        "n_pairs": found.n,
                        "n_captures": found.n_groups,
                    }
                )
    return pd.DataFrame(rows, columns=list(COMPARISON_COLUMNS))


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
    trials = declared[_TRIAL].drop_duplicates()
    judged = slots.merge(trials, on=_TRIAL).merge(
        declared[[*_TRIAL, "slot"]].assign(declared=True), how="left", on=[*_TRIAL, "slot"]
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
