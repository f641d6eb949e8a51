"""Confidence against probabilities that are known in closed form, and against errors that are drawn."""

import numpy as np
import pytest
from scipy.stats import norm

from tubepose.confidence import KNOWN_ALONG_M, WITHIN_M, WITHIN_RAD, confidence, within


def stated(tilt_deg=0.1, lateral_mm=0.1, along_mm=0.1):
    std = [*np.deg2rad([tilt_deg, tilt_deg]), *(1e-3 * np.array([lateral_mm, lateral_mm, along_mm]))]
    return np.diag(np.square(std))


def rayleigh(limit_over_std):
    return 1 - np.exp(-(limit_over_std**2) / 2)


@pytest.mark.parametrize("tilt_deg", [0.5, 1.0, 2.0, 8.0])
def test_a_tilt_alone_has_rayleighs_probability(tilt_deg):
    assert confidence(stated(tilt_deg=tilt_deg)) == pytest.approx([rayleigh(2 / tilt_deg)], abs=0.003)


@pytest.mark.parametrize("lateral_mm", [0.7, 2.0, 5.0])
def test_a_shift_alone_too_and_independent_parts_multiply(lateral_mm):
    across = rayleigh(2 / lateral_mm)
    assert confidence(stated(lateral_mm=lateral_mm)) == pytest.approx([across], abs=0.003)
    both = confidence(stated(tilt_deg=1.5, lateral_mm=lateral_mm))
    assert both == pytest.approx([across * rayleigh(2 / 1.5)], abs=0.004)


def test_along_the_axis_counts_where_it_is_known():
    known = float(norm.cdf(2 / 0.95) - norm.cdf(-2 / 0.95))
    assert confidence(stated(along_mm=0.95)) == pytest.approx([known], abs=0.003)
    assert confidence(stated(along_mm=1.05)) == pytest.approx([1.0], abs=1e-3)
    yes, no = np.array([0.0]), np.array([2 * WITHIN_M])
    assert not within(yes, yes, no, np.array([KNOWN_ALONG_M]))
    assert within(yes, yes, no, np.array([1.01 * KNOWN_ALONG_M]))
    assert not within(yes, yes, no, np.array([np.nan]))


def test_limits():
    zero, std = np.zeros(1), np.zeros(1)
    assert within(np.array([WITHIN_RAD]), np.array([WITHIN_M]), np.array([-WITHIN_M]), std)
    assert not within(np.array([WITHIN_RAD * 1.001]), zero, zero, std)
    assert not within(zero, np.array([WITHIN_M * 1.001]), zero, std)
    assert not within(np.array([np.nan]), zero, zero, std)


def test_errors_that_go_together_are_likelier_to_be_small_together():
    covariance = stated(tilt_deg=2.0, lateral_mm=2.0)
    apart = confidence(covariance)[0]
    # A shift that a turn makes: ry moves the bottom along x, rx along y.
    covariance[0, 3] = covariance[3, 0] = -0.999 * np.sqrt(covariance[0, 0] * covariance[3, 3])
    covariance[1, 2] = covariance[2, 1] = 0.999 * np.sqrt(covariance[1, 1] * covariance[2, 2])
    together = confidence(covariance)[0]
    assert apart == pytest.approx(rayleigh(1.0) ** 2, abs=0.005)
    assert together == pytest.approx(rayleigh(1.0), abs=0.03)


def test_drawn_errors_are_right_as_often_as_stated():
    rng = np.random.default_rng(3)
    factors = rng.normal(size=(200, 5, 5)) * np.array([0.012, 0.012, 7e-4, 7e-4, 2e-4])[:, None]
    covariances = factors @ factors.transpose(0, 2, 1)
    errors = np.einsum("tij,tnj->tni", factors, rng.normal(size=(200, 50, 5)))
    std_along = np.sqrt(covariances[:, 4, 4])[:, None]
    right = within(
        np.hypot(errors[..., 0], errors[..., 1]), np.hypot(errors[..., 2], errors[..., 3]), errors[..., 4], std_along
    )
    stated_mean = confidence(covariances).mean()
    assert 0.2 < stated_mean < 0.8
    assert right.mean() == pytest.approx(stated_mean, abs=0.02)


def test_the_same_numbers_every_time_and_none_for_what_is_not_stated():
    many = np.stack([stated(), np.full((5, 5), np.nan), stated(lateral_mm=3.0)])
    found = confidence(many)
    assert np.isnan(found[1])
    assert np.array_equal(found, confidence(many), equal_nan=True)
    assert len(confidence(np.empty((0, 5, 5)))) == 0
