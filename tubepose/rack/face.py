"""What the lines of sight say of a rack's face, cell by cell: points at its height, below it, above it, or none.

One picture of the face serves every hypothesis of what rack it is. A cell that something above hides says nothing; one
that is seen says "solid" or "open", and one in which no line of sight ended says little.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from tubepose.labware import RackModel
from tubepose.rack import view_kernels as view_kernels
from tubepose.rack.fit import camera_place, top_frame
from tubepose.rack.fit_kernels import EDGE_SHIFT_M, WRONG_SHARE
from tubepose.transforms import FloatArray, parts

# Side of a cell, and how many of the spacings of coarse points it has at least, so that most cells have one.
CELL_M = 0.7e-3
CELL_STEP_M = 0.3e-3
SPACINGS = 1.6
# Points this far below are seen through the face: floors, and walls of openings. Light sinks few ribs by more.
SEEN_BELOW_M = 1.5e-3
# Beside what stands up a projector leaves shadows: this far from it nothing is not told from a shadow.
SHADOW_M = 20e-3
# Blur of an edge: a pixel may be half on either side.
BLUR_M = 0.4e-3
# Steps that chances are counted in.
LEVELS = 256
# Points nearer than this share their label's error: they count as one.
INDEPENDENT_M = 1.5e-3
# A cell this far from every edge tells how often nothing returns from solid parts (ribs are 1 mm wide) and open ones.
INSIDE_M, OPEN_M = 0.4e-3, 1.0e-3
# Share of cells without a return that is assumed before any were counted, and how many cells an assumption is worth.
NOTHING, PRIOR_CELLS = 0.3, 20.0
# An open face with more points than this at its height would be none.
MOST_STRAY = 0.15
# What stands up covers so much around its points: they lie this far apart on coarse scans, and walls lean.
AROUND_M = 1.5e-3


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Cells on the plane of a rack's face, frame of its top: place of the first one's centre, side, count."""

    low_m: FloatArray
    cell_m: float
    shape: tuple[int, int]

    @property
    def centers_m(self) -> FloatArray:
        """Centres of the cells, shape (X, Y, 2), metres."""
        axes = [low + self.cell_m * np.arange(n) for low, n in zip(self.low_m, self.shape, strict=True)]
        return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def face_grid(rack: RackModel, spacing_m: float, beyond_m: float) -> Grid:
    """Cells from so far beyond the outline on one side to as far beyond it on the other."""
    # Few sizes, so that what is drawn on a grid is drawn once.
    steps = np.ceil(SPACINGS * spacing_m / CELL_STEP_M) if np.isfinite(spacing_m) else 0.0
    cell_m = max(CELL_M, steps * CELL_STEP_M)
    half = np.ceil((rack.outline_m / 2 + beyond_m) / cell_m).astype(int)
    return Grid(-half * cell_m, float(cell_m), (int(2 * half[0] + 1), int(2 * half[1] + 1)))


def solid_levels(distance_m: FloatArray) -> NDArray[np.uint8]:
    """Chance of cells to be solid, logistic((shift - d) / blur), in `LEVELS` steps; d (K,) their distance, metres."""
    return np.asarray(np.rint((LEVELS - 1) * expit((EDGE_SHIFT_M - distance_m) / BLUR_M)), np.uint8)


class Rates(NamedTuple):
    """What cells do besides showing what they are.

    Attributes:
        hidden: How often nothing returns from a solid cell, by the zones of `Face.zones`.
        dark: How often nothing returns from an open one, likewise: wells are darker than what lies beside a rack.
        stray: How often an open cell looks solid.
        crossed: The same below what stands up: a tube's wall crosses the height of the face.
    """

    hidden: tuple[float, ...]
    dark: tuple[float, ...]
    stray: float
    crossed: float


@dataclass(frozen=True, eq=False)
class Face:
    """What was seen of a face.

    Attributes:
        grid: The cells.
        places_m: Mean place of what was seen in every cell, shape (X, Y, 2), metres; its centre where nothing was.
        solid: Share of the points at the face's height among those at or below it, per cell; NaN where there are none.
        nothing: Cells, between others that have some, in which no line of sight ended at any height.
        standing: Cells above which something stands.
        shaded: Cells beside what stands up, where a projector leaves shadows.
        beyond: Cells outside of the rack's outline.
        weight: How many independent observations one cell is.
    """

    grid: Grid
    places_m: FloatArray
    solid: FloatArray
    nothing: NDArray[np.bool_]
    standing: NDArray[np.bool_]
    shaded: NDArray[np.bool_]
    beyond: NDArray[np.bool_]
    weight: float

    @cached_property
    def seen(self) -> NDArray[np.bool_]:
        """Cells that say solid or open."""
        return np.isfinite(self.solid)

    @cached_property
    def zones(self) -> NDArray[np.uint8]:
        """Zone of every cell, shape (X, Y): 1 more where it is shaded, 2 more where it is beyond the outline."""
        return np.asarray(self.shaded + 2 * self.beyond, np.uint8)

    @cached_property
    def kinds(self) -> NDArray[np.uint8]:
        """What every cell is, shape (X * Y,): its zone, 4 more below what stands up, 8 for nothing; 16 for no news."""
        kinds = np.where(self.seen, self.zones + 4 * self.standing, np.where(self.nothing, 8 + self.zones, 16))
        return np.asarray(kinds.ravel(), np.uint8)

    @cached_property
    def shares(self) -> FloatArray:
        """`solid`, 0 where nothing was seen, shape (X * Y,)."""
        return np.nan_to_num(self.solid).ravel()

    def tables(self, rates: Rates) -> tuple[FloatArray, FloatArray]:
        """Log likelihoods of cells by their kind and their chance of being solid, nats; see `view_kernels.gained`.

        A cell that is solid with the chance s returns nothing with the rate of what it is, and otherwise shows what it
        is, but for a share of wrong ones.
        """
        s = np.arange(LEVELS) / (LEVELS - 1)
        none = np.array(rates.hidden)[:, None] * s + np.array(rates.dark)[:, None] * (1 - s)
        seen = []
        for wrong in (rates.stray, rates.crossed):
            shown = wrong + (1 - WRONG_SHARE - wrong) * s
            seen.append(np.log1p(-none)[:, None] + np.log(np.stack([shown, 1 - shown])))
        return self.weight * np.concatenate(seen), self.weight * np.log(none)

    def log_likelihood(self, distance_m: FloatArray) -> float:
        """Log likelihood of all cells with a hypothesis, nats.

        Args:
            distance_m: Signed distance of every cell's centre from its solid part, shape (X * Y,), metres.
        """
        tables = self.tables(self.rates(distance_m))
        return float(view_kernels.whole(self.kinds, self.shares, solid_levels(distance_m), *tables))

    def rates(self, distance_m: FloatArray) -> Rates:
        """What cells do besides showing what they are, by those of a hypothesis (X * Y,), 2 to 90 %.

        Solid parts return more than openings do. Where they do not, as in the shadows between caps, that nothing
        returned says nothing: both rates are then the same.
        """
        distance_m = distance_m.reshape(self.grid.shape)
        solid, opened = distance_m < -INSIDE_M, distance_m > OPEN_M
        zones = [self.zones == zone for zone in range(4)]
        hidden, dark = (
            [_rate(self.nothing & cells & zone, self.seen & cells & zone, NOTHING) for zone in zones]
            for cells in (solid, opened)
        )
        # Hardly a cell of a rack is solid beyond its outline: those within it tell.
        hidden[2:] = hidden[:2]
        clear, below = opened & self.seen & ~self.standing, opened & self.seen & self.standing
        at = np.nan_to_num(self.solid) > 0.5
        stray, crossed = (_rate(cells & at, cells & ~at, WRONG_SHARE) for cells in (clear, below))
        stray = min(stray, MOST_STRAY)
        return Rates(tuple(map(min, hidden, dark)), tuple(dark), stray, max(crossed, stray))


def _rate(some: NDArray[np.bool_], others: NDArray[np.bool_], expected: float) -> float:
    yes, no = np.count_nonzero(some), np.count_nonzero(others)
    return float(np.clip((yes + expected * PRIOR_CELLS) / (yes + no + PRIOR_CELLS), 0.02, 0.90))


def look_at_face(
    points_m: FloatArray, T_camera_rack: FloatArray, rack: RackModel, window_m: float, grid: Grid, spacing_m: float
) -> Face:
    """Lay points (N, 3), camera frame, on the cells of a rack's face.

    Args:
        points_m: The points; of a bowed rack those that were laid flat.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
        rack: The rack.
        window_m: Points this near to the face's height are of it.
        grid: The cells.
        spacing_m: How far apart points lie.
    """
    T = top_frame(T_camera_rack, rack)
    counts, sums = view_kernels.face_cells(
        np.ascontiguousarray(points_m, float), *parts(T), camera_place(T), grid.low_m, grid.cell_m, grid.shape,
        window_m, max(SEEN_BELOW_M, 2 * window_m),
    )  # fmt: skip
    at, below, above, other, standing = counts
    told = at + below
    # A cell that is half hidden shows an edge of what hides it.
    clear = (told > 0) & (above <= told)
    solid = np.where(clear, at / np.maximum(told, 1), np.nan)
    empty = (told + above + other) == 0
    nothing, shaded = empty & _surrounded(~empty), _beside(above > told, grid.cell_m)
    independent = min(1.0, (max(grid.cell_m, spacing_m) / INDEPENDENT_M) ** 2)
    beyond = np.any(np.abs(grid.centers_m) > rack.outline_m / 2, axis=-1)
    places = np.where(clear[..., None], sums.transpose(1, 2, 0) / np.maximum(told, 1)[..., None], grid.centers_m)
    return Face(grid, places, solid, nothing, _footprint(standing > 0, grid.cell_m), shaded, beyond, independent)


def _footprint(standing: NDArray[np.bool_], cell_m: float) -> NDArray[np.bool_]:
    """Cells over which something stands, and those right beside them; single points are stray ones."""
    core = cv2.morphologyEx(standing.astype(np.uint8), cv2.MORPH_OPEN, np.ones((2, 2), np.uint8))
    return cv2.distanceTransform(1 - core, cv2.DIST_L2, 3) * cell_m < AROUND_M if core.any() else core.astype(bool)


def _beside(standing: NDArray[np.bool_], cell_m: float) -> NDArray[np.bool_]:
    """Cells nearer than `SHADOW_M` to what stands up; single cells of it are stray points."""
    core = cv2.morphologyEx(standing.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    return cv2.distanceTransform(1 - core, cv2.DIST_L2, 3) * cell_m < SHADOW_M if core.any() else core.astype(bool)


def _surrounded(some: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells within the convex hull of those that have something: beyond it the image may have ended."""
    rows = np.flatnonzero(some.any(axis=1))
    inside = np.zeros(some.shape, np.uint8)
    if len(rows):
        # The first and the last cell of every row have the hull of all of them.
        first, last = some[rows].argmax(axis=1), some.shape[1] - 1 - some[rows, ::-1].argmax(axis=1)
        ends = np.stack([np.concatenate([first, last]), np.concatenate([rows, rows])], axis=1)
        cv2.fillConvexPoly(inside, cv2.convexHull(ends.astype(np.int32)), 1)
    return inside.astype(bool)
