"""The compiled loops against the few lines of NumPy that they stand for."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from scipy.special import log_expit

from tubepose.labware import load_rack
from tubepose.profile import fit_kernels, kernels, outline_kernels
from tubepose.profile.outline import DESIGN, SECTORS

RNG = np.random.default_rng(5)


@given(angle=st.floats(-np.pi, np.pi), radius=st.floats(1e-6, 1e3), quarter=st.integers(1, 12))
def test_sectors_are_those_of_the_angle(angle, radius, quarter):
    sectors = 4 * quarter
    place = (angle + np.pi) / (2 * np.pi) * sectors
    tangents = np.tan(np.arange(1, quarter) * 2 * np.pi / sectors)
    x, y = np.array([radius * np.cos(angle)]), np.array([radius * np.sin(angle)])
    found = outline_kernels.sectors_of(x, y, tangents)[0]
    if abs(place - round(place)) > 1e-6:  # on a border both are right
        assert found == int(place) % sectors


def test_points_are_grouped_by_their_labels_and_keep_their_order():
    points, label = RNG.normal(size=(500, 3)), RNG.integers(-1, 7, 500)
    label[label == 3] = 2
    ordered, ends = kernels.grouped(points, label, 7)
    for k in range(7):
        assert np.array_equal(ordered[ends[k] : ends[k + 1]], points[label == k])
    assert len(kernels.grouped(points, np.full(500, -1), 0)[0]) == 0


def test_every_cell_has_the_nearest_top_that_is_near_enough():
    centers, radii, near = RNG.uniform(0, 0.05, (6, 2)), RNG.uniform(5e-3, 9e-3, 6), 2e-3
    low, cell, shape = np.array([-0.01, -0.02]), 1e-3, np.array([60, 70])
    label = kernels.nearest_tops(centers, radii, near, low, cell, shape)
    xy = low + np.stack(np.meshgrid(np.arange(60), np.arange(70), indexing="ij"), axis=-1) * cell
    distance = np.linalg.norm(xy[:, :, None] - centers, axis=3)
    distance[distance >= radii + near] = np.inf
    expected = np.where(np.isfinite(distance).any(axis=2), distance.argmin(axis=2), -1)
    assert np.array_equal(label, expected)
    assert len(np.unique(label)) == 7


def test_the_best_place_of_a_window_is_the_middle_of_what_is_as_good_beside_it():
    score = np.zeros((20, 20), np.float32)
    score[5:8, 9] = (0.99, 1.0, 0.98)  # one peak, three cells
    score[15, 3] = 0.995  # as good, but elsewhere
    low, high = (
        np.array([[0, 0], [10, 0], [-5, -5], [30, 30], [0, 0]]),
        np.array([[20, 20], [20, 10], [2, 2], [40, 40], [20, 20]]),
    )
    wanted = np.array([True, True, True, True, False])
    found = kernels.best_places(score, low, high, wanted, 0.03, 3.5)
    assert found[0] == pytest.approx((1.0, 6.0, 9.0))
    assert found[1] == pytest.approx((0.995, 15.0, 3.0))
    assert found[2] == pytest.approx((0.0, 0.5, 0.5))  # cut at the picture's edge
    assert np.all(found[3:] == -np.inf)  # outside of the picture, and not wanted


def test_circles_by_reweighted_least_squares():
    excess, seen = RNG.normal(0, 3e-4, (8, SECTORS)), RNG.uniform(size=(8, SECTORS)) < 0.8
    seen[7] = np.arange(SECTORS) < 3
    sigma, prior = RNG.uniform(1e-4, 3e-4, 8), np.diag([0, 0, 1e7, 1e7, 1e7])
    solution, covariance, squares, counts = outline_kernels.circle_rounds(
        excess, seen, sigma, DESIGN, prior, SECTORS // 4
    )
    for t in range(7):
        weight = seen[t] / sigma[t] ** 2
        for _ in range(outline_kernels.ROUNDS):
            matrix = (DESIGN.T * weight) @ DESIGN + prior
            x = np.linalg.solve(matrix, (DESIGN.T * weight) @ excess[t])
            residual = np.abs(excess[t] - DESIGN @ x)
            weight = seen[t] / sigma[t] ** 2 * np.minimum(1, outline_kernels.HUBER * sigma[t] / residual)
        assert solution[t] == pytest.approx(x, abs=1e-12)
        assert covariance[t] == pytest.approx(np.linalg.inv(matrix)[:2, :2], rel=1e-9)
        assert squares[t] == pytest.approx((residual[seen[t]] ** 2).sum())
    assert np.array_equal(counts, seen.sum(axis=1))
    assert not solution[7].any()  # too few sectors
    assert np.array_equal(covariance[7], np.eye(2))


@pytest.mark.parametrize("name", ["chen2023-soft-5x10", "steel-round-16mm-5x10"])
def test_the_room_in_an_opening_is_the_slots_own_distance(name):
    slot = load_rack(name).all_slots[0]
    opening = np.array([*slot.half_size_m, slot.corner_radius_mm * 1e-3, slot.shape == "round"], float)
    for xy in RNG.uniform(-0.015, 0.015, (200, 2)):
        room = fit_kernels.room_m(*xy, opening)
        assert room == pytest.approx(-float(slot.signed_distance_m(slot.center_m + xy)), abs=1e-12)


def test_samples_are_weighted_by_what_the_slot_allows():
    tubes, soft, play = 3, 1e-4, np.array([1e-3, 5e-4, 2e-3])
    mean = RNG.normal(0, 1, (tubes, 4)) * [5e-4, 5e-4, 1e-2, 1e-2]
    root = np.linalg.cholesky(np.stack([np.diag([1e-7, 1e-7, 1e-5, 1e-5])] * tubes))
    normal, spread = RNG.normal(size=(300, 4)), np.tile([1e-3, 1e-3, 0.03, 0.03], (tubes, 1))
    opening = np.array([[8e-3, 8e-3, 1e-3, 0.0], [8e-3, 8e-3, 0.0, 1.0], [9e-3, 7e-3, 0.0, 0.0]])
    levers, radii = np.tile([0.0, 0.05], (tubes, 1)), np.tile([6.5e-3, 7.4e-3], (tubes, 1))
    found = fit_kernels.weighted_samples(mean, root, normal, spread, play, opening, levers, radii, soft)
    for t in range(tubes):
        x = mean[t] + normal @ root[t].T
        log = log_expit((play[t] - np.hypot(*x[:, :2].T)) / soft)
        for lever, radius in zip(levers[t], radii[t], strict=True):
            places = x[:, :2] + lever * x[:, 2:]
            room = np.array([fit_kernels.room_m(*place, opening[t]) for place in places])
            log += log_expit((room - radius) / soft)
        weight = np.exp(log + 0.5 * ((x / spread[t]) ** 2).sum(axis=1))
        weight /= weight.sum()
        middle = weight @ x
        assert found[0][t] == pytest.approx(middle, abs=1e-12)
        assert found[1][t] == pytest.approx((x - middle).T @ ((x - middle) * weight[:, None]), abs=1e-15)
        assert found[2][t] == pytest.approx(np.exp(log).mean(), rel=1e-9)
        assert 0 < found[2][t] < 1


def test_nothing_that_is_impossible_overflows():
    arguments = (
        np.full((1, 4), 50.0), np.zeros((1, 4, 4)), np.zeros((4, 4)), np.full((1, 4), 1e-3), np.array([1e-3]),
        np.array([[8e-3, 8e-3, 0.0, 0.0]]), np.array([[0.0, 0.05]]), np.array([[6e-3, 7e-3]]), 1e-5,
    )  # fmt: skip
    middle, covariance, allowed = fit_kernels.weighted_samples(*arguments)
    assert middle[0] == pytest.approx(50.0)
    assert np.isfinite(covariance).all()
    assert 0 <= allowed[0] < 1e-100


def test_a_ring_is_even_by_what_it_varies_against_what_is_beside_it():
    rng = np.random.default_rng(6)
    picture = rng.uniform(0, 1, (60, 64)).astype(np.float32)
    angles = np.arange(16) * 2 * np.pi / 16
    around, ring, sides = np.column_stack([np.cos(angles), np.sin(angles)]), np.array([6.7, 7.2]), (9.3, 5.1)
    place, shifts = np.array([[30.2, 31.4], [3.0, 30.0]]), np.array([[0.0, 0.0], [1.5, -0.5]])

    def gray(at, radius):
        return map_coordinates(picture.astype(float), (at + radius * around).T, order=1)

    def evenness(at):
        own = np.stack([gray(at, radius) for radius in ring])
        beside = [np.mean((gray(at, radius) - own.mean()) ** 2) + 0.01 for radius in sides]
        return 1 - (own.var() + 0.01) / np.cbrt(beside[0] ** 2 * beside[1])

    found, best = fit_kernels.even_rings(picture, place, shifts, around, ring, *sides, 12, 0.01)
    expected = [evenness(place[0] + shift) for shift in shifts]
    assert found[0] == pytest.approx(max(expected), abs=1e-5)
    assert best[0] == int(np.argmax(expected))
    assert found[1] == -np.inf  # it leaves the picture
    picture[:, 33:] = np.nan
    assert fit_kernels.even_rings(picture, place, shifts, around, ring, *sides, 12, 0.01)[0][0] == -np.inf


def test_what_is_beside_a_ring_is_told_by_direction():
    x, y = np.meshgrid(np.arange(60.0), np.arange(60.0), indexing="ij")
    rho, east = np.hypot(x - 30, y - 30), x > 30
    picture = np.where(rho < 10, np.where(east, 0.2, 0.5), np.where(rho < 14, 0.5, np.where(east, 0.9, 0.5)))
    picture = np.where(rho < 5, np.where(east, 0.0, 1.0), picture).astype(np.float32)
    angles = (np.arange(32) + 0.5) * 2 * np.pi / 32
    around, place = np.column_stack([np.cos(angles), np.sin(angles)]), np.array([[30.0, 30.0]])
    beside = np.array([17.0, 7.0, 2.5])
    outside, inside, apart, inwards, edge = fit_kernels.ring_sides(
        picture, place, around, np.array([12.0]), beside, 0.1, 1e-3
    )[0]
    assert (outside, inside, apart) == pytest.approx((0.5, 0.5, 0.5), abs=0.07)
    assert inwards == pytest.approx(np.log((0.25 + 1e-3) / (0.0225 + 1e-3)), abs=0.2)
    assert edge == pytest.approx(1e-3 / (0.04 + 1e-3), rel=0.3)  # brighter outside than inside, and uneven there
    disc = np.where(rho < 12, 0.9, 0.1).astype(np.float32)
    assert fit_kernels.ring_sides(disc, place, around, np.array([12.0]), beside, 0.1, 1e-3)[0, 4] > 1.0
    ring = np.where(np.abs(rho - 12) < 2, 0.9, 0.1).astype(np.float32)
    assert fit_kernels.ring_sides(ring, place, around, np.array([12.0]), beside, 0.1, 1e-3)[0, 4] == 0.0


def test_slopes_along_the_radii_are_those_of_a_circle():
    x, y = np.meshgrid(np.arange(60.0), np.arange(60.0), indexing="ij")
    angles = (np.arange(32) + 0.5) * 2 * np.pi / 32
    around, place, edges = np.column_stack([np.cos(angles), np.sin(angles)]), np.array([[30.0, 30.0]]), np.array([12.0])

    def share(gray):
        return fit_kernels.edge_shares(*map(np.ascontiguousarray, np.gradient(gray)), place, around, edges, 1e-6)[0]

    assert share(np.hypot(x - 30, y - 30)) == pytest.approx(1.0, abs=0.01)  # rings
    assert share(x) == pytest.approx(0.5, abs=0.01)  # a ramp: along the radius in two directions, across it in two
    assert share(np.arctan2(y - 30, x - 30)) < 0.1  # spokes
    assert share(np.full((60, 60), 0.3)) == 0.0


def test_shifts_of_a_ring_are_scored_by_the_sectors_that_are_free():
    rng = np.random.default_rng(5)
    correlation, blocked = rng.uniform(-1, 1, (3, 8, 11)), rng.random((3, 8)) < 0.3
    moved = rng.integers(0, 11, (7, 8))
    found = fit_kernels.shift_scores(correlation, blocked, moved)
    usable = np.where(blocked[..., None], 0.0, np.maximum(correlation, 0.0))
    expected = np.stack([usable[:, np.arange(8), row].sum(axis=1) for row in moved], axis=1)
    assert found == pytest.approx(expected)
