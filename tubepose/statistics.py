"""What a difference of means is worth, and whether a score is worth anything."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tubepose.transforms import FloatArray

DRAWS = 10_000
_MAX_CELLS = 4_000_000


@dataclass(frozen=True, slots=True)
class BootstrapInterval:
    """A mean and its 95 % interval.

    Attributes:
        mean: Mean of all values, in their unit; NaN without values.
        low: 2.5 % quantile of the resampled means; NaN with fewer than two groups.
        high: 97.5 % quantile; NaN with fewer than two groups.
        n: Number of values.
        n_groups: Number of groups.
    """

    mean: float
    low: float
    high: float
    n: int
    n_groups: int


@dataclass(frozen=True, slots=True, eq=False)
class CoverageCurve:
    """Mean error of what is kept when the lowest scores are dropped.

    Attributes:
        threshold: Lowest score kept, shape (K,), falling; every distinct score once.
        coverage: Share of the answers kept, shape (K,), 0 to 1, rising.
        mean_error: Mean error of the answers kept, shape (K,), in the unit of the error.
        max_error: Largest error of the answers kept, shape (K,).
    """

    threshold: FloatArray
    coverage: FloatArray
    mean_error: FloatArray
    max_error: FloatArray


def paired_bootstrap(
    differences: FloatArray, groups: Sequence[Any] | NDArray[Any], draws: int = DRAWS, seed: int = 0
) -> BootstrapInterval:
    """Mean of paired differences with a 95 % percentile interval, resampling whole groups.

    Tubes of one capture share the error of its rack and are not independent; so captures are drawn, not tubes.

    Args:
        differences: Array of shape (N,), finite, any unit.
        groups: What each difference belongs to (its capture), N hashable, sortable labels.
        draws: Number of resamples.
        seed: Seed; the same seed gives the same interval.
    """
    values = np.asarray(differences, dtype=float)
    if len(values) != len(groups):
        raise ValueError(f"expected as many groups as differences, found {len(groups)} and {len(values)}")
    if not np.isfinite(values).all():
        raise ValueError("expected finite differences")
    numbers = {label: i for i, label in enumerate(sorted(set(groups)))}
    index = np.array([numbers[label] for label in groups], dtype=int)
    count, mean = len(numbers), float(values.mean()) if len(values) else float("nan")
    if count < 2:
        return BootstrapInterval(mean, float("nan"), float("nan"), len(values), count)
    sums, sizes = np.bincount(index, weights=values), np.bincount(index)
    rng, means = np.random.default_rng(seed), np.empty(draws)
    step = max(1, _MAX_CELLS // count)
    for start in range(0, draws, step):
        times = rng.multinomial(count, np.full(count, 1 / count), size=min(step, draws - start))
        means[start : start + len(times)] = (times @ sums) / (times @ sizes)
    low, high = np.quantile(means, [0.025, 0.975])
    return BootstrapInterval(mean, float(low), float(high), len(values), count)


def coverage_curve(score: FloatArray, error: FloatArray) -> CoverageCurve:
    """Mean and largest error against the share of answers kept, best scores first.

    A score that is worth something gives a mean error that falls when coverage falls. Answers with the same score are
    kept or dropped together; pairs with a NaN are left out.

    Args:
        score: Array of shape (N,), larger is more trustworthy.
        error: Array of shape (N,), the errors of the same answers.
    """
    scores, errors = np.asarray(score, dtype=float), np.asarray(error, dtype=float)
    if scores.shape != errors.shape:
        raise ValueError(f"expected as many errors as scores, found {errors.shape} and {scores.shape}")
    keep = np.isfinite(scores) & np.isfinite(errors)
    order = np.argsort(-scores[keep], kind="stable")
    scores, errors = scores[keep][order], errors[keep][order]
    last = np.flatnonzero(np.append(scores[1:] != scores[:-1], True)[: len(scores)])
    return CoverageCurve(
        threshold=scores[last],
        coverage=(last + 1) / max(len(scores), 1),
        mean_error=np.cumsum(errors)[last] / (last + 1),
        max_error=np.maximum.accumulate(errors)[last],
    )


def weighted_mean(values: FloatArray, stds: FloatArray) -> tuple[float, float]:
    """Mean by inverse variances and its standard deviation, larger where values scatter more than they state (Birge).

    Args:
        values: Array of shape (N,), N at least one.
        stds: Their standard deviations, shape (N,).
    """
    weights = 1 / np.maximum(stds, 1e-12) ** 2
    mean = float(weights @ values / weights.sum())
    birge = np.sqrt(weights @ (values - mean) ** 2 / max(len(values) - 1, 1))
    return mean, float(max(birge, 1.0) / np.sqrt(weights.sum()))
