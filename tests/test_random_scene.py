"""Scenes as they are made: caps, walls, finishes, liquids, labels, and what the truth says of them."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import yaml

from tubepose.errors import CaptureError, ConfigError
from tubepose.labware import load_cap, load_rack, load_tube
from tubepose.labware.tubes import TubeModel
from tubepose.simulation import read_exact_truth
from tubepose.simulation.camera import default_camera
from tubepose.simulation.collision import collide, solid_of
from tubepose.simulation.random_scene import fit_caps, random_scene, straight_wall_m
from tubepose.simulation.scene import (
    LABEL_OFFSET_M,
    MATERIALS,
    CapFit,
    Finishes,
    Label,
    Liquid,
    Material,
    PlacedTube,
    Scene,
    label_mesh,
    tube_parts,
)
from tubepose.simulation.truth import as_made, write_exact_truth
from tubepose.simulation.variation import SceneVariation, Tolerances, load_scene_variation
from tubepose.transforms import invert_transform, make_transform, tilt_rotation, transform_points, translation

RACK = load_rack("chen2023-soft-5x10")
CAP = load_cap("printed-square-16.7")
CAMERA = default_camera(96)
TUBES = [load_tube(f"chen2023-tube-{k}") for k in (1, 2, 3)]
PERFECT = Tolerances(cap_tilt_deg=0, cap_radius_mm=0, cap_height_mm=0, printed_cap_tilt_deg=0)
CAPPED = TUBES[2]


def scene_of(seed=3, types=TUBES, rack=RACK, **ranges):
    return random_scene(rack, types, CAP, CAMERA, np.random.default_rng(seed), SceneVariation(**ranges))


def standing(model=CAPPED, T=None, **changes):
    return PlacedTube("A1", model, np.eye(4) if T is None else T, **changes)


# Streams


def without(tube, *names):
    return {f.name: getattr(tube, f.name) for f in dataclasses.fields(tube) if f.name not in names}


SWITCHES = {
    "liquid": {"liquid_share": 1.0},
    "label": {"label_share": 1.0},
    "optics": {"scattering_per_mm": (0.5, 1.0)},
    "cap_albedo": {"cap_albedo": (0.1, 0.2)},
}


@pytest.mark.parametrize("name", SWITCHES)
def test_a_switch_changes_one_thing_alone(name):
    plain, other = scene_of(), scene_of(**SWITCHES[name])
    assert np.array_equal(plain.T_camera_rack, other.T_camera_rack)
    assert plain.finishes == other.finishes
    for a, b in zip(plain.tubes, other.tubes, strict=True):
        assert np.array_equal(a.T_rack_tube, b.T_rack_tube)
        assert without(a, name, "T_rack_tube") == without(b, name, "T_rack_tube")
    assert any(getattr(a, name) != getattr(b, name) for a, b in zip(plain.tubes, other.tubes, strict=True))


def test_tolerances_and_finishes_move_no_tube():
    plain = scene_of(fill=(0.6, 0.6))
    other = scene_of(fill=(0.6, 0.6), tolerances=PERFECT, rack_albedo=(0.1, 0.9), gloss_roughness=(0.5, 0.5))
    assert np.array_equal(plain.T_camera_rack, other.T_camera_rack)
    for a, b in zip(plain.tubes, other.tubes, strict=True):
        assert (a.slot, a.model, a.cap_spin_rad) == (b.slot, b.model, b.cap_spin_rad)
        assert np.array_equal(a.T_rack_tube, b.T_rack_tube)


def test_the_same_seed_gives_the_same_scene_and_another_seed_another():
    ranges = {"liquid_share": 0.5, "label_share": 0.5, "scattering_per_mm": (0, 1)}
    a, b, c = scene_of(1, **ranges), scene_of(1, **ranges), scene_of(2, **ranges)
    assert [as_made(t) for t in a.tubes] == [as_made(t) for t in b.tubes]
    assert a.finishes == b.finishes
    assert a.finishes != c.finishes


def test_fill_and_scanner_tilt_are_the_drawn_ones():
    for seed in range(6):
        scene = scene_of(seed, types=TUBES[1:2], fill=(0.2, 0.2), scanner_tilt_deg=(9, 10))
        assert len(scene.tubes) == 10
        assert 9 <= np.rad2deg(np.arccos(-scene.T_camera_rack[2, 2])) <= 10
    assert len(scene_of(fill=(0, 0)).tubes) == 1


# Parts as they are made


def drawn_fits(tolerances, count, model=CAPPED):
    rng = np.random.default_rng(0)
    return [fit_caps([standing(model)], CAP, tolerances, rng)[0] for _ in range(count)]


def test_errors_spread_as_the_tolerances_say():
    tubes = drawn_fits(Tolerances(), 1500)
    fits = [tube.cap_fit for tube in tubes]
    errors = np.column_stack(
        [
            np.rad2deg([fit.tilt_rad for fit in fits]),
            [[1e3 * fit.radius_error_m, 1e3 * fit.height_error_m] for fit in fits],
            np.rad2deg([tube.printed_tilt_rad for tube in tubes]),
        ]
    )
    expected = np.array([0.15, 0.15, 0.05, 0.2, 0.1, 0.1])
    assert np.allclose(errors.std(axis=0), expected, rtol=0.08)
    assert np.all(np.abs(errors.mean(axis=0)) < 4 * expected / np.sqrt(1500))
    assert np.abs(np.corrcoef(errors.T) - np.eye(6)).max() < 0.12


def test_zero_tolerances_make_perfect_parts():
    for tube in scene_of(tolerances=PERFECT, fill=(0.5, 0.5)).tubes:
        assert tube.cap_fit == CapFit()
        assert tube.printed_tilt_rad == (0, 0)
        assert np.array_equal(tube.T_tube_own_cap, np.eye(4))
        assert np.array_equal(tube.own_cap_profile_m(), tube.model.cap_profile_m())


def test_a_flange_and_a_plain_rim_have_no_cap_fit():
    for tube in scene_of(types=TUBES[:1]).tubes:
        assert tube.cap_fit == CapFit()
        assert tube.printed_tilt_rad != (0, 0)


def test_crooked_caps_stand_where_their_numbers_say():
    tilt, up = 0.02, 0.3e-3
    T = make_transform(tilt_rotation(0.05, -0.03), np.array([0.01, 0.02, 0.003]))
    fit = CapFit((tilt, 0.0), 0.1e-3, up)
    tube = standing(T=T, cap_fit=fit, printed_tilt_rad=(0.0, tilt), cap_spin_rad=0.04)
    rim, above = CAPPED.rim_height_m, CAPPED.height_m - CAPPED.rim_height_m
    center = transform_points(tube.T_tube_own_cap, np.array([0, 0, CAPPED.height_m]))
    assert center == pytest.approx([0, -above * np.sin(tilt), rim + above * np.cos(tilt) + up])
    square = transform_points(tube.T_tube_cap, np.array([0, 0, CAP.offset_m(CAPPED)]))
    seat = CAP.seat_mm * 1e-3
    assert square == pytest.approx([seat * np.sin(tilt), 0, rim + seat * np.cos(tilt)])
    assert np.array_equal(tube.T_rack_tube, T)

    parts = list(tube_parts(tube, None, MATERIALS, Finishes()))
    body, cap = parts[0][0].vertices_m, parts[-1][0].vertices_m
    assert np.array_equal(body, next(tube_parts(standing(T=T), None, MATERIALS, Finishes()))[0].vertices_m)
    local = transform_points(invert_transform(tube.T_tube_own_cap), cap)
    assert np.hypot(local[:, 0], local[:, 1]).max() == pytest.approx(CAPPED.max_radius_m + 0.1e-3)
    assert local[:, 2].max() == pytest.approx(CAPPED.height_m)
    solid = solid_of(tube, CAP)
    assert solid.cap.axis == pytest.approx(T[:3, :3] @ [0, -np.sin(tilt), np.cos(tilt)])
    assert solid.body.axis == pytest.approx(T[:3, 2])
    assert solid.plate_top_m.mean(axis=0) == pytest.approx(transform_points(T, square))


@pytest.mark.parametrize(
    ("wider_m", "leaning_rad", "touch"),
    [(0.0, 0.0, False), (0.4e-3, 0.0, False), (0.6e-3, 0.0, True), (0.0, 0.05, False), (0.0, 0.1, True)],
)
def test_caps_as_made_collide_where_perfect_ones_do_not(wider_m, leaning_rad, touch):
    """Perfect caps 0.5 mm apart; a tilt of 0.1 moves the cap's top, 6 mm above the rim, by 0.6 mm."""
    gap = 2 * CAPPED.max_radius_m + 0.5e-3
    fit = CapFit((0.0, leaning_rad), wider_m, 0.0)
    a = solid_of(standing(cap_fit=fit), CAP)
    b = solid_of(standing(T=translation([gap, 0, 0])), CAP)
    assert collide(a, b, CAP) == touch
    assert collide(b, a, CAP) == touch


def test_plates_that_lean_apart_collide_at_their_lower_sides():
    lean, seat = 0.01, np.array([0.0, 0.0, CAP.offset_m(TUBES[1])])
    bare = TUBES[1].model_copy(update={"cap": None})

    def solid(beta, x_m):
        """A tube whose plate's top has its centre at x."""
        R = tilt_rotation(0.0, beta)
        return solid_of(standing(bare, make_transform(R, np.array([x_m, 0, 0]) - R @ seat)), CAP)

    # Lower sides reach 3 mm * sin(0.01) = 0.03 mm farther out than the tops, on either side.
    width = CAP.square_m * np.cos(lean)
    assert collide(solid(-lean, 0.0), solid(lean, width + 0.05e-3), CAP)
    assert not collide(solid(-lean, 0.0), solid(lean, width + 0.07e-3), CAP)
    assert not collide(solid(-lean, 0.0), solid(-lean, width + 0.05e-3), CAP)


@pytest.mark.parametrize(("seed", "types"), [(11, TUBES[1:2]), (12, TUBES[2:]), (13, TUBES)])
def test_nothing_cuts_into_a_neighbour_in_a_full_rack(seed, types):
    tolerances = Tolerances(cap_tilt_deg=0.6, cap_radius_mm=0.2, cap_height_mm=0.4, printed_cap_tilt_deg=0.4)
    tubes = scene_of(seed, types, fill=(1, 1), tolerances=tolerances).tubes
    assert len(tubes) > 25
    assert any(tube.printed_tilt_rad != (0, 0) for tube in tubes)
    for cap in (None, CAP):
        points = [worn_points(tube, cap) for tube in tubes]
        for a, points_a in zip(tubes, points, strict=True):
            for b in tubes:
                if a is not b and np.linalg.norm((a.T_rack_tube - b.T_rack_tube)[:3, 3]) < 0.03:
                    assert not inside_tube(b, cap, points_a).any()


def worn_points(tube, cap):
    parts = tube_parts(tube, cap, MATERIALS, Finishes())
    points = [transform_points(tube.T_rack_tube, mesh.vertices_m) for mesh, _ in parts]
    edge = np.linspace(-1, 1, 21) * CAP.square_m / 2
    top = CAP.offset_m(tube.model)
    if cap is not None:
        plate = np.stack(np.meshgrid(edge, edge, [top - CAP.thickness_mm * 1e-3, top]), axis=-1).reshape(-1, 3)
        points.append(transform_points(tube.T_rack_tube @ tube.T_tube_cap, plate))
    return np.concatenate(points)


def inside_tube(tube, cap, points):
    """Which points are more than 0.02 mm inside a tube (its cavity counts as inside) or its cap."""
    local = transform_points(invert_transform(tube.T_rack_tube), points)
    model = tube.model
    within = inside_turned(local, (model.outer_profile_m if model.is_open else model.body_profile_m)())
    if cap is not None:
        q = transform_points(invert_transform(tube.T_tube_cap), local)
        q[:, 2] -= CAP.offset_m(model) - CAP.thickness_mm * 0.5e-3
        half = np.array([CAP.square_m, CAP.square_m, CAP.thickness_mm * 1e-3]) / 2
        within |= np.all(np.abs(q) < half - 2e-5, axis=1)
    elif not model.is_open:
        within |= inside_turned(
            transform_points(invert_transform(tube.T_tube_own_cap), local), tube.own_cap_profile_m()
        )
    return within


def inside_turned(points, profile):
    z, r = points[:, 2], np.hypot(points[:, 0], points[:, 1])
    rising = profile[np.r_[True, np.diff(profile[:, 0]) > 0]]
    if len(rising) < 3:
        rising = profile[1:3]
    within = (z > rising[0, 0] + 2e-5) & (z < rising[-1, 0] - 2e-5)
    return within & (r < np.interp(z, rising[:, 0], rising[:, 1]) - 2e-5)


def test_caps_always_cover_the_rim_that_they_sit_on():
    low = TUBES[1].model_copy(update={"cap": TUBES[1].cap.model_copy(update={"top_mm": 0.3, "diameter_mm": 13.4})})
    wild = Tolerances(cap_tilt_deg=0.5, cap_radius_mm=0.3, cap_height_mm=0.5, printed_cap_tilt_deg=0.1)
    tubes = drawn_fits(wild, 150, low)
    assert len({tube.cap_fit for tube in tubes}) > 140
    skirt = low.cap_profile_m()[0, 0]
    turn = np.linspace(0, 2 * np.pi, 60)
    for tube in tubes:
        for z in (skirt, low.rim_height_m):
            radius = float(low.body_radius_m(z))
            ring = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), np.full(60, z)])
            local = transform_points(invert_transform(tube.T_tube_own_cap), ring)
            assert np.hypot(local[:, 0], local[:, 1]).max() < tube.own_cap_profile_m()[1, 1]
            assert local[:, 2].max() < low.height_m


# Liquids, labels, walls, finishes


@pytest.mark.parametrize(
    ("rack", "tube"),
    [
        *(("chen2023-soft-5x10", model.name) for model in TUBES),
        ("round-5ml-3x4", "centrifuge-5ml"),
        ("mixed-6x15ml-4x50ml", "centrifuge-15ml-conical"),
        ("chen2023-soft-5x10", "blood-13x100"),
    ],
)
def test_liquids_and_labels_are_where_they_can_be(rack, tube):
    model = load_tube(tube)
    cavity = model.cavity_profile_m()[-1, 0], model.rim_height_m
    seen = []
    for seed in range(4):
        for placed in scene_of(seed, [model], load_rack(rack), liquid_share=1.0, label_share=1.0).tubes:
            share = (placed.liquid.level_m - cavity[0]) / (cavity[1] - cavity[0])
            assert 0.2 <= share <= 0.8
            assert 1 <= placed.liquid.absorption_per_m <= 10
            label = placed.label
            assert label.low_m > model.body.bottom_height_mm * 1e-3
            assert label.high_m < (model.rim_height_m if model.cap is None else model.cap_profile_m()[0, 0])
            assert label.high_m - label.low_m <= 0.050 + 1e-12
            assert label.high_m - label.low_m >= 0.020 - 1e-12
            assert np.deg2rad(200) <= label.span_rad <= 2 * np.pi
            assert 0.7 <= label.albedo <= 0.9
            seen.append(label.low_m)
    assert len(set(seen)) > len(seen) / 2


def test_a_label_on_a_short_wall_is_as_high_as_fits_and_none_is_on_a_shorter_one():
    def short(height_mm):
        return TubeModel(
            kind="tube",
            name="short",
            body={"height_mm": height_mm, "bottom_diameter_mm": 15, "top_diameter_mm": 15, "material": "transparent"},
        )

    low_rack = RACK.model_copy(update={"height_mm": 15.0})
    for height_mm, wall_mm in ((20.0, 8.5), (16.0, None)):
        model = short(height_mm)
        labels = {tube.label for tube in scene_of(types=[model], rack=low_rack, label_share=1.0).tubes}
        if wall_mm is None:
            assert labels == {None}
        else:
            assert {round(1e3 * (label.high_m - label.low_m), 6) for label in labels} == {wall_mm}
        assert straight_wall_m(model) == pytest.approx((0.0075, height_mm * 1e-3))


def test_shares_of_liquids_and_labels():
    tubes = [
        t
        for seed in range(6)
        for t in scene_of(seed, TUBES[:1], fill=(0.5, 0.5), liquid_share=0.3, label_share=0.6).tubes
    ]
    assert np.mean([tube.liquid is not None for tube in tubes]) == pytest.approx(0.3, abs=0.1)
    assert np.mean([tube.label is not None for tube in tubes]) == pytest.approx(0.6, abs=0.1)
    both = np.mean([tube.label is not None and tube.liquid is not None for tube in tubes])
    assert both == pytest.approx(0.18, abs=0.08)


def test_walls_are_the_labwares_own_unless_a_range_says_otherwise():
    assert all(tube.wall_optics == tube.model.body.wall_optics for tube in scene_of().tubes)
    tubes = scene_of(scattering_per_mm=(0.6, 0.9), refractive_index=(1.5, 1.6)).tubes
    assert len({tube.model.name for tube in tubes}) > 1
    assert len({(t.wall_optics.scattering_per_mm, t.wall_optics.refractive_index) for t in tubes}) == 1
    assert 0.6 <= tubes[0].wall_optics.scattering_per_mm <= 0.9
    assert 1.5 <= tubes[0].wall_optics.refractive_index <= 1.6
    for tube in tubes:
        assert tube.wall_optics.absorption_per_mm == tube.model.body.wall_optics.absorption_per_mm


def test_an_opaque_body_has_no_wall_optics():
    body = TUBES[1].body.model_copy(update={"material": "opaque"})
    opaque = TUBES[1].model_copy(update={"body": body})
    assert {tube.wall_optics for tube in scene_of(types=[opaque], scattering_per_mm=(1, 1)).tubes} == {None}


def test_finishes_come_from_their_ranges():
    ranges = {"rack_albedo": (0.1, 0.9), "table_albedo": (0.05, 0.5), "printed_cap_albedo": (0.6, 0.9)}
    drawn = [scene_of(seed, fill=(0, 0), **ranges).finishes for seed in range(12)]
    rough = np.array([[f.rack.roughness, f.cap_roughness, f.wall_roughness] for f in drawn])
    albedo = np.array([[f.rack.albedo, f.table.albedo, f.printed_cap.albedo] for f in drawn])
    assert np.all((rough >= [0.3, 0.3, 0.05]) & (rough <= [0.6, 0.6, 0.1]))
    assert np.all((albedo >= [0.1, 0.05, 0.6]) & (albedo <= [0.9, 0.5, 0.9]))
    assert all(len(set(column)) == 12 for column in (*rough.T, *albedo.T))


def test_finishes_reach_the_parts_of_the_scene():
    finishes = Finishes(
        table=Material(0.11), rack=Material(0.22), printed_cap=Material(0.33), opaque_body=Material(0.44)
    )
    body = CAPPED.body.model_copy(update={"material": "opaque"})
    tube = standing(CAPPED.model_copy(update={"body": body}), cap_albedo=0.55, label=Label(0.03, 0.05, 0.0, 4.0, 0.66))
    scene = Scene(RACK, np.eye(4), (tube,), None, finishes=finishes)
    assert [m.albedo for _, m in scene.parts()] == pytest.approx([0.11, 0.22, 0.8 * 0.22, 0.44, 0.66, 0.55])
    printed = dataclasses.replace(scene, printed_cap=CAP)
    assert [m.albedo for _, m in printed.parts()][-2:] == [0.66, 0.33]


@pytest.mark.parametrize("model", TUBES, ids=lambda model: model.name)
def test_a_label_is_a_patch_just_outside_the_wall(model):
    label = Label(0.03, 0.06, 1.0, 4.0)
    mesh = label_mesh(label, model)
    x, y, z = mesh.vertices_m.T
    assert np.hypot(x, y) - model.body_radius_m(z) == pytest.approx(np.full(len(z), LABEL_OFFSET_M))
    assert (z.min(), z.max()) == pytest.approx((0.03, 0.06))
    turn = (np.arctan2(y, x) - 1.0 + 1e-9) % (2 * np.pi)
    assert turn.max() == pytest.approx(4.0)
    corners = mesh.vertices_m[mesh.triangles]
    face = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.einsum("tkc,tc->tk", mesh.normals[mesh.triangles], face).min() > 0
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(np.ones(len(z)))
    area = 4.0 * float(model.body_radius_m(0.045) + LABEL_OFFSET_M) * 0.03
    assert np.linalg.norm(face, axis=1).sum() / 2 == pytest.approx(area, rel=3e-3)


# The exact truth


def test_the_truth_says_what_was_made(tmp_path):
    scene = scene_of(liquid_share=0.5, label_share=0.5, scattering_per_mm=(0, 1), fill=(0.4, 0.4))
    write_exact_truth(tmp_path, "t", scene, {tube.slot: tube.model.name for tube in scene.tubes})
    truth = read_exact_truth(tmp_path, "t")
    assert truth.finishes == scene.finishes
    assert truth.as_made == {tube.slot: as_made(tube) for tube in scene.tubes}
    made = list(truth.as_made.values())
    assert {item.cap_fit is None for item in made} == {True, False}
    assert {item.liquid is None for item in made} == {True, False}
    for tube in scene.tubes:
        assert np.array_equal(truth.tubes[tube.slot][1], scene.T_camera_rack @ tube.T_rack_tube)
        if not tube.model.is_open:
            assert truth.as_made[tube.slot].cap_fit == tube.cap_fit
        assert truth.as_made[tube.slot].printed_cap_tilt_rad == tube.printed_tilt_rad


def test_finishes_without_gloss_stay_so(tmp_path):
    finishes = Finishes(cap_roughness=None, rack=Material(0.3, roughness=None))
    write_exact_truth(tmp_path, "t", Scene(RACK, np.eye(4), (), finishes=finishes), {})
    assert read_exact_truth(tmp_path, "t").finishes == finishes


OLD = """\
format: 1
trial: t
T_camera_rack: &T [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
slots:
  A3: {tube: x, T_camera_tube: *T, bottom_offset_m: [0, 0], tilt_rad: 0.0}
"""


def test_a_truth_file_without_these_keys_means_perfect_parts(tmp_path):
    (tmp_path / "simulation_truth").mkdir()
    file = tmp_path / "simulation_truth" / "t.yaml"
    file.write_text(OLD)
    truth = read_exact_truth(tmp_path, "t")
    assert truth.finishes is None
    assert truth.as_made["A3"].cap_fit is None
    assert truth.as_made["A3"].printed_cap_tilt_rad == (0, 0)
    file.write_text(OLD.replace("tilt_rad: 0.0", "tilt_rad: 0.0, liquid: {level_m: deep}"))
    with pytest.raises(CaptureError, match=r"t\.yaml: not a truth file.*level_m") as caught:
        read_exact_truth(tmp_path, "t")
    assert "\n" not in str(caught.value)


# Ranges from a file


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fill: [0.4, 0.1]", r"fill: expected \[least, most\] with 0 <= least <= most <= 1, found \[0\.4, 0\.1\]"),
        ("fill: 0.3", r"fill: expected \[least, most\], found 0\.3"),
        ("fill: [0.3]", r"fill: expected \[least, most\], found \[0\.3\]"),
        ("scattering_per_mm: [0, .inf]", "scattering_per_mm.1: .*finite"),
        ("refractive_index: [0.9, 1.5]", r"refractive_index: .* 1 <= least <= most <= 2\.5, found \[0\.9, 1\.5\]"),
        ("scanner_tilt_deg: [0, 90]", "scanner_tilt_deg: .* <= 60"),
        ("wall_roughness: [0, 0.2]", r"wall_roughness: .* 0\.01 <= least"),
        ("label_share: 1.2", r"label_share: .*less than or equal to 1 \(found 1\.2\)"),
        ("labels: 1", "unknown key 'labels'; known keys: fill, .*label_share"),
        ("tolerances: {cap_tilt: 1}", r"unknown key 'tolerances\.cap_tilt'; known keys: cap_tilt_deg"),
        ("tolerances: {cap_tilt_deg: -1}", r"tolerances\.cap_tilt_deg: .*greater than or equal to 0"),
        ("- fill", "expected a mapping"),
    ],
)
def test_wrong_ranges_are_refused_in_one_line(tmp_path, text, message):
    file = tmp_path / "scenes.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        load_scene_variation(file)
    assert "\n" not in str(caught.value)
    assert "scenes.yaml" in str(caught.value)


def test_ranges_of_a_file_keep_the_other_defaults(tmp_path):
    file = tmp_path / "scenes.yaml"
    file.write_text("scattering_per_mm: [0, 1]\nrefractive_index: null\ntolerances: {cap_tilt_deg: 0.5}\n")
    expected = SceneVariation(scattering_per_mm=(0, 1), tolerances=Tolerances(cap_tilt_deg=0.5))
    assert load_scene_variation(file) == expected
    assert expected.tolerances.cap_radius_mm == 0.05


def test_liquid_is_water_unless_it_says_otherwise():
    assert Liquid(0.05).refractive_index == 1.33


def test_the_docs_table_says_every_key_with_its_default():
    text = (Path(__file__).parent.parent / "docs" / "simulation.md").read_text(encoding="utf-8")
    rows = dict(re.findall(r"^\| `([a-z_.]+)` \| ([^|]+) \|", text, re.MULTILINE))
    defaults = SceneVariation().model_dump(mode="json")
    expected = {f"tolerances.{key}": value for key, value in defaults.pop("tolerances").items()} | defaults
    assert {key: yaml.safe_load(rows[key]) for key in expected} == expected
