"""A rack's face is seen from the origin: what a cloud in a robot's frame contradicts."""

import numpy as np
import pytest
import scenes
from scipy.spatial.transform import Rotation

from tubepose.checks import reason, reason_code
from tubepose.config import Config
from tubepose.labware import load_rack
from tubepose.rack import RackStatus, register_rack
from tubepose.rack.viewpoint import viewpoint_checks
from tubepose.transforms import invert_transform, make_transform, transform_points

SOFT = load_rack("chen2023-soft-5x10")
T_CAMERA_RACK = scenes.camera_from_rack(SOFT, yaw_rad=0.3, tilt_rad=0.2)
SEEN_FLOORS = transform_points(
    invert_transform(T_CAMERA_RACK),
    scenes.seen_past_the_top(transform_points(T_CAMERA_RACK, scenes.slot_floors(SOFT)), SOFT, T_CAMERA_RACK),
)
SCENE = np.vstack([scenes.rack_top(SOFT), SEEN_FLOORS])
"""In the rack's frame: what a camera sees of an empty rack."""
UPSIDE_DOWN = make_transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 2 * SOFT.height_m]))


def table(seed=0):
    xy = np.random.default_rng(seed).uniform(-0.14, 0.14, (6000, 2))
    beyond = (np.abs(xy) - SOFT.outline_m / 2).max(axis=1) > 2e-3
    return np.column_stack([xy[beyond], np.zeros(beyond.sum())])


def robot(origin_m, yaw_rad=0.4):
    """T_robot_rack of a robot whose origin is at a place in the rack's frame, z up."""
    R = Rotation.from_euler("z", yaw_rad).as_matrix()
    return make_transform(R, -R @ np.array(origin_m))


def code(scene, T):
    return reason_code(viewpoint_checks(transform_points(T, scene), T, SOFT))


@pytest.mark.parametrize("scene", [SCENE, np.vstack([SCENE, table()]), scenes.rack_top(SOFT)])
def test_a_cloud_in_the_cameras_frame_passes(scene):
    assert code(scene, T_CAMERA_RACK) == ""


@pytest.mark.parametrize("origin_m", [(0.4, 0.1, 0.0), (0.6, 0.1, 0.07), (0.0, 0.0, -0.5)])
def test_a_face_that_is_seen_from_the_side_or_from_below_is_refused(origin_m):
    assert code(SCENE, robot(origin_m)) == "faces_away"


def test_lines_of_sight_through_ribs_tell_of_an_origin_above_the_face():
    assert code(SCENE, robot((0.35, 0.2, 0.4))) == "seen_through"
    assert code(scenes.rack_top(SOFT), robot((0.35, 0.2, 0.4))) == ""  # nothing is behind the face: not to be told


def test_a_table_above_the_face_tells_of_an_origin_under_the_table():
    T = robot((0.05, 0.02, -0.6)) @ UPSIDE_DOWN
    scene = transform_points(UPSIDE_DOWN, np.vstack([scenes.rack_top(SOFT), table()]))
    assert code(scene, T) == "table_above"


def test_a_rack_in_a_robots_frame_gets_no_pose_and_a_reason():
    config = Config()
    camera = register_rack(transform_points(T_CAMERA_RACK, SCENE), SOFT, config)
    assert camera.status is RackStatus.OK, camera.reason
    T = robot((0.5, 0.1, 0.0))
    pose = register_rack(transform_points(T, SCENE), SOFT, config)
    assert pose.status is not RackStatus.OK
    assert pose.T_camera_rack is None
    if pose.status is RackStatus.REFUSED:
        assert "is the cloud in a robot's frame?" in pose.reason
        assert reason(pose.checks, SOFT.name) == pose.reason
