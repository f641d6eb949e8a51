"""The camera of every simulated sensor: optics, exposure, decoding, calibration."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tubepose.simulation.camera import CHANNELS, NO_NOISE, PERIODS, NoiseModel, default_camera

ONE_CAPTURE = NoiseModel(blur_px=0.0, smooth_depth_m=0.0, calibration_error_m=0.0)
FINEST = PERIODS[-1]


def camera(noise=NO_NOISE, resolution=64):
    return dataclasses.replace(default_camera(resolution), noise=noise)


def light(columns, amplitude=1.0, room=0.0):
    """Sums of one path per pixel: columns of the projector, and amplitudes, that broadcast to (H, W)."""
    columns, amplitude, room = np.broadcast_arrays(columns, amplitude, room)
    sums = np.zeros((CHANNELS, *columns.shape), dtype=np.float32)
    sums[0], sums[1] = amplitude, room
    for i, period in enumerate(PERIODS):
        sums[2 + 2 * i] = amplitude * np.cos(2 * np.pi * columns / period)
        sums[3 + 2 * i] = amplitude * np.sin(2 * np.pi * columns / period)
    return sums


def decoded(cam, sums, seed=0):
    return cam.decode(cam.phasors(cam.blurred(sums), np.random.default_rng(seed)))


RAMP = np.linspace(12.0, 1012.0, 64 * 64).reshape(64, 64)


@pytest.mark.parametrize("steps", [3, 4, 5, 8])
def test_without_noise_the_true_column_comes_back(steps):
    cam = camera(dataclasses.replace(NO_NOISE, steps=steps))
    assert np.abs(decoded(cam, light(RAMP, 0.3, 1.0)) - RAMP).max() < 2e-4


def test_a_level_plane_is_where_it_is():
    cam = camera()
    plane = cam.intrinsics.backproject(np.full((64, 64), 0.65))
    column = cam.column(plane)
    frame = cam.capture(light(np.nan_to_num(column), np.isfinite(column)), np.random.default_rng(0))
    lit = np.isfinite(column)
    assert np.abs(frame.cloud_m - plane)[lit].max() < 1e-6
    assert np.isnan(frame.cloud_m[~lit]).all()


@settings(max_examples=25)
@given(bits=st.integers(8, 14), amplitude=st.floats(0.1, 1.0), room=st.floats(0.0, 1.0))
def test_quantisation_alone_moves_a_column_by_no_more_than_half_a_count_allows(bits, amplitude, room):
    noise = dataclasses.replace(NO_NOISE, bits=bits)
    # Each component is the difference of two images, each half a count off at most.
    worst = np.arctan(np.sqrt(2) * noise.quantum / (amplitude - noise.quantum)) * FINEST / (2 * np.pi)
    error = np.abs(decoded(camera(noise), light(RAMP, amplitude, room)) - RAMP)
    assert error.max() <= worst + 2e-4
    assert error.max() > worst / 10


@pytest.mark.parametrize(("amplitude", "room"), [(1.0, 1.0), (0.5, 0.5), (0.3, 0.1), (0.09, 0.15)])
def test_noise_of_a_phasor_is_that_of_its_images(amplitude, room):
    cam = camera(ONE_CAPTURE, 128)
    columns = np.broadcast_to(np.linspace(100, 900, 128), (128, 128))
    seen = light(columns, amplitude, room)
    noise = cam.phasors(seen, np.random.default_rng(0)) - seen[2:]
    level = amplitude / 2 + ONE_CAPTURE.room_light * room
    expected = 2 * (ONE_CAPTURE.read**2 + ONE_CAPTURE.quantum**2 / 12 + ONE_CAPTURE.electron * level)
    assert noise.var(axis=(1, 2)).mean() == pytest.approx(expected, rel=0.03)
    # What docs/simulation.md compared with a real scan.
    compared = 0.003**2 + 0.8e-4 * (amplitude + ONE_CAPTURE.room_light * room)
    assert expected == pytest.approx(compared, rel=0.06)
    error = decoded(cam, seen) - columns
    assert error.std() == pytest.approx(np.sqrt(expected) / amplitude * FINEST / (2 * np.pi), rel=0.05)


def test_the_mean_of_many_captures_is_the_truth():
    cam = camera(ONE_CAPTURE)
    columns = np.linspace(200, 800, 64 * 64).reshape(64, 64)
    for amplitude in (0.15, 1.0):
        shots = np.stack([decoded(cam, light(columns, amplitude, 1.0), seed) - columns for seed in range(40)])
        assert np.isfinite(shots).all()
        assert abs(shots.mean()) < 4 * shots.std() / np.sqrt(shots.size)


def test_noise_in_the_dark_keeps_its_mean():
    cam = camera(ONE_CAPTURE)
    dark = cam.expose(np.zeros((64, 64), np.float32), np.random.default_rng(0))
    assert dark.min() < 0
    assert abs(dark.mean()) < 4 * dark.std() / 64


@pytest.mark.parametrize("noise", [NO_NOISE, ONE_CAPTURE])
def test_a_pixel_that_saturates_is_not_decoded(noise):
    full = 1 / noise.exposure
    amplitude = np.full((64, 64), 0.9 * full)
    amplitude[10, 20] = 1.1 * full
    column = decoded(camera(noise), light(RAMP, amplitude))
    assert np.isnan(column[10, 20])
    assert np.isfinite(column).sum() == 64 * 64 - 1
    assert np.isnan(decoded(camera(noise), light(RAMP, 0.9 * full, 4.0))).all()
    shorter = dataclasses.replace(noise, exposure=noise.exposure / 2)
    assert np.isfinite(decoded(camera(shorter), light(RAMP, 0.9 * full, 4.0))).all()


def test_a_weak_pattern_is_not_decoded():
    amplitude = np.where(RAMP < 500, 0.02, 0.05)
    np.testing.assert_array_equal(np.isfinite(decoded(camera(), light(RAMP, amplitude))), RAMP >= 500)


@pytest.mark.parametrize("apart", [1.0, 3.0, 6.0, 40.0, 300.0])
def test_two_lights_in_one_pixel_decode_to_something_between_or_to_nothing(apart):
    start = np.linspace(100, 600, 64 * 64).reshape(64, 64)
    column = decoded(camera(), light(start, 0.4) + light(start + apart, 0.4))
    seen = np.isfinite(column)
    assert ((column >= start - 1e-3) & (column <= start + apart + 1e-3))[seen].all()
    if apart < FINEST / 2:
        assert seen.all()
        assert np.abs(column - start - apart / 2).max() < 1e-3


def test_periods_that_disagree_are_refused():
    for period in (1, 2):
        for share, passes in ((0.3, True), (0.4, False)):
            sums = light(RAMP[8:-8])
            rows = slice(2 + 2 * period, None)
            sums[rows] = light(RAMP[8:-8] + share * PERIODS[period])[rows]
            np.testing.assert_array_equal(np.isfinite(decoded(camera(), sums)), passes)


def test_blur_mixes_the_two_sides_of_an_edge():
    noise = dataclasses.replace(NO_NOISE, blur_px=1376 / 64)
    columns = np.where(np.arange(64) < 32, 400.0, 402.0) * np.ones((64, 1))
    sharp = decoded(camera(), light(columns))
    assert set(np.round(np.unique(sharp), 3)) == {400.0, 402.0}
    soft = decoded(camera(noise), light(columns))
    between = (soft > 400.1) & (soft < 401.9)
    assert between[:, 30:34].any()
    assert not between[:, :28].any()
    assert (np.diff(soft[5]) > -1e-3).all()


def test_calibration_error_is_small_smooth_and_can_be_turned_off():
    cam = camera(NoiseModel(), 128)
    error = cam.calibration_error_m()
    assert np.sqrt(np.mean(error**2)) == pytest.approx(cam.noise.calibration_error_m, rel=1e-4)
    assert abs(error.mean()) < 0.1 * cam.noise.calibration_error_m
    assert np.abs(np.gradient(error)).max() < 0.2 * cam.noise.calibration_error_m
    np.testing.assert_array_equal(error, cam.calibration_error_m())
    assert not camera().calibration_error_m().any()
    half = camera(NoiseModel(), 64).calibration_error_m()
    assert np.abs(half - error[::2, ::2]).max() < 0.2 * cam.noise.calibration_error_m


def test_calibration_error_is_in_the_cloud():
    noise = dataclasses.replace(NO_NOISE, calibration_error_m=1e-3)
    sums = light(np.linspace(300, 700, 64) * np.ones((64, 1)))
    with_error, without = (camera(n).capture(sums, np.random.default_rng(0)).cloud_m[..., 2] for n in (noise, NO_NOISE))
    found = (with_error - without)[np.isfinite(without)]
    np.testing.assert_allclose(found, camera(noise).calibration_error_m()[np.isfinite(without)], atol=1e-9)
    assert len(found) > 500


def test_gray_image_shows_projector_and_room_and_saturates():
    sums = light(RAMP, np.linspace(0, 3, 64)[None, :] * np.ones((64, 1)), 0.5)
    image = camera().capture(sums, np.random.default_rng(0)).image
    assert image.dtype == np.uint8
    assert image[0, 0] == round(255 * np.sqrt(0.75 * 0.15 * 0.5))
    assert image[0, -1] == 255
    assert (np.diff(image[0].astype(int)) >= 0).all()


def test_the_same_seed_gives_the_same_frame():
    sums = light(np.linspace(300, 700, 64) * np.ones((64, 1)), 0.6, 1.0)
    one, same, other = (camera(NoiseModel()).capture(sums, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(one.cloud_m, same.cloud_m)
    np.testing.assert_array_equal(one.image, same.image)
    assert (one.image != other.image).any()
    assert not np.array_equal(one.cloud_m, other.cloud_m, equal_nan=True)


def test_sums_are_left_as_they_are():
    sums = light(RAMP, 0.6, 1.0)
    before = sums.copy()
    for noise in (NO_NOISE, NoiseModel()):
        camera(noise).capture(sums, np.random.default_rng(0))
    np.testing.assert_array_equal(sums, before)
