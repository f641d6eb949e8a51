"""Whether a rack's face was seen from the origin: a cloud in a robot's frame is seen from elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from tubepose.checks import Check
from tubepose.labware import RackModel
from tubepose.preprocessing import thin
from tubepose.rack.field import top_field
from tubepose.transforms import FloatArray, invert_transform, transform_points, translation

# Beyond this angle off its normal a face is foreshortened to a third: its openings close, and no sensor of this kind
# sees its ribs. A robot's base stands about as high as the rack, and sees its face from the side or from below.
MOST_INCIDENCE_DEG = 70.0
# Points so far behind the face are of nothing that is bowed (2.5 mm) or noisy there, nor of light that a tube has bent.
BEHIND_M = 10e-3
# Lines of sight this far inside the solid part are not of an edge: blur, and light from below a surface.
INSIDE_M = 1.5e-3
# Fewer points behind the face, or a smaller share of the face that deep in the solid part, decide nothing.
LEAST_BEHIND, LEAST_SOLID = 200, 0.03
# Were the face not there, as many lines of sight would cross the solid part as its share of the area (100 %). A face
# that stops them lets hardly one pass: ghosts and light through its material. Half tells them apart.
MOST_THROUGH_PERCENT = 50.0
# They are few if they are less than this share of those that end on the solid part, within so much of its height.
LEAST_PASSED, STOPPED_M = 0.05, 2e-3
# The table around a rack lies below its face, by the rack's height; above it, as near to that as this, the rack is seen
# from below. Most of what lies around it has to say so.
AROUND_M = 40e-3
TABLE_M = 5e-3
LEAST_AROUND, MOST_ABOVE_PERCENT = 200, 50.0
# So many points of the scene are looked at: a share of 200 of them is known to 4 %.
POINTS = 20_000


def viewpoint_checks(points_m: FloatArray, T_camera_rack: FloatArray, rack: RackModel) -> Iterator[Check]:
    """What contradicts that a rack was seen from the origin.

    Args:
        points_m: Points of the scene, shape (N, 3), in the frame of the cloud, metres.
        T_camera_rack: The rack's pose in that frame, shape (4, 4), metres.
        rack: The rack.
    """
    origin_m = invert_transform(T_camera_rack)[:3, 3]
    away_m = origin_m - [0.0, 0.0, rack.height_m]
    incidence_deg = float(np.rad2deg(np.arccos(np.clip(away_m[2] / np.linalg.norm(away_m), -1.0, 1.0))))
    facing = incidence_deg <= MOST_INCIDENCE_DEG
    yield Check("faces_away", incidence_deg, MOST_INCIDENCE_DEG, facing)
    if not facing:
        return
    local_m = transform_points(invert_transform(T_camera_rack), thin(points_m, POINTS))
    yield from _through(local_m, origin_m, rack)
    yield from _around(local_m, rack)


def _through(local_m: FloatArray, origin_m: FloatArray, rack: RackModel) -> Iterator[Check]:
    """Lines of sight behind the face that cross its solid part, as a share of those that would without a face."""
    behind = local_m[local_m[:, 2] < rack.height_m - BEHIND_M]
    share = (rack.height_m - origin_m[2]) / (behind[:, 2] - origin_m[2])
    crossing_m = origin_m[:2] + (behind[:, :2] - origin_m[:2]) * share[:, None]
    crossing_m = crossing_m[(np.abs(crossing_m) < rack.outline_m / 2 - INSIDE_M).all(axis=1)]
    field = top_field(rack)
    solid = _solid_share(rack)
    if len(crossing_m) < LEAST_BEHIND or solid < LEAST_SOLID:
        return
    passed = field.look_up(crossing_m)[0] < -INSIDE_M
    stopped = len(field.on_solid(local_m, translation([0.0, 0.0, rack.height_m]), STOPPED_M, INSIDE_M))
    through = 100 * float(np.mean(passed)) / solid
    # Where wells return hardly a point, light that goes astray is most of what lies behind: the face stops the rest.
    few = bool(np.count_nonzero(passed) < LEAST_PASSED * stopped)
    yield Check("seen_through", through, MOST_THROUGH_PERCENT, few or through <= MOST_THROUGH_PERCENT)


@lru_cache(maxsize=32)
def _solid_share(rack: RackModel) -> float:
    """Share of a face, off its outline, that is so deep in its solid part that a line of sight there is of no edge."""
    inner = (np.abs(_places(rack)) < rack.outline_m / 2 - INSIDE_M).all(axis=1)
    return float(np.mean(top_field(rack).table[inner, 0] < -INSIDE_M))


def _places(rack: RackModel) -> FloatArray:
    """Places of the cells of a rack's field, in the order of its table, shape (X * Y, 2), metres."""
    low_m, cell_m, shape, _ = top_field(rack).grid
    return np.asarray(low_m + cell_m * np.indices(shape).reshape(2, -1).T)


def _around(local_m: FloatArray, rack: RackModel) -> Iterator[Check]:
    """Share of what lies around the rack that is as far above its face as a table is below it."""
    beyond = (np.abs(local_m[:, :2]) - rack.outline_m / 2).max(axis=1)
    z = local_m[(beyond > TABLE_M) & (beyond < AROUND_M), 2]
    if len(z) >= LEAST_AROUND:
        above = 100 * float(np.mean(np.abs(z - 2 * rack.height_m) < TABLE_M))
        yield Check("table_above", above, MOST_ABOVE_PERCENT, above <= MOST_ABOVE_PERCENT)
