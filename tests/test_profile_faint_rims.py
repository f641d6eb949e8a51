"""Rims that only the image shows: found where they are, told from edges, discs and noise, and from what others hide."""

import numpy as np
import pytest
from test_profile_rims import CAMERA, INNER_M, LEVEL_M, OUTER_M, RACK, VIEW, drawn, frame_of, level_points, seen

from tubepose.config import Config, ProfileConfig
from tubepose.labware import load_tube
from tubepose.profile import fit_profiles
from tubepose.profile.closed_tops import blocked_sectors
from tubepose.profile.faint_rims import RimSearch, find_faint_rims, without_bare
from tubepose.profile.measure import measure_tops
from tubepose.profile.outline import SECTORS
from tubepose.profile.standing import Standing
from tubepose.profile.tops import mouth_radius_m, top_radius_m
from tubepose.transforms import invert_transform, transform_points

CONFIG = ProfileConfig()
SLOTS = ("B4", "C5", "D6")
CENTERS_M = np.array([RACK.slot(name).center_m for name in SLOTS])
REACH_M = 4e-3


def free(place_m):
    return np.zeros((len(place_m), SECTORS), bool)


NOTHING = Standing(np.empty((0, 3)), invert_transform(VIEW)[:3, 3])


NO_HOLES = np.empty((0, 3))


def look(image, centers_m=CENTERS_M, blocked_at=free, standing=NOTHING, holes_m=NO_HOLES):
    search = RimSearch(
        seen(image), centers_m, REACH_M, LEVEL_M, np.array([INNER_M, OUTER_M]), blocked_at, standing, holes_m, CONFIG
    )
    return find_faint_rims(search)


def told(found):
    """Slots in which a rim is found."""
    return [slot for slot, evenness in zip(SLOTS, found.evenness, strict=False) if np.isfinite(evenness)]


@pytest.mark.parametrize("shift_mm", [(0.0, 0.0), (3.5, -1.0), (-2.0, 3.0)])
def test_a_ring_without_a_single_point_is_measured_where_it_is(shift_mm):
    place = CENTERS_M[1] + 1e-3 * np.array(shift_mm)
    found = look(drawn(VIEW, place, clutter=15.0))
    assert told(found) == ["C5"]
    assert found.evenness[1] > 0.9
    assert found.center_m[1] + found.circles.offset_m[1] == pytest.approx(place, abs=2e-4)
    assert np.sqrt(np.diag(found.circles.covariance_m2[1])) == pytest.approx([CONFIG.faint_rim_bias_m] * 2, rel=0.1)


def test_a_dark_ring_is_a_rim_that_leads_its_light_away():
    place = CENTERS_M[1] + np.array([2e-3, -1e-3])
    found = look(255 - drawn(VIEW, place, clutter=15.0))
    assert told(found) == ["C5"]
    assert found.evenness[1] > 0.9
    assert found.center_m[1] + found.circles.offset_m[1] == pytest.approx(place, abs=2e-4)
    assert np.sqrt(np.diag(found.circles.covariance_m2[1])) == pytest.approx([CONFIG.faint_rim_bias_m] * 2, rel=0.1)


def test_three_rings_are_three_rims():
    places = CENTERS_M + np.array([[1e-3, 0.0], [0.0, 2e-3], [-2e-3, -2e-3]])
    found = look(drawn(VIEW, *places))
    assert told(found) == list(SLOTS)
    assert np.allclose(found.center_m + found.circles.offset_m, places, atol=2e-4)


def painted(gray_of_rho):
    """An image that depends on the distance from the middle of the slot C5 alone, at the rims' level."""
    rho = np.hypot(*np.moveaxis(level_points(VIEW) - CENTERS_M[1], -1, 0))
    image = gray_of_rho(rho).reshape(CAMERA.height, 3, CAMERA.width, 3).mean(axis=(1, 3))
    return np.clip(image + np.random.default_rng(0).normal(0, 2, image.shape), 0, 255).astype(np.uint8)


MIDDLE_M = (INNER_M + OUTER_M) / 2


@pytest.mark.parametrize(
    "gray_of_rho",
    [
        lambda rho: np.where(rho < MIDDLE_M, 160.0, 60.0),  # a disc as large as the rim
        lambda rho: np.where(rho < MIDDLE_M, 60.0, 160.0),  # a hole
        lambda rho: np.where((rho > INNER_M - 4e-3) & (rho < OUTER_M - 4e-3), 160.0, 60.0),  # another size
        lambda rho: np.full(rho.shape, 100.0),
    ],
)
def test_what_is_no_ring_of_that_size_is_no_rim(gray_of_rho):
    assert told(look(painted(gray_of_rho))) == []


def test_a_ring_of_one_gray_before_bright_and_dark_things_is_a_rim():
    """Clear plastic: neither brighter than what is beside it nor darker, but the same all around."""
    xy = level_points(VIEW)
    off = xy - CENTERS_M[1] - np.array([1e-3, -2e-3])
    rho = np.hypot(*np.moveaxis(off, -1, 0))
    ribs = np.where((np.mod(off[..., 0], 18e-3) < 7e-3) ^ (np.mod(off[..., 1], 18e-3) < 7e-3), 190.0, 40.0)
    behind = np.where(rho < INNER_M, 0.6 * ribs + 20.0, ribs)
    gray = np.where((rho > INNER_M) & (rho < OUTER_M), 110.0, behind)
    image = gray.reshape(CAMERA.height, 3, CAMERA.width, 3).mean(axis=(1, 3))
    image = np.clip(image + np.random.default_rng(0).normal(0, 2, image.shape), 0, 255).astype(np.uint8)
    found = look(image)
    assert told(found) == ["C5"]
    assert found.center_m[1] == pytest.approx(CENTERS_M[1] + np.array([1e-3, -2e-3]), abs=2e-4)
    assert not found.circles.offset_m[1].any()
    assert np.sqrt(np.diag(found.circles.covariance_m2[1])) == pytest.approx([CONFIG.even_rim_m] * 2)
    ribs_alone = ribs.reshape(CAMERA.height, 3, CAMERA.width, 3).mean(axis=(1, 3)).astype(np.uint8)
    assert told(look(ribs_alone)) == []


@pytest.mark.parametrize(
    ("off_mm", "radius_mm", "slots"),
    [(0.0, 0.0, []), (1.0, 1.0, []), (3.0, 0.0, ["C5"]), (0.0, 3.0, ["C5"])],
)
def test_a_ring_that_may_be_the_edge_of_a_round_opening_is_no_rim(off_mm, radius_mm, slots):
    hole = [*(CENTERS_M[1] + [1e-3 * off_mm, 0.0]), (INNER_M + OUTER_M) / 2 + 1e-3 * radius_mm]
    assert told(look(drawn(VIEW, CENTERS_M[1]), holes_m=np.array([hole]))) == slots


def test_noise_is_no_rim():
    rng = np.random.default_rng(3)
    every = RACK.slot_centers_m
    for _ in range(3):
        image = rng.integers(0, 255, (CAMERA.height, CAMERA.width)).astype(np.uint8)
        assert not np.isfinite(look(image, every).evenness).any()


def test_a_rim_that_other_tops_are_near_to_on_too_many_sides_is_not_told_of():
    image = drawn(VIEW, CENTERS_M[1])

    def beside(count):
        angles = np.arange(count) * 2 * np.pi / 6
        others = CENTERS_M[1] + 2 * OUTER_M * np.column_stack([np.cos(angles), np.sin(angles)])

        def blocked_at(place_m):
            tops = np.vstack([place_m, others])
            sure = np.arange(len(tops)) >= len(place_m)
            return blocked_sectors(tops, np.full(len(tops), OUTER_M), 6e-4, sure)[: len(place_m)]

        return told(look(image, blocked_at=blocked_at))

    assert beside(1) == ["C5"]
    assert beside(6) == []


def ring_of_points(height_m, share=1.0, scatter_m=2e-4, count=600):
    """Points that are seen on the rim of a tube in C5, at any height on their lines of sight."""
    rng = np.random.default_rng(4)
    angle, rho = rng.uniform(0, 2 * np.pi * share, count), rng.uniform(INNER_M, OUTER_M, count)
    at = np.column_stack(
        [CENTERS_M[1] + rho[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]), np.full(count, LEVEL_M)]
    )
    camera = NOTHING.camera_m
    heights = height_m + rng.normal(0, scatter_m, count)
    along = (heights - camera[2]) / (LEVEL_M - camera[2])
    return Standing(camera + (at - camera) * along[:, None], camera)


@pytest.mark.parametrize(
    ("standing", "is_told"),
    [
        (ring_of_points(LEVEL_M + 7e-3), False),  # the rim of a taller tube
        (ring_of_points(LEVEL_M - 7e-3), False),  # of a lower one
        (ring_of_points(LEVEL_M - 1e-3), True),  # light from below the surface of the rim itself
        (ring_of_points(LEVEL_M - 20e-3, scatter_m=8e-3), True),  # what lies behind clear plastic
        (ring_of_points(LEVEL_M - 7e-3, share=0.4), True),  # something behind one side of it
    ],
)
def test_a_ring_of_points_at_another_height_is_the_rim_of_something_else(standing, is_told):
    assert told(look(drawn(VIEW, CENTERS_M[1]), standing=standing)) == (["C5"] if is_told else [])


def test_beyond_the_picture_there_is_nothing():
    far = CENTERS_M + np.array([[0.5, 0.5]])
    found = look(drawn(VIEW, CENTERS_M[1]), far)
    assert np.all(found.evenness == -np.inf)
    assert np.isnan(found.circles.offset_m).all()


def test_a_tube_whose_rim_only_the_image_shows_gets_a_pose_and_no_other_slot_does():
    """`fit_profiles` on a cloud without a point above the rack: the image alone speaks for the tube."""
    tube = load_tube("chen2023-tube-1")
    level_m = RACK.floor_m + tube.height_m
    place = RACK.slot("C5").center_m + np.array([0.4e-3, -0.3e-3])
    xy = level_points(VIEW, level_m)
    rho = np.hypot(*np.moveaxis(xy - place, -1, 0))
    outer = float(tube.body_radius_m(tube.rim_height_m)) if tube.cap is None else tube.cap.diameter_mm * 0.5e-3
    inner = float(tube.body_radius_m(tube.rim_height_m)) - tube.body.wall_mm * 1e-3
    gray = np.where((rho > inner) & (rho < outer), 160.0, 60.0)
    image = gray.reshape(CAMERA.height, 3, CAMERA.width, 3).mean(axis=(1, 3)).astype(np.uint8)
    for shown, slots in ((image, ["C5"]), (np.full_like(image, 60), [])):
        frame = frame_of(shown, np.full((CAMERA.height, CAMERA.width, 3), np.nan))
        found = fit_profiles(frame, CAMERA, VIEW, RACK, [tube], Config())
        assert [entry.slot for entry in found if entry.pose.status == "ok"] == slots
        for entry in found:
            top = transform_points(entry.pose.T_rack_tube, np.array([[0.0, 0.0, tube.height_m]]))[0]
            assert top[:2] == pytest.approx(place, abs=2e-4)
            assert len(entry.points_m) == 0
    assert invert_transform(VIEW)[2, 3] > level_m  # the camera stands above the rims


def with_points_on_a_rim(gray_of_angle):
    """What is measured of a tube in C5 whose rim has points all around, and in the image a gray for each direction."""
    tube = load_tube("chen2023-tube-1")
    level_m = RACK.floor_m + tube.height_m
    place = RACK.slot("C5").center_m
    off = level_points(VIEW, level_m) - place
    rho, angle = np.hypot(*np.moveaxis(off, -1, 0)), np.arctan2(off[..., 1], off[..., 0])
    on_rim = (rho > mouth_radius_m(tube)) & (rho < top_radius_m(tube))
    gray = np.where(on_rim, gray_of_angle(angle), 60.0)
    image = gray.reshape(CAMERA.height, 3, CAMERA.width, 3).mean(axis=(1, 3)).astype(np.uint8)
    at = np.concatenate([off[1::3, 1::3] + place, np.full((CAMERA.height, CAMERA.width, 1), level_m)], axis=2)
    cloud = np.where(on_rim[1::3, 1::3, None], transform_points(VIEW, at.reshape(-1, 3)).reshape(at.shape), np.nan)
    found = measure_tops(frame_of(image, cloud), CAMERA, VIEW, RACK, [tube], Config())
    assert [RACK.all_slots[slot].name for slot in found.tops.slot] == ["C5"]
    return found.center_m[0] - place, np.sqrt(np.diag(found.circles.covariance_m2[0]))


def test_a_torn_ring_that_is_no_ring_of_one_gray_is_less_sure():
    off_m, std_m = with_points_on_a_rim(lambda angle: np.full(angle.shape, 160.0))
    assert np.abs(off_m).max() < 1e-4
    assert std_m.max() < 1.5e-4
    off_m, std_m = with_points_on_a_rim(lambda angle: np.where(np.abs(angle) < 1.8, 160.0, 60.0))
    assert np.abs(off_m).max() < CONFIG.lone_rim_m
    assert std_m.min() > CONFIG.lone_rim_m


@pytest.mark.parametrize(("spacing_m", "is_told"), [(0.5e-3, False), (12e-3, True)])
def test_a_ring_without_a_point_is_none_where_others_of_its_type_return_many(spacing_m, is_told):
    known_m = CENTERS_M[[0, 2]]
    angle = np.arange(0, 2 * np.pi, spacing_m / OUTER_M)
    rim = np.column_stack([np.cos(angle), np.sin(angle)]) * (INNER_M + OUTER_M) / 2
    points = [np.column_stack([rim + middle, np.full(len(rim), LEVEL_M)]) for middle in known_m]
    standing = Standing(np.vstack(points), NOTHING.camera_m)
    search = RimSearch(
        seen(drawn(VIEW, CENTERS_M[1])), CENTERS_M[1:2], REACH_M, LEVEL_M, np.array([INNER_M, OUTER_M]), free, standing,
        NO_HOLES, CONFIG,
    )  # fmt: skip
    found = find_faint_rims(search)
    assert np.isfinite(found.evenness[0])
    assert np.isfinite(without_bare(found, known_m, search).evenness[0]) == is_told
    # One rim with points says nothing of all of them.
    assert np.isfinite(without_bare(found, known_m[:1], search).evenness[0])
