"""Whether a tube's pose is to be believed: checks with a value and a limit each, and what is known of its type."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tubepose.checks import Check
from tubepose.config import ProfileConfig
from tubepose.labware import RackModel, TubeModel

COARSE_M = 1.3e-3
"""Where the circle of a top is not seen though points that lie farther apart than this are on it, they are too few."""
PATCH_M = 3.0e-3
"""Side of a patch of a top whose points count as one: the range over which real scanners' depth errors are shared."""
PATCH_NATS = float(np.log(0.95 / 0.05))
"""What a patch that one type explains and another does not says for the one: as of the patches of slots."""


def tube_checks(
    *,
    sectors: float,
    allowed: float,
    higher: float,
    filled: float,
    high_m: float,
    tilt_std_rad: float,
    tube: TubeModel,
    rack: RackModel,
    slot: str,
    config: ProfileConfig,
    looked_at: bool = True,
    runner_up: float = 0.0,
    spacing_m: float = float("nan"),
) -> tuple[Check, ...]:
    """What a tube's pose has to pass, what was not seen before what was seen wrong.

    Args:
        sectors: Share of the top's circle that was seen.
        allowed: Share of what the measurements leave open that the slot allows.
        higher: Share of the points over its top's middle that lie above it.
        filled: Share of the points in its mouth that lie at one height near its rim; NaN of a closed top.
        high_m: Height of a closed top above where it should be, metres; NaN for an open one.
        tilt_std_rad: Standard deviation of the tilt.
        tube: Its type.
        rack: The rack.
        slot: Name of the slot.
        config: Limits.
        looked_at: Whether there were pixels to look at an open rim in.
        runner_up: Support of the next best type over that of this one; below zero without one.
        spacing_m: How far apart the points on a closed top lie, metres; NaN for an open one.
    """

    def checks() -> Iterator[Check]:
        if np.isfinite(runner_up):
            limit = config.max_runner_up
            yield Check("type_unclear", 100 * runner_up, 100 * limit, runner_up <= limit)
        if tube.is_open or not looked_at:
            yield Check("not_looked_at", float(looked_at), 1.0, looked_at)
        enough = sectors >= config.min_sectors
        if enough or not spacing_m > COARSE_M:
            yield Check("circle_little_seen", 100 * sectors, 100 * config.min_sectors, enough)
        else:
            yield Check("points_apart", 1e3 * spacing_m, 1e3 * COARSE_M, False)
        if np.isfinite(high_m):
            most_m = config.max_height_error_m
            yield Check("height_off", 1e3 * high_m, 1e3 * most_m, abs(high_m) <= most_m, detail=rack.name)
        yield Check("something_higher", 100 * higher, 100 * config.max_higher, higher <= config.max_higher)
        if np.isfinite(filled):
            yield Check("mouth_filled", 100 * filled, 100 * config.max_filled, filled <= config.max_filled)
        where = f"{slot} of {rack.name}"
        yield Check("not_in_slot", allowed, config.min_allowed, allowed >= config.min_allowed, detail=where)
        std_deg, limit_deg = np.rad2deg(tilt_std_rad), np.rad2deg(config.max_tilt_std_rad)
        yield Check("tilt_uncertain", float(std_deg), float(limit_deg), tilt_std_rad <= config.max_tilt_std_rad)

    return tuple(checks())


def p_type(support: float, runner_up: float, radius_m: float, odds: float = float("nan")) -> float:
    """Probability that a top is of its type: by log odds, else against the next best type (naive Bayes over patches).

    Args:
        support: Share of its top that is seen, less that of its surroundings.
        runner_up: The same of the next best type; minus infinity without one.
        radius_m: Radius of its top, metres: how many patches the shares are of.
        odds: Log odds of its type against all others, nats, where they are known; NaN where they are not.
    """
    if not np.isfinite(odds):
        odds = PATCH_NATS * np.pi * (radius_m / PATCH_M) ** 2 * (support - runner_up)
    return float(1 / (1 + np.exp(-np.clip(odds, -50.0, 50.0))))
