"""Simulated sessions: files, seeds, truth, refusals."""

import hashlib

import numpy as np
import pytest

from tubepose.capture.frame import RgbdFrame
from tubepose.capture.session import load_session
from tubepose.capture.source import open_captures
from tubepose.errors import CaptureError, ConfigError
from tubepose.labware import load_cap, load_rack, load_tube
from tubepose.simulation import SENSORS, SceneVariation, read_exact_truth, simulate_session

RACK = load_rack("chen2023-soft-5x10")
CAP = load_cap("printed-square-16.7")
TUBES = [load_tube("chen2023-tube-1"), load_tube("chen2023-tube-2")]


def simulate(out, tubes=TUBES, rack=RACK, **changes):
    options = {"trials": 1, "seed": 7, "cap": CAP, "resolution": 96} | changes
    simulate_session(out, rack, tubes, **options)
    return out


def digests(folder):
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


@pytest.fixture
def seen_scenes(monkeypatch):
    """Replace the sensor by one that notes the scenes and sees nothing."""
    scenes = []

    def blind(scene, camera, rng, *, threads=1):
        scenes.append(scene)
        k = camera.intrinsics
        return RgbdFrame(np.full((k.height, k.width, 3), np.nan), np.zeros((k.height, k.width), np.uint8), k, None, "")

    for name in ("raycast", "structured-light"):
        monkeypatch.setitem(SENSORS, name, blind)
    return scenes


def filled(low, high):
    return {"variation": SceneVariation(fill=(low, high))}


def test_the_same_seed_gives_the_same_bytes_with_one_and_two_threads(tmp_path):
    first = digests(simulate(tmp_path / "a" / "s"))
    assert digests(simulate(tmp_path / "b" / "s", threads=2)) == first
    other = digests(simulate(tmp_path / "c" / "s", seed=8))
    assert other.keys() == first.keys()
    images = [name for name in first if name.endswith(("depth.png", "image.png"))]
    assert len(images) == 8
    assert all(other[name] != first[name] for name in images)


def test_a_trial_does_not_depend_on_the_number_of_trials(tmp_path, seen_scenes):
    short, long = digests(simulate(tmp_path / "a")), digests(simulate(tmp_path / "b", trials=3))
    assert all(long[name] == digest for name, digest in short.items() if name != "session.yaml")
    assert len(long) > len(short)


def test_the_session_opens_and_its_captures_are_as_announced(tmp_path):
    session = load_session(simulate(tmp_path / "s", tubes=TUBES[:1]))
    assert (session.origin, session.rack, session.printed_cap) == ("simulated", RACK, CAP)
    (trial,) = session.trials
    assert set(trial.tubes.values()) == {"chen2023-tube-1"}
    stamps = []
    for place in (trial.printed, trial.original):
        (capture,) = open_captures(session.folder / place)
        (frame,) = capture.frames()
        assert frame.simulated
        assert frame.image.shape == (96, 96)
        assert frame.valid.mean() > 0.5
        stamps.append(frame.timestamp_ns)
    assert stamps[1] > stamps[0] > 10**18


def test_truth_is_read_as_it_was_written(tmp_path, seen_scenes):
    out = simulate(tmp_path / "s", tubes=TUBES[:1])
    truth = read_exact_truth(out, "chen2023-tube-1-001")
    scene = seen_scenes[0]
    assert np.array_equal(truth.T_camera_rack, scene.T_camera_rack)
    assert list(truth.tubes) == [tube.slot for tube in scene.tubes]
    for tube in scene.tubes:
        name, T_camera_tube = truth.tubes[tube.slot]
        assert name == "chen2023-tube-1"
        assert np.array_equal(T_camera_tube, scene.T_camera_rack @ tube.T_rack_tube)


def test_printed_and_original_captures_share_all_poses(tmp_path, seen_scenes):
    simulate(tmp_path / "s", trials=2)
    assert len(seen_scenes) == 8
    for printed, original in zip(seen_scenes[::2], seen_scenes[1::2], strict=True):
        assert printed.printed_cap == CAP
        assert original.printed_cap is None
        assert printed.tubes == original.tubes
        assert np.array_equal(printed.T_camera_rack, original.T_camera_rack)


def test_without_printed_captures_the_others_are_the_same(tmp_path):
    whole = simulate(tmp_path / "whole", tubes=TUBES[:1])
    half = simulate(tmp_path / "half", tubes=TUBES[:1], printed=False)
    session = load_session(half)
    (trial,) = session.trials
    assert (trial.printed, session.printed_cap) == (None, CAP)
    assert session.name != load_session(whole).name
    kept = digests(half)
    assert {path.name for path in (half / "captures").iterdir()} == {"chen2023-tube-1-001-original"}
    assert kept.items() - digests(whole).items() == {("session.yaml", kept["session.yaml"])}


def test_the_hint_points_at_the_first_slot(tmp_path, seen_scenes):
    session = load_session(simulate(tmp_path / "s", tubes=TUBES[:1], resolution=688))
    hint = session.trials[0].hint
    scene = seen_scenes[0]
    center = scene.T_camera_rack @ [*RACK.slot("A1").center_m, RACK.height_m, 1]
    uv = center[:2] / center[2] * 782 + 343.5
    assert hint.slot == "A1"
    assert np.hypot(*(np.array(hint.pixel) - uv)) < 8


def test_fill_and_mixed(tmp_path, seen_scenes):
    session = load_session(simulate(tmp_path / "s", mixed=True, trials=4, **filled(0.3, 0.3)))
    assert [trial.name for trial in session.trials] == [f"mixed-{k:03d}" for k in (1, 2, 3, 4)]
    assert all(len(trial.tubes) == 15 for trial in session.trials)
    assert set(session.trials[0].tubes.values()) == {"chen2023-tube-1", "chen2023-tube-2"}
    sparse = load_session(simulate(tmp_path / "one", **filled(0.001, 0.001)))
    assert all(len(trial.tubes) == 1 for trial in sparse.trials)


def test_default_fill_leaves_slots_empty(tmp_path, seen_scenes):
    session = load_session(simulate(tmp_path / "s", trials=4, resolution=32))
    counts = [len(trial.tubes) for trial in session.trials]
    assert min(counts) >= 5
    assert max(counts) <= 20
    assert len(set(counts)) > 2


def test_labware_that_is_not_in_the_catalogue_goes_along(tmp_path, seen_scenes):
    mine = TUBES[0].model_copy(update={"name": "mine"})
    rack = RACK.model_copy(update={"name": "my-rack", "height_mm": 54.0})
    session = load_session(simulate(tmp_path / "s", tubes=[mine], rack=rack))
    assert session.rack == rack
    assert session.tubes == {"labware/mine.yaml": mine}
    assert read_exact_truth(session.folder, "mine-001").tubes.popitem()[1][0] == "labware/mine.yaml"


def test_mcap_captures(tmp_path):
    session = load_session(simulate(tmp_path / "s", tubes=TUBES[:1], capture_format="mcap"))
    place = session.trials[0].original
    assert place.endswith(".mcap")
    (capture,) = open_captures(session.folder / place)
    (frame,) = capture.frames()
    assert frame.simulated
    assert frame.valid.mean() > 0.5


def test_progress_counts_captures(tmp_path, seen_scenes):
    calls = []
    simulate(tmp_path / "s", progress=lambda done, total: calls.append((done, total)))
    assert calls == [(1, 4), (2, 4), (3, 4), (4, 4)]


def test_an_empty_folder_is_filled_and_a_full_one_refused(tmp_path, seen_scenes):
    (tmp_path / "s").mkdir()
    simulate(tmp_path / "s")
    before = digests(tmp_path)
    with pytest.raises(CaptureError, match="there is something already"):
        simulate(tmp_path / "s")
    assert digests(tmp_path) == before


def broken_after(captures, scenes):
    """A sensor that fails after some captures."""
    whole = SENSORS["raycast"]

    def sensor(scene, camera, rng, *, threads=1):
        if len(scenes) == captures:
            raise KeyboardInterrupt
        return whole(scene, camera, rng)

    return sensor


def test_a_failure_leaves_nothing_behind(tmp_path, monkeypatch, seen_scenes):
    monkeypatch.setitem(SENSORS, "raycast", broken_after(3, seen_scenes))
    with pytest.raises(KeyboardInterrupt):
        simulate(tmp_path / "s")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("capture_format", ["folder", "mcap"])
def test_a_stopped_session_goes_on_where_it_was(tmp_path, monkeypatch, seen_scenes, capture_format):
    options = {"resume": True, "capture_format": capture_format, "resolution": 32}
    whole = digests(simulate(tmp_path / "whole", **options))
    seen_scenes.clear()
    with monkeypatch.context() as patch:
        patch.setitem(SENSORS, "raycast", broken_after(3, seen_scenes))
        with pytest.raises(KeyboardInterrupt):
            simulate(tmp_path / "s", **options)
    assert not (tmp_path / "s").exists()
    with pytest.raises(CaptureError, match=r"\.s\.part: captures of an interrupted run with other options"):
        simulate(tmp_path / "s", **options | {"seed": 8})
    calls = []
    simulate(tmp_path / "s", **options, progress=lambda *counts: calls.append(counts))
    assert calls == [(1, 1)]
    assert digests(tmp_path / "s") == whole
    assert {path.name for path in tmp_path.iterdir()} == {"whole", "s"}


def test_no_scene_depends_on_the_sensor(tmp_path, seen_scenes):
    varied = SceneVariation(liquid_share=0.5, label_share=0.5, scattering_per_mm=(0.0, 1.0))
    options = {"variation": varied, "trials": 2, "resolution": 64}
    one = simulate(tmp_path / "one", **options)
    other = simulate(tmp_path / "other", **options, sensor="structured-light")
    truths = [{k: v for k, v in digests(out).items() if k.startswith("simulation_truth/")} for out in (one, other)]
    assert len(truths[0]) == 4
    assert truths[0] == truths[1]
    first, second = load_session(one), load_session(other)
    assert (first.trials, first.sensor) == (second.trials, "simulated-raycast")
    assert (second.sensor, first.name != second.name) == ("simulated-structured-light", True)


def test_sessions_of_other_materials_have_other_names(tmp_path, seen_scenes):
    dark, light = (
        load_session(simulate(tmp_path / str(share), variation=SceneVariation(table_albedo=(share, share))))
        for share in (0.1, 0.5)
    )
    assert dark.trials == light.trials
    assert dark.name != light.name


def test_a_camera_without_calibration_error(tmp_path, monkeypatch):
    cameras = []

    def noting(scene, camera, rng, *, threads=1):
        cameras.append(camera)
        raise KeyboardInterrupt

    monkeypatch.setitem(SENSORS, "raycast", noting)
    for wanted in (True, False):
        with pytest.raises(KeyboardInterrupt):
            simulate(tmp_path / "s", calibration_error=wanted)
    assert cameras[0].noise.calibration_error_m > 0
    assert cameras[1].noise.calibration_error_m == 0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sensor": "laser"}, "unknown sensor 'laser'; known sensors: raycast, structured-light"),
        ({"trials": 0}, "trials is 0; expected 1 or more"),
        ({"threads": 0}, "threads is 0; expected 1 or more"),
        ({"tubes": []}, "tubes: found none"),
        ({"tubes": [TUBES[0], TUBES[0]]}, "found chen2023-tube-1 twice"),
        ({"capture_format": "bag"}, "known formats: folder, mcap"),
    ],
)
def test_wrong_options_are_refused(tmp_path, changes, message):
    with pytest.raises(ConfigError, match=message):
        simulate(tmp_path / "s", **changes)
    assert list(tmp_path.iterdir()) == []


def test_missing_or_broken_truth_is_refused(tmp_path):
    with pytest.raises(CaptureError, match="no such file"):
        read_exact_truth(tmp_path, "x")
    (tmp_path / "simulation_truth").mkdir()
    (tmp_path / "simulation_truth" / "x.yaml").write_text("T_camera_rack: [[1, 2]]\nslots: {}\n")
    with pytest.raises(CaptureError, match="expected 4 x 4 numbers"):
        read_exact_truth(tmp_path, "x")
