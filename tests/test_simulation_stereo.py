"""The simulated stereo camera: what matching does to surfaces, its noise, its recordings, its refusals."""

import dataclasses

import cv2
import numpy as np
import pytest
import yaml
from commands import tubepose

from tubepose.capture.source import open_captures
from tubepose.errors import ConfigError
from tubepose.labware import load_cap, load_rack, load_tube
from tubepose.simulation import SceneVariation, simulate_session
from tubepose.simulation.random_scene import random_scene
from tubepose.simulation.stereo import CAMERAS, load_stereo_camera
from tubepose.simulation.stereo.dressing import dressed
from tubepose.simulation.stereo.matching import matched_depth_m, unseen_by_second
from tubepose.simulation.stereo.stereo_camera import StereoCamera
from tubepose.simulation.stereo.stereo_view import StereoView, counted_depth_m, stereo_frames, texture_of
from tubepose.simulation.stereo.waves import depth_error_m, smooth_field

RACK, CAP, TUBE = load_rack("round-10ml-3x4"), load_cap("printed-square-16.7"), load_tube("blood-16x100")
SHAPE = (120, 200)


def camera_of(**changes) -> StereoCamera:
    """A small camera without noise, whose edges do not wander."""
    data = {
        "kind": "stereo-camera",
        "name": "small",
        "image": {"width": SHAPE[1], "height": SHAPE[0], "fx": 300.0, "fy": 300.0, "cx": 99.5, "cy": 59.5},
        "baseline_m": 0.05,
        "stereo_focal_px": 300.0,
        "depth_range_m": (0.1, 5.0),
        "face_distance_m": (0.4, 0.5),
        "wander_px": 0.0,
        "missing_share": 0.0,
        "scale_std": 0.0,
    }
    return StereoCamera.model_validate(data | changes)


def matched(depth, camera, texture=None, seed=0):
    return matched_depth_m(
        camera, depth, np.ones(depth.shape) if texture is None else texture, np.random.default_rng(seed)
    )


def step(near=0.5, far=0.6, column=100):
    depth = np.full(SHAPE, far)
    depth[:, :column] = near
    return depth


def scene(seed=1, camera=None, **variation):
    camera = camera or camera_of()
    rng = np.random.default_rng(seed)
    return random_scene(RACK, [TUBE], CAP, camera, rng, SceneVariation(**variation), camera.face_distance_m)


# ---------------------------------------------------------------- surfaces


def test_planes_stay_where_they_are() -> None:
    camera = camera_of()
    rays = camera.intrinsics.rays()
    normal = np.array([0.3, -0.2, 0.93])
    depth = 0.5 / (rays @ normal)
    np.testing.assert_allclose(matched(depth, camera)[15:-15, 15:-15], depth[15:-15, 15:-15], rtol=2e-4)


@pytest.mark.parametrize(("near_share", "outside_px"), [(0.5, 0.0), (0.35, 2.55), (0.25, 4.25)])
def test_the_foreground_is_fattened(near_share: float, outside_px: float) -> None:
    camera = camera_of(near_share=near_share, window_px=17, ramp_px=6)
    inverse = np.mean(1 / matched(step(), camera)[30:90], axis=0)
    middle = np.interp(-(1 / 0.5 + 1 / 0.6) / 2, -inverse[60:140], np.arange(60, 140)) + 0.5
    assert middle - 100 == pytest.approx(outside_px, abs=1.2)


def test_an_edge_is_a_ramp_of_its_width() -> None:
    inverse = np.median(1 / matched(step(), camera_of(ramp_px=9))[30:90], axis=0)
    share = (inverse - 1 / 0.6) / (1 / 0.5 - 1 / 0.6)
    places = [float(np.interp(-level, -share, np.arange(SHAPE[1]))) for level in (0.9, 0.1)]
    assert places[1] - places[0] == pytest.approx(9, abs=1.5)


@pytest.mark.parametrize(("diameter_px", "flat"), [(12, True), (60, False)])
def test_openings_narrower_than_the_window_are_filled(diameter_px: int, flat: bool) -> None:
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    inside = np.hypot(u - 100, v - 60) < diameter_px / 2
    depth, texture = np.where(inside, 0.58, 0.5), np.where(inside, 0.5, 1.0)
    middle = matched(depth, camera_of(), texture)[60, 100]
    assert middle == pytest.approx(0.5 if flat else 0.58, abs=1e-3)


def test_a_thing_much_smaller_than_the_window_vanishes() -> None:
    depth = np.full(SHAPE, 0.6)
    depth[58:62, 98:102] = 0.5
    assert matched(depth, camera_of())[60, 100] == pytest.approx(0.6, abs=2e-3)


def test_black_and_glaring_surfaces_have_no_depth() -> None:
    radiance = np.full((*SHAPE, 3), 0.5, np.float32)
    radiance[30:90, 20:80] = 0.002
    radiance[40:80, 130:170] = 4.0
    texture = texture_of(radiance)
    assert texture[10, 10] > 0.8
    found = matched(np.full(SHAPE, 0.5), camera_of(), texture)
    assert np.isnan(found[60, 50])
    assert np.isnan(found[60, 150])
    assert np.isfinite(found[10, 10])


def test_a_band_at_the_left_of_near_objects_is_not_seen_by_the_second_imager() -> None:
    depth = np.full(SHAPE, 1.0)
    depth[40:80, 90:130] = 0.5
    hidden = unseen_by_second(camera_of(), 1 / depth)
    rows = hidden[45:75].sum(axis=1)
    np.testing.assert_allclose(rows, 300 * 0.05 * (1 / 0.5 - 1 / 1.0), atol=1)
    assert hidden[60, 89]
    assert not hidden[:, 130:].any()
    assert not hidden[:35].any()


def test_blind_columns_are_as_wide_as_the_disparity() -> None:
    hidden = unseen_by_second(camera_of(blind_columns=True), np.full(SHAPE, 1 / 0.5))
    assert (hidden.sum(axis=1) == 30).all()
    assert hidden[:, :30].all()


# ---------------------------------------------------------------- noise


@pytest.mark.parametrize("length_px", [(4.0, 3.0), (10.0, 7.0), (40.0, 20.0)])
def test_fields_have_variance_one_and_their_lengths(length_px: tuple[float, float]) -> None:
    fields = np.array([smooth_field((600, 900), length_px, np.random.default_rng(seed)) for seed in range(5)])
    assert np.std(fields) == pytest.approx(1, rel=0.08)
    for axis, length in ((2, length_px[0]), (1, length_px[1])):
        lag = round(length)
        ahead, behind = np.swapaxes(fields, 0, axis)[lag:], np.swapaxes(fields, 0, axis)[:-lag]
        assert np.mean(ahead * behind) == pytest.approx(np.exp(-((lag / length) ** 2)), abs=0.1)


WAVES = {
    "waves": [{"length_px": [6, 4]}, {"length_px": [8, 6], "temporal": True}],
    "noise": [{"depth_m": 0.4, "std_mm": [1.0, 2.0]}, {"depth_m": 0.8, "std_mm": [2.0, 6.0]}],
}


def test_noise_is_linear_between_its_depths_and_proportional_beyond() -> None:
    camera = camera_of(**WAVES)
    depths = np.array([0.2, 0.4, 0.6, 0.8, 1.6])
    np.testing.assert_allclose(camera.wave_std_m(1, depths), np.array([1.0, 2.0, 4.0, 6.0, 12.0]) * 1e-3)


def test_waves_that_stay_and_waves_that_do_not() -> None:
    camera = camera_of(**WAVES, subpixel=0, depth_step_m=1e-4)
    depth = np.full(SHAPE, 0.4) + depth_error_m(camera, np.full(SHAPE, 0.4), np.random.default_rng(0), temporal=False)
    view = StereoView(camera, np.zeros((*SHAPE, 3), np.float32), depth, np.zeros(SHAPE, np.float32), 0)
    frames = np.array([view.frame_depth_m(rng) for rng in np.random.default_rng(1).spawn(16)])
    np.testing.assert_allclose(np.std(frames, axis=0).mean(), 2e-3, rtol=0.1)
    mean = frames.mean(axis=0) - 0.4
    assert np.var(mean) == pytest.approx(1e-6 + 4e-6 / 16, rel=0.25)
    assert np.corrcoef(mean.ravel(), (depth - 0.4).ravel())[0, 1] > 0.85


def test_depth_comes_in_steps_of_disparity_and_of_counts() -> None:
    d435 = load_stereo_camera("d435")
    values = np.unique(counted_depth_m(d435, np.linspace(1.43, 1.44, 2000)))
    assert np.median(np.diff(values)) == pytest.approx(2e-3, abs=1e-9)
    np.testing.assert_allclose(values, np.round(values, 3), atol=1e-12)
    assert np.isnan(counted_depth_m(d435, np.array([0.1, 11.0, np.nan]))).all()


# ---------------------------------------------------------------- scenes


def test_depth_of_a_scene_lies_on_its_rack() -> None:
    camera = camera_of()
    seen = scene(fill=(0.1, 0.1))
    (frame,) = stereo_frames(seen, camera, np.random.default_rng(0))
    points = (frame.measured_m - seen.T_camera_rack[:3, 3]) @ seen.T_camera_rack[:3, :3]
    half = RACK.outline_m / 2 - 0.005
    on_face = points[(np.abs(points[:, :2]) < half).all(axis=1) & (np.abs(points[:, 2] - RACK.height_m) < 0.012)]
    assert len(on_face) > 500
    assert np.median(on_face[:, 2]) == pytest.approx(RACK.height_m, abs=1.5e-3)
    assert frame.image is not None
    assert frame.image.shape == (*SHAPE, 3)
    assert frame.simulated


def test_clear_tubes_are_seen_through_and_milky_ones_are_not() -> None:
    milky, clear = (
        TUBE.model_copy(update={"body": TUBE.body.model_copy(update={"material": material})})
        for material in ("translucent", "transparent")
    )
    camera = camera_of()
    counts = []
    for model in (milky, clear):
        rng = np.random.default_rng(2)
        one = random_scene(RACK, [model], CAP, camera, rng, SceneVariation(), camera.face_distance_m)
        counts.append((len(one.tubes), len(dressed(one).parts), len(dressed(one).with_depth)))
    assert counts[0][1] == counts[0][2]
    assert counts[1][1] - counts[1][2] == counts[1][0]


def test_what_a_scene_looks_like_does_not_depend_on_its_caps() -> None:
    one = scene()
    other = dressed(dataclasses.replace(one, printed_cap=CAP))
    assert [part.surface.albedo for part in dressed(one).parts[:3]] == [part.surface.albedo for part in other.parts[:3]]
    np.testing.assert_array_equal(dressed(one).light.environment, other.light.environment)


def simulate(out, **changes):
    options = {"trials": 1, "seed": 3, "cap": CAP, "sensor": "stereo", "camera": camera_of(**WAVES), "printed": False}
    simulate_session(out, RACK, [TUBE], **(options | changes))
    return out


def test_sessions_have_counted_depth_and_recordings_begin_with_the_same_frame(tmp_path) -> None:
    (name,) = (path.name for path in (simulate(tmp_path / "a") / "captures").iterdir())
    counts = cv2.imread(str(tmp_path / "a" / "captures" / name / "depth.png"), cv2.IMREAD_UNCHANGED)
    assert counts.dtype == np.uint16
    described = yaml.safe_load((tmp_path / "a" / "captures" / name / "capture.yaml").read_text())
    assert described["depth_scale_m"] == 0.001
    assert described["sensor"] == "simulated-stereo-small"
    assert described["simulated"] is True
    (alone,) = next(iter(open_captures(tmp_path / "a" / "captures"))).frames()
    simulate(tmp_path / "b", frames=3, capture_format="mcap")
    frames = list(open_captures(tmp_path / "b" / "captures")[0].frames())
    assert [frame.index for frame in frames] == [0, 1, 2]
    np.testing.assert_allclose(frames[0].cloud_m, alone.cloud_m, atol=1e-9)
    stamps = np.diff([frame.timestamp_ns for frame in frames])
    assert (stamps == 33_333_333).all()
    assert not np.array_equal(frames[0].cloud_m, frames[1].cloud_m, equal_nan=True)


def test_depth_finer_than_a_millimetre_survives_a_recording(tmp_path) -> None:
    simulate(tmp_path / "s", camera=camera_of(**WAVES, depth_step_m=1e-4, depth_range_m=(0.1, 4.0)), frames=2,
             capture_format="mcap")  # fmt: skip
    depth = next(iter(open_captures(tmp_path / "s" / "captures")[0].frames())).cloud_m[..., 2]
    counts = depth[np.isfinite(depth)] / 1e-4
    np.testing.assert_allclose(counts, np.round(counts), atol=5e-3)
    assert (np.round(counts) % 10 != 0).any()


def test_other_sensors_record_several_frames_too(tmp_path) -> None:
    simulate(tmp_path / "s", sensor="raycast", camera=None, resolution=64, frames=2, capture_format="mcap")
    first, second = open_captures(tmp_path / "s" / "captures")[0].frames()
    assert not np.array_equal(first.cloud_m, second.cloud_m, equal_nan=True)


# ---------------------------------------------------------------- refusals


@pytest.mark.parametrize("name", CAMERAS)
def test_bundled_cameras_are_whole(name: str) -> None:
    camera = load_stereo_camera(name)
    assert camera.name == name
    assert camera.source
    assert camera.exact().scale_std == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"noise": [{"depth_m": 0.4, "std_mm": [1.0]}], "waves": WAVES["waves"]}, "expected 2 values of std_mm"),
        ({"waves": WAVES["waves"]}, "waves and noise belong together"),
        ({"noise": WAVES["noise"][::-1], "waves": WAVES["waves"]}, "rising values of depth_m"),
        ({"depth_step_m": 1e-5}, "16 bits"),
        ({"face_distance_m": [0.01, 0.5]}, "within depth_range_m"),
        ({"colour": 1}, "colour"),
    ],
)
def test_files_that_break_the_format_are_refused(tmp_path, change, words: str) -> None:
    data = camera_of().model_dump(mode="json") | change
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(data))
    with pytest.raises(ConfigError, match=words):
        load_stereo_camera(str(tmp_path / "c.yaml"))


def test_unknown_cameras_and_options_that_do_not_fit_are_refused(tmp_path) -> None:
    with pytest.raises(ConfigError, match="known: d405, d435"):
        load_stereo_camera("d999")
    with pytest.raises(ConfigError, match="a camera goes with the sensor stereo"):
        simulate(tmp_path / "s", camera=None)
    with pytest.raises(ConfigError, match="choose the format mcap"):
        simulate(tmp_path / "s", frames=2)
    with pytest.raises(ConfigError, match="expected 1 to 750"):
        simulate(tmp_path / "s", frames=10_000, capture_format="mcap")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--sensor", "stereo"], "--sensor stereo needs --camera: d405, d435, d435-640, or a YAML file"),
        (["--camera", "d405"], "--camera given, but --sensor raycast has no use for it; give --sensor stereo"),
        (
            ["--sensor", "stereo", "--camera", "d405", "--resolution", "400"],
            "the size of a stereo image is its camera's",
        ),
        (["--frames", "2", "--format", "folder"], "2 frames do not go into a folder, which holds one"),
    ],
)
def test_options_of_the_command_that_do_not_fit_are_one_line(tmp_path, options, words: str) -> None:
    ended = tubepose("simulate", tmp_path / "s", "--rack", RACK.name, "--tubes", TUBE.name, "--trials", "1", *options)
    assert ended.code == 1
    assert len(ended.errors) == 1
    assert words in ended.errors[0]
    assert not (tmp_path / "s").exists()
