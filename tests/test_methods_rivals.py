"""KISS-Matcher and small_gicp as rivals: what they recover on clean clouds, and that they fail aloud."""

import ast
import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest
import scenes
from commands import tubepose

from tubepose import methods
from tubepose.config import Config, RivalsConfig
from tubepose.errors import TubePoseError
from tubepose.labware import load_rack, load_tube
from tubepose.methods import METHODS, require_methods
from tubepose.methods.gicp import fit_gicp
from tubepose.methods.kiss_matcher import fit_kiss_matcher
from tubepose.provenance import pinned_threads
from tubepose.transforms import axis_rotation, tilt_rad
from tubepose.tube import TubeStatus

REPOSITORY = Path(__file__).resolve().parent.parent
CONFIG = Config()
RACK = load_rack("chen2023-soft-5x10")
SLOT = RACK.slot("C4")
TUBES = [load_tube(f"chen2023-tube-{i}") for i in (1, 2, 3)]
ASIDE = np.array([np.sin(0.3), 0.0, np.cos(0.3)])
ABOVE_M = RACK.height_m + CONFIG.slots.clearance_m
FITS = {"kiss-matcher": fit_kiss_matcher, "gicp": fit_gicp}
PACKAGES = {name: METHODS[name].packages for name in FITS}


def installed(method):
    try:
        require_methods([method])
    except TubePoseError as problem:
        return str(problem)
    return ""


def needs(method):
    missing = installed(method)
    return pytest.mark.skipif(bool(missing), reason=missing)


EACH = [pytest.param(name, marks=needs(name)) for name in FITS]


def leaning(tube, alpha_deg=0.8, beta_deg=-0.6, off_m=(0.6e-3, -0.4e-3)):
    T_rack_tube = scenes.tube_pose(RACK, SLOT.name, np.deg2rad(alpha_deg), np.deg2rad(beta_deg), off_m)
    return scenes.tube_surface(tube, T_rack_tube, ABOVE_M, seen_from=ASIDE), T_rack_tube


def errors(T_found, T_true):
    """Tilt in degrees, bottom in millimetres."""
    return np.rad2deg(tilt_rad(T_found[:3, 2], T_true[:3, 2])), 1e3 * np.linalg.norm((T_found - T_true)[:3, 3])


def changed(**settings):
    return Config(rivals=RivalsConfig(**settings))


@needs("gicp")
@pytest.mark.parametrize("tube", TUBES, ids=lambda tube: tube.name)
def test_gicp_recovers_a_clean_tube_with_its_bottom_off_the_centre(tube):
    points, T_true = leaning(tube)
    pose = fit_gicp(points, SLOT, tube, RACK, CONFIG)
    assert (pose.status, pose.reason, pose.n_points) == (TubeStatus.OK, "", len(points))
    tilt_deg, bottom_mm = errors(pose.T_rack_tube, T_true)
    assert tilt_deg < 0.15
    assert bottom_mm < 0.3
    assert pose.fitness > 0.95
    assert 0.02e-3 < pose.inlier_rmse_m < 0.6e-3  # metres, between the noise and the template's spacing


@needs("gicp")
@pytest.mark.parametrize("kind", ["GICP", "PLANE_ICP", "ICP"])
@pytest.mark.parametrize("target", ["template", "scan"])
def test_every_kind_and_direction_comes_nearer_than_upright(kind, target):
    points, T_true = leaning(TUBES[1], 1.5, -1.5)
    pose = fit_gicp(points, SLOT, TUBES[1], RACK, changed(gicp_kind=kind, gicp_target=target))
    assert errors(pose.T_rack_tube, T_true)[0] < 0.6 * errors(np.eye(4), T_true)[0]


@needs("kiss-matcher")
@pytest.mark.parametrize("tube", TUBES[1:], ids=lambda tube: tube.name)
def test_kiss_matcher_recovers_a_clean_capped_tube_anywhere(tube):
    points, T_true = leaning(tube, 20.0, -15.0)
    pose = fit_kiss_matcher(points, RACK.slot("A1"), tube, RACK, CONFIG)
    assert pose.status is TubeStatus.OK
    tilt_deg, bottom_mm = errors(pose.T_rack_tube, T_true)
    assert tilt_deg < 0.3
    assert bottom_mm < 0.5


@needs("kiss-matcher")
def test_attempts_are_what_kiss_matcher_needs_on_a_turned_body():
    points, T_true = leaning(TUBES[2])
    found = [
        fit_kiss_matcher(points, SLOT, TUBES[2], RACK, changed(kiss_attempts=1), seed).T_rack_tube for seed in range(4)
    ]
    assert not all(T is not None and errors(T, T_true)[0] < 0.3 for T in found)


@needs("kiss-matcher")
@pytest.mark.parametrize("settings", [{"kiss_refinement": "icp"}, {"kiss_pruning": False}], ids=str)
def test_other_settings_of_kiss_matcher_are_answered_too(settings):
    points, T_true = leaning(TUBES[2])
    pose = fit_kiss_matcher(points, SLOT, TUBES[2], RACK, changed(**settings))
    assert errors(pose.T_rack_tube, T_true)[0] < 0.3


@pytest.mark.parametrize("name", EACH)
def test_the_same_seed_gives_the_same_pose(name):
    points, _ = leaning(TUBES[1])
    with pinned_threads(1):  # as every command does: sums of several threads differ in the last bit
        poses = [FITS[name](points, SLOT, TUBES[1], RACK, changed(kiss_attempts=8), 3).T_rack_tube for _ in range(2)]
    assert np.array_equal(poses[0], poses[1])


@pytest.mark.parametrize("name", EACH)
def test_the_spin_is_fixed_by_the_rule_of_eq_1(name):
    points, _ = leaning(TUBES[1])
    T = FITS[name](points, SLOT, TUBES[1], RACK, changed(kiss_attempts=8), 0).T_rack_tube
    assert np.allclose(T[:3, :3], axis_rotation(T[:3, 2]), atol=1e-9)


@pytest.mark.parametrize("name", EACH)
@pytest.mark.parametrize("count", [0, 1, 5])
def test_too_few_points_fail_without_a_pose(name, count):
    points, _ = leaning(TUBES[1])
    pose = FITS[name](points[:count], SLOT, TUBES[1], RACK, CONFIG, 0)
    assert (pose.status, pose.T_rack_tube, pose.n_points) == (TubeStatus.FAILED, None, count)
    assert "at least 10 expected" in pose.reason


@needs("gicp")
@pytest.mark.parametrize("kind", ["GICP", "PLANE_ICP", "ICP"])
def test_gicp_without_a_correspondence_fails_and_is_no_identity(kind):
    points, _ = leaning(TUBES[1])
    pose = fit_gicp(points + np.array([0.5, 0.0, 0.0]), SLOT, TUBES[1], RACK, changed(gicp_kind=kind))
    assert (pose.status, pose.T_rack_tube) == (TubeStatus.FAILED, None)
    assert pose.reason == f"{kind} found no correspondence within 1.5 mm"


@needs("kiss-matcher")
def test_kiss_matcher_without_a_match_fails_and_is_no_identity():
    line = np.linspace([0, 0, 0.06], [1.0, 0, 0.06], 60)
    pose = fit_kiss_matcher(line, SLOT, TUBES[1], RACK, CONFIG, 0)
    assert (pose.status, pose.T_rack_tube) == (TubeStatus.FAILED, None)
    assert pose.reason == "KISS-Matcher found no pose in 40 attempts"


@needs("kiss-matcher")
def test_what_the_package_raises_is_a_failed_attempt(monkeypatch):
    import kiss_matcher

    class Broken:
        def __init__(self, settings):
            pass

        def prune_and_solve(self, source, target):
            raise RuntimeError("too few")

    monkeypatch.setattr(kiss_matcher, "KISSMatcher", Broken)
    points, _ = leaning(TUBES[1])
    pose = fit_kiss_matcher(points, SLOT, TUBES[1], RACK, CONFIG, 0)
    assert (pose.status, pose.T_rack_tube) == (TubeStatus.FAILED, None)


@needs("gicp")
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pose_that_is_not_finite_is_no_pose(monkeypatch, value):
    import small_gicp

    class Diverged:
        T_target_source = np.full((4, 4), value)
        num_inliers = 100

    monkeypatch.setattr(small_gicp, "align", lambda *args, **settings: Diverged())
    points, _ = leaning(TUBES[1])
    pose = fit_gicp(points, SLOT, TUBES[1], RACK, CONFIG)
    assert (pose.status, pose.T_rack_tube, pose.reason) == (TubeStatus.FAILED, None, "GICP diverged")


@pytest.mark.parametrize(("name", "package"), [(name, package) for name in PACKAGES for package in PACKAGES[name]])
def test_a_missing_package_is_named_with_what_to_install(monkeypatch, name, package):
    for other in {entry for entries in PACKAGES.values() for entry in entries}:
        monkeypatch.setitem(sys.modules, other, sys)  # there, whatever it is
    monkeypatch.setitem(sys.modules, package, None)  # importing it raises ImportError
    points, _ = leaning(TUBES[1])
    with pytest.raises(TubePoseError, match=r"pip install '\.\[rivals\]'") as told:
        FITS[name](points, SLOT, TUBES[1], RACK, CONFIG, 0)
    assert f"method '{name}' needs the package {package}" in str(told.value)
    assert "\n" not in str(told.value)


def test_bench_without_the_extra_ends_before_any_work(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    ended = tubepose("bench", "--methods", "upright,gicp", "--out", tmp_path / "out")
    assert ended.code == 1
    assert ended.err.count("error:") == 1
    assert "pip install '.[rivals]'" in ended.err.replace("\n", " ")
    assert not (tmp_path / "out").exists()


def test_methods_without_extras_need_nothing(monkeypatch):
    for package in {entry for entries in PACKAGES.values() for entry in entries}:
        monkeypatch.setitem(sys.modules, package, None)
    require_methods(["paper", "upright", "slot-icp", "global-icp"])


def test_notes_name_the_settings_that_ran():
    config = changed(kiss_attempts=7, gicp_kind="PLANE_ICP", gicp_target="scan", gicp_max_distance_m=(3e-3, 1e-3))
    gicp = METHODS["gicp"].note(config, 2)
    assert gicp.startswith("gicp: small_gicp PLANE_ICP, template onto scan, distances 3, 1 mm")
    kiss = METHODS["kiss-matcher"].note(config, 2)
    assert "best of 7 draws of 200 pairs, 2 seeds; then small_gicp PLANE_ICP" in kiss
    assert "then ICP as slot-icp" in METHODS["kiss-matcher"].note(changed(kiss_refinement="icp"), 2)
    assert "GNC without pruning" in METHODS["kiss-matcher"].note(changed(kiss_pruning=False), 2)


def test_the_global_baselines_and_gicp_say_their_settings_and_no_other_does():
    told = {name: method.note(CONFIG, 2).split(":")[0] for name, method in METHODS.items()}
    assert {name for name, first in told.items() if first} == {"global-icp", "kiss-matcher", "gicp"}
    assert all(first in ("", name) for name, first in told.items())


@pytest.mark.parametrize("group", ["kiss_settings", "gicp_settings"])
def test_compared_settings_change_one_thing_each(group):
    spec = importlib.util.spec_from_file_location("compare_settings", REPOSITORY / "benchmarks" / "compare_settings.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found = dict(getattr(module, group)())
    assert found.pop("default") == CONFIG
    assert CONFIG not in found.values()
    assert len({config.rivals.model_dump_json() for config in found.values()}) == len(found)


def test_the_packages_are_imported_by_functions_only():
    trees = [ast.parse(path.read_text()) for path in Path(methods.__file__).parent.glob("*.py")]
    nodes = [node for tree in trees for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
    nodes = [node for node in nodes if "tubepose" not in ast.unparse(node)]
    assert not set(re.findall(r"kiss_matcher|small_gicp", " ".join(map(ast.unparse, nodes))))
