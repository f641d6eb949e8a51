"""The rack's pose in six degrees of freedom, from its plane and from the edges of its ribs, openings and outline.

Heights of points on the solid part give the plane. The edges give the rest: a point at the top's height must lie on the
solid part, whose signed distance says how far off it is, less the blur of the sensor. Points on opposite edges of ribs
push in opposite directions, so a blur that makes every rib look wider, or thinner, moves no pose.

Points below the top are not used here: next to an edge they mix two depths, and lie on the side that the projector's
shadow leaves. `Labels` has them as evidence all the same.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from tubepose.labware import RackModel
from tubepose.rack_field import TopField, top_field
from tubepose.rack_search import crossings
from tubepose.transforms import FloatArray, make_transform

# Per round: blur of the edges (the first as wide as a coarse start may be off, the last half a pixel of 0.4 mm), and half
# width of the heights that count as the top's.
ROUNDS_M = ((1.2e-3, 2.5e-3), (0.6e-3, 1.5e-3), (0.3e-3, 1.0e-3), (0.2e-3, 1.0e-3), (0.2e-3, 1.0e-3))
ROUGH_ROUNDS = 2
ROUGH_POINTS = 5000
FINE_POINTS = 20_000
# A pixel that is half on a rib is still at its height: edges seem that much farther out.
EDGE_SHIFT_M = 0.2e-3
# Share of pixels that say the wrong thing wherever they are: bounds what one of them can do.
WRONG_SHARE = 0.05
# Points this far inside the solid part are on the plane; nearer to an edge, pixels mix two depths.
INSIDE_M = 0.2e-3
# The plane is fitted within three standard deviations, but no narrower than three of a good sensor's 0.08 mm.
LEAST_WINDOW_M = 0.25e-3
# Points below this far are seen through the top: nearer ones may be mixed with it.
THROUGH_M = 10e-3
# How far beside a top points are looked at: a slot and its ribs.
BESIDE_M = 30e-3
# Neighbours share their depth's error, and an edge's: so many millimetres of points count as one.
SHARED_LENGTH_M = 3e-3
SHARED_HEIGHT_M = 0.05e-3
SHARED_EDGE_M = 0.3e-3
# What no number of points takes away: calibration, and shadows and hidden sides that are on the same side everywhere.
FLOOR = np.array([3e-4, 3e-4, 2e-4, 5e-5, 5e-5, 5e-5])


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A refined pose and what it stands on.

    Attributes:
        T_camera_rack: Array of shape (4, 4), metres.
        covariance: (6, 6), rotation vector (rad) then translation (m), rack frame, about the centre of the top.
        scatter_m: Standard deviation of heights about the plane, from their median, metres.
    """

    T_camera_rack: FloatArray
    covariance: FloatArray
    scatter_m: float


@dataclass(slots=True, eq=False)
class _State:
    T_camera_top: FloatArray
    window_m: float
    scatter_m: float
    information: FloatArray


def top_frame(T_camera_rack: FloatArray, rack: RackModel) -> FloatArray:
    """T_camera_top: the rack's frame, moved up to the top; shape (4, 4), metres."""
    return T_camera_rack @ make_transform(np.eye(3), np.array([0.0, 0.0, rack.height_m]))


def refine(points_m: FloatArray, T_camera_rack: FloatArray, rack: RackModel) -> Fit:
    """Refine a coarse pose (2 mm and 1.5 degrees off at most) with points (N, 3), camera frame, metres."""
    field = top_field(rack)
    state = _State(top_frame(T_camera_rack, rack), ROUNDS_M[0][1], ROUNDS_M[0][1], np.zeros((6, 6)))
    local = to_frame(points_m, state.T_camera_top)
    reach = rack.outline_m / 2 + 5e-3
    near = (np.abs(local[:, 2]) < 5e-3) & (np.abs(local[:, 0]) < reach[0]) & (np.abs(local[:, 1]) < reach[1])
    kept = points_m[near]
    rough, fine = kept[:: len(kept) // ROUGH_POINTS + 1], kept[:: len(kept) // FINE_POINTS + 1]
    for number, (blur_m, window_m) in enumerate(ROUNDS_M):
        _step(rough if number < ROUGH_ROUNDS else fine, state, field, blur_m, window_m)
    covariance = np.linalg.inv(state.information + np.diag([1e2, 1e2, 1e2, 1e4, 1e4, 1e4])) + np.diag(FLOOR**2)
    T = state.T_camera_top @ make_transform(np.eye(3), np.array([0.0, 0.0, -rack.height_m]))
    return Fit(T, covariance, state.scatter_m)


def to_frame(points_m: FloatArray, T_camera_frame: FloatArray) -> FloatArray:
    """Points (N, 3) of the camera frame in another frame, metres."""
    return np.asarray((points_m - T_camera_frame[:3, 3]) @ T_camera_frame[:3, :3])


def _step(points_m: FloatArray, state: _State, field: TopField, blur_m: float, least_m: float) -> None:
    """One round of plane and edges, in place."""
    state.window_m = float(np.clip(3 * state.scatter_m, least_m, state.window_m))
    local = to_frame(points_m, state.T_camera_top)
    local = local[np.abs(local[:, 2]) < state.window_m]
    distance, slope, known = field.look_up(local[:, :2])
    local, distance, slope = local[known], distance[known], slope[known].astype(float)
    state.information = np.zeros((6, 6))
    move = np.zeros(6)
    inside = distance < -INSIDE_M
    if inside.sum() >= 20:
        plane, edges = np.ix_([0, 1, 5], [0, 1, 5]), np.ix_([2, 3, 4], [2, 3, 4])
        move[[0, 1, 5]], state.information[plane], state.scatter_m = _plane(local[inside], state.window_m)
        move[[2, 3, 4]], state.information[edges] = _edges(local[:, :2], distance, slope, blur_m)
    T_step = make_transform(Rotation.from_rotvec(move[:3]).as_matrix(), move[3:])
    state.T_camera_top = state.T_camera_top @ T_step


def _plane(points_m: FloatArray, window_m: float) -> tuple[FloatArray, FloatArray, float]:
    """Turns about x and y, and height, of the plane where heights are densest; their information; their scatter."""
    x, y, h = points_m.T
    design = np.column_stack([y, -x, np.ones(len(x))])
    found = np.array([0.0, 0.0, _mode(h, window_m)])
    width = window_m
    for _ in range(4):
        off = h - design @ found
        scatter = float(1.4826 * np.median(np.abs(off[np.abs(off) < width])))
        width = float(np.clip(3 * scatter, LEAST_WINDOW_M, width))
        weight = np.maximum(1 - (off / width) ** 2, 0) ** 2
        normal = design.T @ (weight[:, None] * design) + np.diag([1e-9, 1e-9, 1e-6])
        found = found + np.linalg.solve(normal, design.T @ (weight * off))
    cells, total = _patches(points_m[weight > 0.2]), max(float(weight.sum()), 1.0)
    return found, normal * (cells / total) / (SHARED_HEIGHT_M**2 + scatter**2 * cells / total), scatter


def _patches(points_m: FloatArray) -> int:
    """How many squares of the length that errors are shared over hold points."""
    cells = np.rint(points_m[:, :2] / SHARED_LENGTH_M).astype(np.intp)
    return max(1, len(np.unique(cells[:, 0] * 4096 + cells[:, 1])))


def _mode(h: FloatArray, window_m: float) -> float:
    """Height of the densest bin: light that was scattered on its way pulls means, and hardly moves the mode."""
    bins = np.arange(-window_m, window_m * 1.001, window_m / 20)
    counts = np.convolve(np.histogram(h, bins)[0], [0.5, 1, 1, 1, 0.5], mode="same")
    return float(bins[int(counts.argmax())] + window_m / 40)


def _edges(xy_m: FloatArray, distance_m: FloatArray, slope: FloatArray, blur_m: float) -> tuple[FloatArray, FloatArray]:
    """Yaw and shift along x and y that put points on the solid part, by a step of Fisher scoring; their information."""
    eta = (EDGE_SHIFT_M - distance_m) / blur_m
    near = np.abs(eta) < 6
    eta, g, xy = eta[near], slope[near], xy_m[near]
    plain = 1 / (1 + np.exp(-eta))
    chance = WRONG_SHARE + (1 - 2 * WRONG_SHARE) * plain
    rate = (1 - 2 * WRONG_SHARE) * plain * (1 - plain)
    # Moving the rack by t moves a point by -t in its frame.
    design = np.column_stack([g[:, 1] * xy[:, 0] - g[:, 0] * xy[:, 1], g]) / blur_m
    weight = rate**2 / (chance * (1 - chance))
    information = design.T @ (weight[:, None] * design)
    step = np.linalg.solve(information + np.diag([1e1, 1e5, 1e5]), design.T @ (rate / chance))
    step *= min(1.0, 1e-3 / max(float(np.abs(step[1:]).max()), 1e-12))
    cells = _patches(xy[np.abs(eta) < 2])
    total = max(float(weight.sum()), 1e-9)
    return step, information * (blur_m**2 * cells / total / SHARED_EDGE_M**2)


@dataclass(frozen=True, slots=True, eq=False)
class Labels:
    """What pixels say at the height of a top.

    Attributes:
        solid_m: Points at its height, frame of the top, shape (N, 3), metres.
        free_m: Where the lines of sight of points far below cross it, shape (M, 2), metres.
    """

    solid_m: FloatArray
    free_m: FloatArray


def label(points_m: FloatArray, T_camera_rack: FloatArray, rack: RackModel, window_m: float) -> Labels:
    """Label the points (N, 3), camera frame, that say something about a rack's top in a pose.

    Left out are points far beside it, and those whose height is neither within `window_m` of the top nor far below.
    """
    T_camera_top = top_frame(T_camera_rack, rack)
    local = to_frame(points_m, T_camera_top)
    camera = -T_camera_top[:3, 3] @ T_camera_top[:3, :3]
    solid = local[np.abs(local[:, 2]) < window_m]
    free = crossings(local[local[:, 2] < -max(THROUGH_M, 2 * window_m)], camera)
    reach = rack.outline_m / 2 + BESIDE_M
    return Labels(*(p[(np.abs(p[:, 0]) < reach[0]) & (np.abs(p[:, 1]) < reach[1])] for p in (solid, free)))
