from __future__ import annotations

import numpy as np
import pytest

from tubepose.statistics import coverage_curve, paired_bootstrap, weighted_mean


def test_the_interval_is_that_of_a_mean_when_every_group_has_one_value():
    values = np.random.default_rng(1).normal(2.0, 1.0, 200)
    found = paired_bootstrap(values, np.arange(200))
    half = 1.96 * values.std() / np.sqrt(200)
    assert found.mean == values.mean()
    assert found.low == pytest.approx(values.mean() - half, abs=0.02)
    assert found.high == pytest.approx(values.mean() + half, abs=0.02)
    assert (found.n, found.n_groups) == (200, 200)


def test_values_that_share_a_groups_error_do_not_narrow_the_interval():
    shared = np.random.default_rng(2).normal(0.0, 1.0, 20)
    values, groups = np.repeat(shared, 10), np.repeat(np.arange(20), 10)
    honest, naive = paired_bootstrap(values, groups), paired_bootstrap(values, np.arange(200))
    assert (honest.high - honest.low) > 2.5 * (naive.high - naive.low)
    alone = paired_bootstrap(shared, np.arange(20))
    assert (honest.low, honest.high) == pytest.approx((alone.low, alone.high))


def test_the_interval_holds_the_true_mean_about_as_often_as_it_says():
    rng = np.random.default_rng(3)
    hits = 0
    for i in range(200):
        found = paired_bootstrap(rng.normal(0.0, 1.0, 40), np.arange(40), draws=500, seed=i)
        hits += found.low <= 0.0 <= found.high
    assert 176 <= hits <= 199


def test_captures_with_many_and_few_tubes_count_by_their_tubes():
    found = paired_bootstrap(np.full(13, 0.7), ["a"] * 10 + ["b", "c", "d"])
    assert (found.mean, found.low, found.high) == pytest.approx((0.7, 0.7, 0.7))


def test_the_seed_decides_and_the_order_of_the_rows_does_not():
    values = np.random.default_rng(4).normal(size=30)
    groups = [("s", f"t{i % 7}") for i in range(30)]
    assert paired_bootstrap(values, groups, seed=5) == paired_bootstrap(values, groups, seed=5)
    assert paired_bootstrap(values, groups, seed=5).low != paired_bootstrap(values, groups, seed=6).low
    back = paired_bootstrap(values[::-1], groups[::-1], seed=5)
    assert (back.low, back.high) == pytest.approx((paired_bootstrap(values, groups, seed=5).low, back.high))


def test_many_groups_are_drawn_in_pieces(monkeypatch):
    values = np.random.default_rng(6).normal(size=50)
    whole = paired_bootstrap(values, np.arange(50), draws=1000)
    monkeypatch.setattr("tubepose.statistics._MAX_CELLS", 5000)
    assert paired_bootstrap(values, np.arange(50), draws=1000) == whole


def test_one_capture_gives_no_interval_and_no_value_gives_no_mean():
    one = paired_bootstrap(np.array([1.0, 2.0]), ["a", "a"])
    assert one.mean == 1.5
    assert np.isnan([one.low, one.high]).all()
    none = paired_bootstrap(np.array([]), [])
    assert np.isnan(none.mean)
    assert (none.n, none.n_groups) == (0, 0)


def test_broken_input_is_refused():
    with pytest.raises(ValueError, match="as many groups as differences, found 1 and 2"):
        paired_bootstrap(np.zeros(2), ["a"])
    with pytest.raises(ValueError, match="expected finite differences"):
        paired_bootstrap(np.array([np.nan]), ["a"])
    with pytest.raises(ValueError, match="as many errors as scores"):
        coverage_curve(np.zeros(2), np.zeros(3))


def test_a_perfect_score_gives_a_rising_curve():
    curve = coverage_curve(np.array([0.1, 0.9, 0.5]), np.array([3.0, 1.0, 2.0]))
    assert curve.threshold.tolist() == [0.9, 0.5, 0.1]
    assert curve.coverage.tolist() == pytest.approx([1 / 3, 2 / 3, 1.0])
    assert curve.mean_error.tolist() == [1.0, 1.5, 2.0]
    assert curve.max_error.tolist() == [1.0, 2.0, 3.0]


def test_equal_scores_are_kept_together_and_nan_is_left_out():
    curve = coverage_curve(np.array([0.5, 0.5, np.nan, 0.7]), np.array([1.0, 3.0, 9.0, 0.0]))
    assert curve.threshold.tolist() == [0.7, 0.5]
    assert curve.mean_error.tolist() == pytest.approx([0.0, 4 / 3])
    empty = coverage_curve(np.array([np.nan]), np.array([1.0]))
    assert empty.coverage.shape == (0,)


def test_a_weighted_mean_by_hand_and_what_contradicts_itself():
    assert weighted_mean(np.array([1.0, 3.0]), np.array([1.0, 2.0])) == pytest.approx((1.4, np.sqrt(0.8)))
    assert weighted_mean(np.array([2.5]), np.array([0.3])) == pytest.approx((2.5, 0.3))
    # Ten standard deviations apart: the mean is as sure as half of that.
    assert weighted_mean(np.array([0.0, 10.0]), np.array([1.0, 1.0])) == pytest.approx((5.0, 5.0))
