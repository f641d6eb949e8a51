"""How well points agree with a rack's pose, and why a pose is not believed (method `edges`).

A wrong rack, or one in a wrong place, has points in its openings, lines of sight through its ribs, or explains no
more than another place would. Points in openings are counted in a thin layer at the height of the top: it
has all of the ribs, and little of a tube's wall that crosses it or of light in a well.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from tubepose.config import RackConfig
from tubepose.labware import RackModel
from tubepose.rack import view_kernels as view_kernels
from tubepose.rack.evidence import evidence_of
from tubepose.rack.field import PICTURE_M, picture, top_field
from tubepose.rack.fit import LEAST_POINTS, Fit, RoughFit, camera_place, label, rack_frame, top_frame
from tubepose.transforms import FloatArray, parts

# Half thickness of the layer that is judged: the standard deviation of heights, but at least that of a good sensor, and
# no more than the layer that a tube's wall fills with few points.
JUDGED_M = (0.3e-3, 0.6e-3)
# Heights that tell how rough a scan is.
SCATTER_M = 2.5e-3
# The same where tops of tubes hold the rack: most of what shows between them is what stray light has lifted or sunk.
HELD_SCATTER_M = 1.0e-3
# A top that goes on across its outline is another; a rack that stands beside it may be this near.
BORDER_M = 3.5e-3
# Points nearer than this share their label's error: they count as one.
INDEPENDENT_M = 1.5e-3
STRIP_POINTS = 3000
SPACING_SAMPLE = 300


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """How well points agree with a pose.

    Attributes:
        rmse_m: RMS distance of the points near the top to its solid part, metres; the part along the normal from the
            median of all heights within `SCATTER_M`, so that it tells a rough scan from a good one with stray light;
            within `HELD_SCATTER_M` where tubes hold the rack: a rough scan has no tops that hold one.
        fitness: Share of the points at its height that are near its solid part.
        in_slot: Share of them that lie in its openings.
        coverage: Share of its solid part that has points.
        evidence: How much likelier the points are with the rack there than anywhere, nats of independent points.
        slot_margin: The same less that of the likeliest pose a slot farther along the rows, columns or diagonals.
        step_m: Where that pose's top lies, in the frame of this one's, shape (2,), metres.
        spacing_m: Median distance of neighbouring points at the top's height.
        outside: Share of the points at its height that lie just outside the outline.
        unseen: Share of the solid part near which there are no points at all, neither on, nor above, nor below it.
    """

    rmse_m: float = float("nan")
    fitness: float = 0.0
    in_slot: float = 1.0
    coverage: float = 0.0
    evidence: float = 0.0
    slot_margin: float = 0.0
    step_m: tuple[float, float] = (0.0, 0.0)
    spacing_m: float = float("nan")
    outside: float = 0.0
    unseen: float = 0.0

    def evidence_at(self, spacing_m: float) -> float:
        """The evidence, had the points been measured to lie this far apart: to be compared with a fit that found so."""
        return self.evidence * _alike(spacing_m) / _alike(self.spacing_m) if self.evidence else 0.0


def measure_agreement(points_m: FloatArray, fit: Fit, rack: RackModel, config: RackConfig) -> Agreement:
    """Compare points (N, 3), camera frame, with a fit."""
    points_m = np.ascontiguousarray(points_m, float)
    window_m = float(np.clip(fit.scatter_m, *JUDGED_M))
    seen = label(points_m, fit.T_camera_rack, rack, window_m)
    top = top_field(rack)
    distance, _, known = top.look_up(seen.solid_m)
    solid, distance = seen.solid_m[known], distance[known]
    if len(solid) < LEAST_POINTS or not np.any(distance < 0):
        return Agreement()
    near = distance < config.judge_distance_m
    beyond = np.max(np.abs(solid[:, :2]) - rack.outline_m / 2, axis=1)
    stray = distance > config.edge_margin_m
    height_m = SCATTER_M if fit.level is None else HELD_SCATTER_M
    ribs = top.on_solid(points_m, top_frame(fit.T_camera_rack, rack), height_m)
    spacing_m = _spacing(ribs[:, :2])
    scatter_m = float(1.4826 * np.median(np.abs(ribs[:, 2])))
    evidence, beside, step_m = evidence_of(seen, rack)
    alike = _alike(spacing_m)
    return Agreement(
        rmse_m=float(np.hypot(scatter_m, np.sqrt(np.mean(np.maximum(distance[near], 0) ** 2)))),
        fitness=float(np.mean(near)),
        in_slot=float(np.mean(stray[beyond <= 0])) if np.any(beyond <= 0) else 1.0,
        outside=float(np.mean(stray & (beyond > 0) & (beyond < BORDER_M))),
        coverage=coverage(solid, rack),
        unseen=_unseen(points_m, fit, rack),
        evidence=evidence * alike,
        slot_margin=(evidence - beside) * alike,
        step_m=step_m,
        spacing_m=spacing_m,
    )


def rough_evidence(points_m: FloatArray, rough: RoughFit, spacing_m: float, rack: RackModel) -> float:
    """The evidence of a rough fit among points (N, 3), camera frame, that lie `spacing_m` apart."""
    window_m = float(np.clip(rough.scatter_m, *JUDGED_M))
    evidence, _, _ = evidence_of(label(points_m, rack_frame(rough, rack), rack, window_m), rack)
    return evidence * _alike(spacing_m)


def _alike(spacing_m: float) -> float:
    """For how many independent points one stands, at most 1."""
    return min(1.0, (spacing_m / INDEPENDENT_M) ** 2)


def _unseen(points_m: FloatArray, fit: Fit, rack: RackModel) -> float:
    shape = np.ceil(rack.outline_m / (4 * PICTURE_M)).astype(int)
    T = top_frame(fit.T_camera_rack, rack)
    step = len(points_m) // 10_000 + 1
    hit = view_kernels.cells_crossed(points_m, step, *parts(T), camera_place(T), rack.outline_m, shape)
    return float(1 - hit.mean())


def coverage(solid_m: FloatArray, rack: RackModel) -> float:
    """Share of the cells of a rack's solid part that have one of the points (N, 2 or more), frame of its top."""
    top = picture(rack)
    half = np.array(top.shape) // 2
    i, j = np.rint(solid_m[:, 0] / PICTURE_M) + half[0], np.rint(solid_m[:, 1] / PICTURE_M) + half[1]
    inside = (i >= 0) & (i < top.shape[0]) & (j >= 0) & (j < top.shape[1])
    cells = (i * top.shape[1] + j)[inside].astype(np.intp)
    return float(np.mean(np.bincount(cells, minlength=top.size)[top.ravel() > 0] > 0))


def _spacing(points_m: FloatArray) -> float:
    """Median distance to the nearest neighbour, in a strip of points (N, 2) through their middle."""
    if len(points_m) > STRIP_POINTS:
        first = (len(points_m) - STRIP_POINTS) // 2
        order = np.argpartition(points_m[:, 0], [first, first + STRIP_POINTS - 1])
        points_m = points_m[order[first : first + STRIP_POINTS]]
    tree = cKDTree(points_m, balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(points_m[:: len(points_m) // SPACING_SAMPLE + 1], k=2)
    return float(np.median(np.asarray(distance)[:, 1]))


def outline_fits(seen: Agreement, config: RackConfig) -> bool:
    """Whether the top ends where the rack's does, and is there as a whole; if not, the rack is not found."""
    return seen.outside <= config.max_outside_share and seen.unseen <= config.max_unseen_share
