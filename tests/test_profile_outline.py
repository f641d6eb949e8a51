"""Middles of tops: circles from where discs end, with missing sectors, blurred, touched, coarse."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tubepose.config import ProfileConfig
from tubepose.profile.closed_tops import DISC_GAP_M, blocked_sectors
from tubepose.profile.outline import ANGLES, NORMALS, SECTORS, fit_circles, fit_discs, unknown_circles

CONFIG = ProfileConfig()
RADIUS_M = 9e-3
NONE_BLOCKED = np.zeros((1, SECTORS), bool)
SIGMA_M = CONFIG.outline_noise_m


def disc(center_m=(0.0, 0.0), spacing_m=0.35e-3, radius_m=RADIUS_M, seed=0):
    """Points of a grid, jittered and turned, on a disc; shape (N, 2)."""
    rng = np.random.default_rng(seed)
    axis = np.arange(-12e-3, 12e-3, spacing_m)
    xy = (
        np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        + rng.uniform(-0.3, 0.3, (len(axis) ** 2, 2)) * spacing_m
    )
    turn = rng.uniform(0, np.pi)
    xy = xy @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    return xy[np.hypot(*(xy - center_m).T) < radius_m]


def fit(points, blocked=NONE_BLOCKED, radius_m=RADIUS_M):
    return fit_discs(np.zeros(len(points), np.intp), points, np.array([radius_m]), blocked, CONFIG)


@pytest.mark.parametrize("center_mm", [(0.0, 0.0), (0.6, -0.3), (-1.0, 0.7)])
def test_the_middle_of_a_full_disc(center_mm):
    center_m = np.array(center_mm) * 1e-3
    found = fit(disc(center_m))
    assert found.offset_m[0] == pytest.approx(center_m, abs=6e-5)
    assert found.sectors[0] > 0.9
    assert abs(found.widening_m[0]) < 1e-4


def test_missing_sectors_are_not_seen_and_shift_nothing():
    points = disc((0.4e-3, 0.0))
    angle = np.arctan2(points[:, 1], points[:, 0])
    kept = points[(angle < 0.2) | (angle > 1.9)]
    found = fit(kept)
    assert found.offset_m[0] == pytest.approx((0.4e-3, 0.0), abs=1e-4)
    assert 0.6 < found.sectors[0] < 0.85
    assert np.trace(found.covariance_m2[0]) > np.trace(fit(points).covariance_m2[0])


def test_a_touching_neighbour_blocks_the_sectors_where_it_is():
    beside = np.array([2 * RADIUS_M + 0.1e-3, 0.0])
    centers, radii = np.array([[0.0, 0.0], beside]), np.full(2, RADIUS_M)
    blocked = blocked_sectors(centers, radii, DISC_GAP_M)
    assert 2 <= blocked[0].sum() <= 8
    assert np.all(NORMALS[blocked[0]] @ [1, 0] > 0.8)
    assert not blocked_sectors(centers, radii, DISC_GAP_M, sure=np.array([True, False]))[0].any()
    one, other = disc(seed=1), disc(seed=2) + beside
    nearer = np.linalg.norm(other, axis=1) < RADIUS_M + 2.5e-3
    both = np.vstack([one, other[nearer]])
    assert fit(both, blocked[:1]).offset_m[0] == pytest.approx((0.0, 0.0), abs=8e-5)


def test_an_elliptic_blur_is_no_shift():
    points = disc() * np.array([1.02, 0.99])
    found = fit(points)
    assert found.offset_m[0] == pytest.approx((0.0, 0.0), abs=6e-5)


def test_a_wider_cap_is_no_shift_even_if_half_of_it_is_seen():
    points = disc(radius_m=RADIUS_M + 0.2e-3)
    found = fit(points[points[:, 1] > -2e-3])
    assert found.offset_m[0] == pytest.approx((0.0, 0.0), abs=2e-4)
    assert found.widening_m[0] == pytest.approx(0.2e-3, abs=1e-4)


@pytest.mark.parametrize("spacing_mm", [0.6, 0.8, 1.0])
def test_a_coarse_scan_has_a_middle_too_and_knows_it_less_well(spacing_mm):
    errors, squares = [], []
    for seed in range(12):
        center_m = np.random.default_rng(seed).uniform(-0.5e-3, 0.5e-3, 2)
        found = fit(disc(center_m, spacing_mm * 1e-3, seed=seed))
        assert found.sectors[0] > 0.6
        off = found.offset_m[0] - center_m
        errors.append(np.linalg.norm(off))
        squares.append(off @ np.linalg.solve(found.covariance_m2[0], off))
    assert max(errors) < 0.35e-3
    assert np.mean(squares) < 4.0  # 2 if honest
    assert np.trace(found.covariance_m2[0]) > 1.2 * np.trace(fit(disc()).covariance_m2[0])


def test_nothing_to_see_is_unknown():
    found = fit(np.empty((0, 2)))
    assert np.isnan(found.offset_m).all()
    assert found.sectors[0] == 0
    assert np.isfinite(found.covariance_m2).all()


@settings(max_examples=40)
@given(
    x=st.floats(-0.8, 0.8),
    y=st.floats(-0.8, 0.8),
    widening=st.floats(-0.1, 0.1),
    missing=st.integers(0, 12),
    start=st.integers(0, SECTORS - 1),
)
def test_exact_ends_give_exact_circles(x, y, widening, missing, start):
    offset_m = np.array([x, y]) * 1e-3
    excess = (NORMALS @ offset_m + widening * 1e-3)[None]
    seen = np.ones((1, SECTORS), bool)
    seen[0, (start + np.arange(missing)) % SECTORS] = False
    found = fit_circles(excess, seen, CONFIG, SIGMA_M, 0.0)
    # The prior on the widening pulls once not all of the circle is seen: by 0.09 mm at most with half of it.
    assert found.offset_m[0] == pytest.approx(offset_m, abs=9e-5 if missing else 1e-6)
    assert found.sectors[0] == pytest.approx(1 - missing / SECTORS)
    assert np.all(np.linalg.eigvalsh(found.covariance_m2[0]) > 0)


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000), turn=st.integers(0, SECTORS - 1))
def test_turning_the_sectors_turns_the_offset(seed, turn):
    excess = np.random.default_rng(seed).normal(0, 2e-4, (1, SECTORS))
    seen = np.ones((1, SECTORS), bool)
    found = fit_circles(excess, seen, CONFIG, SIGMA_M, 0.0).offset_m[0]
    turned = fit_circles(np.roll(excess, turn, axis=1), seen, CONFIG, SIGMA_M, 0.0).offset_m[0]
    angle = turn * 2 * np.pi / SECTORS
    R = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    assert turned == pytest.approx(R @ found, abs=1e-9)


def test_one_wrong_sector_is_outvoted():
    excess = (NORMALS @ [3e-4, 0.0])[None].copy()
    excess[0, 3] += 2e-3
    seen = np.ones((1, SECTORS), bool)
    assert fit_circles(excess, seen, CONFIG, SIGMA_M, 0.0).offset_m[0] == pytest.approx((3e-4, 0), abs=5e-5)


def test_stated_errors_follow_the_noise():
    rng = np.random.default_rng(0)
    excess = rng.normal(0, SIGMA_M, (400, SECTORS))
    excess += 1e-4 * np.cos(2 * ANGLES)
    found = fit_circles(excess, np.ones((400, SECTORS), bool), CONFIG, SIGMA_M, 0.0)
    squares = np.einsum("ti,tij,tj->t", found.offset_m, np.linalg.inv(found.covariance_m2), found.offset_m)
    assert np.mean(squares) == pytest.approx(2.0, abs=0.5)


def test_too_few_sectors_are_unknown():
    seen = np.zeros((1, SECTORS), bool)
    seen[0, : SECTORS // 4 - 1] = True
    found = fit_circles(np.zeros((1, SECTORS)), seen, CONFIG, SIGMA_M, 0.0)
    assert np.isnan(found.offset_m).all()


def test_circles_are_taken_put_and_mixed_by_tube():
    found = fit_circles(NORMALS[None] @ [1e-4, 0.0], np.ones((1, SECTORS), bool), CONFIG, SIGMA_M, 0.0)
    all_of = unknown_circles(3).put(np.array([1]), found)
    assert np.isnan(all_of.offset_m[[0, 2]]).all()
    assert all_of.offset_m[1] == pytest.approx(found.offset_m[0])
    assert all_of.take(np.array([1])).sectors == pytest.approx(found.sectors)
    mixed = all_of.where(np.array([False, True, False]), unknown_circles(3))
    assert mixed.sectors.tolist() == [0.0, 1.0, 0.0]
    assert unknown_circles(2).put(np.array([], np.intp), unknown_circles(0)).sectors.tolist() == [0.0, 0.0]
