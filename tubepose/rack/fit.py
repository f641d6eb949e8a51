"""The rack's pose in six degrees of freedom, from its plane and from the edges of its ribs, openings and outline.

What one round of it does is in `fit_kernels`. Points below the top are not used here: next to an edge they mix two
depths, and lie on the side that the projector's shadow leaves. `Labels` has them as evidence all the same.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from tubepose.labware import RackModel
from tubepose.rack import fit_kernels
from tubepose.rack import kernels as kernels
from tubepose.rack import view_kernels as view_kernels
from tubepose.rack.field import TopField, top_field
from tubepose.rack.fit_kernels import INSIDE_M, WIDEST_M
from tubepose.rack.tops import FLAT_CHI2, Level
from tubepose.transforms import FloatArray, make_transform, parts, translation

# Per round: blur of the edges (the first as wide as a coarse start may be off, the last half a pixel of 0.4 mm), and
# half widths of the heights that a plane is fitted to, one after the other.
ROUNDS_M = (
    (1.2e-3, np.geomspace(2.5e-3, 0.8e-3, 6)),
    (0.6e-3, np.geomspace(1.5e-3, 0.4e-3, 5)),
    (0.3e-3, np.geomspace(0.6e-3, 0.3e-3, 3)),
    (0.2e-3, np.geomspace(0.4e-3, 0.3e-3, 2)),
    (0.2e-3, np.geomspace(0.4e-3, 0.3e-3, 2)),
)
ROUGH_ROUNDS = 2
ROUGH_POINTS = 4000
FINE_POINTS = 10_000
# With so many points astray after the rough rounds, finer ones are of no use.
HOPELESS_SHARE = 0.35
# Half widths of the heights that a bowed face is first fitted to: a plane has cut its ends off.
BOW_WIDTHS_M = np.geomspace(3.0e-3, 0.6e-3, 8)
# Light that lifts or sinks whole sides of a rack looks like a bow, too (`INFLATE`): a face is flat unless its bow is
# less likely than one in a thousand by chance.
BOW_INFLATE = 3.0
LEAST_BOW_M = 1e-5
# Edges are looked for at least this near the top.
EDGE_WINDOW_M = 1.0e-3
LEAST_POINTS = 20
# Variance of what nothing is known of.
UNKNOWN = 1e6
# Of a pose's six numbers those that the plane tells, and those that the edges tell.
PLANE, EDGES = np.ix_([0, 1, 5], [0, 1, 5]), np.ix_([2, 3, 4], [2, 3, 4])
# Points below this far are seen through the top: nearer ones may be mixed with it.
THROUGH_M = 10e-3
# How far beside a top points are looked at: a slot and its ribs.
BESIDE_M = 30e-3
# Light that goes astray is alike over a slot and its ribs: what a pose's error is estimated from.
CLUSTER_M = 20e-3
# What no number of points takes away: calibration, and shadows and hidden sides that are on the same side everywhere.
FLOOR = np.array([5e-4, 3e-4, 2e-4, 6e-5, 6e-5, 6e-5])
# On `dev` planes are off by twice what their residuals say, because whole sides of a rack are lifted or sunk together.
INFLATE = np.diag([3.0, 2.5, 1.0, 1.2, 1.2, 2.0])
# More so where light lifts or sinks many points of the solid part out of the plane: with this share of them so far off
# it, its variance is twice as large. By 61 simulated racks, of `dev` and of clear tubes.
LIFTED_M = 0.8e-3
LIFTED_SHARE = 0.15
# The same for a rack that is held level by tubes, by 18 simulated racks full of caps: what shows of its edges is seen
# between caps. Light lifts its ribs, too: a standard deviation that no number of points takes away.
INFLATE_HELD = np.diag([1.0, 1.0, 1.5, 2.2, 2.2, 2.0])
FLOOR_HELD_M = 2e-4


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A refined pose and what it stands on.

    Attributes:
        T_camera_rack: Array of shape (4, 4), metres.
        covariance: (6, 6), rotation vector (rad) then translation (m), rack frame, about the centre of the top.
        scatter_m: Standard deviation of heights about the plane, from their median, metres.
        level: The tops of what stands in the rack that hold it level, where little of its own top is seen or that
            leans otherwise; None where its own ribs tell.
        bow_m: How much higher the face is than the plane at its centre, shape (3,), metres: at the ends of its x axis,
            of its y axis, and what its corners have besides (`bow_at`); 0 where it is not significant.
        bow_std_m: Standard deviations of that, shape (3,); of a face that is called flat those of the fit with a bow.
    """

    T_camera_rack: FloatArray
    covariance: FloatArray
    scatter_m: float
    level: Level | None = None
    bow_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    bow_std_m: FloatArray = field(default_factory=lambda: np.full(3, np.inf))

    def laid_flat(self, points_m: FloatArray, rack: RackModel) -> FloatArray:
        """Points (N, 3), camera frame, as they would lie were the face flat: moved by its bow where they are seen."""
        return laid_flat(points_m, self.T_camera_rack, self.bow_m, rack)


def laid_flat(points_m: FloatArray, T_camera_rack: FloatArray, bow_m: FloatArray, rack: RackModel) -> FloatArray:
    """Points (N, 3), camera frame, as they would lie were a rack's face flat; NaN stays NaN.

    Args:
        points_m: The points, metres.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
        bow_m: Of its face, as `Fit.bow_m`, shape (3,), metres.
        rack: The rack.
    """
    if not bow_m.any():
        return points_m
    T = top_frame(T_camera_rack, rack)
    points_m = np.ascontiguousarray(points_m, float)
    return np.asarray(fit_kernels.laid_flat(points_m, *parts(T), camera_place(T), rack.outline_m / 2, bow_m))


@dataclass(slots=True, eq=False)
class RoughFit:
    """A pose after the first rounds, and what it goes on with; the later ones change it in place.

    Attributes:
        T_camera_top: Frame of the top, shape (4, 4), metres.
        kept_m: Points near the top, camera frame, shape (N, 3), metres.
        rough_m: Some of them, which the first rounds saw.
        scatter_m: Standard deviation of heights about the plane, metres.
        covariance: Of the last round, shape (6, 6).
        stray: Share of the points at the top's height that lie far from its solid part.
        level: What holds the top level; None where its own ribs tell.
        half_m: Half of the rack's outline along x and y, shape (2,), metres.
        bow_m: As `Fit.bow_m`, shape (3,).
        bow_covariance: Of that, shape (3, 3).
    """

    T_camera_top: FloatArray
    kept_m: FloatArray
    rough_m: FloatArray
    scatter_m: float
    covariance: FloatArray
    half_m: FloatArray
    stray: float = 1.0
    level: Level | None = None
    bow_m: FloatArray = field(default_factory=lambda: np.zeros(3))
    bow_covariance: FloatArray = field(default_factory=lambda: UNKNOWN * np.eye(3))


def bow_slopes(bow_m: FloatArray, places_m: FloatArray, rack: RackModel) -> FloatArray:
    """Slopes of a bowed face (`Fit.bow_m`) along x and y at places (..., 2), frame of the top: tubes there lean so."""
    half = rack.outline_m / 2
    uv = places_m / half
    return np.asarray((2 * bow_m[:2] * uv + bow_m[2] * uv[..., ::-1]) / half)


def top_frame(T_camera_rack: FloatArray, rack: RackModel) -> FloatArray:
    """T_camera_top: the rack's frame, moved up to the top; shape (4, 4), metres."""
    return T_camera_rack @ translation([0.0, 0.0, rack.height_m])


def roughly(points_m: FloatArray, T_camera_rack: FloatArray, rack: RackModel) -> RoughFit:
    """The first rounds from a coarse pose (2 mm and 1.5 degrees off at most), with points (N, 3), camera frame."""
    T = top_frame(T_camera_rack, rack)
    kept = _near_top(points_m, T, rack)
    state = RoughFit(T, kept, _thinned(kept, ROUGH_POINTS), WIDEST_M, UNKNOWN * np.eye(6), rack.outline_m / 2)
    for blur_m, widths_m in ROUNDS_M[:ROUGH_ROUNDS]:
        _step(state.rough_m, state, top_field(rack), blur_m, widths_m)
    return state


def filled(rough: RoughFit, points_m: FloatArray, rack: RackModel) -> RoughFit:
    """A rough fit to some of the points, with all of them, (N, 3), camera frame, to go on with."""
    kept = _near_top(points_m, rough.T_camera_top, rack)
    return replace(rough, kept_m=kept, rough_m=_thinned(kept, ROUGH_POINTS))


def _near_top(points_m: FloatArray, T_camera_top: FloatArray, rack: RackModel) -> FloatArray:
    """Points (N, 3), camera frame, a little beside a top and above and below it at most."""
    points_m, reach_m = np.ascontiguousarray(points_m, float), rack.outline_m / 2 + 5e-3
    return np.asarray(kernels.in_box(points_m, *parts(T_camera_top), reach_m, -5e-3, 5e-3))


def refine(state: RoughFit, rack: RackModel) -> Fit:
    """The other rounds; none where so much lies beside the solid part that they are of no use.

    The first of them fits a bow. Where that is not significant, the face is flat. Tops that hold a rack tell its bow,
    too.
    """
    top, fine, bowed = top_field(rack), _thinned(state.kept_m, FINE_POINTS), False
    if state.stray <= HOPELESS_SHARE:
        if state.level is None:
            flat = replace(state)
            _step(fine, state, top, ROUNDS_M[ROUGH_ROUNDS][0], BOW_WIDTHS_M, tells=True, bowed=True)
            state.bow_covariance = state.bow_covariance * _lifted(state, fine, top)
            bowed = _significant(state.bow_m, state.bow_covariance)
            if not bowed:
                flat.bow_covariance = state.bow_covariance
                state = flat
        for number, (blur_m, widths_m) in enumerate(ROUNDS_M[ROUGH_ROUNDS:], ROUGH_ROUNDS):
            _step(fine, state, top, blur_m, widths_m, tells=number == len(ROUNDS_M) - 1, bowed=bowed)
    lifted = _lifted(state, fine, top) if state.level is None else 1.0
    covariance = _covariance(state, lifted)
    if bowed:
        state.bow_covariance = state.bow_covariance * lifted
    bow_std_m = np.sqrt(np.diag(state.bow_covariance))
    return Fit(rack_frame(state, rack), covariance, state.scatter_m, state.level, state.bow_m, bow_std_m)


def _significant(bow_m: FloatArray, covariance: FloatArray) -> bool:
    """Whether a bow is one: less likely than this by chance."""
    return bool(bow_m @ np.linalg.solve(covariance + LEAST_BOW_M**2 * np.eye(3), bow_m) > FLAT_CHI2)


def _covariance(state: RoughFit, lifted: float) -> FloatArray:
    """Of the pose's error, shape (6, 6): that of the last round, and what it cannot know of (`_lifted`, among it)."""
    inflate = INFLATE if state.level is None else INFLATE_HELD
    covariance = np.asarray(inflate @ state.covariance @ inflate + np.diag(FLOOR**2))
    if state.level is None:
        covariance[PLANE] *= lifted
        return covariance
    covariance[5, 5] += FLOOR_HELD_M**2
    # The height is that of ribs that may be seen at one end only: the level's error moves it at the centre.
    seen = at_the_top(state, state.rough_m)
    x, y = seen.mean(axis=0) if len(seen) else np.zeros(2)
    lever = np.array([[1.0, 0], [0, 1], [-y, x]])
    covariance[PLANE] += lever @ state.level.covariance @ lever.T
    return covariance


def _lifted(state: RoughFit, points_m: FloatArray, field: TopField) -> float:
    """How many times larger variances of heights are because light lifts or sinks points of the solid part."""
    local = _flat_local(points_m, state)
    distance, _, known = field.look_up(local)
    off_m = np.abs(local[known & (distance < -INSIDE_M), 2])
    lifted = float(np.mean(off_m > LIFTED_M)) if len(off_m) else 1.0
    return 1 + (lifted / LIFTED_SHARE) ** 2


def leveled(rough: RoughFit, level: Level) -> RoughFit:
    """A rough fit, held level by the tops of what stands in the rack, to go on with."""
    return replace(
        rough, T_camera_top=level.T_camera_top, scatter_m=WIDEST_M, level=level, bow_m=level.bow_m,
        bow_covariance=level.bow_covariance,
    )  # fmt: skip


def rack_frame(state: RoughFit, rack: RackModel) -> FloatArray:
    """T_camera_rack of a fit, shape (4, 4), metres."""
    return np.asarray(state.T_camera_top @ translation([0.0, 0.0, -rack.height_m]))


def at_the_top(state: RoughFit, points_m: FloatArray) -> FloatArray:
    """Places of a rough fit's points (all or some) at the height of its top, frame of the top, shape (N, 2), metres."""
    local = _flat_local(points_m, state)
    return local[np.abs(local[:, 2]) < max(EDGE_WINDOW_M, min(3 * state.scatter_m, WIDEST_M)), :2]


def _flat_local(points_m: FloatArray, state: RoughFit) -> FloatArray:
    """Points (N, 3) near a top in its frame, their heights those over its bowed face."""
    local = to_frame(points_m, state.T_camera_top)
    local[:, 2] -= fit_kernels.bow_at(state.bow_m, *(local[:, :2] / state.half_m).T)
    return local


def _thinned(points_m: FloatArray, count: int) -> FloatArray:
    return points_m[:: len(points_m) // count + 1].copy()


def to_frame(points_m: FloatArray, T_camera_frame: FloatArray) -> FloatArray:
    """Points (N, 3) of the camera frame in another frame, metres."""
    return np.asarray((points_m - T_camera_frame[:3, 3]) @ T_camera_frame[:3, :3])


def _step(
    points_m: FloatArray,
    state: RoughFit,
    field: TopField,
    blur_m: float,
    widths_m: FloatArray,
    *,
    tells: bool = False,
    bowed: bool = False,
) -> None:
    """One round of face and edges, in place, with a bow or without; one that `tells` states their covariance."""
    T = state.T_camera_top
    window_m = max(EDGE_WINDOW_M, min(3 * state.scatter_m, float(widths_m[0])))
    held = state.level is not None
    (face, scatter_m, normal, scores), inside, (edges, outlines), stray = fit_kernels.round_step(
        points_m, *parts(T), window_m, blur_m, widths_m, held, state.bow_m, 6 if bowed else 3, state.half_m, *field.grid
    )
    state.covariance = UNKNOWN * np.eye(6)
    if len(inside) < LEAST_POINTS:
        return
    if tells:
        covariance = _clustered(normal, scores, inside)
        state.covariance[PLANE] = covariance[:3, :3]
        state.covariance[EDGES] = _clustered(*outlines)
        if bowed:
            state.bow_covariance = BOW_INFLATE**2 * covariance[3:, 3:]
    state.scatter_m, state.stray = float(scatter_m), float(stray)
    if bowed:
        state.bow_m = state.bow_m + face[3:]
    turn = np.asarray(cv2.Rodrigues(np.array([*face[:2], edges[0]]))[0], float)
    state.T_camera_top = np.asarray(T @ make_transform(turn, np.array([*edges[1:], face[2]])))


def _clustered(normal: FloatArray, scores: FloatArray, points_m: FloatArray) -> FloatArray:
    """Covariance of a fit whose residuals are alike within squares of `CLUSTER_M`, and independent between them."""
    if len(points_m) == 0:
        return UNKNOWN * np.eye(len(normal))
    products, count = fit_kernels.cluster_sums(points_m, scores, CLUSTER_M)
    inverse = np.linalg.inv(normal)
    return np.asarray(inverse @ products @ inverse * (count / max(count - len(normal), 1)))


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
    T = top_frame(T_camera_rack, rack)
    points_m = np.ascontiguousarray(points_m, float)
    reach_m, through_m = rack.outline_m / 2 + BESIDE_M, max(THROUGH_M, 2 * window_m)
    return Labels(*view_kernels.labelled(points_m, *parts(T), camera_place(T), reach_m, window_m, through_m))


def camera_place(T_camera_frame: FloatArray) -> FloatArray:
    """Where the camera stands in a frame, shape (3,), metres."""
    return np.asarray(-T_camera_frame[:3, 3] @ T_camera_frame[:3, :3])
