"""Probability that a stated pose of a tube is right: its covariance, integrated over what counts as right.

Right is an answer whose axis is within 2 deg of the true one, and whose bottom is within 2 mm of the true one across
the axis, and along it where the capture tells that: a height that is only known from labware files does not count.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm, qmc

from tubepose.transforms import FloatArray

WITHIN_M = 2.0e-3
"""A gripper's jaws and a needle still meet a tube that is off by this."""
WITHIN_RAD = float(np.deg2rad(2.0))
"""A tube of 100 mm that leans by this is 3.5 mm off at its other end."""
KNOWN_ALONG_M = 1.0e-3
"""A position along the axis with a larger standard deviation is not known: half of what counts as right."""
POWER = 11
"""Two to this many samples: steps of 0.0005, which is less than what a calibration of some thousand tubes can show."""


def confidence(covariance: FloatArray) -> FloatArray:
    """Probability that poses are right, by quasi-random (Sobol) samples of their Gaussian, the same ones every time.

    Args:
        covariance: Of poses, shape (T, 5, 5), over small turns about the tube's x and y and shifts along its x, y, z at
            its bottom, rad and metres.

    Returns:
        Shape (T,), 0 to 1; NaN where a covariance is not finite.
    """
    covariance = np.asarray(covariance, dtype=float).reshape(-1, 5, 5)
    finite = np.isfinite(covariance).all(axis=(1, 2))
    found = np.full(len(covariance), np.nan)
    if not finite.any():
        return found
    values, vectors = np.linalg.eigh(covariance[finite])
    root = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    errors = np.einsum("tij,nj->tin", root, _normal_samples())
    tilt, lateral = np.hypot(errors[:, 0], errors[:, 1]), np.hypot(errors[:, 2], errors[:, 3])
    std_along_m = np.sqrt(covariance[finite, 4, 4])[:, None]
    found[finite] = within(tilt, lateral, errors[:, 4], std_along_m).mean(axis=1)
    return found


def within(
    tilt_rad: FloatArray, lateral_m: FloatArray, axial_m: FloatArray, std_along_m: FloatArray
) -> NDArray[np.bool_]:
    """Whether errors count as right; arrays of one shape, or of shapes that broadcast.

    Args:
        tilt_rad: Angle between the axes.
        lateral_m: Distance of the bottoms across the axis, metres.
        axial_m: The same along it, signed or not, metres.
        std_along_m: Stated standard deviation along the axis, metres; NaN counts as known.
    """
    along = (np.abs(axial_m) <= WITHIN_M) | (std_along_m > KNOWN_ALONG_M)
    return np.asarray((tilt_rad <= WITHIN_RAD) & (lateral_m <= WITHIN_M) & along)


@lru_cache(maxsize=1)
def _normal_samples() -> FloatArray:
    """Samples of a standard normal in five dimensions, shape (2 ** POWER, 5)."""
    points = qmc.Sobol(5, scramble=False).random_base2(POWER)
    return np.asarray(norm.ppf(points + 0.5 / len(points)))
