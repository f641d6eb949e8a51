"""Noise told by caps about their own planes: known noise is found again, and who is believed."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tubepose.config import SensorConfig
from tubepose.sensor.caps import CapDisc, caps_error, seen_on_caps
from tubepose.sensor.noise import CAPS, PRIOR, RACK_TOP, TABLE, prior_noise

RADIUS_M = 5.5e-3
DISTANCE_M = 0.65
SPACING_M = 0.5e-3


def smooth(rng, count, length_m):
    """A field (count, count) of variance 1 with correlation exp(-(d / l)^2)."""
    reach = int(4 * length_m / SPACING_M) + 1
    kernel = np.exp(-2 * (np.arange(-reach, reach + 1) * SPACING_M / length_m) ** 2)
    kernel /= np.linalg.norm(kernel)
    size = count + 2 * reach
    return cv2.sepFilter2D(rng.normal(size=(size, size)), -1, kernel, kernel)[reach:-reach, reach:-reach]


def caps(own_m, shared_m, length_m, count=24, depth_m=DISTANCE_M, seed=0):
    """Caps with noise about their own planes, and the slopes (count, 2) of those planes, which nobody is told."""
    rng = np.random.default_rng(seed)
    side = int(2 * RADIUS_M / SPACING_M) + 3
    axis = (np.arange(side) - (side - 1) / 2) * SPACING_M
    xy = np.stack(np.meshgrid(axis, axis), axis=-1)
    found, slopes = [], []
    for _ in range(count):
        off = shared_m * smooth(rng, side, length_m) + rng.normal(0, own_m, (side, side))
        inside = np.hypot(*np.moveaxis(xy, -1, 0)) < RADIUS_M
        terms = np.column_stack([np.ones(inside.sum()), xy[inside]])
        plane = np.linalg.lstsq(terms, off[inside], rcond=None)[0]
        scale = depth_m / DISTANCE_M
        found.append(CapDisc(scale * xy[inside], scale * (off[inside] - terms @ plane), scale * RADIUS_M, depth_m))
        slopes.append(plane[1:])
    return found, np.array(slopes)


@pytest.mark.parametrize(
    ("own_m", "shared_m", "length_m"),
    [(1e-4, 1e-4, 1.5e-3), (1e-4, 1e-4, 3e-3), (5e-4, 5e-4, 3e-3), (3e-5, 1e-4, 4e-3)],
)
def test_known_noise_is_found_again(own_m, shared_m, length_m):
    discs, _ = caps(own_m, shared_m, length_m)
    found = caps_error(discs, DISTANCE_M)
    assert found.n_caps == len(discs)
    assert found.spacing_m == pytest.approx(SPACING_M, rel=0.03)
    assert found.independent_m == pytest.approx(own_m, rel=0.1)
    assert found.shared_m == pytest.approx(shared_m, rel=0.25)
    assert found.correlation_m == pytest.approx(length_m, rel=0.35)
    assert found.relative_std < 0.3


def test_the_scatter_of_planes_that_were_absorbed_is_told():
    discs, _ = caps(1e-4, 1e-4, 3e-3)
    _, slopes = caps(1e-4, 1e-4, 3e-3, count=200, seed=1)
    told = seen_on_caps(replace(prior_noise(SensorConfig()), spacing_m=SPACING_M), discs)
    assert told.source == CAPS
    assert told.slope_std(RADIUS_M, DISTANCE_M) == pytest.approx(float(slopes.std()), rel=0.3)


def test_without_shared_error_none_to_speak_of_is_found():
    discs, slopes = caps(1e-4, 0.0, 3e-3, count=40)
    told = seen_on_caps(prior_noise(SensorConfig()), discs)
    assert told.independent_m == pytest.approx(1e-4, rel=0.1)
    assert told.slope_std(RADIUS_M, DISTANCE_M) < 2.5 * slopes.std()


def test_noise_lives_in_pixels_so_caps_farther_off_say_the_same():
    near, far = (caps_error(caps(1e-4, 1e-4, 3e-3, depth_m=d)[0], DISTANCE_M) for d in (DISTANCE_M, 2 * DISTANCE_M))
    assert far.independent_m == pytest.approx(near.independent_m)
    assert far.shared_m == pytest.approx(near.shared_m)
    assert far.correlation_m == pytest.approx(near.correlation_m)


@pytest.mark.parametrize(
    ("source", "times", "believed"),
    [(RACK_TOP, 4.0, CAPS), (RACK_TOP, 0.5, RACK_TOP), (TABLE, 1.0, TABLE), (TABLE, 0.5, TABLE)],
)
def test_caps_are_believed_against_a_racks_top_that_reads_too_high(source, times, believed):
    discs, _ = caps(1e-4, 1e-4, 3e-3)
    surface = replace(
        prior_noise(SensorConfig()), source=source, shared_m=times * 1e-4, independent_m=1e-4, spacing_m=SPACING_M
    )
    found = seen_on_caps(surface, discs)
    assert found.source == believed
    assert ("rack's top has" in found.note) == (believed == CAPS)
    if believed != CAPS:
        assert found == surface


@pytest.mark.parametrize(("own_m", "shared_m"), [(1e-4, 1e-4), (3e-5, 1e-4), (1e-4, 1e-5)])
@pytest.mark.parametrize("times", [1.0, 2.0])
def test_a_table_that_is_noisier_than_the_caps_is_scaled(own_m, shared_m, times):
    discs, _ = caps(own_m, shared_m, 3e-3, count=40)
    table = replace(
        prior_noise(SensorConfig()), source=TABLE, shared_m=times * shared_m, independent_m=times * own_m,
        correlation_m=3e-3, spacing_m=SPACING_M, independent_relative_std=0.02, shared_relative_std=0.05,
    )  # fmt: skip
    found = seen_on_caps(table, discs)
    assert found.source == TABLE
    assert found.independent_m == pytest.approx(own_m, rel=0.15)
    assert found.shared_m == pytest.approx(shared_m, rel=0.15)
    assert ("the table has 2" in found.note) == (times == 2.0)


def test_too_few_points_say_nothing():
    nothing = CapDisc(np.zeros((0, 2)), np.zeros(0), RADIUS_M, DISTANCE_M)
    sparse = CapDisc(np.random.default_rng(0).normal(0, 2e-3, (12, 2)), np.zeros(12), RADIUS_M, DISTANCE_M)
    noise = prior_noise(SensorConfig())
    for discs in ([], [nothing], [sparse]):
        assert caps_error(discs, DISTANCE_M) is None
        assert seen_on_caps(noise, discs).source == PRIOR
