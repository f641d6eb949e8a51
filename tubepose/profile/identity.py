"""Of which type a measured top is: each given type against the others, and against a tube of another type.

What is measured of a closed top, its height and its radius, has a likelihood under each given type (a Gaussian about
its definition), and under "another type", which may have any height, or that of a given type, and any radius (uniform).
The heights of a type's tubes in a frame have one offset in common, of its definition and of the floor, which the others
of them tell; radii have one of the sensor and one of the cap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.config import ProfileConfig
from tubepose.labware import RackModel, TubeModel
from tubepose.profile.tops import top_level_m, top_radius_m
from tubepose.transforms import FloatArray

OTHER_HEIGHTS_M, OTHER_RADII_M = 0.1, 0.012
"""Tubes that racks hold are 30 to 130 mm high, with tops of 5 to 17 mm radius: where another type's may be, evenly."""
SAME_HEIGHT = 0.02
"""Tubes come in standard lengths: a type that is not given is as high as a given one so often (of the catalogue's 66
pairs of types one is within 0.5 mm: Laplace's rule, 2 of 68, rounded down)."""
TIGHT_M, TIGHT_SHARE = 3.0e-4, 0.9
"""Nine files of ten describe a type's height as well as its caps sit; the tenth is off by `type_height_m`."""
ENDS_BETWEEN = float(np.sqrt(12.0))
"""A top's end lies evenly between two points: a spacing over this is its standard deviation."""

LEAST_ENDS_M = 5.0e-5
"""Edges of caps are rounded: a finer scan does not know better where they end."""
MOST_MATES = 4
"""A median of a type's radii tells as much as so many of them: some may be of another type."""
TELLS = 2.0
"""Radii within so many standard deviations of a type's tell its common offset."""
CONTRADICTS = 3.0
"""Standard deviations of a type's common radius beyond which its tops are of another type."""


@dataclass(frozen=True, slots=True, eq=False)
class Names:
    """What tops are, T of them.

    Attributes:
        tube: The likeliest of the given types, shape (T,).
        odds: Log odds of it against the next best one and against another type, the smaller one, shape (T,), nats.
        rival: Index of the type that these odds are against, shape (T,); -1 for another type.
    """

    tube: NDArray[np.intp]
    odds: FloatArray
    rival: NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class Radii:
    """Radii of tops, T of them.

    Attributes:
        radius_m: Of their circles, shape (T,), metres; NaN where it is not known.
        fit_std_m: How well each is known by its own points, standard deviation, shape (T,), metres.
        ends_std_m: How far off all of them may be together: where a sensor's points end.
    """

    radius_m: FloatArray
    fit_std_m: FloatArray
    ends_std_m: float


def measured_radii(radius_m: FloatArray, covariance_m2: FloatArray, spacing_m: FloatArray) -> Radii:
    """Radii with their errors.

    Args:
        radius_m: Radii, shape (T,), metres; NaN where not known.
        covariance_m2: Of the circles' middles, shape (T, 2, 2): a radius is known twice as well as a coordinate.
        spacing_m: Distance of points on each top, shape (T,), metres; NaN where not known.
    """
    known = spacing_m[np.isfinite(spacing_m)]
    ends_m = max(float(np.median(known)) / ENDS_BETWEEN, LEAST_ENDS_M) if len(known) else LEAST_ENDS_M
    return Radii(radius_m, np.sqrt(np.trace(covariance_m2, axis1=1, axis2=2) / 4), ends_m)


def name_tops(
    height_m: FloatArray,
    radii: Radii,
    may: NDArray[np.bool_],
    rack: RackModel,
    tubes: Sequence[TubeModel],
    config: ProfileConfig,
) -> Names:
    """The types of closed tops: maximum likelihood, with heights and radii of a type's tubes pooled over the frame.

    Args:
        height_m: Height of each top above the rack's base, shape (T,), metres; NaN where it is not known.
        radii: Radii of their circles.
        may: Which types each can be, shape (T, K); open ones cannot.
        rack: The rack.
        tubes: The given types, K of them.
        config: Spread of heights and radii.
    """
    off_m = height_m[:, None] - [top_level_m(tube, rack) for tube in tubes]
    wider_m = radii.radius_m[:, None] - [top_radius_m(tube) for tube in tubes]
    known = np.isfinite(radii.radius_m)
    floor_m = rack.floor_tolerance_mm * 1e-3
    nothing = np.zeros(off_m.shape, bool)
    high = _by_height(off_m, nothing, floor_m, config)
    alone = np.where(may, high + _by_radius(wider_m, radii, nothing, config), -np.inf)
    other = _of_another(high, may, np.isfinite(height_m), known)
    sure = (alone > other[:, None]) & (alone >= alone.max(axis=1, initial=-np.inf, keepdims=True))
    high = _by_height(off_m, sure & np.isfinite(off_m), floor_m, config)
    pooled = high + _by_radius(wider_m, radii, sure & known[:, None], config)
    return _best(np.where(may, pooled, -np.inf), _of_another(high, may, np.isfinite(height_m), known))


def _of_another(
    high: FloatArray, may: NDArray[np.bool_], has_height: NDArray[np.bool_], has_radius: NDArray[np.bool_]
) -> FloatArray:
    """Log likelihood of what was measured of tops (T,) under another type: of any height, or as high as a given one.

    Args:
        high: Log likelihoods of their heights under the given types, shape (T, K).
        may: Which types each can be, shape (T, K).
        has_height: Whose heights are known, shape (T,).
        has_radius: Whose radii are known, shape (T,).
    """
    alike = np.where(may, high, -np.inf).max(axis=1, initial=-np.inf)
    any_height = np.log(1 - SAME_HEIGHT) - np.log(OTHER_HEIGHTS_M)
    height = np.where(has_height, np.logaddexp(any_height, np.log(SAME_HEIGHT) + alike), 0.0)
    return np.asarray(height - np.log(OTHER_RADII_M) * has_radius)


def _by_radius(wider_m: FloatArray, radii: Radii, sure: NDArray[np.bool_], config: ProfileConfig) -> FloatArray:
    """Log likelihood of radii off a type's (T, K), given those of the tops that are `sure` (T, K) to be of a type.

    Where points end is the sensor's, one offset for all tops: what the other types' tops say of it is known. With the
    cap's tolerance it is a type's common offset, which the median of its own tops tells, wrong ones among them.
    """
    ends2 = radii.ends_std_m**2
    each2 = radii.fit_std_m**2 + config.top_radius_m**2
    fit2 = float(np.median(each2)) if len(each2) else 0.0
    # What is far off may be of another type, and tells nothing of this one's.
    sure = sure & (np.abs(wider_m) < TELLS * np.sqrt(ends2 + config.cap_radius_m**2 + fit2))
    count = sure.sum(axis=0)
    middle = np.array([np.median(wider_m[sure[:, k], k]) if count[k] else 0.0 for k in range(len(count))])
    one2 = config.cap_radius_m**2 + fit2 / np.maximum(count, 1)
    information = np.where(count > 0, 1 / one2, 0.0)
    others = information.sum() - information
    left2 = 1 / (1 / ends2 + others)
    expected = ((information * middle).sum() - information * middle) * left2
    common2 = config.cap_radius_m**2 + left2
    # A median of few is no better than one of them.
    mates = np.where(count > 1, np.minimum(count - 1, MOST_MATES) / fit2 if fit2 > 0 else 0.0, 0.0)
    spread2 = 1 / (1 / common2 + mates)
    value = _gauss(wider_m - spread2 * (expected / common2 + mates * middle), np.sqrt(spread2 + each2[:, None]))
    beyond = (count > 1) & (np.abs(middle - expected) > CONTRADICTS * np.sqrt(common2 + fit2 / np.maximum(count, 1)))
    return np.where(beyond & np.isfinite(wider_m), -np.inf, value)


def _best(likelihood: FloatArray, other: FloatArray) -> Names:
    """The best type of each top by log likelihoods (T, K), and its log odds against the rest and another type (T,)."""
    rows = np.arange(len(other))
    best = likelihood.argmax(axis=1)
    rest = likelihood.copy()
    rest[rows, best] = -np.inf
    second, value = rest.argmax(axis=1), likelihood[rows, best]
    against = np.maximum(rest[rows, second], other)
    rival = np.where(rest[rows, second] > other, second, -1)
    odds = np.where(np.isfinite(value), value - against, -np.inf)
    return Names(best.astype(np.intp), odds, rival.astype(np.intp))


def _by_height(off_m: FloatArray, sure: NDArray[np.bool_], floor_m: float, config: ProfileConfig) -> FloatArray:
    """Log likelihood of heights off a type's (T, K), given those of the other tubes that are `sure` (T, K) to be of it.

    The common offset of a type has a mixture of two Gaussians as its prior; each top scatters about it by its seat.
    """
    seat2 = config.cap_height_m**2
    known = np.where(sure, np.nan_to_num(off_m), 0.0)
    count = sure.sum(axis=0) - sure
    mean = (known.sum(axis=0) - known) / np.maximum(count, 1)
    logs = []
    for spread_m, share in ((TIGHT_M, TIGHT_SHARE), (config.type_height_m, 1 - TIGHT_SHARE)):
        prior2 = spread_m**2 + floor_m**2
        information = 1 / prior2 + count / seat2
        middle = mean * (count / seat2) / information
        weight = np.where(count > 0, _gauss(mean, np.sqrt(prior2 + seat2 / np.maximum(count, 1))), 0.0)
        logs.append((np.log(share) + weight, _gauss(off_m - middle, np.sqrt(1 / information + seat2))))
    weights = np.stack([weight for weight, _ in logs])
    values = np.stack([weight + value for weight, value in logs])
    return np.asarray(np.logaddexp.reduce(values) - np.logaddexp.reduce(weights))


def _gauss(off: FloatArray, std: FloatArray) -> FloatArray:
    """Log density of a Gaussian; 0 where the value is not known, as for another type."""
    return np.where(np.isfinite(off), -0.5 * (np.nan_to_num(off) / std) ** 2 - np.log(np.sqrt(2 * np.pi) * std), 0.0)


def unknown_words(
    height_m: float,
    radius_m: float,
    names: tuple[TubeModel, TubeModel | None],
    odds: float,
    rack: RackModel,
    least: float,
) -> str:
    """Why a top is of no given type for sure, in words.

    Args:
        height_m: Its height above the rack's base, metres.
        radius_m: Its radius, metres.
        names: The likeliest type, and the one that it is not distinguished from; None for another type.
        odds: Log odds of the first.
        rack: The rack.
        least: Log odds that are expected.
    """
    best, rival = names
    high_mm, wide = (
        1e3 * (height_m - rack.floor_m),
        f"{2e3 * radius_m:.1f} mm" if np.isfinite(radius_m) else "not known to be",
    )
    found = f"its top is {high_mm:.1f} mm high and {wide} wide, that of {best.name} {best.height_mm:g} and "
    found += f"{2e3 * top_radius_m(best):.1f} mm (log odds {odds:.1f}, at least {least:g} expected)"
    if rival is None:
        return f"unknown type: {found}; or it stands on something"
    return f"unknown type: {best.name} and {rival.name} fit alike: {found}"
