"""Whether a method knows how wrong it is: stated covariances and confidences against errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from scipy.stats import chi2

from tubepose.pose_errors import COVARIANCE_AXES
from tubepose.statistics import coverage_curve

REGION = 0.95
ALL_TUBES = "all"
UNCERTAINTY_COLUMNS = (
    "method", "tube", "n", "inside_95", "mahalanobis2_mean", "confidence_mean", "right_share",
    "tilt_deg_all", "tilt_deg_best_half", "tilt_deg_worst_half",
)  # fmt: skip
COVERAGE_COLUMNS = ("method", "tube", "coverage", "confidence", "tilt_deg_mean", "tilt_deg_max")
SHARES = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)


def uncertainty(errors: pd.DataFrame) -> pd.DataFrame:
    """How honest the stated covariances are, per method that states them and per tube.

    Args:
        errors: Rows of errors.csv; only those count that are ``ok`` and state a covariance.

    Returns:
        Rows of uncertainty.csv: share of the truths inside the 95 % region of the five stated errors, mean of their
        squared Mahalanobis distances (5 if honest); the mean confidence and the share that is right, the same if
        confidences are calibrated; the mean tilt error of all answers and of the halves with the higher and the lower
        confidence. The tube ``all`` stands for all together.
    """
    rows: list[dict[str, Any]] = []
    limit = float(chi2.ppf(REGION, len(COVARIANCE_AXES)))
    for method, tube, group in _groups(errors):
        group = group[group["mahalanobis2"].notna()]
        squares = group["mahalanobis2"]
        if len(squares) == 0:
            continue
        ordered = group.sort_values("confidence", ascending=False, kind="stable")["tilt_deg"]
        half = (len(ordered) + 1) // 2
        rows.append(
            {
                "method": method,
                "tube": tube,
                "n": len(squares),
                "inside_95": float((squares <= limit).mean()),
                "mahalanobis2_mean": float(squares.mean()),
                "confidence_mean": float(group["confidence"].mean()),
                "right_share": float(group["right"].mean()) if group["right"].notna().any() else float("nan"),
                "tilt_deg_all": float(ordered.mean()),
                "tilt_deg_best_half": float(ordered.iloc[:half].mean()),
                "tilt_deg_worst_half": float(ordered.iloc[half:].mean()),
            }
        )
    return pd.DataFrame(rows, columns=list(UNCERTAINTY_COLUMNS))


def coverage(errors: pd.DataFrame) -> pd.DataFrame:
    """Mean tilt error of the answers that are kept when the least confident ones are dropped.

    Args:
        errors: Rows of errors.csv; only those count that are ``ok`` and have a confidence.

    Returns:
        Rows of coverage.csv, per method, tube (and ``all``) and share kept, the nearest one that confidences allow.
    """
    rows: list[dict[str, Any]] = []
    for method, tube, group in _groups(errors):
        curve = coverage_curve(group["confidence"].to_numpy(float), group["tilt_deg"].to_numpy(float))
        if len(curve.coverage) == 0:
            continue
        for at in sorted({int(np.abs(curve.coverage - share).argmin()) for share in SHARES}, reverse=True):
            rows.append(
                {
                    "method": method,
                    "tube": tube,
                    "coverage": curve.coverage[at],
                    "confidence": curve.threshold[at],
                    "tilt_deg_mean": curve.mean_error[at],
                    "tilt_deg_max": curve.max_error[at],
                }
            )
    return pd.DataFrame(rows, columns=list(COVERAGE_COLUMNS))


def _groups(errors: pd.DataFrame) -> list[tuple[str, str, pd.DataFrame]]:
    """The ok rows of every method, tube by tube and all together."""
    ok = errors[errors["outcome"] == "ok"]
    found = []
    for method in ok["method"].unique():
        of = ok[ok["method"] == method]
        found += [(str(method), str(tube), of[of["tube"] == tube]) for tube in sorted(of["tube"].unique())]
        found.append((str(method), ALL_TUBES, of))
    return found
