"""A bowed rack: its face bends as stated, tubes follow, the truth says so, and a flat rack stays as it was."""

import dataclasses

import numpy as np
import pytest

from tubepose.errors import ConfigError
from tubepose.labware import load_cap, load_rack, load_tube
from tubepose.simulation import SENSORS, SceneVariation, raycast, read_exact_truth, simulate_session
from tubepose.simulation.bent_meshes import base_height_m, bent_shell, bent_wells, subdivided
from tubepose.simulation.bow import FLAT, Bow
from tubepose.simulation.camera import NO_NOISE, default_camera
from tubepose.simulation.collision import collide, solid_of
from tubepose.simulation.meshes import rack_shell, rack_wells
from tubepose.simulation.placement import place_tubes
from tubepose.simulation.random_scene import random_scene
from tubepose.simulation.scene import Scene
from tubepose.simulation.truth import write_exact_truth
from tubepose.simulation.variation import scene_variation
from tubepose.transforms import invert_transform, tilt_rad, transform_points

RACK = load_rack("chen2023-soft-5x10")
CAP = load_cap("printed-square-16.7")
TUBE = load_tube("chen2023-tube-3")
BOW = Bow(2e-3, -1.5e-3, 0.5e-3)


def area_m2(mesh):
    corners = mesh.vertices_m[mesh.triangles]
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2


def variation(low, high):
    return SceneVariation(rack_bow_mm=(low, high), fill=(0.06, 0.06))


def test_the_surface_has_its_stated_heights_and_slopes():
    half = RACK.outline_m / 2
    places = np.array([[0, 0], [half[0], 0], [0, -half[1]], half, [half[0], -half[1]]])
    assert BOW.height_m(RACK, places) == pytest.approx([0, 2e-3, -1.5e-3, 1e-3, 0])
    step = 1e-6
    for axis, name in enumerate("xy"):
        shift = np.eye(2)[axis] * step
        rise = (BOW.height_m(RACK, places + shift) - BOW.height_m(RACK, places - shift)) / (2 * step)
        assert BOW.slope(RACK, places)[:, axis] == pytest.approx(rise, abs=1e-8), name


def test_subdividing_keeps_the_surface_and_shortens_its_edges():
    mesh = rack_shell(RACK)
    fine = subdivided(mesh, 4e-3)
    assert area_m2(fine) == pytest.approx(area_m2(mesh))
    corners = fine.vertices_m[fine.triangles]
    assert np.linalg.norm((np.roll(corners, -1, axis=1) - corners)[..., :2], axis=2).max() <= 4e-3
    # They meet without a gap: every corner of one triangle is a corner of a neighbour, none lies within an edge.
    assert len(np.unique(np.round(fine.vertices_m, 9), axis=0)) < len(fine.vertices_m) / 3


def test_bent_meshes_without_a_bow_are_the_flat_rack():
    assert area_m2(bent_shell(RACK, FLAT, 0.0)) == pytest.approx(area_m2(rack_shell(RACK)))
    assert area_m2(bent_wells(RACK, FLAT)) == pytest.approx(area_m2(rack_wells(RACK)))
    assert base_height_m(RACK, FLAT) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("bow", [BOW, Bow(-2.5e-3, -2.5e-3), Bow(2.5e-3, 2.5e-3)])
def test_no_part_of_a_bowed_rack_is_below_its_table(bow):
    base_m = base_height_m(RACK, bow)
    lowest = min(mesh.vertices_m[:, 2].min() for mesh in (bent_shell(RACK, bow, base_m), bent_wells(RACK, bow)))
    assert lowest >= base_m - 1e-12
    assert base_m >= -8e-3


def test_the_sensor_sees_the_face_where_the_bow_puts_it():
    cam = dataclasses.replace(default_camera(400), noise=NO_NOISE)
    scene = random_scene(RACK, [TUBE], CAP, cam, np.random.default_rng(3))
    scene = Scene(RACK, scene.T_camera_rack, (), bow=BOW)
    points = raycast.render(scene, cam, np.random.default_rng(0), threads=1).points_m.reshape(-1, 3)
    local = transform_points(invert_transform(scene.T_camera_rack), points[np.isfinite(points[:, 2])])
    on_face = (RACK.top_signed_distance_m(local[:, :2]) < -1e-3) & (np.abs(local[:, 2] - RACK.height_m) < 6e-3)
    assert on_face.sum() > 700
    error = local[on_face, 2] - RACK.height_m - BOW.height_m(RACK, local[on_face, :2])
    assert np.abs(np.median(error)) < 5e-6
    assert np.percentile(np.abs(error), 99) < 5e-5
    assert np.ptp(local[on_face, 2]) > 2.5e-3


@pytest.mark.parametrize("sensor", sorted(set(SENSORS) - {"stereo"}))
def test_both_sensors_see_openings_and_face_where_they_are(sensor):
    """A bow moves the face along z alone: the edges of openings stay where they are in x and y."""
    cam = dataclasses.replace(default_camera(300), noise=NO_NOISE)
    rack = load_rack("quincunx-17mm-8")
    T_camera_rack = random_scene(RACK, [TUBE], CAP, cam, np.random.default_rng(3)).T_camera_rack
    scene = Scene(rack, T_camera_rack, (), bow=BOW)
    points = SENSORS[sensor](scene, cam, np.random.default_rng(0), threads=1).points_m
    local = transform_points(invert_transform(T_camera_rack), points[np.isfinite(points[:, 2])])
    above = local[:, 2] - rack.height_m - BOW.height_m(rack, local[:, :2])
    distance = rack.top_signed_distance_m(local[:, :2])
    on_face = (distance < -1e-3) & (np.abs(local[:, 2] - rack.height_m) < 6e-3)
    assert on_face.sum() > 1500
    assert np.abs(np.median(above[on_face])) < 2e-5
    # Coarse captures of `structured-light` are noisy: a flat rack gives 0.41 mm at this resolution, too.
    assert np.percentile(np.abs(above[on_face]), 95) < 5e-4
    near = np.all(np.abs(local[:, :2]) < rack.outline_m / 2 + 2e-3, axis=1)
    level = near & (np.abs(above) < 5e-4)
    assert level.sum() > on_face.sum()
    assert np.percentile(distance[level], 99) < 4e-4, "points of the face lie over an opening"


def test_tubes_move_with_the_frames_of_their_slots():
    placed = place_tubes(RACK, [TUBE], 20, CAP, np.random.default_rng(2), bow=BOW)
    for tube in placed:
        slot = RACK.slot(tube.slot)
        T_slot = BOW.slot_frame(RACK, slot)
        height_m = float(BOW.height_m(RACK, slot.center_m))
        raised = transform_points(T_slot, np.array([*slot.center_m, RACK.height_m]))
        assert raised == pytest.approx([*slot.center_m, RACK.height_m + height_m])
        assert T_slot[:3, 2] == pytest.approx(BOW.normals(RACK, slot.center_m))
        # In its slot's frame it is a tube of a flat rack: on the floor, and within the play of floor and opening.
        flat = invert_transform(T_slot) @ tube.T_rack_tube
        pivot = flat[:3, 3] + TUBE.pivot_height_m * flat[:3, 2]
        assert np.hypot(*(pivot[:2] - slot.center_m)) <= RACK.floor_play_mm * 1e-3 + 1e-9
        assert flat[2, 3] == pytest.approx(RACK.floor_m, abs=2e-4)
        assert np.rad2deg(tilt_rad(flat[:3, 2], np.array([0.0, 0.0, 1.0]))) < 3.0
    solids = [solid_of(tube, CAP) for tube in placed]
    assert not any(collide(a, b, CAP) for i, a in enumerate(solids) for b in solids[:i])


def test_bow_is_drawn_for_both_axes_within_its_range_and_moves_nothing_else():
    cam = default_camera(64)
    drawn = []
    for seed in range(24):
        flat, bowed, again = (
            random_scene(RACK, [TUBE], CAP, cam, np.random.default_rng(seed), variation(*ends))
            for ends in ((0.0, 0.0), (-1e-9, 1e-9), (-2.5, 2.5))
        )
        assert flat.bow == FLAT
        assert np.array_equal(flat.T_camera_rack, bowed.T_camera_rack)
        assert [t.slot for t in flat.tubes] == [t.slot for t in bowed.tubes]
        for a, b in zip(flat.tubes, bowed.tubes, strict=True):
            assert a.T_rack_tube == pytest.approx(b.T_rack_tube, abs=1e-9)
        drawn.append((again.bow.along_x_m, again.bow.along_y_m))
    drawn = 1e3 * np.array(drawn)
    assert np.abs(drawn).max() <= 2.5
    assert np.all(drawn.min(axis=0) < -1.5)
    assert np.all(drawn.max(axis=0) > 1.5)
    assert np.abs(drawn[:, 0] - drawn[:, 1]).max() > 1.0


def test_the_truth_states_the_bow_and_the_poses_in_it(tmp_path):
    cam = default_camera(64)
    scene = random_scene(RACK, [TUBE], CAP, cam, np.random.default_rng(5), variation(2.0, 2.0))
    write_exact_truth(tmp_path, "t", scene, {tube.slot: TUBE.name for tube in scene.tubes})
    truth = read_exact_truth(tmp_path, "t")
    assert truth.bow == Bow(2e-3, 2e-3)
    assert np.array_equal(truth.T_camera_rack, scene.T_camera_rack)
    for tube in scene.tubes:
        name, T_camera_tube = truth.tubes[tube.slot]
        assert name == TUBE.name
        assert T_camera_tube == pytest.approx(scene.T_camera_rack @ tube.T_rack_tube)


def test_the_truth_of_a_flat_rack_says_nothing_of_a_bow(tmp_path):
    scene = random_scene(RACK, [TUBE], CAP, default_camera(64), np.random.default_rng(5))
    write_exact_truth(tmp_path, "t", scene, {tube.slot: TUBE.name for tube in scene.tubes})
    assert "bow" not in (tmp_path / "simulation_truth" / "t.yaml").read_text()
    assert read_exact_truth(tmp_path, "t").bow == FLAT


def test_a_session_is_named_after_its_bow_but_only_where_there_is_one(tmp_path, monkeypatch):
    """The name of a session of flat racks is what it was before racks could be bowed."""
    assert "bow" not in str(SceneVariation())
    assert "rack_bow_mm=(0.0, 1.0)" in str(SceneVariation(rack_bow_mm=(0.0, 1.0)))
    options = {"trials": 1, "seed": 1, "cap": CAP, "resolution": 96, "printed": False}
    for name, ends in (("a", (0.0, 0.0)), ("b", (2.0, 2.0))):
        simulate_session(tmp_path / name, RACK, [TUBE], variation=variation(*ends), **options)
    assert read_exact_truth(tmp_path / "b", "chen2023-tube-3-001").bow == Bow(2e-3, 2e-3)
    names = [(tmp_path / name / "session.yaml").read_text().split("name: ")[1].split("\n")[0] for name in "ab"]
    assert names[0] != names[1]
    assert set(SENSORS) == {"raycast", "structured-light", "stereo"}


@pytest.mark.parametrize("bad", [[1.0, -1.0], [-6.0, 0.0], 2.0])
def test_a_bow_that_cannot_be_is_refused(bad):
    with pytest.raises(ConfigError, match=r"scenes\.yaml.*rack_bow_mm"):
        scene_variation({"rack_bow_mm": bad}, "scenes.yaml")
