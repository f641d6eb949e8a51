"""Lines of sight that a tube in a slot would have stopped, wherever it stood: the proof that none is there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from tubepose.labware import RackModel, TubeModel
from tubepose.slots.cells import SLENDER, OpeningCells, opening_sizes
from tubepose.slots.sight_kernels import least_passing
from tubepose.transforms import FloatArray

MARGIN_M = 5.0e-4
"""A silhouette is taken this much smaller all around, metres: the rack's pose (0.3 mm), and half a pixel."""
RIM_M = 1.0e-3
"""The upper end of a tube counts from this far below it, metres: edges are rounded, and there the outline closes."""
LEVELS = 5
"""Heights at which a tube's outline is cut: discs of neighbouring ones overlap."""
STEPS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Where a body touches its slot, along x and along y, as shares of the clearance."""


class Outline(NamedTuple):
    """What of a tube stops lines of sight, in one slot each.

    Attributes:
        height_m: Heights of the cuts above the rack's face, shape (L,), metres.
        radius_m: Radius at each, shape (L, S), metres.
        clearance_m: Room of the body to each side at the face, shape (S,), metres.
    """

    height_m: FloatArray
    radius_m: FloatArray
    clearance_m: FloatArray


def contradicting_m2(
    passing: FloatArray, cells: OpeningCells, rack: RackModel, tubes: Sequence[TubeModel], camera_m: FloatArray
) -> FloatArray:
    """Area of lines of sight that went on where a tube in the slot would have stopped them, shape (S,), square metres.

    For every type and 25 ways to stand (at the face anywhere in the slot, leaning as far as floor and slot allow) the
    tube's silhouette is laid on the face along the lines of sight. The least area of all of them counts: what the
    tube that is contradicted least would have to let through. Where that is large, no tube of the given types is in the
    slot, whatever its cap returns.

    Args:
        passing: Share of every grid place's lines of sight that ended at the face or below, shape (X, Y).
        cells: The grid.
        rack: The rack.
        tubes: Types that can stand in it; without any, a body of `SLENDER` of the opening's width, as high as the face.
        camera_m: Place of the camera, rack frame, shape (3,), metres; above the face.
    """
    summed = np.zeros((passing.shape[0] + 1, passing.shape[1]))
    np.cumsum(passing, axis=0, out=summed[1:])
    outlines = [_outline(rack, tube) for tube in tubes] or [_outline(rack, None)]
    found = [_least_area(summed, cells, rack, outline, camera_m) for outline in outlines]
    return np.asarray(np.min(found, axis=0) * cells.cell_m**2)


def _outline(rack: RackModel, tube: TubeModel | None) -> Outline:
    widths = opening_sizes(rack).width_m
    if tube is None:
        return Outline(np.zeros(1), SLENDER / 2 * widths[None], (1 - SLENDER) / 2 * widths)
    out_m = rack.floor_m + tube.height_m - rack.height_m
    heights = np.linspace(0.0, out_m, LEVELS) if out_m > 0 else np.array([out_m])
    z, r = tube.outer_profile_m().T
    radius = np.interp(np.minimum(heights + rack.depth_m, z.max() - RIM_M), z, r)
    clearance = np.maximum(widths / 2 - tube.body_radius_m(rack.depth_m), 0.0)
    return Outline(heights, np.repeat(radius[:, None], len(widths), axis=1), clearance)


def _least_area(
    summed: FloatArray, cells: OpeningCells, rack: RackModel, outline: Outline, camera_m: FloatArray
) -> FloatArray:
    """Least number of passing places within the silhouettes of one type, over its ways to stand, shape (S,)."""
    ways = np.stack(np.meshgrid(STEPS, STEPS), axis=-1).reshape(-1, 1, 2)
    play = rack.floor_play_mm * 1e-3
    lever = outline.clearance_m + (outline.clearance_m + play) * outline.height_m[:, None] / rack.depth_m
    # Axes (levels, ways, slots, 2): where the tube's axis crosses each level.
    axis = rack.slot_centers_m + ways * lever[:, None, :, None]
    k = (outline.height_m / (camera_m[2] - rack.height_m))[:, None, None]
    middle = (axis - k[..., None] * camera_m[:2]) / (1 - k[..., None])
    radius = np.maximum(outline.radius_m - MARGIN_M, 0.0) / (1 - k[:, 0])
    places = np.ascontiguousarray((middle - cells.low_m) / cells.cell_m)
    return np.asarray(least_passing(summed, places, radius / cells.cell_m))
