"""Measurements of the tops of all tubes of a frame: which they are, where their circles are, how their planes lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.config import Config, ProfileConfig
from tubepose.labware import RackModel, TubeModel
from tubepose.profile.faint_rims import RimSearch, find_faint_rims
from tubepose.profile.kernels import cell_values, crowded_ends, ends_on_planes, near_planes, nearest_tops
from tubepose.profile.outline import NORMALS, OUTLINE_DEPTH_M, SECTORS, Circles, fit_discs, unknown_circles
from tubepose.profile.plane import TopPlanes, fit_top_planes, unknown_planes
from tubepose.profile.rims import RimView, fit_rims, rim_view
from tubepose.profile.standing import Standing, gather_standing
from tubepose.profile.tops import (
    Tops,
    find_tops,
    joined,
    mouth_radius_m,
    top_level_m,
    top_radius_m,
    top_reach_m,
    without_overlaps,
)
from tubepose.transforms import FloatArray

TALLER_M = 0.08
"""Something that stands on something else is looked for this far above the tallest tube."""
ON_PLANE_SHARE = 1 / 3
"""Points of a circle lie this near its top's plane, as a share of the band that grows with the sensor's noise."""
DISC_GAP_M = 0.9e-3
RIM_GAP_M = 0.6e-3
"""Where another top is nearer than this, the end of a disc (the ring of a rim) is not told from the other's."""
LEAST_WHOLE = 0.75
"""Of a rim's sectors that no other top is near to at least this share looks like a ring where it is whole."""
LABEL_CELL_M = 5.0e-4
RING_SUPPORT = 0.6
"""Points with this much support are a rim whatever the image shows."""
NEAR_TOP_M = 2.5e-3
"""Points this far outside of a top can be of the wall below it."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Measurements of tops, T tubes.

    Attributes:
        tops: Where they were found.
        center_m: Middle of each top's circle, rack frame, shape (T, 2), metres.
        level_m: Height of that circle above the rack's base, shape (T,), metres.
        planes: Planes of closed tops; NaN for open ones.
        circles: Circles of all tops.
        label: Tube of each point, shape (N,), -1 for none.
        points: The points.
    """

    tops: Tops
    center_m: FloatArray
    level_m: FloatArray
    planes: TopPlanes
    circles: Circles
    label: NDArray[np.intp]
    points: Standing


def measure_tops(
    frame: RgbdFrame,
    intrinsics: CameraIntrinsics | None,
    T_camera_rack: FloatArray,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    config: Config,
    allowed: NDArray[np.bool_] | None = None,
) -> Measured:
    """Find and measure the tops of all tubes in a rack.

    Args:
        frame: The frame.
        intrinsics: Of its image; without them rims are not measured.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
        rack: The rack.
        tubes: Candidate types, at least one.
        config: Sections profile and slots are used.
        allowed: Which type may stand in which slot, shape (K, S); all by default.
    """
    tallest = max(tube.height_m for tube in tubes)
    lowest_m, highest_m = rack.height_m + config.slots.clearance_m, rack.floor_m + tallest + TALLER_M
    standing = gather_standing(frame, intrinsics, T_camera_rack, rack, lowest_m, highest_m)
    tops = find_tops(standing, rack, tubes, config.profile, allowed)
    shape = _shapes(tops, tubes, rack)
    # Without pixels, or without knowing where they look, rims are not measured.
    has_rims = any(tube.is_open for tube in tubes) and frame.organised
    view = rim_view(frame, intrinsics, T_camera_rack) if has_rims and intrinsics is not None else None
    rims = _measure_rims(view, tops, shape, config.profile)
    # A rim of clear plastic has few points, and other things look like one in the image: both must speak for it. Points
    # that make a ring are told of without the image too, to say that something stands there.
    alone = np.where(np.isfinite(rims.widening_m), RING_SUPPORT, config.profile.min_support)
    kept = ~shape.open | (tops.support > alone)
    kept |= rims.sectors * tops.support >= config.profile.min_rim_evidence
    tops, rims = tops.take(kept), rims.take(kept)
    if view is not None and view.is_image:
        torn = _torn(tops, rims, _shapes(tops, tubes, rack), config.profile)
        rest = (tops.take(torn), _less_sure(rims.take(torn), config.profile.lone_rim_m))
        found = _with_faint_rims(
            view, tops.take(~torn), rims.take(~torn), standing, rack, tubes, config.profile, allowed
        )
        tops, rims = _with_others(*found, *rest, rack, tubes)
    shape = _shapes(tops, tubes, rack)
    label = label_points(standing, tops.center_m, shape.radius_m)
    planes, circles = unknown_planes(len(shape.open)), rims
    if not shape.open.all():
        planes, discs = _measure_closed(standing, label, tops, shape, config.profile)
        circles = discs.where(~shape.open, rims)
    level = np.where(np.isfinite(planes.height_m), planes.height_m, shape.level_m)
    return Measured(tops, tops.center_m + circles.offset_m, level, planes, circles, label, standing)


@dataclass(frozen=True, slots=True, eq=False)
class _Shapes:
    """What the definitions say of the tops, T of them: outer and inner radius, expected height, whether open."""

    radius_m: FloatArray
    mouth_m: FloatArray
    level_m: FloatArray
    open: NDArray[np.bool_]


def _shapes(tops: Tops, tubes: Sequence[TubeModel], rack: RackModel) -> _Shapes:
    of_type = np.array([[top_radius_m(t), mouth_radius_m(t), top_level_m(t, rack), t.is_open] for t in tubes])[
        tops.tube
    ]
    return _Shapes(of_type[:, 0], of_type[:, 1], of_type[:, 2], of_type[:, 3] > 0)


def _measure_rims(view: RimView | None, tops: Tops, shape: _Shapes, config: ProfileConfig) -> Circles:
    """Circles of the open tops; unknown for the others, and for all without a view."""
    circles = unknown_circles(len(shape.open))
    at = np.flatnonzero(shape.open)
    if len(at) == 0 or view is None:
        return circles
    radii = np.column_stack([shape.mouth_m, shape.radius_m])[at]
    sure = tops.support >= config.min_support
    blocked = blocked_sectors(tops.center_m, shape.radius_m, RIM_GAP_M, sure)[at]
    rims = fit_rims(view, tops.center_m[at], shape.level_m[at], radii, blocked, config, config.rim_bias_m)
    return circles.put(at, rims)


def _torn(tops: Tops, rims: Circles, shape: _Shapes, config: ProfileConfig) -> NDArray[np.bool_]:
    """Rims of which so little looks like a ring, shape (T,), that a ring of one gray nearby may be the right one."""
    sure = tops.support >= config.min_support
    free = ~blocked_sectors(tops.center_m, shape.radius_m, RIM_GAP_M, sure)
    return np.asarray(shape.open & (rims.sectors * SECTORS < LEAST_WHOLE * free.sum(axis=1)))


def _less_sure(rims: Circles, more_m: float) -> Circles:
    """The same circles with a standard deviation more along each axis, metres."""
    return replace(rims, covariance_m2=rims.covariance_m2 + np.eye(2) * more_m**2)


def _with_others(
    tops: Tops, rims: Circles, other: Tops, other_rims: Circles, rack: RackModel, tubes: Sequence[TubeModel]
) -> tuple[Tops, Circles]:
    """The same tops and circles, and those of others whose slots are left and that overlap none of them."""
    free = np.setdiff1d(other.slot, tops.slot)
    left = np.isin(other.slot, without_overlaps(free, tops.slot, *_by_slot(rack, other, tops), tubes))
    tops, rims = joined(tops, other.take(left)), joined(rims, other_rims.take(left))
    order = np.argsort(tops.slot, kind="stable")
    return tops.take(order), rims.take(order)


def _by_slot(rack: RackModel, *found: Tops) -> tuple[NDArray[np.intp], FloatArray]:
    """Type (S,) and support and place (S, 3) of the tops of all slots, the last one's; -1 and -inf for none."""
    kind, place = np.full(len(rack.all_slots), -1), np.full((len(rack.all_slots), 3), -np.inf)
    for tops in found:
        kind[tops.slot], place[tops.slot] = tops.tube, np.column_stack([tops.support, tops.center_m])
    return kind, place


def _with_faint_rims(
    view: RimView,
    tops: Tops,
    rims: Circles,
    standing: Standing,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    config: ProfileConfig,
    allowed: NDArray[np.bool_] | None,
) -> tuple[Tops, Circles]:
    """The same tops and circles, and those of open types that the image alone shows in the slots that are left."""
    free = np.setdiff1d(np.arange(len(rack.all_slots)), tops.slot)
    types = np.array([k for k, tube in enumerate(tubes) if tube.is_open], np.intp)
    if len(free) == 0 or len(types) == 0:
        return tops, rims
    known = (tops.center_m, np.array([top_radius_m(tubes[k]) for k in tops.tube]))
    seen = []
    for tube in (tubes[k] for k in types):
        radii = np.array([mouth_radius_m(tube), top_radius_m(tube)])
        reach_m = max(top_reach_m(rack.all_slots[i], tube, rack) for i in free)
        level_m = top_level_m(tube, rack)
        search = RimSearch(
            view, rack.slot_centers_m[free], reach_m, level_m, radii, partial(_blocked_by, *known, float(radii[1])),
            standing, _holes_m(rack, standing, level_m), config,
        )  # fmt: skip
        seen.append(find_faint_rims(search))
    evenness = np.stack([one.evenness for one in seen])
    if allowed is not None:
        evenness = np.where(allowed[np.ix_(types, free)], evenness, -np.inf)
    best, ranked = evenness.argmax(axis=0), np.sort(evenness, axis=0)
    kind, place = _by_slot(rack, tops)
    kind[free], place[free, 0] = types[best], ranked[-1]
    place[free, 1:] = np.stack([one.center_m for one in seen])[best, np.arange(len(free))]
    chosen = without_overlaps(free[np.isfinite(ranked[-1])], tops.slot, kind, place, tubes)
    at = np.searchsorted(free, chosen)
    second = ranked[-2, at] if len(types) > 1 else np.full(len(at), -np.inf)
    new = Tops(chosen, kind[chosen], place[chosen, 1:], place[chosen, 0], second)
    circles = [one.circles.take(at) for one in seen]
    found = reduce(lambda low, k: circles[k].where(best[at] == k, low), range(1, len(types)), circles[0])
    return joined(tops, new), joined(rims, found)


def _holes_m(rack: RackModel, standing: Standing, level_m: float) -> FloatArray:
    """A rack's round openings as the camera sees them on a level: middle and radius, shape (H, 3), metres."""
    holes = [(*slot.center_m, rack.height_m, slot.half_size_m[0]) for slot in rack.all_slots if slot.shape == "round"]
    tops = np.array(holes).reshape(-1, 4)
    smaller = (standing.camera_m[2] - level_m) / (standing.camera_m[2] - rack.height_m)
    return np.column_stack([standing.on_level(level_m, tops[:, :3]), tops[:, 3] * smaller])


def _blocked_by(center_m: FloatArray, radius_m: FloatArray, own_m: float, place_m: FloatArray) -> NDArray[np.bool_]:
    """Sectors (N, SECTORS) of tops of one radius at places (N, 2) that other tops, (T, 2), are too near to."""
    radii = np.concatenate([np.full(len(place_m), own_m), radius_m])
    sure = np.arange(len(radii)) >= len(place_m)
    return blocked_sectors(np.vstack([place_m, center_m]), radii, RIM_GAP_M, sure)[: len(place_m)]


def label_points(standing: Standing, center_m: FloatArray, radius_m: FloatArray) -> NDArray[np.intp]:
    """Tube whose top is nearest to each point from above, shape (N,); -1 farther than `NEAR_TOP_M` from all.

    Looked up in a picture of the rack from above, in cells of `LABEL_CELL_M`: half a cell does not matter, as tops that
    nearly touch are not measured where they do.
    """
    if len(center_m) == 0 or len(standing.points_m) == 0:
        return np.full(len(standing.points_m), -1)
    reach = float(radius_m.max()) + NEAR_TOP_M + LABEL_CELL_M
    low = center_m.min(axis=0) - 2 * reach
    size = np.ceil((np.ptp(center_m, axis=0) + 4 * reach) / LABEL_CELL_M).astype(int) + 1
    label = nearest_tops(center_m, radius_m, NEAR_TOP_M, low, LABEL_CELL_M, size)
    # The picture's border belongs to no top.
    return np.asarray(cell_values(standing.points_m, low, LABEL_CELL_M, label))


def blocked_sectors(
    center_m: FloatArray, radius_m: FloatArray, gap_m: float, sure: NDArray[np.bool_] | None = None
) -> NDArray[np.bool_]:
    """Sectors of every top whose end is nearer than a gap to another top, shape (T, SECTORS).

    Only tops that are `sure`, shape (T,), block others; all by default.
    """
    sure = np.ones(len(radius_m), bool) if sure is None else sure
    return np.asarray(crowded_ends(center_m, radius_m, NORMALS, gap_m, sure))


def _measure_closed(
    standing: Standing, label: NDArray[np.intp], tops: Tops, shape: _Shapes, config: ProfileConfig
) -> tuple[TopPlanes, Circles]:
    """Planes and circles of the closed tops; unknown for the others.

    A circle needs the points near its end alone.
    """
    rows, of, offset = near_planes(
        standing.points_m, label, tops.center_m, shape.level_m, config.top_band_m, ~shape.open
    )
    planes = fit_top_planes(of, offset, standing.points_m[rows, 2], shape.level_m, shape.radius_m, config)
    ends_of, flat = ends_on_planes(
        standing.points_m, rows, of, offset, np.column_stack([planes.height_m, planes.slope]),
        np.maximum(shape.radius_m - OUTLINE_DEPTH_M - config.edge_ramp_m, 0.0), config.top_band_m * ON_PLANE_SHARE,
        tops.center_m, standing.camera_m,
    )  # fmt: skip
    blocked = blocked_sectors(tops.center_m, shape.radius_m, DISC_GAP_M)
    return planes, fit_discs(ends_of, flat, shape.radius_m, blocked, config)
