"""Simulated sensor: geometry, decoding, shadow, refraction."""

import dataclasses

import numpy as np
import pytest

from tubepose.labware import load_cap, load_rack, load_tube
from tubepose.simulation import meshes, raycast
from tubepose.simulation.camera import NO_NOISE, NoiseModel, default_camera
from tubepose.simulation.placement import place_rack, place_tubes
from tubepose.simulation.random_scene import random_scene
from tubepose.simulation.scene import OPAQUE_BODY, Material, Plastic, Scene

RACK = load_rack("chen2023-soft-5x10")
CAP = load_cap("printed-square-16.7")
OPAQUE = dict.fromkeys(("opaque", "translucent", "transparent"), OPAQUE_BODY)


def camera(resolution=240, noise=NO_NOISE):
    return dataclasses.replace(default_camera(resolution), noise=noise)


def scene_of(name, seed=1, resolution=240, materials=None):
    scene = random_scene(RACK, [load_tube(name)], CAP, camera(resolution), np.random.default_rng(seed))
    return dataclasses.replace(scene, materials=materials)


def cast(scene, cam):
    """First hits of the pixels' rays by the opaque scene alone: depth, point, normal."""
    surfaces = raycast.Surfaces(scene.parts())
    rays = cam.intrinsics.rays().reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return surfaces, surfaces.cast(np.zeros_like(rays), rays)


def test_rack_top_has_the_area_of_its_solid_part():
    mesh = meshes.rack_shell(RACK)
    corners = mesh.vertices_m[mesh.triangles]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] / 2
    openings = 50 * (16.5**2 - (4 - np.pi) * 2.0**2)
    assert abs(area).sum() * 1e6 == pytest.approx(192.5 * 95.5 - openings, rel=3e-3)


def test_revolved_tube_is_closed_and_faces_outwards():
    tube = load_tube("chen2023-tube-1")
    mesh = meshes.revolve(np.vstack([tube.outer_profile_m(), tube.cavity_profile_m()]))
    corners = mesh.vertices_m[mesh.triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.allclose(face.sum(axis=0), 0, atol=1e-12)
    assert np.einsum("tc,tc->t", corners[:, 0], face).sum() > 0
    assert np.all(np.einsum("tkc,tc->tk", mesh.normals[mesh.triangles], face) > 0)
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1)


def test_triangulation_inverts_the_projection():
    cam = camera(64)
    depth = np.random.default_rng(0).uniform(0.5, 0.8, (64, 64))
    again = cam.triangulate(cam.column(cam.intrinsics.backproject(depth)))
    assert np.isfinite(again).mean() > 0.99
    assert np.nanmax(np.abs(again - depth)) < 1e-12


@pytest.mark.parametrize("printed", [None, CAP])
def test_opaque_parts_are_where_exact_ray_casting_puts_them(printed):
    scene = dataclasses.replace(scene_of("chen2023-tube-3", materials=OPAQUE), printed_cap=printed)
    _, hits = cast(scene, camera())
    depth = raycast.render(scene, camera(), np.random.default_rng(0)).points_m[:, 2]
    seen = np.isfinite(depth)
    assert seen.mean() > 0.8
    assert np.abs(depth - hits.points_m[:, 2])[seen].max() < 5e-5


def test_noise_on_level_surfaces_is_small_but_there():
    noise = dataclasses.replace(NoiseModel(), blur_px=0.0)
    scene = scene_of("chen2023-tube-3", materials=OPAQUE)
    frame = raycast.render(scene, camera(noise=noise), np.random.default_rng(0))
    _, hits = cast(scene, camera())
    facing_up = hits.normals @ scene.T_camera_rack[:3, 2] > 0.99
    above = (hits.points_m - scene.T_camera_rack[:3, 3]) @ scene.T_camera_rack[:3, 2] - scene.rack.height_m
    rows = facing_up & frame.valid & (above > -1e-3)
    error = frame.points_m[rows, 2] - hits.points_m[rows, 2]
    assert rows.sum() > 100
    assert 0.02e-3 < np.sqrt(np.mean(error**2)) < 0.25e-3


def test_what_the_projector_does_not_light_is_invalid():
    scene = scene_of("chen2023-tube-3", materials=OPAQUE)
    cam = camera()
    surfaces, hits = cast(scene, cam)
    shadow = surfaces.blocked(hits.points_m + 1e-4 * hits.normals, cam.projector_m)
    frame = raycast.render(scene, cam, np.random.default_rng(0))
    assert shadow.sum() > 300
    assert frame.valid[shadow].mean() < 0.005
    lit_up = ~shadow & (hits.normals @ scene.T_camera_rack[:3, 2] > 0.99)
    assert frame.valid[lit_up].mean() > 0.99


def test_a_wall_that_does_nothing_to_light_is_invisible():
    nothing = dict.fromkeys(OPAQUE, Material(0.0, plastic=Plastic(1.0, 1.0)))
    scene = scene_of("chen2023-tube-1", materials=nothing)
    with_tubes = raycast.render(scene, camera(), np.random.default_rng(0)).points_m[:, 2]
    without = raycast.render(dataclasses.replace(scene, tubes=()), camera(), np.random.default_rng(0)).points_m[:, 2]
    assert np.mean(np.isfinite(with_tubes) != np.isfinite(without)) < 1e-3
    both = np.isfinite(with_tubes) & np.isfinite(without)
    assert np.mean(np.abs(with_tubes - without)[both] > 1e-5) < 1e-3


def test_a_refracting_wall_displaces_points():
    clear = dict.fromkeys(OPAQUE, Material(0.0, plastic=Plastic(1.49, 1.0)))
    scene = scene_of("chen2023-tube-1", materials=clear)
    with_tubes = raycast.render(scene, camera(), np.random.default_rng(0)).points_m[:, 2]
    without = raycast.render(dataclasses.replace(scene, tubes=()), camera(), np.random.default_rng(0)).points_m[:, 2]
    assert np.sum(np.abs(with_tubes - without) > 1e-3) > 20
    assert np.sum(np.isfinite(without) & np.isnan(with_tubes)) > 20


def test_refraction_obeys_snell_and_fresnel():
    angle = np.deg2rad(40.0)
    rays = np.array([[np.sin(angle), 0, -np.cos(angle)], [0, 0, -1.0]])
    up = np.tile([0.0, 0.0, 1.0], (2, 1))
    onward, share = raycast.cross_interface(rays, up, np.full(2, 1.49))
    assert 1.49 * onward[0, 0] == pytest.approx(np.sin(angle))
    assert share[1] == pytest.approx(1 - (0.49 / 2.49) ** 2)
    back, same_share = raycast.cross_interface(onward, -up, np.full(2, 1.49))
    assert back == pytest.approx(rays)
    assert same_share == pytest.approx(share)


def test_total_reflection_keeps_the_light_inside():
    ray = np.array([[np.sin(1.0), 0, np.cos(1.0)]])
    onward, share = raycast.cross_interface(ray, np.array([[0, 0, 1.0]]), np.array([1.49]))
    assert onward == pytest.approx(ray * [1, 1, -1])
    assert share[0] == 1


def test_the_image_shows_the_caps_brighter_than_the_table():
    scene = dataclasses.replace(scene_of("chen2023-tube-2"), printed_cap=CAP)
    frame = raycast.render(scene, camera(noise=NoiseModel()), np.random.default_rng(0))
    assert frame.image.dtype == np.uint8
    top = scene.T_camera_rack @ scene.tubes[0].T_rack_tube @ [0, 0, CAP.offset_m(scene.tubes[0].model), 1]
    u, v = np.rint(frame.intrinsics.project(top[:3])).astype(int)
    assert frame.image[v, u] > frame.image[5, 5] + 50


def test_the_rack_stays_in_view_and_faces_the_camera():
    k = default_camera().intrinsics
    corners = np.array([[x, y, 0.053, 1] for x in (-0.09625, 0.09625) for y in (-0.04775, 0.04775)])
    for seed in range(20):
        T = place_rack(RACK, 0.12, k, np.random.default_rng(seed))
        uv = k.project((corners @ T.T)[:, :3])
        assert uv.min() > 0
        assert uv.max() < k.width - 1
        assert -T[2, 2] >= np.cos(np.deg2rad(20.0)) - 1e-9
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1)


def test_an_empty_scene_needs_no_plastic():
    scene = Scene(RACK, place_rack(RACK, 0.1, camera(64).intrinsics, np.random.default_rng(0)), ())
    assert raycast.render(scene, camera(64), np.random.default_rng(0)).valid.mean() > 0.7


def test_wide_caps_leave_slots_empty_instead_of_overlapping():
    placed = place_tubes(RACK, [load_tube("chen2023-tube-3")], 50, CAP, np.random.default_rng(0))
    assert 15 < len(placed) < 50
