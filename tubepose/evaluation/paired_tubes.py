"""Two runs paired by tube: what became of every tube, and a sign-flip test over captures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from tubepose.evaluation.matching import TRIAL
from tubepose.transforms import FloatArray

PAIR_KEYS = [*TRIAL, "slot", "tube", "seed_key"]
PAIRED_ERRORS = ("tilt_deg", "cap_mm", "lateral_mm", "axial_mm")
CHANGE_COLUMNS = (
    "run", "method", *TRIAL, "slot", "tube", "seed", "before", "after", "kept_before", "kept_after", "wrong_before",
    "wrong_after", *(f"{name}_{end}" for name in PAIRED_ERRORS for end in ("before", "after")), "cap_mm_change",
)  # fmt: skip
FLIPS = 10_000
ABSENT = "absent"
"""Outcome of a tube that the second run did not expect."""


def expected_tubes(errors: pd.DataFrame, method: str) -> pd.DataFrame:
    """The expected tubes of a method with the columns ``kept`` (answered) and ``wrong`` (answered, and not right).

    Args:
        errors: Rows of errors.csv.
        method: The method.
    """
    rows = errors[(errors["method"] == method) & (errors["outcome"] != "false")]
    kept = rows["outcome"] == "ok"
    right = rows["right"].astype("boolean").fillna(False).astype(bool)
    seed = rows["seed"].astype("Int64").fillna(-1).astype("int64")
    return rows.assign(kept=kept, wrong=kept & ~right, seed_key=seed)


def pair_tubes(before: pd.DataFrame, after: pd.DataFrame, methods: tuple[str, str]) -> pd.DataFrame:
    """Tubes that the first run expected, once each, values with the endings ``_before`` and ``_after``.

    A tube that the second run did not expect is `ABSENT` there, and not kept: a run cannot win by leaving captures out.

    Args:
        before: Rows of errors.csv of the run that is compared with.
        after: Rows of errors.csv of the run in question.
        methods: The method of the first and of the second.
    """
    values = ["outcome", "kept", "wrong", *PAIRED_ERRORS, "mahalanobis2"]
    first, second = (
        expected_tubes(errors, method)[[*PAIR_KEYS, *values]]
        for errors, method in zip((before, after), methods, strict=True)
    )
    pairs = first.merge(second, how="left", on=PAIR_KEYS, suffixes=("_before", "_after"))
    filled = {name: pairs[name].astype("boolean").fillna(False).astype(bool) for name in ("kept_after", "wrong_after")}
    return pairs.assign(outcome_after=pairs["outcome_after"].fillna(ABSENT), **filled)


def captures_of(pairs: pd.DataFrame) -> list[tuple[str, str]]:
    """Which capture each pair is of: tubes of one share the error of its rack."""
    return list(zip(pairs["session"].astype(str), pairs["trial"].astype(str), strict=True))


def tube_changes(pairs: pd.DataFrame, run: str, method: str) -> pd.DataFrame:
    """What became of every tube, the worst change first: lost, then wrong, then by the growth of the error at the cap.

    Args:
        pairs: Result of `pair_tubes`.
        run: Name of the run in question.
        method: Its method.
    """
    change_mm = (pairs["cap_mm_after"].abs() - pairs["cap_mm_before"].abs()).astype(float)
    lost = pairs["kept_before"].astype(int) - pairs["kept_after"].astype(int)
    turned = pairs["wrong_after"].astype(int) - pairs["wrong_before"].astype(int)
    rows = pairs.assign(
        run=run, method=method, before=pairs["outcome_before"], after=pairs["outcome_after"], cap_mm_change=change_mm,
        seed=pairs["seed_key"].astype("Int64").mask(pairs["seed_key"] < 0), lost=lost, turned=turned,
    )  # fmt: skip
    ordered = rows.sort_values(["lost", "turned", "cap_mm_change"], ascending=False, kind="stable", na_position="last")
    return ordered[list(CHANGE_COLUMNS)].reset_index(drop=True)


def sign_flip_p(differences: FloatArray, groups: Sequence[Any], flips: int = FLIPS, seed: int = 0) -> float:
    """One-sided p-value that the sum of paired differences is above zero: sign-flip permutation test over groups.

    Without a change the sign of a capture's sum is a matter of chance (Fisher, 1935; Good, 2005): signs are drawn, all
    of them where there are no more than 2^13. Captures without a difference say nothing and count as such.

    Args:
        differences: Array of shape (N,), any unit, finite.
        groups: What each difference belongs to (its capture), N hashable labels.
        flips: Number of draws where there are too many signs.
        seed: Seed of the draws.

    Returns:
        p-value, 0 to 1; 1 without any difference.
    """
    sums = pd.Series(np.asarray(differences, float)).groupby(pd.factorize(pd.Series(list(groups)))[0]).sum().to_numpy()
    sums = sums[sums != 0]
    if not len(sums):
        return 1.0
    seen = sums.sum() - 1e-9 * np.abs(sums).sum()
    if 2 ** len(sums) <= 2**13:
        signs = 1.0 - 2.0 * ((np.arange(2 ** len(sums))[:, None] >> np.arange(len(sums))) & 1)
        return float(np.mean(signs @ sums >= seen))
    rng = np.random.default_rng(seed)
    signs = rng.choice([-1.0, 1.0], size=(flips, len(sums)))
    return float((1 + np.sum(signs @ sums >= seen)) / (1 + flips))
