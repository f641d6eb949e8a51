"""What is known of a pose: Gaussian where the slot says nothing, bounded by play and walls where it does."""

import numpy as np
import pytest

from tubepose.config import ProfileConfig
from tubepose.labware import load_rack, load_tube
from tubepose.profile.posterior import Evidence, combine, evidence, no_evidence

CONFIG = ProfileConfig()
RACK = load_rack("chen2023-soft-5x10")
ROUND_RACK = load_rack("steel-round-13mm-5x10")
SLOT = RACK.slot("C5")
TUBE_2 = load_tube("chen2023-tube-2")
FLAT = load_tube("chen2023-tube-3")
PLAY_M = RACK.floor_play_mm * 1e-3
CAMERA_STD = np.array([5e-5, 5e-5, 5e-4, 5e-4])


def measured(value=(0.0, 0.0, 0.0, 0.0), std=CAMERA_STD, correlation=0.0):
    covariance = np.diag(np.asarray(std) ** 2)
    covariance[0, 2] = covariance[2, 0] = correlation * std[0] * std[2]
    return evidence(np.eye(4)[None], np.array([value]), covariance[None])


def posterior(*args, slot=SLOT, tube=TUBE_2, rack=RACK, **more):
    return combine(measured(*args, **more), [slot], [tube], rack, CONFIG)


def test_a_round_bottom_is_held_at_its_centre_and_others_at_the_tip():
    assert TUBE_2.pivot_height_m == pytest.approx(13.05e-3 / 2)
    assert load_tube("centrifuge-15ml-conical").pivot_height_m == 0.0


def test_evidence_by_hand():
    design = np.array([[[1.0, 0.0, 0.1, 0.0], [0.0, 1.0, 0.0, 0.1]]])
    found = evidence(design, np.array([[2.0, 4.0]]), np.array([np.diag([0.5, 0.25])]))
    assert found.matrix[0] == pytest.approx(np.array(
        [[2.0, 0, 0.2, 0], [0, 4.0, 0, 0.4], [0.2, 0, 0.02, 0], [0, 0.4, 0, 0.04]]
    ))  # fmt: skip
    assert found.vector[0] == pytest.approx([4.0, 16.0, 0.4, 1.6])


def test_what_is_not_known_says_nothing():
    found = evidence(np.ones((2, 1, 4)), np.array([[np.nan], [1.0]]), np.ones((2, 1, 1)))
    assert not found.matrix[0].any()
    assert not found.vector[0].any()
    assert found.matrix[1].all()
    both = found + no_evidence(2)
    assert np.array_equal(both.matrix, found.matrix)


@pytest.mark.parametrize("correlation", [0.0, 0.7])
def test_far_from_every_edge_the_answer_is_the_measurement(correlation):
    std = np.array([2e-5, 2e-5, 3e-4, 3e-4])
    value = (0.3 * PLAY_M, -0.2 * PLAY_M, 2e-3, -3e-3)
    found = posterior(value, std, correlation=correlation)
    assert found.mean[0] == pytest.approx(value, abs=0.25 * std.max() * np.array([0.1, 0.1, 1, 1]).max())
    assert np.abs(found.mean[0] - value) @ (1 / std) < 0.6
    covariance = np.linalg.inv(measured(value, std, correlation).matrix[0])
    assert np.allclose(found.covariance[0] / np.outer(std, std), covariance / np.outer(std, std), atol=0.15)
    assert found.allowed[0] > 0.9


def test_nothing_measured_leaves_the_middle_and_what_the_slot_allows():
    found = combine(no_evidence(1), [SLOT], [TUBE_2], RACK, CONFIG)
    std = np.sqrt(np.diag(found.covariance[0]))
    assert np.all(np.abs(found.mean[0]) < 0.3 * std)
    # Even over a disc of radius R: R / 2 about each axis.
    assert std[:2] == pytest.approx(PLAY_M / 2, rel=0.3)
    room = SLOT.half_size_m[0] + PLAY_M - float(TUBE_2.body_radius_m(RACK.depth_m))
    assert np.all(std[2:] < room / RACK.depth_m)


def test_the_floors_play_bounds_a_foot_that_is_measured_farther_out():
    out = 2.5 * PLAY_M
    found = posterior((out, 0.0, 0.0, 0.0), (PLAY_M, PLAY_M, 5e-4, 5e-4))
    assert 0 < found.mean[0, 0] < 1.1 * PLAY_M
    assert found.covariance[0, 0, 0] < (0.6 * PLAY_M) ** 2


@pytest.mark.parametrize("axis", [2, 3])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_a_wall_bounds_a_lean_that_is_measured_too_large(axis, sign):
    room = SLOT.half_size_m[0] - float(TUBE_2.body_radius_m(RACK.depth_m))
    limit = (room + PLAY_M) / (RACK.depth_m - TUBE_2.pivot_height_m)
    value = np.zeros(4)
    value[axis] = sign * (limit + 8e-3)
    found = posterior(value, (PLAY_M, PLAY_M, 5e-3, 5e-3))
    assert sign * found.mean[0, axis] < limit + 2e-3
    assert sign * found.mean[0, axis] > 0.5 * limit
    assert abs(found.mean[0, 5 - axis]) < 2e-3


def test_a_sure_lean_beyond_the_slot_is_not_allowed_and_one_within_is():
    room = SLOT.half_size_m[0] - float(TUBE_2.body_radius_m(RACK.depth_m))
    limit = (room + PLAY_M) / (RACK.depth_m - TUBE_2.pivot_height_m)
    std = (5e-5, 5e-5, 5e-4, 5e-4)
    assert posterior((0.0, 0.0, limit + 8e-3, 0.0), std).allowed[0] < CONFIG.min_allowed
    assert posterior((0.0, 0.0, 0.5 * limit, 0.0), std).allowed[0] > 0.5
    assert posterior((5 * PLAY_M + 1e-3, 0.0, 0.0, 0.0), std).allowed[0] < CONFIG.min_allowed


@pytest.mark.parametrize("slot", ["A1", "C5"])
def test_a_mirrored_measurement_has_a_mirrored_answer(slot):
    value, std = np.array([1e-4, -2e-4, 6e-3, 4e-3]), np.array([1e-4, 1e-4, 3e-3, 3e-3])
    found = posterior(value, std, slot=RACK.slot(slot))
    mirrored = posterior(-value, std, slot=RACK.slot(slot))
    # The samples are mirrored with their middle.
    assert mirrored.mean == pytest.approx(-found.mean, abs=1e-12)
    assert mirrored.covariance == pytest.approx(found.covariance, abs=1e-15)
    assert mirrored.allowed == pytest.approx(found.allowed)


def test_in_a_round_slot_all_directions_are_alike():
    tube = load_tube("blood-13x75")
    room = 6.5e-3 - float(tube.body_radius_m(ROUND_RACK.depth_m))
    lean = (room + ROUND_RACK.floor_play_mm * 1e-3) / (ROUND_RACK.depth_m - tube.pivot_height_m)
    std = (2e-4, 2e-4, 2e-3, 2e-3)
    lengths, shares = [], []
    for angle in np.linspace(0, np.pi / 2, 7):
        value = (0.0, 0.0, lean * np.cos(angle), lean * np.sin(angle))
        found = posterior(value, std, slot=ROUND_RACK.slot("B4"), tube=tube, rack=ROUND_RACK)
        lengths.append(np.hypot(*found.mean[0, 2:]))
        shares.append(found.allowed[0])
    assert np.ptp(lengths) < 0.12 * lean
    assert np.ptp(shares) < 0.25


def test_covariances_are_positive_definite_wherever_a_tube_is_said_to_stand():
    rng = np.random.default_rng(0)
    count = 60
    values = rng.normal(0, 1, (count, 4)) * [1e-3, 1e-3, 0.03, 0.03]
    root = rng.normal(0, 1, (count, 4, 4)) * np.array([1e-4, 1e-4, 1e-3, 1e-3])[:, None]
    covariance = np.einsum("tij,tkj->tik", root, root) + np.diag([1e-10, 1e-10, 1e-8, 1e-8])
    told = evidence(np.tile(np.eye(4), (count, 1, 1)), values, covariance)
    found = combine(told, [SLOT] * count, [TUBE_2, FLAT] * (count // 2), RACK, CONFIG)
    scaled = found.covariance / np.outer([1e-4, 1e-4, 1e-3, 1e-3], [1e-4, 1e-4, 1e-3, 1e-3])
    assert np.linalg.eigvalsh(scaled).min() > 0
    assert np.isfinite(found.mean).all()
    assert np.all((found.allowed >= 0) & (found.allowed <= 1))


def test_tubes_do_not_change_one_another():
    rng = np.random.default_rng(1)
    slots = [RACK.slot("A1"), RACK.slot("E9"), RACK.slot("B2")]
    tubes = [TUBE_2, FLAT, load_tube("chen2023-tube-1")]
    values = rng.normal(0, 1, (3, 4)) * [1e-4, 1e-4, 5e-3, 5e-3]
    told = evidence(np.tile(np.eye(4), (3, 1, 1)), values, np.tile(np.diag(CAMERA_STD**2), (3, 1, 1)))
    together = combine(told, slots, tubes, RACK, CONFIG)
    for i in range(3):
        alone = combine(Evidence(told.matrix[i : i + 1], told.vector[i : i + 1]), [slots[i]], [tubes[i]], RACK, CONFIG)
        assert alone.mean[0] == pytest.approx(together.mean[i], rel=1e-9, abs=1e-12)
        assert np.allclose(alone.covariance[0], together.covariance[i], rtol=1e-6)


def test_no_tubes_give_nothing():
    found = combine(no_evidence(0), [], [], RACK, CONFIG)
    assert found.mean.shape == (0, 4)
    assert found.covariance.shape == (0, 4, 4)
