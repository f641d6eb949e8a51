"""Measurements of the tops of all tubes of a frame: which they are, where their circles are, how their planes lie."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial, reduce

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.config import Config, ProfileConfig
from tubepose.labware import RackModel, TubeModel
from tubepose.profile.closed_tops import (
    Measured,
    TopShapes,
    blocked_sectors,
    measure_closed_tops,
    name_measured,
    top_shapes,
)
from tubepose.profile.faint_rims import RimSearch, find_faint_rims, without_bare
from tubepose.profile.outline import SECTORS, Circles, unknown_circles
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
RIM_GAP_M = 0.6e-3
"""Where another top is nearer than this, the ring of a rim is not told from the other's."""
LEAST_WHOLE = 0.75
"""Of a rim's sectors that no other top is near to at least this share looks like a ring where it is whole."""
RING_SUPPORT = 0.6
"""Points with this much support are a rim whatever the image shows."""


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
    shape = top_shapes(tops, tubes, rack)
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
        torn = _torn(tops, rims, top_shapes(tops, tubes, rack), config.profile)
        rest = (tops.take(torn), _less_sure(rims.take(torn), config.profile.lone_rim_m))
        found = _with_faint_rims(
            view, tops.take(~torn), rims.take(~torn), standing, rack, tubes, config.profile, allowed
        )
        tops, rims = _with_others(*found, *rest, rack, tubes)
    measured = measure_closed_tops(standing, tops, rims, rack, tubes, config.profile)
    return name_measured(measured, rims, rack, tubes, config.profile, allowed)


def _measure_rims(view: RimView | None, tops: Tops, shape: TopShapes, config: ProfileConfig) -> Circles:
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


def _torn(tops: Tops, rims: Circles, shape: TopShapes, config: ProfileConfig) -> NDArray[np.bool_]:
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
    # An opaque rim returns points: what the image alone shows is none.
    types = np.array([k for k, tube in enumerate(tubes) if tube.is_open and not _is_opaque(tube)], np.intp)
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
        known_m = tops.center_m[tops.tube == tubes.index(tube)]
        seen.append(without_bare(find_faint_rims(search), known_m, search))
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


def _is_opaque(tube: TubeModel) -> bool:
    """Whether light does not enter an open tube's rim."""
    return (tube.body if tube.cap is None else tube.cap).material == "opaque"


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
