"""Registration of a square template onto the points of a square (paper, section V-A).

An ICP whose template is the square's outline: each round the outermost points of narrow strips find their edge, and
the square moves by least squares. The interior says nothing about the centre, and a template of filled points would
be drawn to the side where points are dense. The known size tells strips that are whole from strips that have lost an
end to a shadow; lost ends are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tubepose.ground_truth.model import GroundTruthConfig
from tubepose.transforms import FloatArray

_SIDES = (-1, 1)


@dataclass(frozen=True, slots=True, eq=False)
class SquareFit:
    """A square in its plane.

    Attributes:
        center_m: Centre, shape (2,), metres.
        turn_rad: Turn of its edges, in [-pi/4, pi/4]: it has four equal answers.
        icp_rms_m: RMS distance of the edge points to the template's edges, metres.
        coverage: Share of the square with points, 0 to 1.
        loss_m: Missing width that no higher neighbour explains, metres, the worse of both directions.
    """

    center_m: FloatArray
    turn_rad: float
    icp_rms_m: float
    coverage: float
    loss_m: float

    def to_square(self, xy_m: FloatArray) -> FloatArray:
        """Points (N, 2) of the plane frame in the square's own: origin at its centre, axes along its edges, metres."""
        return _to_local(xy_m, self.center_m, self.turn_rad)


@dataclass(frozen=True, slots=True, eq=False)
class _Edges:
    """Edge points of one round: rows of the linear system about (du, dv, dturn), and the unexplained loss."""

    rows: FloatArray
    residuals_m: FloatArray
    loss_m: float


def point_spacing_m(xy_m: FloatArray) -> float:
    """Median distance of points (N, D) to their nearest neighbour, metres."""
    distances, _ = cKDTree(xy_m).query(xy_m, k=[2])
    return float(np.median(distances))


def fit_square(xy_m: FloatArray, higher_xy_m: FloatArray, side_m: float, config: GroundTruthConfig) -> SquareFit:
    """Register a square of known side onto points of its plane.

    Args:
        xy_m: Points of the square, shape (N, 2), plane frame, metres.
        higher_xy_m: Points of the surroundings that stand higher than the plane, shape (M, 2), same frame, metres.
        side_m: Side of the square, metres.
        config: Thresholds.
    """
    center, turn = _start(xy_m)
    spacing = point_spacing_m(xy_m)
    edges = _Edges(np.empty((0, 3)), np.empty(0), side_m)
    for _ in range(config.icp_iterations):
        local, higher = _to_local(xy_m, center, turn), _to_local(higher_xy_m, center, turn)
        edges = _edges(local, higher, side_m, spacing, config)
        if len(edges.rows) < 3:
            break
        step = _robust_step(edges, spacing)
        center = center + _rotation(turn) @ step[:2]
        turn += float(step[2])
        if np.abs(step[:2]).max() < 1e-7 and abs(step[2]) < 1e-7:
            break
    rms = float(np.sqrt(np.mean(edges.residuals_m**2))) if len(edges.residuals_m) else float("nan")
    return SquareFit(
        center_m=center,
        turn_rad=turn,
        icp_rms_m=rms,
        coverage=_coverage(_to_local(xy_m, center, turn), side_m, spacing),
        loss_m=edges.loss_m,
    )


def _start(xy_m: FloatArray) -> tuple[FloatArray, float]:
    """Centre and turn of the smallest rectangle, in millimetres for the single precision of OpenCV."""
    (u, v), _, angle_deg = cv2.minAreaRect((xy_m * 1e3).astype(np.float32))
    turn = np.deg2rad((angle_deg + 45) % 90 - 45)
    return np.array([u, v]) * 1e-3, float(turn)


def _rotation(turn_rad: float) -> FloatArray:
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    return np.array([[c, -s], [s, c]])


def _to_local(xy_m: FloatArray, center_m: FloatArray, turn_rad: float) -> FloatArray:
    return np.asarray((xy_m - center_m) @ _rotation(turn_rad))


def _strip_ends(local_m: FloatArray, axis: int, half_m: float, width_m: float) -> tuple[FloatArray, FloatArray]:
    """Both ends of the strips along an axis: middles of the strips (K,) and ends (K, 2), metres.

    Strips next to the corners are left out: a small turn cuts them short.
    """
    along, across = local_m[:, axis], local_m[:, 1 - axis]
    count = max(4, int(2 * half_m / width_m))
    strip = np.floor((across + half_m) / (2 * half_m) * count).astype(int)
    low, high = np.full(count, np.inf), np.full(count, -np.inf)
    known = (strip >= 1) & (strip < count - 1) & (np.abs(along) < half_m + 4 * width_m)
    np.minimum.at(low, strip[known], along[known])
    np.maximum.at(high, strip[known], along[known])
    middles = (np.arange(count) + 0.5) / count * 2 * half_m - half_m
    seen = high > low
    return middles[seen], np.column_stack([low, high])[seen]


def _edges(
    local_m: FloatArray, higher_m: FloatArray, side_m: float, spacing_m: float, config: GroundTruthConfig
) -> _Edges:
    """Edge points of all four sides, without the ends that a shadow took."""
    half = side_m / 2
    strips = [_strip_ends(local_m, axis, half, 1.5 * spacing_m) for axis in (0, 1)]
    missing = [side_m - np.median(ends[:, 1] - ends[:, 0]) if len(ends) else side_m for _, ends in strips]
    # The outermost pixel centre lies inside the edge by up to a spacing; the less covered direction may have lost more.
    usual = float(np.clip(min(missing), 0, 1.2 * spacing_m))
    rows, residuals, losses = [], [], []
    for axis, (middles, ends) in enumerate(strips):
        sides, whole, loss = _trusted(ends, axis, higher_m, side_m, usual, spacing_m, config)
        losses.append(loss)
        for side in sides:
            edge = side * (half - usual / 2)
            end = ends[whole, max(side, 0)]
            rows.append(np.zeros((len(end), 3)))
            rows[-1][:, axis] = 1
            rows[-1][:, 2] = -middles[whole] if axis == 0 else middles[whole]
            residuals.append(end - edge)
    return _Edges(np.concatenate(rows), np.concatenate(residuals), max(losses))


def _trusted(
    ends_m: FloatArray,
    axis: int,
    higher_m: FloatArray,
    side_m: float,
    usual_m: float,
    spacing_m: float,
    config: GroundTruthConfig,
) -> tuple[tuple[int, ...], NDArray[np.bool_], float]:
    """Sides of one direction to believe, the strips to believe there, and the loss of width that stays unexplained."""
    if len(ends_m) == 0:
        return (), np.zeros(0, dtype=bool), side_m
    lost = side_m - (ends_m[:, 1] - ends_m[:, 0]) - usual_m
    whole = np.abs(lost) <= 0.6 * spacing_m + config.edge_tolerance_m
    if whole.mean() >= 0.35:
        return _SIDES, whole, 0.0
    loss = float(np.median(lost)) - 0.5 * spacing_m
    across = np.abs(higher_m[:, 1 - axis]) < side_m / 2
    along = higher_m[across, axis]
    at_risk = [
        side for side in _SIDES if np.sum(np.abs(side * along - side_m / 2 - config.reach_m / 2) < config.reach_m) >= 5
    ]
    if len(at_risk) == 1:
        return (-at_risk[0],), np.ones(len(ends_m), dtype=bool), 0.0
    return _SIDES, np.ones(len(ends_m), dtype=bool), max(loss, 0.0)


def _robust_step(edges: _Edges, spacing_m: float) -> FloatArray:
    """Least-squares move (du, dv, dturn) with Huber weights: single strips end on a mixed pixel."""
    scale = 0.5 * spacing_m
    weights = np.minimum(1.0, scale / np.maximum(np.abs(edges.residuals_m - np.median(edges.residuals_m)), 1e-9))
    root = np.sqrt(weights)
    step, *_ = np.linalg.lstsq(edges.rows * root[:, None], edges.residuals_m * root, rcond=None)
    return np.asarray(np.clip(step, [-5e-3, -5e-3, -0.1], [5e-3, 5e-3, 0.1]))


def _coverage(local_m: FloatArray, side_m: float, spacing_m: float) -> float:
    """Share of a regular grid on the square, its edge included, that has a point within 1.5 spacings."""
    steps = np.linspace(-side_m / 2, side_m / 2, max(5, int(np.ceil(side_m / spacing_m))))
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    distances, _ = cKDTree(local_m).query(grid)
    return float(np.mean(distances <= 1.5 * spacing_m))
