from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import pytest
import scenes

from tubepose.capture.frame import RgbdFrame
from tubepose.config import Config
from tubepose.detection import Detection, Detector
from tubepose.labware import load_rack, load_tube
from tubepose.pipeline import estimate_tubes, prepare_scene
from tubepose.report.overlay import COLORS_BGR, STATE_COLORS_BGR, WIDTH_PX, Picture, _ImageView, draw_overlay
from tubepose.scene import Scene, TubeEstimate
from tubepose.slots import SlotState
from tubepose.transforms import FloatArray, transform_points
from tubepose.tube import TubeStatus

CONFIG = Config()
RACK = load_rack("round-10ml-3x4")
TUBE = load_tube("blood-16x100")
CAMERA = scenes.CAMERA
T_CAMERA_RACK = scenes.camera_from_rack(RACK, 0.3, 0.15)
T_RACK_TUBE = scenes.tube_pose(RACK, "B2", 0.02, 0.01)


@dataclass(frozen=True)
class Fixed(Detector):
    detections: tuple[Detection, ...]
    name: str = "recorded"

    def detect(self, frame: RgbdFrame) -> tuple[Detection, ...]:
        return self.detections


def box_around(points_m: FloatArray) -> tuple[float, float, float, float]:
    pixels = CAMERA.project(points_m)
    return (*pixels.min(axis=0), *pixels.max(axis=0))


def make_scene(organised: bool = True) -> Scene:
    top = transform_points(T_CAMERA_RACK, scenes.rack_top(RACK))
    surface = scenes.tube_surface(TUBE, T_RACK_TUBE, RACK.height_m, seen_from=scenes.towards_camera(T_CAMERA_RACK))
    tube = transform_points(T_CAMERA_RACK, surface)
    points = np.vstack([top, tube])
    rows = np.arange(len(top), len(points))
    frame = scenes.organised(points) if organised else scenes.unorganised(points)
    nowhere = (np.nan,) * 4
    found = (
        Detection("rack", 1.0, box_around(top) if organised else nowhere, "recorded"),
        Detection(TUBE.name, 0.9, box_around(tube) if organised else nowhere, "recorded", None if organised else rows),
    )
    return prepare_scene(frame, RACK, (TUBE,), Fixed(found), CONFIG, T_camera_rack=T_CAMERA_RACK)


def estimates_of(scene: Scene, status: TubeStatus = TubeStatus.OK) -> tuple[TubeEstimate, ...]:
    estimates = estimate_tubes(scene, "upright", CONFIG).estimates
    assert len(estimates) == 1
    return tuple(replace(e, pose=replace(e.pose, status=status)) for e in estimates)


def pixels_of(picture: Picture, color: tuple[int, int, int]) -> int:
    return int((np.abs(picture.astype(int) - color).max(axis=-1) <= 4).sum())


SCENE = make_scene()


def below_the_strip(scene: Scene, estimates: tuple[TubeEstimate, ...]) -> Picture:
    """The picture without its strip of words, which has every colour: the rows that change with the image."""
    size = scene.frame.cloud_m.shape[:2]
    images = (np.full(size, shade, np.uint8) for shade in (60, 200))
    dark, bright = (draw_overlay(replace(scene, frame=replace(scene.frame, image=image)), ()) for image in images)
    strip = int((dark == bright).all(axis=(1, 2)).argmin())
    assert strip > 0
    return draw_overlay(scene, estimates)[strip:]


@pytest.mark.parametrize("status", list(TubeStatus))
def test_a_tube_has_the_colour_of_its_status(status: TubeStatus) -> None:
    picture = below_the_strip(SCENE, estimates_of(SCENE, status))
    counts = {name: pixels_of(picture, color) for name, color in COLORS_BGR.items()}
    assert counts.pop(status.value) > 200
    assert set(counts.values()) == {0}


def test_without_estimates_no_tube_is_drawn_and_the_rest_stays() -> None:
    full, bare = (below_the_strip(SCENE, estimates) for estimates in (estimates_of(SCENE), ()))
    assert full.shape == bare.shape
    assert sum(pixels_of(bare, color) for color in COLORS_BGR.values()) == 0
    changed = (full != bare).any(axis=-1)
    # The rings and the name of one tube: a small part of the picture.
    assert 0 < changed.mean() < 0.1


def test_slots_that_were_not_seen_or_are_unclear_look_unlike_empty_ones() -> None:
    unclear = tuple(replace(look, patches_passed=3.0, patches_stopped=3.0) for look in SCENE.looks)
    free = tuple(replace(look, patches_passed=9.0, patches_stopped=0.0) for look in SCENE.looks)
    drawn = {
        name: [
            pixels_of(below_the_strip(replace(SCENE, looks=looks), ()), color) for color in STATE_COLORS_BGR.values()
        ]
        for name, looks in {SlotState.NOT_SEEN: (), SlotState.UNCLEAR: unclear, SlotState.EMPTY: free}.items()
    }
    assert list(STATE_COLORS_BGR) == [SlotState.NOT_SEEN, SlotState.UNCLEAR]
    gray, none = drawn[SlotState.NOT_SEEN][0], drawn[SlotState.EMPTY]
    assert gray > none[0] + 50
    assert drawn[SlotState.UNCLEAR][1] > none[1] + 50


def test_the_picture_is_of_one_width_and_not_blank() -> None:
    picture = draw_overlay(SCENE, estimates_of(SCENE))
    assert picture.dtype == np.uint8
    assert picture.shape[1] == WIDTH_PX
    assert picture.std() > 10


def test_the_image_is_shown_where_there_is_one() -> None:
    height, width = SCENE.frame.cloud_m.shape[:2]
    # RGB in the frame, BGR in the picture.
    image = np.full((height, width, 3), (200, 100, 50), np.uint8)
    picture = draw_overlay(replace(SCENE, frame=replace(SCENE.frame, image=image)), ())
    gray = draw_overlay(replace(SCENE, frame=replace(SCENE.frame, image=image[..., 1])), ())
    assert pixels_of(picture, (50, 100, 200)) > 0.4 * picture[..., 0].size
    assert pixels_of(gray, (100, 100, 100)) > 0.4 * gray[..., 0].size


def test_a_cloud_without_pixels_is_seen_from_above() -> None:
    scene = make_scene(organised=False)
    picture = draw_overlay(scene, estimates_of(scene))
    assert picture.shape[1] == WIDTH_PX
    assert pixels_of(picture, COLORS_BGR["ok"]) > 200


def test_a_cloud_without_pixels_and_rack_is_seen_as_the_camera_sees_it() -> None:
    u, v = np.meshgrid(np.linspace(-0.1, 0.1, 60), np.linspace(-0.1, 0.1, 60))
    cloud = np.stack([u, v, np.where((u < 0) & (v < 0), 0.5, 0.6)], axis=-1).reshape(1, -1, 3)  # top left is near
    frame = RgbdFrame(cloud, None, None, None, "wall", organised=False)
    scene = prepare_scene(frame, RACK, (TUBE,), Fixed(()), CONFIG)
    picture = draw_overlay(scene, ())[..., 0].astype(float)
    rows, columns = np.array(picture.shape) // 2
    bright = picture > 200
    near = bright[:rows, :columns].sum()
    assert near > 0.8 * bright.sum() > 0


def test_a_frame_without_points_is_drawn_too() -> None:
    nothing = np.full((48, 64, 3), np.nan)
    for organised in (True, False):
        frame = RgbdFrame(nothing if organised else nothing.reshape(1, -1, 3), None, None, None, "empty", organised)
        scene = prepare_scene(frame, RACK, (TUBE,), Fixed(()), CONFIG)
        assert draw_overlay(scene, ()).shape[2] == 3


def test_drawing_changes_nothing() -> None:
    estimates = estimates_of(SCENE)
    cloud, pose = SCENE.frame.cloud_m.copy(), estimates[0].T_camera_tube
    assert pose is not None
    kept = pose.copy()
    first, second = draw_overlay(SCENE, estimates), draw_overlay(SCENE, estimates)
    assert np.array_equal(first, second)
    assert np.array_equal(SCENE.frame.cloud_m, cloud, equal_nan=True)
    assert np.array_equal(pose, kept)


@pytest.mark.parametrize("count", [0, 5])
def test_a_cloud_without_a_single_measurement_has_a_picture_too(count):
    frame = scenes.unorganised(np.full((count, 3), np.nan))
    scene = prepare_scene(frame, RACK, (TUBE,), Fixed(()), CONFIG)
    assert draw_overlay(scene, ()).shape[1] > 0


def test_drawn_marks_lie_on_the_middle_of_the_pixel_that_they_mark():
    """An enlarged picture shows pixel k from k z to (k + 1) z: its middle is half a pixel from its corner."""
    image = np.zeros((40, 60), np.uint8)
    image[20, 30] = 255
    zoom = 8.0
    view = _ImageView(replace(SCENE, intrinsics=scenes.CAMERA), np.array([10.0, 5.0]), zoom)
    picture = cv2.resize(image[5:, 10:], None, fx=zoom, fy=zoom, interpolation=cv2.INTER_CUBIC)
    v, u = np.unravel_index(cv2.GaussianBlur(picture, (0, 0), 2).argmax(), picture.shape)
    assert np.abs(np.array(view.pixel((30.0, 20.0))) - (u, v)).max() <= 1
