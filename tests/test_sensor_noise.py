"""Noise measured in captures without truth: known noise is found, whatever the view; what is not seen is a prior."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import scenes
from scipy.spatial.transform import Rotation

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.config import SensorConfig
from tubepose.labware import load_rack
from tubepose.sensor import SensorNoise, measure_noise, prior_noise
from tubepose.sensor.noise import DiscNoise, height_gain, slope_gain
from tubepose.sensor.surfaces import low_order_surface, solid_map
from tubepose.sensor.variances import cell_correlation
from tubepose.simulation.depth_noise import DepthNoise
from tubepose.transforms import FloatArray, invert_transform, make_transform

CONFIG = SensorConfig()
RACK = load_rack("round-10ml-3x4")
CAMERA = CameraIntrinsics(700, 600, 900.0, 900.0, 349.5, 299.5)
T_CAMERA_RACK = scenes.camera_from_rack(RACK, 0.3, 0.1, distance_m=0.5)
CAP_M = 6.5e-3


def ideal(T_camera_rack: FloatArray = T_CAMERA_RACK, camera: CameraIntrinsics = CAMERA) -> RgbdFrame:
    """A noiseless frame of an empty rack on a table: rays meet the solid top, or the table, and never a wall."""
    rays, depth = camera.rays(), np.full((camera.height, camera.width), np.nan)
    T_rack_camera = invert_transform(T_camera_rack)
    for height in (RACK.height_m, 0.0):
        share = (height - T_rack_camera[2, 3]) / (rays @ T_rack_camera[2, :3])
        xy = (share[..., None] * (rays @ T_rack_camera[:3, :3].T) + T_rack_camera[:3, 3])[..., :2]
        met = np.isnan(depth) if height == 0.0 else RACK.top_signed_distance_m(xy) < 0
        depth[met] = share[met]
    return RgbdFrame(camera.backproject(depth), None, camera, None, "ideal", simulated=True)


def measure(frame: RgbdFrame, T_camera_rack: FloatArray = T_CAMERA_RACK) -> SensorNoise:
    return measure_noise(frame, frame.intrinsics, T_camera_rack, RACK, CONFIG)


def noisy(noise: DepthNoise, seed: int = 0) -> RgbdFrame:
    return noise.applied(ideal(), np.random.default_rng(seed))


def beside_alone(frame: RgbdFrame, keep_table: bool) -> RgbdFrame:
    """The frame without its table, or without its rack."""
    T = invert_transform(T_CAMERA_RACK)
    height = frame.cloud_m @ T[2, :3] + T[2, 3]
    table = height < RACK.height_m / 2
    return replace(frame, cloud_m=np.where((table == keep_table)[..., None], frame.cloud_m, np.nan))


def true_slope_std(noise: DepthNoise, distance_m: float) -> float:
    """Slopes of discs of a cap's radius on a plane that faces the camera, fitted one by one."""
    reach = int(np.ceil(CAP_M * CAMERA.fx / distance_m))
    plane = RgbdFrame(CAMERA.backproject(np.full((600, 700), distance_m)), None, CAMERA, None, "plane")
    slopes = []
    for seed in range(2):
        height = -noise.applied(plane, np.random.default_rng(100 + seed)).cloud_m[..., 2]
        for v in range(reach, 600 - reach, 2 * reach):
            for u in range(reach, 700 - reach, 2 * reach):
                window = slice(v - reach, v + reach + 1), slice(u - reach, u + reach + 1)
                xy = plane.cloud_m[window][..., :2] - plane.cloud_m[v, u, :2]
                near = (np.linalg.norm(xy, axis=-1) < CAP_M) & np.isfinite(height[window])
                terms = np.column_stack([np.ones(near.sum()), xy[near]])
                slopes.append(np.linalg.lstsq(terms, height[window][near], rcond=None)[0][1:])
    return float(np.std(slopes))


@pytest.mark.parametrize(
    "noise",
    [
        DepthNoise(independent_m=1e-4),
        DepthNoise(independent_m=1e-3),
        DepthNoise(shared_m=3e-4, correlation_m=3e-3),
        DepthNoise(1e-4, 1e-4, 2e-3),
        DepthNoise(3e-4, 3e-4, 5e-3),
        DepthNoise(1e-4, 1e-4, 3e-3, missing=0.3),
        DepthNoise(1e-4, 1e-4, 3e-3, blur_px=3),
    ],
    ids=str,
)
def test_known_noise_is_found(noise: DepthNoise) -> None:
    found = measure(noisy(noise))
    assert found.source == "table"
    disc = found.discs[1]
    assert disc.radius_m == CAP_M
    # The law is the same at every depth: it is asked for where it was measured. Three of its own standard deviations.
    expected = true_slope_std(noise, found.distance_m)
    assert found.slope_std(CAP_M, found.distance_m) == pytest.approx(expected, rel=3 * disc.relative_std + 0.03)
    assert found.independent_m == pytest.approx(noise.independent_m, rel=0.06, abs=0.15 * noise.shared_m)
    assert found.shared_m == pytest.approx(noise.shared_m, rel=0.2, abs=0.15 * noise.independent_m)
    if noise.shared_m:
        assert found.correlation_m == pytest.approx(noise.correlation_m, rel=0.3)


def test_stated_stds_cover_the_scatter_of_repeated_measurements() -> None:
    noise = DepthNoise(1e-4, 1e-4, 2e-3)
    found = [measure(noisy(noise, seed)) for seed in range(12)]
    ratios = np.array([one.discs[1].slope_std for one in found])
    scatter = np.std(ratios) / np.mean(ratios)
    assert 0.3 < scatter / found[0].discs[1].relative_std < 2.0


def test_outliers_spacing_and_distance_are_those_of_the_table() -> None:
    frame = noisy(DepthNoise(independent_m=1e-4))
    lost = np.random.default_rng(3).random(frame.cloud_m.shape[:2]) < 0.02
    found = measure(replace(frame, cloud_m=np.where(lost[..., None], 0.9 * frame.cloud_m, frame.cloud_m)))
    assert found.outlier_share == pytest.approx(0.02, rel=0.3)
    assert found.spacing_m == pytest.approx(found.distance_m / CAMERA.fx, rel=0.06)
    depth = frame.cloud_m[..., 2]
    assert np.nanmin(depth) < found.distance_m < np.nanmax(depth)


def test_moving_the_camera_and_turning_the_rack_change_nothing() -> None:
    frame = noisy(DepthNoise(1e-4, 1e-4))
    before = measure(frame)
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    # The depth along the optical axis is not moved with the cloud: a turn about that axis keeps it.
    about_axis = make_transform(Rotation.from_rotvec([0, 0, 0.7]).as_matrix(), np.zeros(3))
    cloud = frame.cloud_m @ about_axis[:3, :3].T
    turned = measure_noise(
        replace(frame, cloud_m=cloud, organised=False), None, about_axis @ T_CAMERA_RACK, RACK, CONFIG
    )
    assert turned.discs[1].slope_std == pytest.approx(before.discs[1].slope_std, rel=1e-6)
    other_way = measure(frame, T_CAMERA_RACK @ half_turn)
    assert other_way.discs[1].slope_std == pytest.approx(before.discs[1].slope_std, rel=0.15)
    assert other_way.shared_m == pytest.approx(before.shared_m, rel=0.05)


@pytest.mark.parametrize(("yaw", "tilt"), [(0.0, 0.0), (1.2, -0.25)])
def test_another_view_of_the_same_noise_has_the_same_answer(yaw: float, tilt: float) -> None:
    noise = DepthNoise(1e-4, 1e-4)
    T = scenes.camera_from_rack(RACK, yaw, tilt, distance_m=0.5)
    seen = measure(noise.applied(ideal(T), np.random.default_rng(1)), T)
    first = measure(noisy(noise))
    assert seen.slope_std(CAP_M, 0.5) == pytest.approx(first.slope_std(CAP_M, 0.5), rel=0.25)
    assert seen.independent_m == pytest.approx(first.independent_m, rel=0.1)


def test_a_cloud_without_pixels_has_the_noise_of_the_same_cloud_with_pixels() -> None:
    frame = noisy(DepthNoise(1e-4, 1e-4))
    points = np.random.default_rng(0).permutation(frame.measured_m)
    found, before = measure(scenes.unorganised(points)), measure(frame)
    assert found.discs[1].slope_std == pytest.approx(before.discs[1].slope_std, rel=0.03)
    assert found.shared_m == pytest.approx(before.shared_m, rel=0.05)
    assert (found.edge_source, found.edge_blur_px) == ("prior", CONFIG.edge_blur_px)


@pytest.mark.parametrize("step_m", [1e-4, 5e-4, 1e-3])
def test_depth_in_steps_does_not_read_as_no_noise(step_m: float) -> None:
    noise = DepthNoise(1e-4, 1e-4, step_m=step_m)
    found, without = measure(noisy(noise)), measure(noisy(replace(noise, step_m=0.0)))
    assert found.slope_std(CAP_M, 0.5) > 0.9 * without.slope_std(CAP_M, 0.5)
    assert np.hypot(found.independent_m, found.shared_m) > 0.9 * np.sqrt(2e-8 + step_m**2 / 12)


def test_steps_alone_are_noise() -> None:
    found = measure(noisy(DepthNoise(step_m=5e-4)))
    assert np.hypot(found.independent_m, found.shared_m) == pytest.approx(5e-4 / np.sqrt(12), rel=0.25)


def test_nothing_to_measure_is_the_prior_and_says_so() -> None:
    empty = replace(ideal(), cloud_m=np.full_like(ideal().cloud_m, np.nan))
    found = measure(empty)
    assert found.source == found.outlier_source == found.edge_source == "prior"
    assert "no level surface" in found.note
    assert (found.independent_m, found.shared_m, found.n_patches) == (CONFIG.independent_m, CONFIG.shared_m, 0)
    assert np.isnan(found.independent_relative_std)
    lost = measure_noise(ideal(), CAMERA, None, RACK, CONFIG)
    assert (lost.source, lost.note) == ("prior", "the rack's pose is not known")
    assert lost.slope_std(CAP_M, 0.5) > 0


@pytest.mark.parametrize("noise", [DepthNoise(1e-4), DepthNoise(1e-4, 1e-4), DepthNoise(3e-4, 3e-4, 2e-3)], ids=str)
def test_without_a_table_the_racks_top_tells(noise: DepthNoise) -> None:
    frame = noisy(noise)
    found, with_table = measure(beside_alone(frame, keep_table=False)), measure(frame)
    assert (found.source, found.outlier_source, found.edge_source) == ("rack_top", "prior", "prior")
    assert "no table is seen" in found.note
    expected = with_table.slope_std(CAP_M, found.distance_m)
    # Both depths have the same law here, and the table's noise is scaled to the nearer one: 20 % less.
    scale = with_table.distance_m / found.distance_m
    tolerance = 2 * found.shared_relative_std + 0.15
    assert found.slope_std(CAP_M, found.distance_m) == pytest.approx(expected * scale, rel=tolerance)


def test_without_a_rack_in_view_the_table_tells() -> None:
    found = measure(beside_alone(noisy(DepthNoise(1e-4, 1e-4)), keep_table=True))
    assert (found.source, found.edge_source) == ("table", "prior")


def on_table(frame: RgbdFrame, where: object, lift_m: float) -> RgbdFrame:
    """The frame with places of the table, chosen by their (x, y), that much nearer to the camera."""
    T = invert_transform(T_CAMERA_RACK)
    local = frame.cloud_m @ T[:3, :3].T + T[:3, 3]
    chosen = (local[..., 2] < RACK.height_m / 2) & where(local[..., 0], local[..., 1])  # type: ignore[operator]
    nearer = frame.cloud_m * (1 - lift_m / frame.cloud_m[..., 2:])
    return replace(frame, cloud_m=np.where(chosen[..., None], nearer, frame.cloud_m))


def test_a_patterned_table_does_not_blow_up_the_result() -> None:
    frame = noisy(DepthNoise(5e-5, 3e-5))

    def checkered(x: FloatArray, y: FloatArray) -> FloatArray:
        return (np.floor(x / 8e-3) + np.floor(y / 8e-3)) % 2 > 0

    found, plain = measure(on_table(frame, checkered, 6e-4)), measure(frame)
    assert found.source == "rack_top"
    assert "the table has" in found.note
    assert "rack's top, which is taken" in found.note
    assert found.slope_std(CAP_M, 0.45) < 2 * plain.slope_std(CAP_M, 0.45)


@pytest.mark.parametrize("lift_m", [5e-3, 2e-2])
def test_things_on_the_table_are_not_noise(lift_m: float) -> None:
    frame = noisy(DepthNoise(1e-4, 1e-4))

    def blocks(x: FloatArray, y: FloatArray) -> FloatArray:
        return (np.abs(np.mod(x, 0.06) - 0.03) < 0.01) & (np.abs(np.mod(y, 0.06) - 0.03) < 0.01)

    found, plain = measure(on_table(frame, blocks, lift_m)), measure(frame)
    assert found.slope_std(CAP_M, 0.5) == pytest.approx(plain.slope_std(CAP_M, 0.5), rel=0.2)


@pytest.mark.parametrize("blur_px", [0, 2, 4, 6])
def test_blur_of_edges_is_counted(blur_px: float) -> None:
    found = measure(noisy(DepthNoise(independent_m=5e-5, blur_px=blur_px)))
    assert found.edge_source == "rack_outline"
    # A square window of w pixels is w (1 + t) / (1 + t^2) steps wide across an edge of slope t: up to 1.21 w.
    assert 0.9 * blur_px <= found.edge_blur_px <= (1.21 * (blur_px + 1) - 1 if blur_px else 0)


def test_lost_pixels_at_an_edge_are_not_blur() -> None:
    assert measure(noisy(DepthNoise(independent_m=5e-5, missing=0.3))).edge_blur_px == 0


def noise_of(**values: object) -> SensorNoise:
    return replace(prior_noise(CONFIG), independent_m=1e-4, shared_m=0.0, spacing_m=5e-4, **values)  # type: ignore[arg-type]


def test_model_of_independent_points_is_that_of_a_least_squares_plane() -> None:
    x, y = np.meshgrid(np.arange(-40, 41) * 5e-4, np.arange(-40, 41) * 5e-4)
    inside = np.hypot(x, y) < 8e-3
    terms = np.column_stack([np.ones(inside.sum()), x[inside], y[inside]])
    covariance = 1e-8 * np.linalg.inv(terms.T @ terms)
    noise = noise_of(distance_m=0.5)
    assert noise.slope_std(8e-3, 0.5) == pytest.approx(np.sqrt(covariance[1, 1]), rel=0.02)
    assert noise.height_std_m(8e-3, 0.5) == pytest.approx(np.sqrt(covariance[0, 0]), rel=0.02)


@pytest.mark.parametrize("length_m", [1e-3, 3e-3, 6e-3, 2e-2])
def test_model_of_shared_error_is_that_of_a_least_squares_plane(length_m: float) -> None:
    radius, (x, y) = 6e-3, np.meshgrid(np.arange(-12, 13) * 5e-4, np.arange(-12, 13) * 5e-4)
    inside = np.hypot(x, y) < radius
    xy = np.column_stack([x[inside], y[inside]])
    shared = np.exp(-np.sum((xy[:, None] - xy[None]) ** 2, axis=-1) / length_m**2)
    fit = np.linalg.pinv(np.column_stack([np.ones(len(xy)), xy]))
    truth = np.diag(fit @ shared @ fit.T)
    gain = slope_gain(length_m / radius) / (radius**2 / 4)
    assert np.sqrt(gain) == pytest.approx(np.sqrt(truth[1]), rel=0.15)
    assert np.sqrt(height_gain(length_m / radius)) == pytest.approx(np.sqrt(truth[0]), rel=0.1)


def test_mean_correlation_in_a_cell_is_that_of_drawn_pairs() -> None:
    a, b = np.random.default_rng(0).uniform(0, 1.7, (2, 200_000, 2))
    drawn = np.mean(np.exp(-np.sum((a - b) ** 2, axis=1)))
    assert float(cell_correlation(1.7)) == pytest.approx(drawn, rel=0.01)


def test_measured_discs_go_before_the_model_and_scale_with_equal_pixels() -> None:
    plain = noise_of(distance_m=0.5)
    discs = (
        DiscNoise(4e-3, 3 * plain.slope_std(4e-3, 0.5), plain.height_std_m(4e-3, 0.5), 100, 0.05),
        DiscNoise(1e-2, 5 * plain.slope_std(1e-2, 0.5), plain.height_std_m(1e-2, 0.5), 100, 0.05),
    )
    noise = replace(plain, discs=discs)
    assert noise.slope_std(4e-3, 0.5) == pytest.approx(discs[0].slope_std)
    assert noise.slope_std(1e-2, 0.5) == pytest.approx(discs[1].slope_std)
    between = noise.slope_std(6e-3, 0.5) / plain.slope_std(6e-3, 0.5)
    assert 3 < between < 5
    assert noise.slope_std(2e-2, 0.5) == pytest.approx(5 * plain.slope_std(2e-2, 0.5))
    # The same pixels at twice the distance: the same slope, twice the height.
    assert noise.slope_std(8e-3, 1.0) == pytest.approx(discs[0].slope_std)
    assert noise.height_std_m(8e-3, 1.0) == pytest.approx(2 * discs[0].height_std_m)


def test_a_bow_is_taken_out_where_there_is_one_only() -> None:
    rng = np.random.default_rng(0)
    rows = np.zeros((20_000, 4))
    rows[:, :2] = rng.uniform(-0.1, 0.1, (20_000, 2))
    rows[:, 2] = 0.01 + 0.02 * rows[:, 0] + rng.normal(0, 1e-4, 20_000)
    np.testing.assert_array_equal(low_order_surface(rows)[3:], 0)
    rows[:, 2] += 0.1 * rows[:, 0] ** 2
    np.testing.assert_allclose(low_order_surface(rows), [0.01, 0.02, 0, 0.1, 0, 0], atol=2e-3)


def test_the_map_of_the_solid_top_keeps_its_distance_from_every_edge() -> None:
    low, solid = solid_map(RACK, 1e-3)
    cells = low + np.argwhere(solid) * 2.5e-4
    assert np.all(RACK.top_signed_distance_m(cells) < -1e-3)
    assert np.count_nonzero(solid) * 2.5e-4**2 > 0.3 * np.prod(RACK.outline_m) * 0.5


def test_frames_are_not_changed() -> None:
    frame = noisy(DepthNoise(1e-4))
    before = frame.cloud_m.copy()
    measure(frame)
    np.testing.assert_array_equal(frame.cloud_m, before)
