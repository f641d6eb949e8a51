"""Repeated frames of an unchanged scene: repeatability, honesty of stated covariances, drift; no truth is needed.

What all frames have in common does not show: the sensor's calibration, the labware's sizes, a bias of the method.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from scipy import stats
from scipy.spatial.transform import Rotation

from tubepose.pose_errors import COVARIANCE_AXES, COVARIANCE_COLUMNS, pose_errors
from tubepose.statistics import paired_bootstrap
from tubepose.transforms import FloatArray

FRAME_KEYS = ["session", "trial", "capture", "frame"]
TUBE_AXES = ("rx_deg", "ry_deg", "tx_mm", "ty_mm", "tz_mm")
RACK_AXES = ("rx_deg", "ry_deg", "rz_deg", "tx_mm", "ty_mm", "tz_mm")
REPEAT_COLUMNS = ("method", "slot", "tube", "n_frames", "n_expected", *(f"{axis}_std" for axis in TUBE_AXES))
INNOVATION_COLUMNS = ("method", "nis_mean", "ci95_low", "ci95_high", "n", "n_frame_pairs", "consistent")
DRIFT_COLUMNS = ("method", "subject", "slot", "axis", "n_frames", "per_frame", "step", "step_at", "p", "alarm")
FALSE_ALARMS = 2e-5
"""Chance that a still series of one rack with all its tubes gives any alarm."""
LEAST_FRAMES = 5
_POSE = ("tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz")


def frame_numbers(rows: pd.DataFrame) -> pd.Series[int]:
    """Place of every row's frame in time: by stamp where every row has one, else in the order of the rows."""
    if "timestamp_ns" in rows and len(rows) and rows["timestamp_ns"].notna().all():
        return rows["timestamp_ns"].rank(method="dense").astype(int) - 1
    return rows.groupby(FRAME_KEYS, sort=False, dropna=False).ngroup()


def repeatability(estimates: pd.DataFrame, racks: pd.DataFrame) -> pd.DataFrame:
    """Standard deviation per axis of every tube's pose over the frames, in the tube's own mean frame.

    Args:
        estimates: Rows of estimates.csv; only those that are ok count, of stochastic methods the first seed.
        racks: Rows of racks.csv, which know every frame.

    Returns:
        One row per method and slot, columns REPEAT_COLUMNS; mm and degrees; NaN with fewer than two frames.
    """
    frames = len(racks[FRAME_KEYS].drop_duplicates())
    rows: list[dict[str, Any]] = []
    for (method, slot), group in _series(estimates).groupby(["method", "slot"], sort=False):
        T = transforms(group)
        found = pose_errors(np.repeat(mean_transform(T)[None], len(T), axis=0), T)
        spread = {
            f"{axis}_std": float(np.std(getattr(found, axis), ddof=1)) if len(T) > 1 else np.nan for axis in TUBE_AXES
        }
        tube = group["tube"].mode().iloc[0] if group["tube"].notna().any() else ""
        rows.append({"method": method, "slot": slot, "tube": tube, "n_frames": len(T), "n_expected": frames, **spread})
    return pd.DataFrame(rows, columns=list(REPEAT_COLUMNS))


def innovations(estimates: pd.DataFrame) -> pd.DataFrame:
    """Normalised innovation squared of neighbouring frames, per degree of freedom; 1 if covariances are honest.

    ``d^T (C_a + C_b)^-1 d / 5`` of the difference of a tube's poses in two frames that follow each other (Bar-Shalom,
    Li, Kirubarajan, 2001, Section 5.4); whole pairs of frames are resampled, as tubes share the error of their rack.
    Neighbours, so that slow drift says little. Errors that both frames share cancel: the mean is below 1 where the
    stated covariance holds them, too.

    Args:
        estimates: Rows of estimates.csv.

    Returns:
        One row per method that states covariances, columns INNOVATION_COLUMNS; `consistent` is whether the interval
        reaches down to 1: a mean above tells of covariances that are too small.
    """
    rows: list[dict[str, Any]] = []
    for method, group in _series(estimates).groupby("method", sort=False):
        values, pairs = _squares(group)
        if not len(values):
            continue
        found = paired_bootstrap(values, pairs)
        rows.append({
            "method": method, "nis_mean": found.mean, "ci95_low": found.low, "ci95_high": found.high, "n": found.n,
            "n_frame_pairs": found.n_groups, "consistent": not found.low > 1.0,
        })  # fmt: skip
    return pd.DataFrame(rows, columns=list(INNOVATION_COLUMNS))


def _squares(group: pd.DataFrame) -> tuple[FloatArray, list[int]]:
    values: list[float] = []
    pairs: list[int] = []
    for _, rows in group.groupby("slot", sort=False):
        C = _covariances(rows)
        T, numbers = transforms(rows), rows["number"].to_numpy()
        for i in range(len(T) - 1):
            S = C[i] + C[i + 1]
            if numbers[i + 1] != numbers[i] + 1 or not np.isfinite(S).all():
                continue
            found = pose_errors(T[i : i + 1], T[i + 1 : i + 2])
            d = np.array([float(getattr(found, axis)[0]) for axis in TUBE_AXES])
            d *= [np.pi / 180, np.pi / 180, 1e-3, 1e-3, 1e-3]
            if np.isfinite(d).all() and np.linalg.eigvalsh(S)[0] > 0:
                values.append(float(d @ np.linalg.solve(S, d)) / len(COVARIANCE_AXES))
                pairs.append(int(numbers[i]))
    return np.array(values), pairs


def _covariances(rows: pd.DataFrame) -> FloatArray:
    half = rows.reindex(columns=list(COVARIANCE_COLUMNS)).to_numpy(dtype=float)
    C = np.empty((len(rows), 5, 5))
    i, j = np.triu_indices(5)
    C[:, i, j] = C[:, j, i] = half
    return C


def drifts(estimates: pd.DataFrame, racks: pd.DataFrame) -> pd.DataFrame:
    """Drift and steps over time of the rack in the camera's frame, and of every tube in the rack's frame.

    Per axis a t-test of the slope over the frames, and of a step at any frame (two-sample t-test, Bonferroni over the
    places). The alarm's limit is shared by all axes of all tubes, so that a still series gives none with a chance of
    1 - `FALSE_ALARMS`. A rack that moves and a camera that moves look the same: both are the rack's rows.

    Args:
        estimates: Rows of estimates.csv.
        racks: Rows of racks.csv.

    Returns:
        One row per method, subject (``rack_or_camera`` or ``tube``), slot and axis, columns DRIFT_COLUMNS; `step_at`
        is the number of the first frame after the step.
    """
    rows: list[dict[str, Any]] = []
    known = racks[(racks["status"] == "ok") & racks[list(_POSE)].notna().all(axis=1)]
    known = known.assign(number=frame_numbers(racks)[known.index])
    series = _series(estimates)
    for method, of_rack in known.groupby("method", sort=False):
        of_rack = of_rack.sort_values("number")
        tubes = series[series["method"] == method].merge(
            of_rack[[*FRAME_KEYS, *_POSE]], on=FRAME_KEYS, suffixes=("", "_rack")
        )
        tests = len(RACK_AXES) + len(TUBE_AXES) * tubes["slot"].nunique()
        limit = FALSE_ALARMS / tests
        T = transforms(of_rack)
        rows += _tested(_turns_and_shifts(T), of_rack["number"].to_numpy(), limit,
                        {"method": method, "subject": "rack_or_camera", "slot": ""})  # fmt: skip
        for slot, group in tubes.groupby("slot", sort=False):
            T_rack_tube = np.linalg.inv(transforms(group, "_rack")) @ transforms(group)
            found = pose_errors(np.repeat(mean_transform(T_rack_tube)[None], len(group), axis=0), T_rack_tube)
            values = {axis: np.asarray(getattr(found, axis)) for axis in TUBE_AXES}
            rows += _tested(
                values, group["number"].to_numpy(), limit, {"method": method, "subject": "tube", "slot": slot}
            )
    return pd.DataFrame(rows, columns=list(DRIFT_COLUMNS))


def _tested(values: dict[str, FloatArray], numbers: Any, limit: float, keys: dict[str, Any]) -> list[dict[str, Any]]:
    rows = []
    for axis, series in values.items():
        slope, step, at, p = change_test(np.asarray(numbers, float), series)
        row = {**keys, "axis": axis, "n_frames": len(series), "per_frame": slope, "step": step, "step_at": at, "p": p}
        rows.append({**row, "alarm": p < limit})
    return rows


def change_test(numbers: FloatArray, values: FloatArray) -> tuple[float, float, int | None, float]:
    """Slope per frame, largest step, the frame after it, and the p-value of the likelier of the two.

    Args:
        numbers: Places of the frames in time, shape (N,), rising.
        values: Array of shape (N,), any unit.

    Returns:
        NaN, NaN, None and 1 with fewer than `LEAST_FRAMES` frames or none that differ.
    """
    n = len(values)
    if n < LEAST_FRAMES or not np.isfinite(values).all() or np.ptp(values) < 1e-12:
        return float("nan"), float("nan"), None, 1.0
    line = stats.linregress(numbers, values)
    best = (1.0, 0.0, 0)
    for k in range(2, n - 1):
        before, after = values[:k], values[k:]
        pooled = (before.var() * k + after.var() * (n - k)) / (n - 2)
        step = float(after.mean() - before.mean())
        t = abs(step) / np.sqrt(max(pooled, 1e-30) * (1 / k + 1 / (n - k)))
        best = min(best, (float(2 * stats.t.sf(t, n - 2)), step, k))
    p_step = min(1.0, best[0] * max(n - 3, 1))
    return float(line.slope), best[1], int(numbers[best[2]]), float(min(1.0, 2 * min(float(line.pvalue), p_step)))


def _series(estimates: pd.DataFrame) -> pd.DataFrame:
    """Accepted poses in slots, the first seed of a method, in time; with the number of the frame."""
    rows = estimates.assign(number=frame_numbers(estimates))
    rows = rows[(rows["status"] == "ok") & rows["slot"].notna() & rows[list(_POSE)].notna().all(axis=1)]
    rows = rows[rows["seed"].isna() | (rows["seed"] == rows.groupby("method")["seed"].transform("min"))]
    rows = rows.sort_values("number", kind="stable")
    return rows.drop_duplicates(["method", "slot", *FRAME_KEYS])


def transforms(rows: pd.DataFrame, suffix: str = "") -> FloatArray:
    """Poses (N, 4, 4) from the columns tx_m ... qz with an ending."""
    values = rows[[name + suffix for name in _POSE]].to_numpy(dtype=float)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    if len(rows):
        T[:, :3, :3] = Rotation.from_quat(values[:, [4, 5, 6, 3]]).as_matrix()
        T[:, :3, 3] = values[:, :3]
    return T


def mean_transform(T: FloatArray) -> FloatArray:
    """Chordal mean of poses (N, 4, 4), shape (4, 4) (Markley et al., 2007)."""
    mean = np.eye(4)
    mean[:3, :3] = Rotation.from_matrix(T[:, :3, :3]).mean().as_matrix()
    mean[:3, 3] = T[:, :3, 3].mean(axis=0)
    return mean


def _turns_and_shifts(T: FloatArray) -> dict[str, FloatArray]:
    """Rotation vector (deg) and shift (mm) of poses against their mean, in its frame."""
    D = np.linalg.inv(mean_transform(T)) @ T
    turn_deg = np.rad2deg(Rotation.from_matrix(D[:, :3, :3]).as_rotvec())
    return dict(zip(RACK_AXES, (*turn_deg.T, *(D[:, :3, 3] * 1e3).T), strict=True))
