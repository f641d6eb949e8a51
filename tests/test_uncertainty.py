"""Whether a method knows how wrong it is: tables from rows made by hand, covariances from sampled errors."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from tubepose.evaluation.matching import _covariances
from tubepose.pose_errors import COVARIANCE_AXES, COVARIANCE_COLUMNS, squared_mahalanobis
from tubepose.records import covariance_columns
from tubepose.transforms import FloatArray, make_transform
from tubepose.uncertainty import COVERAGE_COLUMNS, UNCERTAINTY_COLUMNS, coverage, uncertainty

# Squared Mahalanobis distances


def covariance_of(seed: int) -> FloatArray:
    root = np.random.default_rng(seed).normal(size=(5, 5)) * np.array([3e-3, 3e-3, 2e-4, 2e-4, 1e-4])[:, None]
    return np.asarray(root @ root.T + np.diag(np.square([1e-3, 1e-3, 1e-4, 1e-4, 1e-4])))


def pose_at(seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    return make_transform(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 0.3, 3))


def moved(T: FloatArray, error: FloatArray, spin_rad: float = 0.0) -> FloatArray:
    """Truths that are off by (rx, ry, tx, ty, tz) in the estimate's frame, turned about their own axis."""
    R = Rotation.from_rotvec([error[0], error[1], 0.0]) * Rotation.from_euler("z", spin_rad)
    return np.asarray(T @ make_transform(R.as_matrix(), error[2:]))


@pytest.mark.parametrize("seed", [0, 1])
def test_squares_of_sampled_errors_follow_the_chi_square_law(seed: int) -> None:
    count, covariance, T = 4000, covariance_of(seed), pose_at(seed)
    rng = np.random.default_rng(seed)
    errors = rng.multivariate_normal(np.zeros(5), covariance, count)
    truth = np.array([moved(T, error, spin) for error, spin in zip(errors, rng.uniform(0, 6, count), strict=True)])
    squares = squared_mahalanobis(truth, np.tile(T, (count, 1, 1)), np.tile(covariance, (count, 1, 1)))
    assert squares.mean() == pytest.approx(5, abs=0.25)
    for share in (0.5, 0.9, 0.95):
        assert np.mean(squares < chi2.ppf(share, 5)) == pytest.approx(share, abs=0.025)
    halved = squared_mahalanobis(truth, np.tile(T, (count, 1, 1)), np.tile(covariance / 4, (count, 1, 1)))
    assert halved == pytest.approx(4 * squares)


def test_each_axis_by_hand() -> None:
    stds = np.array([1e-3, 2e-3, 1e-4, 2e-4, 3e-4])
    T = pose_at(3)
    for axis, std in enumerate(stds):
        error = np.zeros(5)
        error[axis] = 3 * std
        (square,) = squared_mahalanobis(moved(T, error)[None], T[None], np.diag(stds**2)[None])
        assert square == pytest.approx(9, rel=1e-6)


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000), spin=st.floats(-3.1, 3.1))
def test_neither_the_camera_nor_the_truths_spin_changes_a_square(seed: int, spin: float) -> None:
    T, covariance, T_moved = pose_at(seed), covariance_of(seed), pose_at(seed + 1)
    error = np.random.default_rng(seed).multivariate_normal(np.zeros(5), covariance)
    (square,) = squared_mahalanobis(moved(T, error)[None], T[None], covariance[None])
    (again,) = squared_mahalanobis(T_moved @ moved(T, error, spin)[None], T_moved @ T[None], covariance[None])
    assert again == pytest.approx(square, rel=1e-6, abs=1e-9)
    assert square == pytest.approx(error @ np.linalg.solve(covariance, error), rel=1e-6)


def test_without_a_pose_or_a_covariance_there_is_no_square() -> None:
    T, covariance = np.tile(np.eye(4), (3, 1, 1)), np.tile(np.eye(5), (3, 1, 1))
    lost, unstated = T.copy(), covariance.copy()
    lost[0], unstated[1] = np.nan, np.nan
    assert np.isnan(squared_mahalanobis(T, lost, unstated)).tolist() == [True, True, False]
    singular = np.tile(np.eye(5), (3, 1, 1))
    singular[0], singular[1] = 0.0, -np.eye(5)
    assert np.isnan(squared_mahalanobis(T, T, singular)).tolist() == [True, True, False]


# Columns


@settings(max_examples=30)
@given(seed=st.integers(0, 10_000))
def test_covariances_come_back_from_their_columns(seed: int) -> None:
    covariance = covariance_of(seed)
    row = covariance_columns(covariance)
    assert list(row) == list(COVARIANCE_COLUMNS)
    assert np.array_equal(_covariances(pd.DataFrame([row]))[0], (covariance + covariance.T) / 2)


def test_columns_are_named_by_what_they_hold() -> None:
    numbers = np.arange(25.0).reshape(5, 5)
    row = covariance_columns(numbers + numbers.T)
    for i, a in enumerate(COVARIANCE_AXES):
        for j, b in enumerate(COVARIANCE_AXES[i:], i):
            assert row[f"cov_{a}_{b}"] == numbers[i, j] + numbers[j, i]
    assert len(row) == 15
    assert np.isnan(list(covariance_columns(None).values())).all()


# Tables


def rows(
    method: str, tube: str, squares: list[float], tilts: list[float], sure: list[float], outcome: str = "ok"
) -> Any:
    return pd.DataFrame(
        {
            "method": method,
            "tube": tube,
            "outcome": outcome,
            "confidence": sure,
            "right": pd.array([tilt <= 0.5 for tilt in tilts], dtype="boolean"),
            "tilt_deg": tilts,
            "mahalanobis2": squares,
        }
    )


ERRORS = pd.concat(
    [
        rows("profile", "b", [1.0, 5.0, 20.0, 4.0], [0.1, 0.2, 0.9, 0.4], [0.9, 0.7, 0.1, 0.5]),
        rows("profile", "a", [2.0], [0.3], [0.6]),
        rows("profile", "a", [99.0], [5.0], [0.99], outcome="rejected"),
        rows("paper", "a", [np.nan, np.nan], [0.5, 0.7], [np.nan, np.nan]),
    ],
    ignore_index=True,
)


def test_honesty_by_hand() -> None:
    found = uncertainty(ERRORS).set_index(["method", "tube"])
    assert list(uncertainty(ERRORS)) == list(UNCERTAINTY_COLUMNS)
    assert list(found.index) == [("profile", "a"), ("profile", "b"), ("profile", "all")]
    of_b = found.loc[("profile", "b")]
    assert of_b["n"] == 4
    assert of_b["inside_95"] == 0.75  # 20 is above 11.07
    assert of_b["mahalanobis2_mean"] == 7.5
    assert of_b["confidence_mean"] == pytest.approx(0.55)
    assert of_b["right_share"] == 0.75  # the tilt of 0.9 deg is wrong here
    assert of_b["tilt_deg_all"] == pytest.approx(0.4)
    assert of_b["tilt_deg_best_half"] == pytest.approx(0.15)
    assert of_b["tilt_deg_worst_half"] == pytest.approx(0.65)
    of_all = found.loc[("profile", "all")]
    assert of_all["n"] == 5
    assert of_all["tilt_deg_best_half"] == pytest.approx(np.mean([0.1, 0.2, 0.3]))
    assert np.isnan(found.loc[("profile", "a"), "tilt_deg_worst_half"])


@pytest.mark.parametrize(("square", "inside"), [(chi2.ppf(0.95, 5) - 1e-6, 1.0), (chi2.ppf(0.95, 5) + 1e-6, 0.0)])
def test_the_region_ends_at_eleven(square: float, inside: float) -> None:
    found = uncertainty(rows("profile", "a", [square], [0.1], [0.5]))
    assert found["inside_95"].tolist() == [inside, inside]


def test_coverage_by_hand() -> None:
    found = coverage(ERRORS)
    assert list(found) == list(COVERAGE_COLUMNS)
    of_b = found[(found["method"] == "profile") & (found["tube"] == "b")]
    assert of_b["coverage"].tolist() == [1.0, 0.75, 0.5, 0.25]
    assert of_b["confidence"].tolist() == [0.1, 0.5, 0.7, 0.9]
    assert of_b["tilt_deg_mean"].tolist() == pytest.approx([0.4, 0.7 / 3, 0.15, 0.1])
    assert of_b["tilt_deg_max"].tolist() == [0.9, 0.4, 0.2, 0.1]
    # A method that states no covariance has no confidence either.
    assert set(found["method"]) == {"profile"}


@pytest.mark.parametrize("make", [uncertainty, coverage])
def test_nothing_accepted_gives_empty_tables(make: Any) -> None:
    found = make(ERRORS[ERRORS["outcome"] == "rejected"])
    assert len(found) == 0
    assert len(list(found)) > 4


def test_ten_levels_of_many_answers_fall_from_all_to_a_tenth() -> None:
    scores = np.linspace(0, 1, 200)
    found = coverage(rows("profile", "a", [1.0] * 200, list(1 - scores), list(scores)))
    of_a = found[found["tube"] == "a"]
    assert of_a["coverage"].tolist() == pytest.approx([1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1])
    assert (np.diff(of_a["tilt_deg_mean"]) < 0).all()
