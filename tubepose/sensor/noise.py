"""Noise of a depth sensor: what it does to a point, and to a plane through a disc of points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tubepose.config import SensorConfig

TABLE, RACK_TOP, CAPS, PRIOR = "table", "rack_top", "caps", "prior"
"""Where a number is from: the level surface beside the rack, the solid part of its top, caps, or an assumption."""


@dataclass(frozen=True, slots=True)
class DiscNoise:
    """What was measured on discs of one radius.

    Attributes:
        radius_m: Radius of the discs at the reference distance.
        slope_std: Standard deviation of each slope of a least-squares plane through such a disc.
        height_std_m: Standard deviation of such a disc's mean height.
        n_discs: How many discs.
        relative_std: How well the slope's is known: one standard deviation, as a share of it. The height's, of half as
            many values, is known 1.4 times less well.
    """

    radius_m: float
    slope_std: float
    height_std_m: float
    n_discs: int
    relative_std: float


@dataclass(frozen=True, slots=True)
class SensorNoise:
    """Noise of depth along a surface's normal, at a reference distance.

    The noise lives in pixels: at another distance the same pixels span more or less of a surface, and their errors
    grow with the distance. (28 REAL RealSense D405 and 40 D435 pairs: 0.40 to 0.45 % of the distance.)

    Attributes:
        independent_m: Standard deviation of a point's own error, metres.
        independent_relative_std: How well that is known, as a share of it; NaN of a prior.
        shared_m: Standard deviation of the error that neighbours share, metres.
        shared_relative_std: How well that is known, as a share of it; NaN of a prior.
        correlation_m: Distance at which the correlation of the shared error is 1/e, metres.
        spacing_m: Distance of neighbouring points: root of the area per point, metres.
        outlier_share: Share of points that lie far off the surface that they are of.
        edge_blur_px: Valid pixels between the two flat sides of a depth step.
        edge_std_px: How well that is known; NaN of a prior.
        distance_m: Reference depth along the optical axis, metres.
        discs: What was measured directly, radius by radius; may be empty.
        n_patches: How many discs of the radius that has most, or how many independent patches of the rack's top.
        source: Where independent and shared error, correlation, spacing and discs are from.
        outlier_source: Where the share of outliers is from.
        edge_source: Where the blur of edges is from: `rack_outline`, or `prior`.
        note: What a reader must know, e.g. that two surfaces contradict each other; may be empty.
    """

    independent_m: float
    independent_relative_std: float
    shared_m: float
    shared_relative_std: float
    correlation_m: float
    spacing_m: float
    outlier_share: float
    edge_blur_px: float
    edge_std_px: float
    distance_m: float
    discs: tuple[DiscNoise, ...] = ()
    n_patches: int = 0
    source: str = PRIOR
    outlier_source: str = PRIOR
    edge_source: str = PRIOR
    note: str = ""

    @property
    def depth_std_m(self) -> float:
        """Standard deviation of one point's depth, its own error and the shared one, metres."""
        return float(np.hypot(self.independent_m, self.shared_m))

    def scaled(self, share: float) -> SensorNoise:
        """The same noise, all errors of depth so many times as large."""
        discs = tuple(
            replace(disc, slope_std=share * disc.slope_std, height_std_m=share * disc.height_std_m)
            for disc in self.discs
        )
        return replace(self, independent_m=share * self.independent_m, shared_m=share * self.shared_m, discs=discs)

    def slope_std(self, radius_m: float, distance_m: float) -> float:
        """Standard deviation of each slope of a least-squares plane through a disc of points.

        The directly measured values, with the noise model between them and beyond them.

        Args:
            radius_m: Radius of the disc, metres.
            distance_m: Its depth along the optical axis, metres.
        """
        radius = radius_m * self._nearer(distance_m)
        measured = [(disc.radius_m, disc.slope_std / self._model_slope(disc.radius_m)) for disc in self.discs]
        # Errors grow with the distance as the pixels' footprint does: the slope of equal pixels stays.
        return self._model_slope(radius) * _between(radius, measured)

    def height_std_m(self, radius_m: float, distance_m: float) -> float:
        """Standard deviation of the mean height of a disc of points, metres; arguments as of `slope_std`."""
        scale = self._nearer(distance_m)
        radius = radius_m * scale
        measured = [(disc.radius_m, disc.height_std_m / self._model_height(disc.radius_m)) for disc in self.discs]
        return self._model_height(radius) * _between(radius, measured) / scale

    def _nearer(self, distance_m: float) -> float:
        """By how much the reference is farther; 1 where a depth is none, as in a cloud whose z is no optical axis."""
        return self.distance_m / distance_m if self.distance_m > 0 and distance_m > 0 else 1.0

    def _model_slope(self, radius_m: float) -> float:
        own = (self.independent_m * self.spacing_m) ** 2 / (np.pi * radius_m**2)
        shared = self.shared_m**2 * slope_gain(self.correlation_m / radius_m)
        return float(np.sqrt((own + shared) / (radius_m**2 / 4) + _TINY))

    def _model_height(self, radius_m: float) -> float:
        own = (self.independent_m * self.spacing_m) ** 2 / (np.pi * radius_m**2)
        return float(np.sqrt(own + self.shared_m**2 * height_gain(self.correlation_m / radius_m) + _TINY))


_TINY = 1e-24
"""Noise of zero has ratios too."""


def slope_gain(length: float) -> float:
    """G of the slope variance c^2 G / (R^2 / 4) by an error of variance c^2 and correlation exp(-(d / l)^2), l = q R.

    Both limits are exact: l^2 / R^2 independent patches for short lengths, a gradient of 2 c^2 / l^2 for long ones;
    within 15 % between them.
    """
    q2 = max(length, 1e-6) ** 2
    return 1.0 / (1.0 / q2 + 3.0 + 2.0 * q2)


def height_gain(length: float) -> float:
    """Variance of a disc's mean height as a share of c^2, for a correlation length of l = q R; exact in both limits."""
    q2 = length * length
    return q2 / (1.0 + q2)


def _between(radius_m: float, measured: list[tuple[float, float]]) -> float:
    """Ratio of what was measured to the model at a radius: linear in the logarithms, constant beyond the ends."""
    if not measured:
        return 1.0
    radii, ratios = np.array(sorted(measured)).T
    return float(np.exp(np.interp(np.log(radius_m), np.log(radii), np.log(np.maximum(ratios, 1e-9)))))


def prior_noise(config: SensorConfig, note: str = "") -> SensorNoise:
    """What is assumed of a sensor that could not be measured.

    Args:
        config: The assumptions, with their origins.
        note: Why nothing was measured.
    """
    return SensorNoise(
        independent_m=config.independent_m,
        independent_relative_std=float("nan"),
        shared_m=config.shared_m,
        shared_relative_std=float("nan"),
        correlation_m=config.correlation_m,
        spacing_m=config.spacing_m,
        outlier_share=config.outlier_share,
        edge_blur_px=config.edge_blur_px,
        edge_std_px=float("nan"),
        distance_m=config.distance_m,
        note=note,
    )
