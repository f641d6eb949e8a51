"""Placements: tubes stand in their slots, on the floor, and beside each other."""

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

from tubepose.errors import LabwareError
from tubepose.labware import load_cap, load_rack, load_tube
from tubepose.simulation.collision import polygons_overlap
from tubepose.simulation.placement import lean, place_tubes
from tubepose.simulation.scene import MATERIALS, Finishes, PlacedTube, tube_parts
from tubepose.transforms import invert_transform, tilt_rad, transform_points

RACK = load_rack("chen2023-soft-5x10")
CAP = load_cap("printed-square-16.7")
TUBES = ["chen2023-tube-1", "chen2023-tube-2", "chen2023-tube-3"]
UP = np.array([0.0, 0.0, 1.0])


def vertices(tube, cap):
    """Vertices of a tube's parts in the rack frame."""
    return [
        transform_points(tube.T_rack_tube, mesh.vertices_m) for mesh, _ in tube_parts(tube, cap, MATERIALS, Finishes())
    ]


@pytest.mark.parametrize(
    ("rack_name", "name"),
    [
        *(("chen2023-soft-5x10", t) for t in TUBES),
        ("steel-round-16mm-5x10", "chen2023-tube-3"),
        ("round-5ml-3x4", "centrifuge-5ml"),
    ],
)
def test_tubes_stay_within_their_slots_and_stand_on_the_floor(rack_name, name):
    rack, model = load_rack(rack_name), load_tube(name)
    slot = rack.all_slots[-1]
    rng = np.random.default_rng(5)
    tilts = []
    for _ in range(60):
        T = lean(rack, slot, model, rng)
        body = transform_points(
            T, next(iter(tube_parts(_placed(slot, model, T), None, MATERIALS, Finishes())))[0].vertices_m
        )
        inside = body[body[:, 2] <= rack.height_m]
        assert slot.signed_distance_m(inside[:, :2]).max() <= 1e-6
        assert body[:, 2].min() == pytest.approx(rack.floor_m, abs=3e-5)
        tilts.append(tilt_rad(T[:3, 2], UP))
    assert len(set(tilts)) > 50
    assert max(tilts) > np.deg2rad(0.3)


def _placed(slot, model, T):
    return PlacedTube(slot.name, model, T)


def test_the_spin_rule_is_the_one_of_every_tube_pose():
    T = lean(RACK, RACK.slot("C5"), load_tube("chen2023-tube-2"), np.random.default_rng(0))
    assert T[1, 0] == pytest.approx(0, abs=1e-12)


def test_neighbours_never_cut_into_each_other():
    placed = place_tubes(RACK, [load_tube(name) for name in TUBES], 24, CAP, np.random.default_rng(2))
    assert len(placed) > 15
    for cap in (None, CAP):
        for tube in placed:
            points = np.concatenate(vertices(tube, cap))
            for other in placed:
                if other.slot == tube.slot or np.linalg.norm((other.T_rack_tube - tube.T_rack_tube)[:3, 3]) > 0.03:
                    continue
                local = transform_points(invert_transform(other.T_rack_tube), points)
                bare = cap is not None and not other.model.is_open
                profile = other.model.body_profile_m() if bare else other.model.outer_profile_m()
                assert not _inside(local, profile).any()


def _inside(points, profile):
    """Points well inside a solid of revolution without its cavity."""
    z, r = points[:, 2], np.hypot(points[:, 0], points[:, 1])
    inside = np.zeros(len(z), dtype=bool)
    for (z0, r0), (z1, r1) in pairwise(profile):
        if z1 > z0:
            inside |= (z > z0) & (z < z1) & (r < np.interp(z, [z0, z1], [r0, r1]) - 2e-5)
    return inside


def test_printed_plates_never_overlap():
    placed = place_tubes(RACK, [load_tube("chen2023-tube-2")], 25, CAP, np.random.default_rng(4))
    edge = np.linspace(-1, 1, 30) * CAP.square_m / 2
    u, v = np.meshgrid(edge, edge)
    for tube in placed:
        top = CAP.offset_m(tube.model)
        plate = np.column_stack([u.ravel(), v.ravel(), np.full(u.size, top)])
        points = transform_points(tube.T_rack_tube @ tube.T_tube_cap, plate)
        for other in placed:
            if other.slot != tube.slot:
                local = transform_points(invert_transform(other.T_rack_tube @ other.T_tube_cap), points)
                assert not np.all(np.abs(local[:, :2]) < CAP.square_m / 2 - 1e-5, axis=1).any()


def test_polygons_overlap_by_area():
    square = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1.0]])
    assert polygons_overlap(square, square * 0.2)
    assert polygons_overlap(square, square + np.array([1.9, 0]))
    assert not polygons_overlap(square, square + np.array([2.0, 0]))
    diamond = np.array([[1, 0], [0, 1], [-1, 0], [0, -1.0]]) * 1.4
    assert not polygons_overlap(square, diamond + np.array([1.75, 1.75]))


def test_a_tube_that_does_not_fit_is_refused():
    with pytest.raises(LabwareError, match=r"'centrifuge-50ml-conical' cannot stand in rack 'chen2023-soft-5x10'"):
        place_tubes(RACK, [load_tube("centrifuge-50ml-conical")], 3, CAP, np.random.default_rng(0))


def test_a_tube_too_short_for_the_printed_cap_is_refused():
    with pytest.raises(LabwareError, match="reaches out of"):
        place_tubes(RACK, [load_tube("microtube-1.5ml")], 3, CAP, np.random.default_rng(0))


def test_printed_cap_stands_on_the_rim_at_its_offset():
    model = load_tube("chen2023-tube-2")
    placed = place_tubes(RACK, [model], 1, CAP, np.random.default_rng(0))[0]
    upright = dataclasses.replace(placed, T_rack_tube=np.eye(4))
    cap_points = vertices(upright, CAP)[-1]
    assert cap_points[:, 2].max() == pytest.approx(CAP.offset_m(model))
    assert cap_points[:, 2].min() == pytest.approx(model.rim_height_m)


@pytest.mark.parametrize(
    ("rack_name", "tube_name"),
    [
        ("steel-round-16mm-5x10", "blood-13x100"),
        ("round-10ml-3x4", "centrifuge-10ml"),
        ("chen2023-soft-5x10", "chen2023-tube-2"),
    ],
)
def test_no_leaning_body_cuts_into_the_wall_of_its_slot(rack_name, tube_name):
    """At the rack's top, where a body stands nearest to the wall, whatever the profile's points are."""
    rack, tube = load_rack(rack_name), load_tube(tube_name)
    rng, slot = np.random.default_rng(3), rack.all_slots[0]
    for _ in range(400):
        T = lean(rack, slot, tube, rng)
        at_top = T[:2, 3] + (rack.height_m - T[2, 3]) / T[2, 2] * T[:2, 2]
        assert -slot.signed_distance_m(at_top) > float(tube.body_radius_m(rack.depth_m))
