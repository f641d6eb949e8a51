"""Planes, circles and types of the tops of all tubes of a frame, once it is known where they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import NDArray

from tubepose.config import ProfileConfig
from tubepose.labware import RackModel, TubeModel
from tubepose.preprocessing import fullest_level
from tubepose.profile.identity import Names, measured_radii, name_tops, unknown_words
from tubepose.profile.kernels import cell_values, crowded_ends, ends_on_planes, near_planes, nearest_tops
from tubepose.profile.leftovers import NO_TOP, STRANGE_TOP, Leftover
from tubepose.profile.outline import NORMALS, OUTLINE_DEPTH_M, Circles, fit_discs
from tubepose.profile.plane import TopPlanes, fit_top_planes, top_spacing_m, unknown_planes
from tubepose.profile.posterior import per_model
from tubepose.profile.standing import Standing
from tubepose.profile.tops import Tops, mouth_radius_m, top_level_m, top_radius_m
from tubepose.transforms import FloatArray
from tubepose.tube import TopMeasure

ON_PLANE_SHARE = 1 / 3
"""Points of a circle lie this near its top's plane, as a share of the band that grows with the sensor's noise."""
DISC_GAP_M = 0.9e-3
"""Where another top is nearer than this, the end of a disc is not told from the other's."""
LABEL_CELL_M = 5.0e-4
NEAR_TOP_M = 2.5e-3
"""Points this far outside of a top can be of the wall below it."""
FAR_OFF_M, MOST_AGAIN = 2.5e-4, 4
"""A circle that is so much wider or narrower than it was looked for is cut off by where its end is looked for: it is
looked for there, so often at most."""


MIDDLE_SHARE, MIDDLE_POINTS = 0.6, 20
"""The middle of a top, as a share of its radius, and how many points it has at least to tell what lies above it."""
HIGHER_M, ONE_HEIGHT_M = 2.0e-3, 2.0e-3
"""What lies this far above a top is not of it: what a wrong pose is, more than a lean or noise make. What is of one top
lies within the other."""
DEEP_M = 4.0e-3
"""Nothing fills a tube up to this far below its rim: what lies there is a closed top that was taken for a rim."""


@dataclass(frozen=True, slots=True, eq=False)
class Measured:
    """Measurements of tops, T tubes.

    Attributes:
        tops: Where they were found.
        center_m: Middle of each top's circle, rack frame, shape (T, 2), metres.
        level_m: Height of that circle above the rack's base, shape (T,), metres.
        planes: Planes of closed tops; NaN for open ones.
        circles: Circles of all tops.
        label: Tube of each point, shape (N,), `NO_TOP` for none, `STRANGE_TOP` for one of no given type.
        points: The points.
        strangers: Tops of no given type, or of which the type is not known.
        type_odds: Log odds of each top's type against all others, shape (T,), nats; NaN of open ones. None before
            types are told.
    """

    tops: Tops
    center_m: FloatArray
    level_m: FloatArray
    planes: TopPlanes
    circles: Circles
    label: NDArray[np.intp]
    points: Standing
    strangers: tuple[Leftover, ...] = ()
    type_odds: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TopShapes:
    """What the definitions say of the tops, T of them.

    Attributes:
        radius_m: Outer radius, shape (T,), metres.
        mouth_m: Inner radius of an open one, shape (T,), metres; 0 of a closed one.
        level_m: Height above the rack's base, shape (T,), metres.
        open: Which are open, shape (T,).
    """

    radius_m: FloatArray
    mouth_m: FloatArray
    level_m: FloatArray
    open: NDArray[np.bool_]


def top_shapes(tops: Tops, tubes: Sequence[TubeModel], rack: RackModel) -> TopShapes:
    """What the definitions of their types say of tops."""
    of_type = np.array([[top_radius_m(t), mouth_radius_m(t), top_level_m(t, rack), t.is_open] for t in tubes])
    of_type = of_type[tops.tube]
    return TopShapes(of_type[:, 0], of_type[:, 1], of_type[:, 2], of_type[:, 3] > 0)


def measure_closed_tops(
    standing: Standing, tops: Tops, rims: Circles, rack: RackModel, tubes: Sequence[TubeModel], config: ProfileConfig
) -> Measured:
    """Planes and circles of tops whose rims are measured."""
    shape = top_shapes(tops, tubes, rack)
    label = label_points(standing, tops.center_m, shape.radius_m)
    planes, circles = unknown_planes(len(shape.open)), rims
    if not shape.open.all():
        planes, discs = _measure_closed(standing, label, tops, shape, config)
        circles = discs.where(~shape.open, rims)
    level = np.where(np.isfinite(planes.height_m), planes.height_m, shape.level_m)
    return Measured(tops, tops.center_m + circles.offset_m, level, planes, circles, label, standing)


def name_measured(
    found: Measured,
    rims: Circles,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    config: ProfileConfig,
    allowed: NDArray[np.bool_] | None,
) -> Measured:
    """The same tops under the types that they are likeliest to be of; those of no type for sure are strangers."""
    names, radius_m = _names(found, rack, tubes, config, allowed)
    shape = top_shapes(found.tops, tubes, rack)
    tube = np.where(names.odds >= config.min_type_odds, names.tube, found.tops.tube)
    if np.any(tube != found.tops.tube):
        found = measure_closed_tops(found.points, replace(found.tops, tube=tube), rims, rack, tubes, config)
        names, radius_m = _names(found, rack, tubes, config, allowed)
    # How well another type would cover the points is no question where its height and its radius were measured.
    runner_up = np.where(shape.open, found.tops.runner_up, -np.inf)
    type_odds = np.where(shape.open, np.nan, names.odds)
    found = replace(found, tops=replace(found.tops, runner_up=runner_up), type_odds=type_odds)
    strange = np.flatnonzero(~shape.open & (names.odds < config.min_type_odds))
    strangers = []
    for t in strange:
        rival = tubes[names.rival[t]] if names.rival[t] >= 0 else None
        words = unknown_words(
            float(found.level_m[t]), float(radius_m[t]), (tubes[found.tops.tube[t]], rival), float(names.odds[t]), rack,
            config.min_type_odds,
        )  # fmt: skip
        code = "unknown_type" if rival is None else "type_not_told"
        strangers.append(Leftover(int(found.tops.slot[t]), words, np.flatnonzero(found.label == t), code))
    return _without(found, strange, tuple(strangers)) if strangers else found


def _names(
    found: Measured,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    config: ProfileConfig,
    allowed: NDArray[np.bool_] | None,
) -> tuple[Names, FloatArray]:
    """Types of all tops, and the radii of their circles, shape (T,), metres."""
    tops, shape = found.tops, top_shapes(found.tops, tubes, rack)
    circles, radius_m = found.circles, shape.radius_m + found.circles.widening_m
    for _ in range(MOST_AGAIN):
        # A circle that is far off its radius is measured again where it ends.
        if not np.any(np.abs(circles.widening_m[~shape.open]) > FAR_OFF_M):
            break
        again = replace(shape, radius_m=np.where(np.isfinite(radius_m), radius_m, shape.radius_m))
        _, circles = _measure_closed(found.points, found.label, tops, again, config)
        radius_m = again.radius_m + circles.widening_m
    radius_m = np.where(np.isfinite(circles.offset_m[:, 0]), radius_m, np.nan)
    spacing_m = top_spacing_m(found.planes, shape.radius_m)
    may = np.array([not tube.is_open for tube in tubes])[None] & ~shape.open[:, None]
    if allowed is not None:
        may = may & allowed[:, tops.slot].T
    radii = measured_radii(radius_m, circles.covariance_m2, spacing_m)
    return name_tops(found.planes.height_m, radii, may, rack, tubes, config), radius_m


def _without(found: Measured, strange: NDArray[np.intp], strangers: tuple[Leftover, ...]) -> Measured:
    """The same without some tops, whose points are of strangers."""
    kept = np.setdiff1d(np.arange(len(found.level_m)), strange)
    number = np.full(len(found.level_m) + 1, NO_TOP)
    number[kept], number[strange] = np.arange(len(kept)), STRANGE_TOP
    planes = TopPlanes(*(getattr(found.planes, field.name)[kept] for field in fields(TopPlanes)))
    return Measured(
        found.tops.take(kept), found.center_m[kept], found.level_m[kept], planes, found.circles.take(kept),
        number[found.label], found.points, strangers, None if found.type_odds is None else found.type_odds[kept],
    )  # fmt: skip


def top_measures(
    measured: Measured, upright: FloatArray, models: Sequence[TubeModel], rack: RackModel
) -> list[TopMeasure]:
    """What was measured of the tops of tubes, to compare with their definitions.

    Args:
        measured: The tops, T of them.
        upright: Cosines of their axes' tilts, shape (T,).
        models: Their types.
        rack: The rack.
    """
    held, radius = per_model(models, lambda tube: (tube.pivot_height_m, top_radius_m(tube))).reshape(-1, 2).T
    height = (measured.planes.height_m - rack.floor_m - held) / upright + held
    closed = np.isfinite(measured.planes.height_m)
    diameter = np.where(closed, 2 * (radius + measured.circles.widening_m), np.nan)
    # A closed top's normal is its axis: it leads down to the rack's face.
    down = (measured.level_m - rack.height_m)[:, None] * measured.planes.slope
    off = measured.center_m + down - rack.slot_centers_m[measured.tops.slot]
    columns = zip(height.tolist(), diameter.tolist(), off.tolist(), strict=True)
    return [TopMeasure(high, wide, (x, y)) for high, wide, (x, y) in columns]


def higher_share(measured: Measured, tubes: Sequence[TubeModel], rack: RackModel) -> FloatArray:
    """Share of the points over the middle of every top that are of a higher one, shape (T,).

    A top is the highest thing over its slot. What is higher and no ghost lies at one height: the fullest two
    millimetres count.
    """
    return _share_above(measured, top_shapes(measured.tops, tubes, rack).radius_m, HIGHER_M)


def filled_share(measured: Measured, tubes: Sequence[TubeModel], rack: RackModel) -> FloatArray:
    """Share of the points in the mouth of every open top that are of a closed one, shape (T,); NaN of closed tops.

    A mouth is open: what lies in it lies deep. The fullest two millimetres above `DEEP_M` below the rim count.
    """
    shape = top_shapes(measured.tops, tubes, rack)
    return np.where(shape.open, _share_above(measured, np.where(shape.open, shape.mouth_m, 0.0), -DEEP_M), np.nan)


def _share_above(measured: Measured, radius_m: FloatArray, above_m: float) -> FloatArray:
    """Share of the points over the middle of discs (T,) that lie at one height, so much above their tops or higher."""
    count = len(measured.level_m)
    rows = np.flatnonzero(measured.label >= 0)
    of, points_m = measured.label[rows], measured.points.points_m[rows]
    near = np.hypot(*(points_m[:, :2] - measured.center_m[of]).T) < MIDDLE_SHARE * radius_m[of]
    of = of[near]
    up_m = points_m[near, 2] - measured.level_m[of] - above_m
    higher = up_m > 0
    fullest = fullest_level(of[higher], up_m[higher], count, ONE_HEIGHT_M, 0.0)
    return np.asarray(fullest / np.maximum(np.bincount(of, minlength=count), MIDDLE_POINTS))


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
    standing: Standing, label: NDArray[np.intp], tops: Tops, shape: TopShapes, config: ProfileConfig
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
