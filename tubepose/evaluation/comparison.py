"""Method against method on the same tubes: paired differences, with bootstrap intervals over captures."""

from __future__ import annotations

from typing import Any

import pandas as pd

from tubepose.evaluation.matching import AXES, TRIAL
from tubepose.statistics import DRAWS, paired_bootstrap

COMPARISON_COLUMNS = (
    "method", "reference", "tube", "error", "mean_difference", "ci95_low", "ci95_high", "n_pairs", "n_captures",
)  # fmt: skip


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
    keys = ["tube", *TRIAL, "slot"]
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
