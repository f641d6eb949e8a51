import filecmp
from dataclasses import replace

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tubepose.capture.frame import CameraIntrinsics
from tubepose.detection.labelled_images import labelled_set
from tubepose.detection.model import CAPPED_CLASS, OPEN_CLASS, RACK_CLASS, visible_class
from tubepose.detection.yolo_input import BORDER
from tubepose.errors import DetectorError
from tubepose.labware import load_cap, load_rack, load_tube
from tubepose.simulation.looks.appearance import NOTHING, Lamp, Light, Part, Surface
from tubepose.simulation.looks.exposure import expose
from tubepose.simulation.looks.render import render
from tubepose.simulation.looks.textures import GROUNDS, HELD_OUT_GROUNDS, SIZE
from tubepose.simulation.meshes import box, revolve
from tubepose.training.augmentation import Views, draw_sample
from tubepose.training.images import CLASSES, ImageSet, write_images
from tubepose.training.labels import label_objects
from tubepose.training.scenes import LearningScene, SceneObject, Stock, random_scene
from tubepose.training.variants import cap_outline, fits, vary_rack, vary_tube
from tubepose.transforms import make_transform

CAMERA = CameraIntrinsics(160, 120, 160.0, 160.0, 79.5, 59.5)
GRAY = Surface((0.5, 0.5, 0.5), 0.0)
ROOM = Light([], (1.0, 1.0, 1.0), np.array([0.0, 0.0, -1.0]), np.zeros((4, 4, 3), np.float32))


def looked_at(parts, light=ROOM, camera=CAMERA):
    return render(parts, light, camera, np.random.default_rng(0))


def plate(x, y, side, z, surface=GRAY, owner=NOTHING):
    """A thin plate before the camera, with a given middle, side and distance."""
    return Part(box((side, side, 1e-4), (x, y, z)), surface, owner)


def labware(**options):
    return Stock(
        (load_rack("chen2023-soft-5x10"), load_rack("round-10ml-3x4")),
        (load_tube("chen2023-tube-1"), load_tube("chen2023-tube-2"), load_tube("centrifuge-10ml")),
        (load_cap("printed-square-16.7"),),
        **options,
    )


def scene_of(parts, objects):
    return LearningScene("color", CAMERA, tuple(parts), tuple(objects), ROOM)


def test_a_box_is_where_its_object_is_projected():
    part = plate(0.05, -0.02, 0.1, 0.5, owner=0)
    scene = scene_of([part], [SceneObject(RACK_CLASS, part.mesh.vertices_m)])
    (label,) = label_objects(scene, looked_at([part]))
    low, high = np.array([0.0, -0.07]) / 0.5 * 160 + [79.5, 59.5], np.array([0.10, 0.03]) / 0.5 * 160 + [79.5, 59.5]
    assert label.box_xyxy_px == pytest.approx((*low + 0.5, *high + 0.5), abs=1.0)
    assert label.visible > 0.95
    assert label.inside == pytest.approx(1.0)


def test_what_stands_before_an_object_hides_it_and_a_wall_does_not():
    behind = plate(0.0, 0.0, 0.1, 0.5, owner=0)
    objects = [SceneObject(CAPPED_CLASS, behind.mesh.vertices_m)]
    half = plate(-0.05, 0.0, 0.1, 0.4)
    (label,) = label_objects(scene_of([behind, half], objects), looked_at([behind, half]))
    assert 0.3 < label.visible < 0.75
    assert label.box_xyxy_px[0] > 79
    glass = plate(-0.05, 0.0, 0.1, 0.4, Surface((0.5,) * 3, transmission=(0.8,) * 3))
    (label,) = label_objects(scene_of([behind, glass], objects), looked_at([behind, glass]))
    assert label.visible > 0.95
    milk = plate(-0.05, 0.0, 0.1, 0.4, Surface((0.5,) * 3, transmission=(0.1,) * 3))
    (label,) = label_objects(scene_of([behind, milk], objects), looked_at([behind, milk]))
    assert label.visible < 0.75


def test_an_object_of_which_too_little_is_seen_has_no_box():
    behind = plate(0.0, 0.0, 0.1, 0.5, owner=0)
    cover = plate(0.006, 0.0, 0.09, 0.45)
    objects = [SceneObject(CAPPED_CLASS, behind.mesh.vertices_m)]
    assert label_objects(scene_of([behind, cover], objects), looked_at([behind, cover])) == []


def test_of_a_tube_in_a_rack_only_what_stands_out_has_a_box():
    tube = Part(revolve(np.array([[0.0, 0.01], [0.1, 0.01], [0.1, 0.0]])), GRAY, 0)
    # The camera looks along y; the rack's z is the camera's -y.
    turn = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    T = make_transform(turn, np.array([0.0, 0.05, 0.4]))
    moved = Part(tube.mesh.transformed(T), GRAY, 0)
    whole = SceneObject(OPEN_CLASS, moved.mesh.vertices_m)
    T_rack_camera = np.linalg.inv(T)
    out = SceneObject(OPEN_CLASS, moved.mesh.vertices_m, T_rack_camera, 0.06)
    rendered = looked_at([moved])
    (all_of_it,), (top,) = (label_objects(scene_of([moved], [one]), rendered) for one in (whole, out))
    heights = [label.box_xyxy_px[3] - label.box_xyxy_px[1] for label in (all_of_it, top)]
    assert heights[1] / heights[0] == pytest.approx(0.4, abs=0.06)


def test_a_lamp_throws_a_shadow_and_a_wall_dims_what_lies_behind():
    ground = plate(0.0, 0.0, 0.6, 0.6, Surface((0.6,) * 3, 0.0))
    lamp = Light([Lamp(np.array([-0.5, 0.0, 0.0]), 1e-4, (0.5,) * 3)], (0.0,) * 3, ROOM.up, ROOM.environment)
    free = looked_at([ground], lamp).radiance
    shaded = looked_at([ground, plate(-0.11, 0.0, 0.08, 0.45)], lamp).radiance
    assert free[60, 80].min() > 0.05
    assert shaded[60, 80:90].max() < 0.2 * free[60, 80].min()
    wall = Part(box((0.3, 0.3, 2e-3), (0.0, 0.0, 0.5)), Surface((0.0,) * 3, 0.0, transmission=(0.5,) * 3))
    dimmed = looked_at([ground, wall]).radiance[60, 80] / looked_at([ground]).radiance[60, 80]
    assert dimmed == pytest.approx(0.25 * 0.96**2, rel=0.05)  # two sides


def test_no_picture_to_train_on_has_a_held_out_ground():
    assert not set(GROUNDS) & set(HELD_OUT_GROUNDS)
    for make in {*GROUNDS, *HELD_OUT_GROUNDS}:
        picture = make(np.random.default_rng(3))
        assert picture.shape == (SIZE, SIZE, 3)
        assert picture.dtype == np.float32
        assert 0.0 <= picture.min() <= picture.max() <= 1.0


@settings(max_examples=30)
@given(st.integers(0, 2**32 - 1))
def test_variants_are_labware_and_differ(seed):
    rng = np.random.default_rng(seed)
    rack, tube = load_rack("chen2023-hard-5x10"), load_tube("chen2023-tube-3")
    other_rack, other = vary_rack(rack, rng), vary_tube(tube, rng)
    assert other_rack.outline_mm != rack.outline_mm
    assert other.height_mm != tube.height_mm
    assert other.is_open == tube.is_open
    outline = cap_outline(other, rng)
    assert outline[:, 1].max() == pytest.approx(other.cap.diameter_mm * 5e-4)
    assert outline[:, 0].max() == pytest.approx(other.height_m)
    for k in fits(other_rack, other):
        assert min(other_rack.all_slots[k].size_mm) > other.body.bottom_diameter_mm


def test_every_tube_of_a_scene_stands_in_a_rack_or_lies_free_and_has_the_class_that_is_seen():
    names = set()
    for seed in range(12):
        scene = random_scene(labware(), 128, np.random.default_rng(seed))
        assert scene.parts[-1].owner == NOTHING  # the table
        for number, found in enumerate(scene.objects):
            names.add(found.class_name)
            assert any(part.owner == number for part in scene.parts)
            assert (found.class_name == RACK_CLASS) <= (found.T_rack_camera is None)
    assert names == set(CLASSES)
    assert visible_class(closed=True) == CAPPED_CLASS


def test_a_scanner_sees_all_of_one_rack_from_above():
    for seed in range(6):
        scene = random_scene(labware(variants=1.0), 160, np.random.default_rng(seed), "scanner")
        racks = [found for found in scene.objects if found.class_name == RACK_CLASS]
        assert len(racks) == 1
        pixels = scene.intrinsics.project(racks[0].shape_m)
        assert pixels.min() > 0
        assert pixels.max() < 159


def test_a_view_of_a_rack_is_the_scanners_cut_to_what_is_on_the_rack():
    for seed in range(6):
        far, near = (
            random_scene(labware(variants=1.0), 160, np.random.default_rng(seed), view) for view in ("scanner", "rack")
        )
        shape = np.vstack([found.shape_m for found in near.objects])
        pixels = near.intrinsics.project(shape)
        assert pixels.min() > -0.5
        assert pixels.max() < 159.5
        assert np.ptp(pixels, axis=0).max() > 160 / 1.51
        np.testing.assert_allclose(shape, np.vstack([found.shape_m for found in far.objects]))
        # One picture is a scaled part of the other.
        one, other = near.intrinsics, far.intrinsics
        np.testing.assert_allclose((pixels - [one.cx, one.cy]) / one.fx, (other.project(shape) - 79.5) / other.fx)


def test_mixed_racks_hold_many_kinds_of_tubes_and_others_three_at_most():
    def kinds(mixed):
        drawn = labware(variants=1.0, fill=(1.0, 1.0), mixed=mixed)
        scenes = [random_scene(drawn, 96, np.random.default_rng(seed), "scanner") for seed in range(6)]
        return [
            len({part.surface.albedo for part in scene.parts if part.owner > 0 and part.surface.sharpness >= 40})
            for scene in scenes
        ]

    few, many = kinds(0.0), kinds(1.0)
    assert np.mean(many) > 2 * np.mean(few)
    assert ImageSet(labware(mixed=0.5)).recipe()["mixed"] == 0.5
    assert "mixed" not in ImageSet(labware()).recipe()


def test_a_given_fill_is_kept():
    for seed in range(4):
        scene = random_scene(labware(variants=0.0, fill=(0.1, 0.2)), 96, np.random.default_rng(seed), "scanner")
        tubes = [found for found in scene.objects if found.class_name != RACK_CLASS]
        assert 1 <= len(tubes) <= 10
    assert ImageSet(labware(fill=(0.1, 0.2))).recipe()["fill"] == [0.1, 0.2]


def test_pictures_depend_on_recipe_and_number_alone(tmp_path):
    source = ImageSet(labware(), seed=4, long_side_px=96)
    write_images(tmp_path / "one", source, 3)
    done = []
    write_images(tmp_path / "two", source, 1)
    write_images(tmp_path / "two", source, 3, on_done=done.append)  # goes on where it stopped
    assert done[0] == 1
    for kind in ("images", "labels", "visibility"):
        names = sorted(path.name for path in (tmp_path / "one" / kind).iterdir())
        assert len(names) == 3
        same, other, failed = filecmp.cmpfiles(tmp_path / "one" / kind, tmp_path / "two" / kind, names, shallow=False)
        assert (len(same), other, failed) == (3, [], [])
    recipe = yaml.safe_load((tmp_path / "one" / "set.yaml").read_text())
    assert recipe == source.recipe()
    assert recipe["simulated"] is True


def test_labels_on_disk_are_those_of_the_scene(tmp_path):
    source = ImageSet(labware(), seed=11, long_side_px=160)
    write_images(tmp_path, source, 2)
    files = labelled_set(tmp_path)
    assert files.classes == CLASSES
    for number in range(2):
        picture, labels = source.picture(number)
        ids, edges = files.read_boxes(number, (picture.shape[1], picture.shape[0]))
        assert [CLASSES[k] for k in ids] == [label.class_name for label in labels]
        assert edges == pytest.approx(np.array([label.box_xyxy_px for label in labels]).reshape(-1, 4), abs=1e-6)


def test_a_camera_that_is_set_up_is_in_focus_and_hardly_too_bright():
    ramp = np.tile(np.linspace(0, 1, 256, dtype=np.float32), (64, 1))
    ramp[:, 100:] += 0.2
    radiance = np.repeat(ramp[..., None], 3, axis=2)

    def look(quality):
        pictures = [expose(radiance, "projector", np.random.default_rng(seed), quality) for seed in range(60)]
        shown = np.stack(pictures)[..., 0].astype(float)
        rows = shown.mean(axis=1)
        edge = (rows[:, 102] - rows[:, 97]) / (rows[:, 106] - rows[:, 93])
        return (shown == 255).mean(axis=(1, 2)), edge

    (bright, sharp), (any_bright, any_sharp) = look("good"), look("any")
    assert bright.max() < 0.05
    assert any_bright.max() > 0.15
    assert sharp.min() > any_sharp.min() + 0.1
    assert ImageSet(labware(), quality="good").recipe()["quality"] == "good"
    assert "quality" not in ImageSet(labware()).recipe()


def test_a_folder_of_another_recipe_or_of_something_else_is_refused(tmp_path):
    write_images(tmp_path / "set", ImageSet(labware(), 1, 96), 1)
    with pytest.raises(DetectorError, match="pictures of another recipe"):
        write_images(tmp_path / "set", ImageSet(labware(), 2, 96), 1)
    tall = load_tube("chen2023-tube-2")
    body = tall.body.model_copy(update={"height_mm": tall.body.height_mm + 5})
    changed = replace(labware(), tubes=(tall.model_copy(update={"body": body}),))
    same_names = ImageSet(replace(labware(), tubes=(tall,)), 1, 96)
    write_images(tmp_path / "one", same_names, 1)
    with pytest.raises(DetectorError, match="pictures of another recipe"):
        write_images(tmp_path / "one", replace(same_names, labware=changed), 1)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.doc").write_text("mine")
    with pytest.raises(DetectorError, match="not empty"):
        write_images(tmp_path / "full", ImageSet(labware(), 1, 96), 1)


@pytest.fixture(scope="module")
def red_square(tmp_path_factory):
    """A set whose pictures hold one red rectangle each, with its box."""
    folder = tmp_path_factory.mktemp("set")
    for name in ("images", "labels"):
        (folder / name).mkdir()
    (folder / "classes.txt").write_text("rack\n")
    for k, (x, y, w, h) in enumerate([(60, 40, 50, 30), (120, 90, 25, 45)]):
        picture = np.full((160, 220, 3), 40, np.uint8)
        picture[y : y + h, x : x + w] = (0, 0, 255)
        cv2.imwrite(str(folder / "images" / f"{k}.png"), picture)
        line = f"0 {(x + w / 2) / 220} {(y + h / 2) / 160} {w / 220} {h / 160}\n"
        (folder / "labels" / f"{k}.txt").write_text(line)
    return labelled_set(folder)


@settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), mosaic=st.sampled_from([0.0, 1.0]), rack_share=st.sampled_from([0.0, 1.0]))
def test_boxes_stay_on_their_objects_in_samples(red_square, monkeypatch_module, seed, mosaic, rack_share):
    views = Views(whole_px=220, rack_px=60, rack_share=rack_share)
    sample = draw_sample(red_square, 128, mosaic, views, np.random.default_rng(seed))
    assert sample.image.shape == (128, 128, 3)
    red = sample.image[..., 0].astype(int) - sample.image[..., 1] > 90
    for left, top, right, bottom in sample.edges_xyxy:
        assert 0 <= left < right <= 128
        assert 0 <= top < bottom <= 128
        rows = slice(round(top + 0.15 * (bottom - top)), max(round(bottom - 0.15 * (bottom - top)), round(top) + 1))
        columns = slice(round(left + 0.15 * (right - left)), max(round(right - 0.15 * (right - left)), round(left) + 1))
        assert red[rows, columns].mean() > 0.9
    outside = red.copy()
    for left, top, right, bottom in sample.edges_xyxy:
        outside[max(int(top) - 2, 0) : int(bottom) + 3, max(int(left) - 2, 0) : int(right) + 3] = False
    # What is left outside of boxes was cut so far that its box was dropped.
    assert outside.sum() < 0.26 * 1.4**2 * 1500 * 4


@pytest.fixture(scope="module")
def monkeypatch_module():
    """Samples as they are, without other colours."""
    patch = pytest.MonkeyPatch()
    patch.setattr("tubepose.training.augmentation.look_other", lambda sample, _rng: sample)
    yield patch
    patch.undo()


def test_beyond_a_picture_is_the_gray_of_the_letterbox(red_square, monkeypatch_module):
    views = Views(whole_px=220, rack_px=60, rack_share=0.0)
    images = [draw_sample(red_square, 320, 0.0, views, np.random.default_rng(k)).image for k in range(5)]
    assert all((image == BORDER).all(axis=2).any() for image in images)


def test_racks_are_shown_about_as_large_as_they_will_be_looked_at(red_square, monkeypatch_module):
    views = Views(whole_px=220, rack_px=60, rack_share=1.0)
    samples = [draw_sample(red_square, 320, 0.0, views, np.random.default_rng(k)) for k in range(40)]
    sides = [np.ptp(sample.edges_xyxy.reshape(-1, 2, 2), axis=1).max() for sample in samples if len(sample.edges_xyxy)]
    assert len(sides) > 30
    # 0.6 to 1.2 times that, and squeezed by a few percent.
    assert 60 * 0.6 * 0.8 < min(sides) < 60 * 0.8
    assert 60 * 1.0 < max(sides) < 60 * 1.2 * 1.25
