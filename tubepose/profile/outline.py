"""Middle of every top's circle, from where it ends: in sectors around it, all tubes at once.

A closed top is a disc of points with its depth; a rim is a bright ring in the image, whatever its depth says. Each
sector of the circle gives the radius at which it ends (or at which the ring is brightest), and the circle's offset and
widening follow by robust least squares: radius_s = R + widening + offset . n_s + ellipse cos(2 phi) + ...
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.config import ProfileConfig
from tubepose.profile.outline_kernels import COARSE_BAND_M, circle_rounds, sector_ends
from tubepose.transforms import FloatArray

SECTORS = 24
ANGLES = (np.arange(SECTORS) + 0.5) / SECTORS * 2 * np.pi - np.pi
NORMALS: FloatArray = np.column_stack([np.cos(ANGLES), np.sin(ANGLES)])
DESIGN: FloatArray = np.column_stack([NORMALS, np.ones(SECTORS), np.cos(2 * ANGLES), np.sin(2 * ANGLES)])
"""Offset along x and y, widening, and the two parts of an ellipse, as they change the radius of a sector."""
WIDTHS_M = ((2.0e-3, 2.0e-3), (1.2e-3, 1.2e-3), (0.8e-3, 0.9e-3))
"""How far inside and outside of the circle a sector's end is looked for, round by round."""
MAX_STD_M = 1.0e-3
"""A circle that is not known better than this is not known."""
OUTLINE_DEPTH_M = WIDTHS_M[0][0] + COARSE_BAND_M
"""Points farther inside of a circle than this do not count, the start's own error included."""


@dataclass(frozen=True, slots=True, eq=False)
class Circles:
    """Circles of tops, one per tube.

    Attributes:
        offset_m: From the centre that was given to the circle's, shape (T, 2), metres; NaN where it is not seen.
        covariance_m2: Of the offset, shape (T, 2, 2).
        widening_m: How much larger than its definition the circle is, shape (T,), metres.
        sectors: Share of the sectors that count, shape (T,).
    """

    offset_m: FloatArray
    covariance_m2: FloatArray
    widening_m: FloatArray
    sectors: FloatArray

    def take(self, keep: NDArray[np.bool_] | NDArray[np.intp]) -> Circles:
        """The same of some of the tubes."""
        return Circles(self.offset_m[keep], self.covariance_m2[keep], self.widening_m[keep], self.sectors[keep])

    def where(self, mine: NDArray[np.bool_], other: Circles) -> Circles:
        """These circles where `mine`, shape (T,), is True, the other's elsewhere."""
        return Circles(
            np.where(mine[:, None], self.offset_m, other.offset_m),
            np.where(mine[:, None, None], self.covariance_m2, other.covariance_m2),
            np.where(mine, self.widening_m, other.widening_m),
            np.where(mine, self.sectors, other.sectors),
        )

    def put(self, at: NDArray[np.intp], other: Circles) -> Circles:
        """These circles with those at some places taken from another, in its order."""
        order = np.zeros(len(self.sectors), np.intp)
        order[at] = np.arange(len(at))
        chosen = np.zeros(len(self.sectors), bool)
        chosen[at] = True
        return other.take(order).where(chosen, self) if len(at) else self


def unknown_circles(count: int) -> Circles:
    """Circles that nothing is known of."""
    return Circles(
        np.full((count, 2), np.nan), np.tile(np.eye(2), (count, 1, 1)), np.full(count, np.nan), np.zeros(count)
    )


def fit_discs(
    label: NDArray[np.intp],
    offset_m: FloatArray,
    radius_m: FloatArray,
    blocked: NDArray[np.bool_],
    config: ProfileConfig,
) -> Circles:
    """Middle of discs that are full of points.

    Args:
        label: Tube of each point of a top, shape (N,).
        offset_m: Its offset from the centre assumed so far, in the top's plane, shape (N, 2), metres.
        radius_m: Radius of each disc, shape (T,).
        blocked: Sectors where another top is so near that the end is not seen, shape (T, SECTORS).
        config: Noise of outlines.
    """
    count = len(radius_m)
    shift = np.zeros((count, 2))
    circles = None
    for inside_m, outside_m in WIDTHS_M:
        inside_m += config.edge_ramp_m  # a ramp lies below the top's plane: its disc ends that much farther in
        end_m, seen, counting_m = sector_ends(label, offset_m, shift, radius_m, inside_m, outside_m, SECTORS)
        sigma_m = np.hypot(config.outline_noise_m, counting_m)
        circles = fit_circles(end_m - radius_m[:, None], seen & ~blocked, config, sigma_m, config.outline_bias_m)
        shift += np.nan_to_num(circles.offset_m)
    assert circles is not None
    return Circles(
        np.where(np.isfinite(circles.offset_m), shift, np.nan),
        circles.covariance_m2,
        circles.widening_m,
        circles.sectors,
    )


def fit_circles(
    excess_m: FloatArray,
    seen: NDArray[np.bool_],
    config: ProfileConfig,
    sigma_m: float | FloatArray,
    bias_m: float,
) -> Circles:
    """Offset and widening of circles from the excess radius of their sectors, shape (T, SECTORS), metres.

    A projector at one side blurs a circle's ends less along the baseline than across it, which looks like an ellipse:
    two more unknowns with a prior. Weights are Huber's. The noise `sigma_m` is one for all circles or one each, (T,);
    where the sectors scatter more, the circle is known so much worse: they are then seldom independent.
    """
    sigma = np.array(np.broadcast_to(np.asarray(sigma_m, float), len(excess_m)))
    prior = np.diag([0.0, 0.0, *np.full(3, config.widening_m**-2)])
    solution, covariance, squares, counts = circle_rounds(excess_m, seen, sigma, DESIGN, prior, SECTORS // 4)
    scatter = squares / np.maximum(counts - 3, 1)
    covariance = covariance + np.eye(2) * bias_m**2
    covariance *= np.maximum(scatter / sigma**2, 1.0)[:, None, None]
    usable = (counts >= SECTORS // 4) & (np.trace(covariance, axis1=1, axis2=2) < MAX_STD_M**2)
    return Circles(np.where(usable[:, None], solution[:, :2], np.nan), covariance, solution[:, 2], counts / SECTORS)
