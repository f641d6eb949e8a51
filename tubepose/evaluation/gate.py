"""Gates: is a run worse than another one, tube by tube? Counts are looked at before means."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.stats import chi2

from tubepose.errors import ConfigError
from tubepose.evaluation.matching import TRIAL
from tubepose.evaluation.paired_tubes import ABSENT, captures_of, expected_tubes, pair_tubes, sign_flip_p
from tubepose.pose_errors import COVARIANCE_AXES
from tubepose.statistics import BootstrapInterval, paired_bootstrap

GATES = ("kept", "wrong", "error", "coverage", "time")
ALARM_RATE = 0.05
"""Chance that an unchanged method fails any of the gates of a run."""
LEAST_CAPTURES = 8
"""With fewer captures no test can tell chance from change: any loss counts."""
INSIDE_95_RANGE = (0.92, 0.98)
GATED_ERRORS = ("tilt_deg", "cap_mm", "axial_mm")
_TESTS = 3 + len(GATED_ERRORS)
_ROUNDING = 1e-5
"""Relative changes below it are those of a baseline file's digits, and count as none."""


@dataclass(frozen=True, slots=True)
class GateResult:
    """What one gate says of one method.

    Attributes:
        gate: One of GATES.
        method: The method.
        passed: Whether it is no worse.
        before: Figure of the baseline, or its limit.
        after: Figure of the run.
        reason: In words, with interval or p-value.
    """

    gate: str
    method: str
    passed: bool
    before: str
    after: str
    reason: str


def read_gates(text: str) -> dict[str, float | None]:
    """Gates of a comma-separated list, with the limit behind a colon where there is one: ``kept,wrong,time:1.2``.

    Raises:
        ConfigError: A gate is unknown, is named twice, or has a limit that is no positive number.
    """
    gates: dict[str, float | None] = {}
    for word in (part.strip() for part in text.split(",")):
        name, colon, limit = word.partition(":")
        if name not in GATES or name in gates:
            why = "named twice" if name in gates else "unknown"
            raise ConfigError(f"--fail-if: gate '{name}' is {why}; known: {', '.join(GATES)}, as kept,wrong,time:1.2")
        try:
            value = float(limit) if colon else None
        except ValueError:
            value = float("nan")
        if value is not None and not (np.isfinite(value) and value >= 0):
            raise ConfigError(f"--fail-if: '{word}'; expected a number after the colon, as in time:1.2")
        gates[name] = value
    return gates


def gate_counts_alone(errors: pd.DataFrame, method: str, gates: Mapping[str, float | None]) -> list[GateResult]:
    """Gates that need no other run: `kept` (share answered), `wrong` (share of answers) and `coverage`.

    Args:
        errors: Rows of errors.csv.
        method: The method to judge.
        gates: Result of `read_gates`; `kept:0.9` asks for nine of ten, `kept` alone for one answer, `wrong:0.02` allows
            one of fifty, `wrong` alone none.
    """
    rows, results = expected_tubes(errors, method), []
    kept, wrong = int(rows["kept"].sum()), int(rows["wrong"].sum()) + len(_false(errors, method))
    if "kept" in gates:
        least = gates["kept"] or 0.0
        ok = kept > 0 and kept >= least * len(rows)
        limit = f"{least:.0%} or more" if least else "any"
        results.append(GateResult("kept", method, ok, limit, f"{kept}/{len(rows)}", "" if ok else "too few answered"))
    if "wrong" in gates:
        most = gates["wrong"] or 0.0
        ok = wrong <= most * max(kept, 1)
        words = f"{most:.1%} of answers or fewer"
        results.append(
            GateResult("wrong", method, ok, words, f"{wrong}/{kept}", "" if ok else "too many wrong answers")
        )
    if "coverage" in gates:
        results.append(_coverage_gate(errors, method))
    return results


def gate_pair(
    before: pd.DataFrame, after: pd.DataFrame, methods: tuple[str, str], gates: Mapping[str, float | None]
) -> list[GateResult]:
    """Gates between two runs, paired by tube; tests are one-sided sign flips over captures.

    Each of the six tests fails an unchanged method with a chance of 1/120, so that together they do in 5 % of runs at
    most (Bonferroni). With fewer than `LEAST_CAPTURES` captures any loss, and any wrong answer more, counts.

    Args:
        before: Rows of errors.csv of the baseline.
        after: Rows of errors.csv of the run.
        methods: The method in the first and in the second.
        gates: Result of `read_gates`.
    """
    pairs, results = pair_tubes(before, after, methods), []
    if (pairs["outcome_after"] == ABSENT).all():
        raise ConfigError(f"{methods[1]}: the runs share no tube; are they of the same sessions?")
    if "kept" in gates:
        results.append(_kept_gate(pairs, methods[1]))
    if "wrong" in gates:
        results.append(_wrong_gate(pairs, before, after, methods))
    if "error" in gates:
        results += [_error_gate(pairs, methods[1], name) for name in GATED_ERRORS]
    if "coverage" in gates:
        results.append(_coverage_gate(after, methods[1], pairs))
    return results


def _limit() -> float:
    return ALARM_RATE / _TESTS


def _count_gate(
    gate: str, method: str, worse: pd.Series[int], totals: tuple[str, str], groups: Sequence[tuple[str, str]]
) -> GateResult:
    net, captures = int(worse.sum()), len(set(groups))
    if captures < LEAST_CAPTURES:
        words = f"{net:+d} with {captures} captures, too few for a test: any loss counts" if net > 0 else ""
        return GateResult(gate, method, net <= 0, *totals, words)
    p = sign_flip_p(np.asarray(worse, dtype=np.float64), groups)
    failed = net > 0 and p < _limit()
    return GateResult(gate, method, not failed, *totals, f"{net:+d} net of {len(worse)}, p = {p:.2g}" if net else "")


def _kept_gate(pairs: pd.DataFrame, method: str) -> GateResult:
    lost = pairs["kept_before"].astype(int) - pairs["kept_after"].astype(int)
    before, after = (f"{int(pairs[f'kept_{end}'].sum())}/{len(pairs)}" for end in ("before", "after"))
    if not pairs["kept_after"].any():
        return GateResult("kept", method, False, before, after, "nothing is answered")
    return _count_gate("kept", method, lost, (before, after), captures_of(pairs))


def _wrong_gate(pairs: pd.DataFrame, before: pd.DataFrame, after: pd.DataFrame, methods: tuple[str, str]) -> GateResult:
    of_tubes = pairs["wrong_after"].astype(int) - pairs["wrong_before"].astype(int)
    groups, values = captures_of(pairs), [of_tubes]
    trials, totals = set(groups), []
    for sign, errors, method, end in ((-1, before, methods[0], "before"), (1, after, methods[1], "after")):
        false = [key for key in captures_of(_false(errors, method)) if key in trials]
        values.append(pd.Series(sign, index=range(len(false)), dtype=int))
        groups = [*groups, *false]
        totals.append(f"{int(pairs[f'wrong_{end}'].sum()) + len(false)}")
    return _count_gate("wrong", methods[1], pd.concat(values, ignore_index=True), (totals[0], totals[1]), groups)


def _error_gate(pairs: pd.DataFrame, method: str, name: str) -> GateResult:
    both = pairs[
        pairs["kept_before"] & pairs["kept_after"] & pairs[[f"{name}_before", f"{name}_after"]].notna().all(axis=1)
    ]
    before, after = (both[f"{name}_{end}"].abs().to_numpy(float) for end in ("before", "after"))
    if not len(both):
        return GateResult(f"error {name}", method, True, "-", "-", "no tube is answered in both")
    groups = captures_of(both)
    change = np.where(np.abs(after - before) <= _ROUNDING * np.maximum(before, after), 0.0, after - before)
    found, p = paired_bootstrap(change, groups), sign_flip_p(change, groups)
    beyond = found.low > 0 if found.n_groups > 1 else found.mean > 0
    failed = beyond and (p < _limit() or found.n_groups < LEAST_CAPTURES)
    words = f"mean change {found.mean:+.4f} [{found.low:+.4f}, {found.high:+.4f}] over {found.n} tubes, p = {p:.2g}"
    return GateResult(f"error {name}", method, not failed, f"{before.mean():.4f}", f"{after.mean():.4f}", words)


def _coverage_gate(errors: pd.DataFrame, method: str, pairs: pd.DataFrame | None = None) -> GateResult:
    """Inside 95 % by its interval, and, with a pair, stated errors that shrank against the seen ones."""
    found = inside_95(errors, method)
    low, high = INSIDE_95_RANGE
    if not found.n:
        return GateResult("coverage", method, True, f"{low:.0%} to {high:.0%}", "-", "no covariance is stated")
    if found.n_groups < LEAST_CAPTURES:
        meets, words = True, f"{found.n_groups} captures, too few for an interval"
    else:
        meets, words = found.low <= high and found.high >= low, f"95 % interval {found.low:.1%} to {found.high:.1%}"
    shown = f"{found.mean:.1%} of {found.n}"
    if meets and pairs is not None:
        both = pairs[pairs["kept_before"] & pairs["kept_after"]].dropna(
            subset=["mahalanobis2_before", "mahalanobis2_after"]
        )
        grown = np.log(both["mahalanobis2_after"].to_numpy(float)) - np.log(both["mahalanobis2_before"].to_numpy(float))
        grown = np.where(np.isfinite(grown) & (np.abs(grown) > _ROUNDING), grown, 0.0)
        p = sign_flip_p(grown, captures_of(both)) if len(both) else 1.0
        if p < _limit() and found.mean < high:
            meets = False
            words = f"{words}; seen over stated errors grew by {np.exp(np.median(grown) / 2) - 1:.1%}, p = {p:.2g}"
    return GateResult("coverage", method, meets, f"{low:.0%} to {high:.0%}", shown, words)


def inside_95(errors: pd.DataFrame, method: str) -> BootstrapInterval:
    """Share of the truths inside the stated 95 % region, with its bootstrap interval over captures.

    Args:
        errors: Rows of errors.csv.
        method: The method.
    """
    rows = errors[(errors["method"] == method) & (errors["outcome"] == "ok") & errors["mahalanobis2"].notna()]
    inside = np.asarray(rows["mahalanobis2"] <= chi2.ppf(0.95, len(COVARIANCE_AXES)), dtype=np.float64)
    return paired_bootstrap(inside, captures_of(rows))


def _false(errors: pd.DataFrame, method: str) -> pd.DataFrame:
    return errors.loc[(errors["method"] == method) & (errors["outcome"] == "false"), TRIAL]
