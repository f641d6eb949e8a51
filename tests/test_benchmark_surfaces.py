"""The surfaces that the benchmark tells apart: areas and places that follow from the scene."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scenes import tube_pose

from tubepose.capture.frame import CameraIntrinsics
from tubepose.labware import load_cap, load_rack, load_tube
from tubepose.simulation.camera import NO_NOISE, StructuredLightCamera, default_camera
from tubepose.simulation.scene import PlacedTube, Scene
from tubepose.transforms import make_transform

PLACE = Path(__file__).resolve().parent.parent / "benchmarks" / "surfaces.py"
RACK, SLOT = load_rack("chen2023-soft-5x10"), "C5"
SIZE, FOCAL_PX, TOP_DISTANCE_M = 96, 2000.0, 0.6
CLOSE_UP = StructuredLightCamera(CameraIntrinsics(SIZE, SIZE, FOCAL_PX, FOCAL_PX, (SIZE - 1) / 2, (SIZE - 1) / 2))


@pytest.fixture(scope="module")
def surfaces() -> ModuleType:
    """The script is no part of an installed package: it is loaded from its file."""
    spec = importlib.util.spec_from_file_location("surfaces_command", PLACE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def from_above(tube: str, cap: str | None = None) -> Scene:
    """One upright tube on the camera's axis, the top of its body `TOP_DISTANCE_M` away."""
    placed = PlacedTube(SLOT, load_tube(tube), tube_pose(RACK, SLOT))
    facing = np.diag([1.0, -1.0, -1.0])
    x, y, z = placed.T_rack_tube[:3, 3]
    T = make_transform(facing, np.array([-x, y, TOP_DISTANCE_M + z + placed.model.rim_height_m]))
    return Scene(RACK, T, (placed,), None if cap is None else load_cap(cap))


def image_of(surfaces: ModuleType, scene: Scene, name: str) -> np.ndarray:
    """Pixels (SIZE, SIZE) that see a surface."""
    return (surfaces.truth_of(scene, CLOSE_UP).surface == surfaces.SURFACES.index(name)).reshape(SIZE, SIZE)


def test_a_cap_from_above_is_a_disc(surfaces: ModuleType) -> None:
    model = load_tube("chen2023-tube-3")
    radius_px = model.max_radius_m * FOCAL_PX / (TOP_DISTANCE_M - (model.height_m - model.rim_height_m))
    seen = image_of(surfaces, from_above(model.name), "cap top")
    v, u = np.nonzero(seen)
    away = np.hypot(u - (SIZE - 1) / 2, v - (SIZE - 1) / 2)
    assert seen.sum() == pytest.approx(np.pi * radius_px**2, rel=0.02)
    assert away.max() < radius_px + 1e-6
    assert not image_of(surfaces, from_above(model.name), "cap side").any()


def test_a_printed_cap_from_above_is_a_square(surfaces: ModuleType) -> None:
    cap = load_cap("printed-square-16.7")
    side_px = cap.square_m * FOCAL_PX / (TOP_DISTANCE_M - cap.seat_mm * 1e-3)
    seen = image_of(surfaces, from_above("chen2023-tube-2", cap.name), "printed cap top")
    v, u = np.nonzero(seen)
    assert seen.sum() == (np.ptp(u) + 1) * (np.ptp(v) + 1)
    assert np.ptp(u) == np.ptp(v)
    assert np.ptp(u) + 1 == pytest.approx(side_px, abs=1.0)
    assert not image_of(surfaces, from_above("chen2023-tube-2", cap.name), "cap top").any()


def test_an_open_tube_from_above_is_a_ring_about_its_inside(surfaces: ModuleType) -> None:
    scene, model = from_above("chen2023-tube-1"), load_tube("chen2023-tube-1")
    assert model.cap is not None
    scale = FOCAL_PX / TOP_DISTANCE_M
    outer_px = model.cap.diameter_mm * 0.5e-3 * scale
    inner_px = (model.body.top_diameter_mm * 0.5 - model.body.wall_mm) * 1e-3 * scale
    rim, inside = image_of(surfaces, scene, "rim"), image_of(surfaces, scene, "inner wall")
    assert rim.sum() == pytest.approx(np.pi * (outer_px**2 - inner_px**2), rel=0.05)
    assert inside.sum() == pytest.approx(np.pi * inner_px**2, rel=0.02)
    assert inside[SIZE // 2, SIZE // 2]
    assert not image_of(surfaces, scene, "outer wall, milky").any()


@pytest.mark.parametrize(
    ("tube", "wall"), [("chen2023-tube-1", "outer wall, milky"), ("chen2023-tube-2", "outer wall, clear")]
)
def test_a_tilted_scanner_sees_walls_above_the_rack_alone(surfaces: ModuleType, tube: str, wall: str) -> None:
    camera = default_camera(3 * SIZE)
    set_up = surfaces.SetUp("", tilt_deg=30.0)
    scene = dataclasses.replace(from_above(tube), T_camera_rack=set_up.T_camera_rack(RACK.height_m))
    truth = surfaces.truth_of(scene, camera)
    seen = truth.surface == surfaces.SURFACES.index(wall)
    assert seen.sum() > 60
    points = surfaces.pixel_rays(camera)[seen] * truth.distance_m[seen, None]
    rack_from_camera = np.linalg.inv(scene.T_camera_rack)
    local = points @ rack_from_camera[:3, :3].T + rack_from_camera[:3, 3]
    assert local[:, 2].min() > RACK.height_m
    assert local[:, 2].max() < scene.tubes[0].T_rack_tube[2, 3] + load_tube(tube).height_m
    # What faces away from the projector is dark; of what faces it, the cap or flange may shade a part.
    projector = rack_from_camera[:3, :3] @ camera.projector_m + rack_from_camera[:3, 3]
    outwards = local[:, :2] - RACK.slot(SLOT).center_m
    facing = np.sum(outwards * (projector[:2] - local[:, :2]), axis=1)
    assert not truth.lit[seen][facing < -1e-4].any()
    assert (facing < -1e-4).sum() >= 5
    assert truth.lit[seen][facing > 1e-4].mean() > 0.5
    others = {name for name in surfaces.SURFACES if name.startswith("outer wall")} - {wall}
    assert not np.isin(truth.surface, [surfaces.SURFACES.index(name) for name in others]).any()


def test_set_ups_keep_the_top_in_place_and_turn_as_they_say(surfaces: ModuleType) -> None:
    height = RACK.height_m
    for set_up, normal, long_axis in zip(
        surfaces.SET_UPS,
        ([0, 0, -1], [0, -np.sin(np.deg2rad(20)), -np.cos(np.deg2rad(20))], [0, 0, -1]),
        ([1, 0, 0], [1, 0, 0], [0, -1, 0]),
        strict=True,
    ):
        T = set_up.T_camera_rack(height)
        np.testing.assert_allclose(T @ [0, 0, height, 1], [0, 0, surfaces.DISTANCE_M, 1], atol=1e-12)
        np.testing.assert_allclose(T[:3, 2], normal, atol=1e-12)
        np.testing.assert_allclose(T[:3, 0], long_axis, atol=1e-12)


def test_errors_of_a_known_cloud(surfaces: ModuleType) -> None:
    camera = default_camera(SIZE)
    scene = dataclasses.replace(
        from_above("chen2023-tube-1"), T_camera_rack=surfaces.SetUp("", 30.0).T_camera_rack(RACK.height_m)
    )
    truth = surfaces.truth_of(scene, camera)
    rays = surfaces.pixel_rays(camera)
    cloud = rays * (truth.distance_m + 1.5e-3)[:, None]
    rows = np.flatnonzero(truth.surface == surfaces.TOP)
    cloud[rows[::2]] = np.nan
    pixels = surfaces.pixels_of(truth, camera, cloud.reshape(SIZE, SIZE, 3))
    assert len(pixels) == (truth.surface >= 0).sum()
    top = surfaces.summary(pixels[pixels["surface"] == surfaces.TOP])
    assert top["complete"] == pytest.approx(0.5, abs=1 / len(rows))
    assert [top[f"error_p{q}_mm"] for q in (5, 50, 95)] == pytest.approx([1.5] * 3, abs=1e-4)
    assert (top["off_1_mm"], top["off_2_mm"]) == (1.0, 0.0)
    assert np.isnan(top["radial_p50_mm"])
    # Behind the wall, as a ray sees it, is inside the tube.
    wall = pixels[pixels["surface"] == surfaces.MILKY_WALL]
    assert (wall["radial_mm"] < 0.1).all()
    assert wall["radial_mm"].min() == pytest.approx(-1.5 * np.sin(np.deg2rad(30)), abs=0.3)
    exact = surfaces.pixels_of(truth, camera, (rays * truth.distance_m[:, None]).reshape(SIZE, SIZE, 3))
    np.testing.assert_allclose(exact[["error_mm", "radial_mm"]].fillna(0.0), 0.0, atol=1e-6)


@pytest.mark.parametrize("sensor", ["raycast", "structured-light"])
def test_an_opaque_scene_has_no_error_without_noise(surfaces: ModuleType, sensor: str) -> None:
    camera = dataclasses.replace(CLOSE_UP, noise=NO_NOISE)
    scene = dataclasses.replace(from_above("chen2023-tube-2"), tubes=())
    frame = surfaces.SENSORS[sensor](scene, camera, np.random.default_rng(1), threads=1)
    pixels = surfaces.pixels_of(surfaces.truth_of(scene, camera), camera, frame.cloud_m)
    assert (pixels["surface"] == surfaces.TOP).all()
    top = surfaces.summary(pixels)
    assert top["pixels"] > 1000
    assert top["lit"] == 1.0
    assert top["complete"] > 0.95
    assert abs(top["error_p50_mm"]) < 0.01
    # Only pixels on edges, which hold light of two surfaces, may be off.
    assert top["off_1_mm"] < 0.03
    assert top["error_p95_mm"] - top["error_p5_mm"] < 0.5


def test_the_table_holds_both_sensors_on_the_same_pixels(
    surfaces: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(surfaces.SENSORS, "structured-light", surfaces.SENSORS["raycast"])
    table = surfaces.set_up_table(surfaces.SET_UPS[1], seeds=1, resolution=SIZE, threads=1)
    one, other = (table[table["sensor"] == name].drop(columns="sensor") for name in surfaces.SENSORS)
    assert one.reset_index(drop=True).equals(other.reset_index(drop=True))
    assert {"cap top", "cap side", "printed cap top", "rim", "rack top"} <= set(one["surface"])
    lines = list(surfaces.markdown(table))
    assert len(lines) == len(table) + 2
    assert {line.count("|") for line in lines} == {11}
    assert capsys.readouterr().err.count("printed caps") == len(surfaces.SENSORS)
