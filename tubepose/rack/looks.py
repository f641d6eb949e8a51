"""Rough looks at the places where a rack could be: a few rounds with few points, before much work is put into one."""

from __future__ import annotations

import numpy as np

from tubepose.labware import RackModel
from tubepose.rack import view_kernels as view_kernels
from tubepose.rack.evidence import likelier_step_m
from tubepose.rack.fit import HOPELESS_SHARE, RoughFit, camera_place, rack_frame, roughly, top_frame
from tubepose.rack.pose import MIN_POINTS
from tubepose.transforms import FloatArray, parts, translation

# A rack full of caps shows its lattice better than its ends: so many slots may the search be off.
SLOT_STEPS = 6
# Steps that lead back to a place this near are of no use.
NEAR_STEP_M = 4e-3
# Beside a coarse place: its own error, and what lies outside of a top. So far from there no others are needed.
NEAR_M = 0.06
SAME_POINTS_M = 0.025


def seen_near(points_m: FloatArray, T_camera_rack: FloatArray, rack: RackModel) -> FloatArray:
    """Points whose lines of sight cross the level of a top at its outline or near it.

    Samples are drawn from the points that are given: of a whole frame with a bright table few would be of the rack.
    """
    T = top_frame(T_camera_rack, rack)
    points_m = np.ascontiguousarray(points_m, float)
    near_m = view_kernels.seen_through(points_m, *parts(T), camera_place(T), rack.outline_m / 2 + NEAR_M)
    return near_m if len(near_m) >= MIN_POINTS else points_m


def on_lattice(points_m: FloatArray, T_camera_rack: FloatArray, rack: RackModel) -> tuple[FloatArray, RoughFit]:
    """Points near a coarse pose, and a rough fit there or as many slots farther as a first look at it says."""
    near_m, rough = look_at(points_m, T_camera_rack, rack)
    middle_m = rough.T_camera_top[:3, 3]
    been: list[FloatArray] = []
    for _ in range(SLOT_STEPS):
        step_m = likelier_step_m(rough, rack)
        if step_m is None or rough.stray > HOPELESS_SHARE:
            break
        been.append(rough.T_camera_top[:3, 3])
        T_there = rack_frame(rough, rack) @ translation([*step_m, 0.0])
        there_m = top_frame(T_there, rack)[:3, 3]
        if any(np.linalg.norm(there_m - place) < NEAR_STEP_M for place in been):
            break
        if np.linalg.norm(there_m - middle_m) < SAME_POINTS_M:
            rough = roughly(near_m, T_there, rack)
        else:
            near_m, rough = look_at(points_m, T_there, rack)
            middle_m = there_m
    return near_m, rough


def look_at(points_m: FloatArray, T_camera_rack: FloatArray, rack: RackModel) -> tuple[FloatArray, RoughFit]:
    """Points (N, 3), camera frame, near a coarse pose (T_camera_rack), and a rough fit there."""
    near_m = seen_near(points_m, T_camera_rack, rack)
    return near_m, roughly(near_m, T_camera_rack, rack)
