"""A camera measured without a rack: on any plane, on any edge, over frames; and what can be expected of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import yaml
from commands import tubepose

from tubepose.camera_report import EXPECTED_COLUMNS, NOISE_COLUMNS, measure_camera
from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.capture.mcap_writing import write_mcap
from tubepose.capture.writing import write_folder_capture
from tubepose.config import Config
from tubepose.errors import CaptureError
from tubepose.expectation import distances_m, expected, plane_std, sufficient_distance_m
from tubepose.labware import load_rack, load_tube
from tubepose.sensor.free_edges import free_edges
from tubepose.sensor.free_planes import planes_of
from tubepose.sensor.in_time import in_time
from tubepose.simulation.depth_noise import DepthNoise

CAMERA = CameraIntrinsics(400, 300, 500.0, 500.0, 199.5, 149.5)
RACK, TUBE = load_rack("round-10ml-3x4"), load_tube("blood-16x100")
CONFIG = Config()


def plane(depth_m=0.4, tilt_rad=0.2, **noise) -> RgbdFrame:
    normal = np.array([np.sin(tilt_rad), 0.0, np.cos(tilt_rad)])
    depth = normal[2] * depth_m / (CAMERA.rays() @ normal)
    frame = RgbdFrame(CAMERA.backproject(depth), None, CAMERA, None, "wall")
    return DepthNoise(**noise, depth_power=1.0).applied(frame, np.random.default_rng(1)) if noise else frame


def scaled(frame: RgbdFrame, share) -> RgbdFrame:
    return replace(frame, cloud_m=frame.cloud_m * (1 + np.asarray(share))[..., None])


# ---------------------------------------------------------------- planes


@pytest.mark.parametrize(("own_m", "shared_m"), [(2e-4, 0.0), (1e-4, 5e-4), (5e-4, 5e-4)])
def test_the_noise_that_was_put_in_is_found(own_m: float, shared_m: float) -> None:
    (found, *_) = planes_of(plane(independent_m=own_m, shared_m=shared_m, correlation_m=4e-3), CONFIG.sensor)
    assert found.noise.source == "plane"
    assert found.noise.distance_m == pytest.approx(0.4, abs=0.02)
    slant = np.cos(0.2)  # the noise is along the line of sight
    assert found.noise.independent_m == pytest.approx(own_m * slant, rel=0.15, abs=2e-5)
    assert found.noise.shared_m == pytest.approx(shared_m * slant, rel=0.2, abs=5e-5)
    assert found.total_std_m == pytest.approx(np.hypot(own_m, shared_m) * slant, rel=0.1)
    assert found.slant_rad == pytest.approx(0.2, abs=0.02)


def test_waves_are_told_by_their_covariance() -> None:
    (found, *_) = planes_of(plane(shared_m=5e-4, correlation_m=1.2e-2), CONFIG.sensor)
    at_length = np.interp(1.2e-2, found.lag_m, found.covariance_m2)
    assert found.covariance_m2[0] == pytest.approx(2.5e-7, rel=0.3)
    assert at_length / found.covariance_m2[0] == pytest.approx(np.exp(-1), abs=0.15)


def test_two_planes_are_told_apart_and_the_larger_comes_first() -> None:
    wall = plane(0.6, 0.0, independent_m=2e-4)
    cloud = wall.cloud_m.copy()
    cloud[:, :150] = plane(0.45, 0.0, independent_m=2e-4).cloud_m[:, :150]
    found = planes_of(replace(wall, cloud_m=cloud), CONFIG.sensor)
    assert [round(one.noise.distance_m, 2) for one in found] == [0.6, 0.45]
    assert all(one.noise.independent_m == pytest.approx(2e-4, rel=0.2) for one in found)


def test_missing_pixels_are_counted_and_clouds_without_pixels_are_measured() -> None:
    frame = plane(independent_m=2e-4, missing=0.05)
    (found, *_) = planes_of(frame, CONFIG.sensor)
    assert found.missing_share == pytest.approx(0.05, abs=0.01)
    flat = replace(frame, cloud_m=frame.measured_m[None], organised=False, intrinsics=None)
    (loose, *_) = planes_of(flat, CONFIG.sensor)
    assert np.isnan(loose.missing_share)
    assert loose.noise.independent_m == pytest.approx(found.noise.independent_m, rel=0.1)


def test_a_cloud_without_a_plane_has_none() -> None:
    points = np.random.default_rng(0).uniform([-0.3, -0.3, 0.3], [0.3, 0.3, 1.0], (20_000, 3))
    assert planes_of(RgbdFrame(points[None], None, None, None, "dust", organised=False), CONFIG.sensor) == ()
    with pytest.raises(CaptureError, match="point the camera at a table"):
        measure_camera([RgbdFrame(points[None], None, None, None, "dust", organised=False)], "dust.ply", CONFIG)
    with pytest.raises(CaptureError, match="no frame"):
        measure_camera([], "nothing", CONFIG)


# ---------------------------------------------------------------- edges and time


@pytest.mark.parametrize("turned", [False, True])
def test_ramps_have_their_width_across_the_edge_however_it_lies(turned: bool) -> None:
    v, u = np.mgrid[:300, :400].astype(float)
    across = (u - 200 + 0.7 * (v - 150)) / np.hypot(1, 0.7) if turned else u - 200
    # A straight ramp in inverse depth, 20 px wide: 16 px from 10 to 90 %.
    inverse = 1 / 0.5 + np.clip(across / 20 + 0.5, 0, 1) * (1 / 0.45 - 1 / 0.5)
    frame = RgbdFrame(CAMERA.backproject(1 / inverse), None, CAMERA, None, "edge")
    found = free_edges(frame)
    assert found is not None
    assert found.ramp_px == pytest.approx(16, abs=1)
    assert found.blur_px == pytest.approx(18.4, abs=1.5)


def test_a_sloped_plane_has_no_edges() -> None:
    assert free_edges(plane(0.4, 0.9)) is None
    assert free_edges(replace(plane(), organised=False)) is None


def test_noise_in_time_and_drift() -> None:
    rng = np.random.default_rng(0)
    frames = [scaled(plane(), rng.normal(0, 1e-3, (300, 400)) + 5e-4 * k) for k in range(9)]
    lost = frames[3].cloud_m.copy()
    lost[:30] = np.nan
    frames[3] = replace(frames[3], cloud_m=lost)
    found = in_time(frames)
    assert found is not None
    assert found.n_frames == 9
    assert found.std_share == pytest.approx(1e-3, rel=0.05)
    assert found.drift_share == pytest.approx(8 * 5e-4, rel=0.02)
    assert found.drift_std_share < 1e-4
    assert found.flicker_share == pytest.approx(0.1, abs=0.01)
    assert in_time(frames[:1]) is None


# ---------------------------------------------------------------- expectation


def measured(**noise):
    (found, *_) = planes_of(plane(0.4, 0.0, **({"independent_m": 2e-4} | noise)), CONFIG.sensor)
    return found


def test_the_expected_error_of_a_plane_is_the_scatter_of_planes() -> None:
    """Through drawn errors of the same covariance, by least squares."""
    found = measured(shared_m=5e-4, correlation_m=1e-2)
    slopes, height_m = plane_std(found, RACK, 1.0)
    half = RACK.outline_m / 2
    half_px = np.round(half * 500 / 0.4).astype(int)
    drawn = []
    for seed in range(40):
        noise = DepthNoise(independent_m=2e-4, shared_m=5e-4, correlation_m=1e-2, depth_power=1.0)
        frame = noise.applied(plane(0.4, 0.0), np.random.default_rng(seed))
        part = frame.cloud_m[150 - half_px[1] : 150 + half_px[1], 200 - half_px[0] : 200 + half_px[0]].reshape(-1, 3)
        design = np.column_stack([np.ones(len(part)), part[:, :2]])
        drawn.append(np.linalg.lstsq(design, part[:, 2], rcond=None)[0])
    scatter = np.std(drawn, axis=0)
    # The face has openings, so its planes are known a little worse than those of a whole rectangle.
    assert height_m == pytest.approx(scatter[0], rel=0.5)
    np.testing.assert_allclose(slopes, scatter[1:], rtol=0.5)


def test_nearer_is_better_and_more_noise_is_worse() -> None:
    little, much = measured(), measured(shared_m=2e-3, correlation_m=8e-3)
    found = {}
    for name, one in (("little", little), ("much", much)):
        found[name] = expected(one, None, CAMERA, RACK, (TUBE,), CONFIG)
        distances = [entry.distance_m for entry in found[name]]
        assert distances == sorted(distances, reverse=True)
        assert len(set(distances)) == 5
        tilts = [entry.rack_tilt_deg for entry in found[name]]
        assert tilts == sorted(tilts, reverse=True)
        assert all(entry.tube_tilt_deg <= entry.slot_tilt_deg * 1.02 for entry in found[name])
    assert found["much"][0].rack_tilt_deg > 3 * found["little"][0].rack_tilt_deg
    assert found["much"][0].tube_tilt_deg > found["little"][0].tube_tilt_deg
    assert found["little"][-1].measured == "tilt"
    assert found["little"][0].opening_px == pytest.approx(2 * RACK.all_slots[0].half_size_m[0] * 500 / 0.4, rel=0.02)


def test_the_rack_is_in_the_picture_at_the_nearest_distance() -> None:
    nearest = distances_m(0.6, CAMERA, RACK, (TUBE,))[-1]
    above = RACK.floor_m + TUBE.height_m - RACK.height_m
    size_px = sorted(RACK.outline_m * 500 / (nearest - above))
    assert size_px[1] <= 400
    assert size_px[0] <= 300
    assert distances_m(0.6, None, RACK, (TUBE,)) == (0.6,)
    assert distances_m(0.1, CAMERA, RACK, (TUBE,)) == (0.1,)


def test_from_where_on_depth_is_enough() -> None:
    good, bad = measured(), measured(shared_m=4e-3, correlation_m=8e-3)
    far = sufficient_distance_m(good, None, CAMERA, RACK, CONFIG)
    near = sufficient_distance_m(bad, None, CAMERA, RACK, CONFIG)
    assert far is not None
    assert near is None or near < far


# ---------------------------------------------------------------- the command


def test_the_command_writes_tables_and_says_what_would_do(tmp_path: Path) -> None:
    frames = [replace(plane(independent_m=2e-4, shared_m=2e-4), index=k, timestamp_ns=k) for k in range(3)]
    write_mcap(tmp_path / "wall.mcap", frames, as_depth=True)
    ended = tubepose(
        "sensor", tmp_path / "wall.mcap", "--rack", RACK.name, "--tubes", TUBE.name, "--out", tmp_path / "out"
    )  # fmt: skip
    assert ended.code == 0, ended.err
    assert "m and nearer" in ended.out
    noise = pd.read_csv(tmp_path / "out" / "camera_noise.csv")
    assert tuple(noise.columns) == NOISE_COLUMNS
    assert noise["n_frames"].tolist() == [3] * len(noise)
    known = pd.read_csv(tmp_path / "out" / "camera_expected.csv")
    assert tuple(known.columns) == EXPECTED_COLUMNS
    assert set(known["measured"]) <= {"tilt", "position"}
    assert (tmp_path / "out" / "run.json").is_file()


def test_the_command_keeps_the_good_captures(tmp_path: Path) -> None:
    write_folder_capture(tmp_path / "caps" / "wall", plane(independent_m=2e-4))
    (tmp_path / "caps" / "bad").mkdir()
    (tmp_path / "caps" / "bad" / "capture.yaml").write_text(yaml.safe_dump({"unit": "parsec"}))
    ended = tubepose("sensor", tmp_path / "caps")
    assert ended.code == 1
    assert "Depth noise of the camera" in ended.out
    assert len(ended.errors) == 1
    alone = tubepose("sensor", tmp_path / "caps" / "wall", "--tubes", TUBE.name)
    assert (alone.code, alone.errors) == (
        1,
        ["error: --tubes given, but no rack that they stand in; give --rack too"],
    )
    assert tubepose("sensor", tmp_path / "nothing").code == 1
