"""Whether a tube's pose is to be believed, in words, and how much."""

from __future__ import annotations

import numpy as np

from tubepose.config import ProfileConfig
from tubepose.labware import RackModel, TubeModel

COARSE_M = 1.3e-3
"""Where the circle of a top is not seen though points that lie farther apart than this are on it, they are too few."""


def rejection(
    *,
    sectors: float,
    allowed: float,
    high_m: float,
    tilt_std_rad: float,
    tube: TubeModel,
    rack: RackModel,
    slot: str,
    config: ProfileConfig,
    looked_at: bool = True,
    runner_up: float = 0.0,
    spacing_m: float = float("nan"),
) -> str:
    """Why a pose cannot be believed; empty if it can.

    Args:
        sectors: Share of the top's circle that was seen.
        allowed: Share of what the measurements leave open that the slot allows.
        high_m: Height of a closed top above where it should be, metres; NaN for an open one.
        tilt_std_rad: Standard deviation of the tilt.
        tube: Its type.
        rack: The rack.
        slot: Name of the slot.
        config: Limits.
        looked_at: Whether there were pixels to look at an open rim in.
        runner_up: Support of the next best type over that of this one.
        spacing_m: How far apart the points on a closed top lie, metres; NaN for an open one.
    """
    if runner_up > config.max_runner_up:
        return f"another of the given types fits its top as well as {tube.name} ({runner_up:.0%} of its support)"
    if not looked_at:
        return "an open rim is measured in the image, and this cloud has no pixels"
    if sectors < config.min_sectors:
        if spacing_m > COARSE_M:
            return (
                f"the points on its top lie {spacing_m * 1e3:.1f} mm apart: too coarse to tell where its circle ends, "
                f"{COARSE_M * 1e3:.1f} mm or less expected"
            )
        return f"{sectors:.0%} of the top's circle seen, at least {config.min_sectors:.0%} expected"
    if abs(high_m) > config.max_height_error_m:
        return (
            f"the top is {high_m * 1e3:+.1f} mm off the height of {tube.name} in {rack.name}: "
            "another type, or it stands on something"
        )
    if allowed < config.min_allowed:
        return (
            f"stands or leans as slot {slot} of {rack.name} does not let it: jammed, on something, or not in the slot"
        )
    if tilt_std_rad > config.max_tilt_std_rad:
        return f"its tilt is known to {np.rad2deg(tilt_std_rad):.2f} deg only"
    return ""


def score(tilt_std_rad: float, sectors: float, allowed: float, config: ProfileConfig) -> float:
    """0 to 1: falls with what is not known of the tilt, with what of the top was not seen, and at the slot's edge."""
    known = 1 / (1 + (tilt_std_rad / config.score_tilt_rad) ** 2)
    return float(known * min(1.0, sectors / 0.75) * min(1.0, allowed / 0.02))
