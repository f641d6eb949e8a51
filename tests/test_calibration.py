from __future__ import annotations

from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
from recordings import (
    CAMERA,
    DEPTH,
    GRAY,
    SECOND_NS,
    STAMP_NS,
    WIDE,
    assert_same,
    cloud_message,
    image_message,
    info_message,
    mcap,
    read_all,
    scaled,
    shots,
    tf_message,
)
from scipy.spatial.transform import Rotation

from tubepose.capture import CameraIntrinsics
from tubepose.capture import mcap_writing as writing
from tubepose.capture.calibration import camera_of, info_at
from tubepose.capture.message_types import CAMERA_INFO, IMAGE, POINT_CLOUD, TRANSFORMS
from tubepose.capture.topics import Topic
from tubepose.errors import CaptureError
from tubepose.transforms import invert_transform, make_transform, transform_points

ZEROS = {"k": [0.0] * 9, "p": [0.0] * 12}
K = [CAMERA.fx, 0, CAMERA.cx, 0, CAMERA.fy, CAMERA.cy, 0, 0, 1]
P = [*K[:3], 0.0, *K[3:6], 0.0, *K[6:], 0.0]
BROWN = [-0.2, 0.05, 0.001, -0.002, 0.0]


def info(**changes) -> SimpleNamespace:
    fields = writing._info(CAMERA) | changes
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False} | fields["roi"]
    return SimpleNamespace(**(fields | {"roi": SimpleNamespace(**roi)}))


# K and P, lenses ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rectified", [False, True])
def test_k_or_p_is_used_where_the_other_is_zero(rectified):
    for zero in ({"k": ZEROS["k"]}, {"p": ZEROS["p"]}):
        assert camera_of(info(**zero), rectified=rectified).pinhole == CAMERA
    assert camera_of(info(**ZEROS), rectified=rectified) is None


def test_p_holds_for_a_rectified_image_and_k_for_the_raw_one():
    moved = info(p=[WIDE.fx, 0, WIDE.cx, 0, 0, WIDE.fy, WIDE.cy, 0, 0, 0, 1, 0])
    assert camera_of(moved, rectified=False).pinhole == CAMERA
    assert camera_of(moved, rectified=True).pinhole.fx == WIDE.fx


def test_a_lens_is_there_unless_p_tells_that_it_was_removed():
    same = info(d=BROWN)
    assert camera_of(same, rectified=False).model == "polynomial"
    assert camera_of(same, rectified=True).model == "polynomial"  # RealSense D405: image_rect_raw is distorted
    other = info(d=BROWN, p=[39.0, 0, 15, 0, 0, 39.5, 11, 0, 0, 0, 1, 0])
    assert camera_of(other, rectified=True).model is None
    assert camera_of(other, rectified=True).pinhole.fx == 39.0
    assert camera_of(other, rectified=False).model == "polynomial"
    assert camera_of(info(d=BROWN, p=ZEROS["p"]), rectified=True).model == "polynomial"


def test_a_distorted_image_without_k_is_not_calibrated():
    assert camera_of(info(d=BROWN, k=ZEROS["k"]), rectified=False) is None
    assert camera_of(info(d=[float("nan")] * 5), rectified=False) is None


@pytest.mark.parametrize("number", [0.0, float("nan"), float("inf"), -1.0])
def test_a_camera_that_is_not_calibrated_is_none(number):
    assert camera_of(info(k=[number] * 9, p=[number] * 12), rectified=False) is None


def test_a_lens_that_moves_nothing_is_none():
    assert camera_of(info(d=[1e-7, 0.0, 0.0, 0.0, 0.0]), rectified=False).model is None


def test_models_are_told_by_their_name_and_others_are_refused():
    for name, found in (("rational_polynomial", "polynomial"), ("equidistant", "fisheye"), ("fisheye", "fisheye")):
        d = BROWN[:4] if found == "fisheye" else [*BROWN, 0.1, 0.0, 0.0]
        assert camera_of(info(d=d, distortion_model=name), rectified=False).model == found
    assert camera_of(info(d=BROWN, distortion_model="Inverse Brown Conrady"), rectified=False).model == "polynomial"
    with pytest.raises(CaptureError, match=r"model 'ftheta' with 5 coefficients is not read; .* record the rectified"):
        camera_of(info(d=BROWN, distortion_model="ftheta"), rectified=False)


def test_a_lens_that_is_not_read_leaves_a_cloud_with_its_pixels(tmp_path):
    unknown = info_message(changes={"d": BROWN, "distortion_model": "ftheta"})
    messages = [
        ("/points", POINT_CLOUD, cloud_message(CAMERA.backproject(DEPTH))),
        ("/color/image_raw", IMAGE, image_message(GRAY, "mono8")),
        ("/color/camera_info", CAMERA_INFO, unknown),
    ]
    (frame,) = read_all(mcap(tmp_path / "a.mcap", messages))
    assert_same(frame)
    depth = [("/depth/image_raw", IMAGE, image_message(DEPTH, "32FC1")), *messages[1:]]
    with pytest.raises(CaptureError, match="message 1: a lens of the model 'ftheta' with 5 coefficients is not read"):
        read_all(mcap(tmp_path / "b.mcap", depth))


# Binning and region of interest --------------------------------------------------------------------------------------


def test_binning_and_region_of_interest_as_image_geometry_has_them():
    roi = {"x_offset": 4, "y_offset": 6, "width": 20, "height": 12}
    cut = camera_of(info(roi=roi), rectified=False, size=(12, 20)).pinhole
    assert cut == replace(CAMERA, width=20, height=12, cx=CAMERA.cx - 4, cy=CAMERA.cy - 6)
    half = camera_of(info(binning_x=2, binning_y=2), rectified=False, size=(12, 16)).pinhole
    assert half == CameraIntrinsics(16, 12, CAMERA.fx / 2, CAMERA.fy / 2, CAMERA.cx / 2, CAMERA.cy / 2)
    both = camera_of(info(roi=roi, binning_x=2, binning_y=3), rectified=False, size=(4, 10)).pinhole
    expected = (10, 4, CAMERA.fx / 2, CAMERA.fy / 3, (CAMERA.cx - 4) / 2, (CAMERA.cy - 6) / 3)
    assert tuple(asdict(both).values()) == pytest.approx(expected)
    # A driver that states a region and sends the whole picture.
    assert camera_of(info(roi=roi), rectified=False, size=(24, 32)).pinhole == CAMERA


def test_a_cut_and_binned_depth_image_gives_the_points_of_the_whole_one(tmp_path):
    plane = np.full((48, 64), 0.8, np.float32)
    whole = WIDE.backproject(plane)
    changes = {"binning_x": 2, "binning_y": 2, "roi": {"x_offset": 8, "y_offset": 4, "width": 40, "height": 32}}
    part = plane[4:36:2, 8:48:2]
    messages = [
        ("/depth/image_raw", IMAGE, image_message(part, "32FC1")),
        ("/depth/camera_info", CAMERA_INFO, info_message(WIDE, changes=changes)),
    ]
    (frame,) = read_all(mcap(tmp_path / "a.mcap", messages))
    np.testing.assert_allclose(frame.cloud_m, whole[4:36:2, 8:48:2], atol=1e-7)
    assert (frame.intrinsics.width, frame.intrinsics.height) == (20, 16)


# The CameraInfo of a moment ------------------------------------------------------------------------------------------


def track(*stamps_ms: float) -> Topic:
    topic = Topic("/camera_info", CAMERA_INFO, None)
    for number, stamp in enumerate(stamps_ms):
        topic.note_info(round(stamp * 1e6), info(k=[*K[:2], float(number), *K[3:]]))
    return topic


@pytest.mark.parametrize(
    ("stamps_ms", "moment_ms", "number"),
    [
        ([0], 900, 0),  # sent once
        ([500], 0, 0),  # sent late
        ([0, 1000], 800, 0),  # holds until the next
        ([0, 1000], 1000, 1),
        ([0, 1000], 998, 1),  # a driver that stamps them a little apart
        ([0, 1000], 5000, 1),
        ([1000, 0], 500, 1),  # stored in another order
    ],
)
def test_the_info_of_the_same_moment_else_the_last_one_before(stamps_ms, moment_ms, number):
    found = info_at(track(*stamps_ms), round(moment_ms * 1e6), None)
    assert found.k[2] == number


def test_infos_of_zeros_are_skipped(tmp_path):
    name, kind, _ = shots()[0]
    zero = (name, kind, info_message(changes=ZEROS))
    (frame,) = read_all(mcap(tmp_path / "a.mcap", [zero, *shots()]))
    assert_same(frame)
    identity = (name, kind, info_message(changes={"k": np.eye(3).ravel().tolist(), "p": np.eye(3, 4).ravel().tolist()}))
    for none in (zero, identity):
        with pytest.raises(CaptureError, match=r"/camera/color/camera_info, without calibration"):
            read_all(mcap(tmp_path / "b.mcap", [none, *shots()[1:]]))


def test_changes_of_k_are_followed(tmp_path):
    later = STAMP_NS + SECOND_NS
    changed = ("/camera/color/camera_info", CAMERA_INFO, info_message(scaled(CAMERA, 2), stamp_ns=later))
    path = mcap(tmp_path / "a.mcap", [*shots(), changed, *shots(stamp_ns=later)[1:]])
    first, second = read_all(path)
    assert (first.intrinsics, second.intrinsics) == (CAMERA, scaled(CAMERA, 2))
    np.testing.assert_allclose(second.cloud_m[..., 0] * 2, first.cloud_m[..., 0])


def test_a_change_of_resolution_is_followed_by_depth_whose_own_info_is_not(tmp_path):
    later = STAMP_NS + SECOND_NS
    own = ("/camera/aligned_depth_to_color/camera_info", CAMERA_INFO, info_message())
    plane = np.full((48, 64), 0.8, np.float32)
    wide = [
        ("/camera/color/camera_info", CAMERA_INFO, info_message(WIDE, stamp_ns=later)),
        ("/camera/color/image_raw", IMAGE, image_message(np.zeros((48, 64), np.uint8), "mono8", stamp_ns=later)),
        ("/camera/aligned_depth_to_color/image_raw", IMAGE, image_message(plane, "32FC1", stamp_ns=later)),
    ]
    first, second = read_all(mcap(tmp_path / "a.mcap", [own, *shots(), *wide]))
    assert_same(first)
    assert second.intrinsics == WIDE
    np.testing.assert_allclose(second.cloud_m, WIDE.backproject(plane), atol=1e-7)


# Two CameraInfos -----------------------------------------------------------------------------------------------------


def test_infos_that_contradict_each_other_are_told_and_the_option_to_paste_works(tmp_path):
    other = "/camera/aligned_depth_to_color/camera_info"
    path = mcap(tmp_path / "a.mcap", [(other, CAMERA_INFO, info_message(scaled(CAMERA, 1.04))), *shots()])
    with pytest.raises(CaptureError, match=r"contradict each other by up to 0\.\d pixels") as caught:
        read_all(path)
    for name, camera in ((other, scaled(CAMERA, 1.04)), ("/camera/color/camera_info", CAMERA)):
        assert f"--info-topic {name}" in str(caught.value)
        (frame,) = read_all(path, info_topic=name)
        assert frame.intrinsics == camera


def test_infos_that_agree_within_half_a_pixel_do_not_contradict(tmp_path):
    other = ("/camera/aligned_depth_to_color/camera_info", CAMERA_INFO, info_message(scaled(CAMERA, 1.01)))
    (frame,) = read_all(mcap(tmp_path / "a.mcap", [other, *shots()]))
    assert frame.intrinsics == CAMERA


# Transforms ----------------------------------------------------------------------------------------------------------

T_COLOR_DEPTH = make_transform(
    Rotation.from_euler("xyz", [2, -3, 4], degrees=True).as_matrix(), np.array([0.03, 0, 0.01])
)
T_BASE_COLOR = make_transform(Rotation.from_euler("xyz", [170, 5, 20], degrees=True).as_matrix(), np.array([1, 2, 0.9]))


def two_cameras() -> list:
    """Depth and colour cameras with transforms by way of a base."""
    return [
        ("/tf_static", TRANSFORMS, tf_message("base", "color", T_BASE_COLOR)),
        ("/tf_static", TRANSFORMS, tf_message("base", "depth", T_BASE_COLOR @ T_COLOR_DEPTH)),
        ("/depth/image_raw", IMAGE, image_message(DEPTH, "32FC1", frame_id="depth")),
        ("/depth/camera_info", CAMERA_INFO, info_message(frame_id="depth")),
        ("/color/image_raw", IMAGE, image_message(np.zeros((48, 64), np.uint8), "mono8", frame_id="color")),
        ("/color/camera_info", CAMERA_INFO, info_message(WIDE, frame_id="color")),
    ]


def test_depth_is_registered_to_the_colour_camera_by_tf_static(tmp_path):
    (frame,) = read_all(mcap(tmp_path / "a.mcap", two_cameras()))
    assert frame.intrinsics == WIDE
    assert frame.image.shape == (48, 64)
    expected = transform_points(T_COLOR_DEPTH, CAMERA.backproject(DEPTH)).reshape(-1, 3)
    found = frame.measured_m
    assert len(found) > 600
    gaps = np.abs(found[:, None] - expected[None]).max(axis=2).min(axis=1)
    assert gaps.max() < 1e-6
    v, u = np.nonzero(frame.valid.reshape(48, 64))
    assert np.abs(WIDE.project(frame.cloud_m[v, u]) - np.stack([u, v], 1)).max() <= 0.5


def test_equal_cameras_in_two_places_are_not_taken_for_one(tmp_path):
    messages = [message for message in two_cameras() if "/color/" not in message[0]]
    messages += [
        ("/color/image_raw", IMAGE, image_message(GRAY, "mono8", frame_id="color")),
        ("/color/camera_info", CAMERA_INFO, info_message(frame_id="color")),
    ]
    (frame,) = read_all(mcap(tmp_path / "a.mcap", messages))
    expected = transform_points(T_COLOR_DEPTH, CAMERA.backproject(DEPTH)).reshape(-1, 3)
    assert np.abs(frame.measured_m[:, None] - expected[None]).max(axis=2).min(axis=1).max() < 1e-6
    # Without a transform all that is known is that one CameraInfo fits both, which is told.
    (frame,) = read_all(mcap(tmp_path / "b.mcap", [message for message in messages if message[1] != TRANSFORMS]))
    np.testing.assert_allclose(frame.cloud_m, CAMERA.backproject(DEPTH))
    assert "no transform between 'depth' and 'color' is recorded" in frame.notes[0]


def test_a_cloud_in_a_robot_frame_comes_into_the_cameras_pixels(tmp_path):
    in_base = transform_points(T_BASE_COLOR, CAMERA.backproject(DEPTH))
    messages = [
        ("/tf_static", TRANSFORMS, tf_message("base", "color", T_BASE_COLOR)),
        ("/points", POINT_CLOUD, cloud_message(in_base, frame_id="base")),
        ("/color/image_raw", IMAGE, image_message(GRAY, "mono8", frame_id="color")),
        ("/color/camera_info", CAMERA_INFO, info_message(frame_id="color")),
    ]
    (frame,) = read_all(mcap(tmp_path / "a.mcap", messages))
    np.testing.assert_allclose(frame.cloud_m, CAMERA.backproject(DEPTH), atol=1e-6)
    np.testing.assert_array_equal(frame.image, GRAY)
    # And without a picture: the CameraInfo names the camera.
    without = [message for message in messages if message[1] != IMAGE]
    (frame,) = read_all(mcap(tmp_path / "b.mcap", without))
    np.testing.assert_allclose(frame.cloud_m, CAMERA.backproject(DEPTH), atol=1e-6)
    assert frame.intrinsics == CAMERA


def test_a_transform_that_moves_is_not_used(tmp_path):
    moved = T_BASE_COLOR.copy()
    moved[0, 3] += 0.01
    messages = [("/tf", TRANSFORMS, tf_message("base", "color", moved)), *two_cameras()]
    with pytest.raises(CaptureError, match=r"not pixel to pixel; .* or /tf_static between the frames"):
        read_all(mcap(tmp_path / "a.mcap", messages))
    still = [("/tf", TRANSFORMS, tf_message("base", "color", T_BASE_COLOR)), *two_cameras()]
    assert len(read_all(mcap(tmp_path / "b.mcap", still))) == 1


def test_transforms_are_read_the_other_way_round_and_with_slashes(tmp_path):
    messages = [message for message in two_cameras() if message[1] != TRANSFORMS]
    edge = ("/tf_static", TRANSFORMS, tf_message("/depth", "/color", invert_transform(T_COLOR_DEPTH)))
    one = read_all(mcap(tmp_path / "a.mcap", [edge, *messages]))[0]
    other = read_all(mcap(tmp_path / "b.mcap", two_cameras()))[0]
    np.testing.assert_allclose(one.cloud_m, other.cloud_m, atol=1e-9)


def test_a_row_of_points_with_one_for_every_pixel_gets_its_pixels_back(tmp_path):
    row = CAMERA.backproject(DEPTH).reshape(1, -1, 3)
    messages = [("/points", POINT_CLOUD, cloud_message(row)), *shots()[:2]]
    (frame,) = read_all(mcap(tmp_path / "a.mcap", messages))
    assert_same(frame)
