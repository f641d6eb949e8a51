"""What a scan says of a rack's sizes: pitch, openings and outline, each measured beside its pose.

One logistic regression over the cells of the face (`size_kernels`): where an edge is, the share of cells that are solid
goes from one to zero. Edges of openings and of the outline that a sensor's blur moves go outwards alike: what counts is
how they differ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.labware import RackModel
from tubepose.rack import size_kernels
from tubepose.rack.alternatives import own_distance_m, squares
from tubepose.rack.face import INSIDE_M, Face
from tubepose.rack.field import GRID_M, openings_field, outline_field
from tubepose.rack.tops_in_slots import TopsInSlots
from tubepose.transforms import FloatArray

# Blurs of the rounds, and how many rounds each has: the first reaches over the width of a rib.
BLURS_M = np.array([1.2e-3, 0.4e-3])
ROUNDS = 3
# What the unknowns may be, standard deviations, and how far one step of the scoring goes.
PRIOR_STD = np.array([5e-3, 0.7e-3, 0.7e-3, 0.03, 0.03, 1.5e-3, 1.5e-3, 1.5e-3])
LONGEST = np.array([5e-3, 0.7e-3, 0.7e-3, 0.01, 0.01, 0.7e-3, 0.7e-3, 0.7e-3])
# Cells this far beyond an edge are of no use.
REACH_M = 6e-3
CLUSTER_M = 20e-3
# Where ribs are missed their edges are those of what is missed, which no square knows of: standard deviations grow by
# this times the share that is missed. (Chosen on one REAL scan, a quarter of whose face is missing.)
PATCHY = 10.0
# Where more of the solid cells beside what stands up return nothing, edges there are those of shadows.
MOST_HIDDEN = 0.12
# In squares where more of the solid part returns nothing, that says nothing of where its edges are: ribs are missed.
MOST_MISSED = 0.35


@dataclass(frozen=True, slots=True, eq=False)
class FaceSize:
    """Sizes of a face, as measured less as defined.

    Attributes:
        stretch: By how much slots lie farther apart along x and y, shape (2,), shares.
        openings_m: How far outside of its place every edge of the openings is: they are wider by twice that, metres.
        outline_m: How far outside of its place the outline is on every side, along x and along y, shape (2,), metres.
        covariance: Of these five in this order, shape (5, 5).
    """

    stretch: FloatArray
    openings_m: float
    outline_m: FloatArray
    covariance: FloatArray

    @property
    def std(self) -> FloatArray:
        """Standard deviations of the five, shape (5,)."""
        return np.sqrt(np.diag(self.covariance))

    def wider_openings_m(self) -> tuple[float, float]:
        """How much farther out the openings' edges are than the outline's say, value and standard deviation, metres."""
        pick = np.array([0, 0, 1.0, 0.5, 0.5])
        value = self.openings_m + float(self.outline_m.mean())
        return value, float(np.sqrt(pick @ self.covariance @ pick))

    def scale(self, rack: RackModel, edge_std_m: float) -> tuple[float, float]:
        """One stretch of pitch and outline by least squares, a share, and its standard deviation.

        Args:
            rack: The rack.
            edge_std_m: How far blur moves an outline's edge, metres: its part is as sure as that.
        """
        half = rack.outline_m / 2
        values = np.concatenate([self.stretch, self.outline_m / half])
        covariance = self.covariance[np.ix_([0, 1, 3, 4], [0, 1, 3, 4])] / np.outer([1, 1, *half], [1, 1, *half])
        covariance = covariance + np.diag([0, 0, *(edge_std_m / half) ** 2])
        weights = np.linalg.solve(covariance, np.ones(4))
        return float(weights @ values / weights.sum()), float(weights.sum() ** -0.5)

    def with_tops(self, tops: TopsInSlots) -> FaceSize:
        """The same, its stretch weighed with that of tops in the slots (inverse variances, axis by axis)."""
        # What the tops say of the stretch, as one more measurement of each: Kalman's update.
        mean = np.concatenate([self.stretch, [self.openings_m], self.outline_m])
        covariance = self.covariance
        for axis in range(2):
            if np.isfinite(tops.std[axis]):
                gain = covariance[:, axis] / (covariance[axis, axis] + tops.std[axis] ** 2)
                mean = mean + gain * (tops.stretch[axis] - mean[axis])
                covariance = covariance - np.outer(gain, covariance[axis])
        return FaceSize(mean[:2], float(mean[2]), mean[3:], covariance)

    def quarter_turned(self) -> FaceSize:
        """The same with x and y changed."""
        order = [1, 0, 2, 4, 3]
        covariance = self.covariance[np.ix_(order, order)]
        return FaceSize(self.stretch[::-1], self.openings_m, self.outline_m[::-1], covariance)


def _patchy(face: Face, own_m: FloatArray) -> NDArray[np.bool_]:
    """Cells (X, Y) of the squares in which much of a rack's solid part is missed."""
    square, count = squares(face.grid)
    solid = own_m < -INSIDE_M
    none, some = (
        np.bincount(square, (cells.ravel() & solid).astype(float), count) for cells in (face.nothing, face.seen)
    )
    return np.asarray((none > MOST_MISSED * (none + some))[square].reshape(face.grid.shape))


def measure_size(face: Face, rack: RackModel) -> FaceSize:
    """Measure a face; what is not seen stays as defined, with the prior's standard deviation.

    Args:
        face: Its cells, in the frame of the rack's pose.
        rack: The rack.
    """
    xy, inner, outline = face.grid.centers_m, openings_field(rack), outline_field(rack)
    own_m = own_distance_m(rack, face.grid)
    rates = face.rates(own_m)
    missed = np.where(face.seen, 0.0, np.take(rates.hidden, face.zones))
    told = face.seen | (face.nothing & ~_patchy(face, own_m))
    near = told & np.all(np.abs(xy) < rack.outline_m / 2 + REACH_M, axis=-1)
    if rates.hidden[1] > MOST_HIDDEN:
        near &= ~face.shaded
    wrong = np.where(face.standing, rates.crossed, rates.stray)
    prior = PRIOR_STD**-2.0
    found, information, products, count = size_kernels.sizes(
        face.places_m[near], np.nan_to_num(face.solid[near]), missed[near], wrong[near], face.shaded[near], face.weight,
        BLURS_M, ROUNDS, prior, LONGEST, CLUSTER_M, inner.low_m, GRID_M, inner.shape, inner.table, outline.table,
    )  # fmt: skip
    inverse = np.linalg.inv(information)
    spread = inverse @ products @ inverse * (count / max(count - len(found), 1))
    # Where few squares are seen, their scatter says little: never less than the likelihood says.
    wider = np.maximum(np.sqrt(np.diag(spread) / np.diag(inverse)), 1.0) * (1 + PATCHY * rates.hidden[0])
    scaled = inverse * np.outer(wider, wider)
    return FaceSize(found[3:5], float(found[5]), found[6:8], scaled[3:, 3:])
