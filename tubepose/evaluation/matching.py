"""Estimates against truth: one row per expected tube, with the errors of the estimate that claims its slot."""

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
    add_s_mm,
    mssd_mm,
    pose_errors,
    squared_mahalanobis,
)
from tubepose.transforms import FloatArray

AXES = ("rx_deg", "ry_deg", "tilt_deg", "tx_mm", "ty_mm", "tz_mm")
ERROR_VALUES = (*AXES, "lateral_mm", "axial_mm", "cap_mm", "mssd_mm", "add_s_mm")
ERROR_COLUMNS = (
    "session", "trial", "capture", "method", "seed", "slot", "tube", "outcome", "reason",
    "tube_estimated", "type_correct", "confidence", "right", *ERROR_VALUES, "mahalanobis2",
)  # fmt: skip
OUTCOMES = ("ok", "rejected", "missed", "failed", "false")
TRIAL = ["session", "trial"]
"""Columns that name a trial."""
_POSE = ("tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz")
_MATCH = [*TRIAL, "method", "seed_key", "slot"]
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
    trials = truth[TRIAL].drop_duplicates()
    rows = estimates[estimates["method"].isin(list(methods))].merge(trials, on=TRIAL)
    first = frames.groupby(TRIAL, as_index=False)["frame"].min()
    rows = rows.merge(first, on=[*TRIAL, "frame"])
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
    tubes = truth.loc[truth["status"] == "ok", [*TRIAL, "slot", "tube", *_POSE]]
    tubes = tubes.rename(columns={name: f"true_{name}" for name in _POSE})
    captures = estimates[[*TRIAL, "capture"]].drop_duplicates(TRIAL)
    return pairs.merge(tubes, how="cross").merge(captures, how="left", on=TRIAL)


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
    held = truth[[*TRIAL, "slot", "status"]].rename(columns={"status": "truth_status"})
    rows = judged.assign(second=judged.duplicated(_MATCH)).merge(held, how="left", on=[*TRIAL, "slot"])
    empty = rows["truth_status"].isna()
    rows = rows[(rows["status"] == "ok") & (empty | (rows["second"] & (rows["truth_status"] == "ok")))]
    reasons = np.where(rows["truth_status"].notna(), "slot is taken", "slot holds no tube")
    reasons = np.where(rows["slot"].isna(), "stands in no slot", reasons)
    rows = rows.assign(outcome="false", reason=reasons, tube_estimated=rows["tube"], type_correct=None, right=None)
    return rows.assign(**dict.fromkeys((*ERROR_VALUES, "mahalanobis2"), np.nan)).sort_values(
        [*TRIAL, "method", "seed_key", "slot"]
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
