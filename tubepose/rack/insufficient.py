"""What to say where a capture cannot show a rack: depth that scatters too much, points too far apart."""

from __future__ import annotations

from tubepose.config import RackConfig
from tubepose.labware import RackModel


def outline_words(rack: RackModel) -> str:
    """Sides of the top, in words, millimetres."""
    return " x ".join(f"{side:g}" for side in rack.outline_mm)


def too_noisy(noise_m: float, reason: str, config: RackConfig) -> str:
    """Sentence for depth that scatters more than a registration may be off."""
    return (
        f"depth scatters by {noise_m * 1e3:.1f} mm on level patches, "
        f"at most {config.max_inlier_rmse_m * 1e3:.1f} mm can be registered ({reason})"
    )


def too_coarse(spacing_m: float, rack: RackModel, config: RackConfig) -> str:
    """Sentence for points farther apart than the narrowest rib is wide; empty if they are not, or it is not known."""
    limit_m = config.max_spacing_ratio * rack.min_rib_m
    if not spacing_m > limit_m:
        return ""
    return (
        f"points are {spacing_m * 1e3:.2f} mm apart, and the ribs of {rack.name} are "
        f"{rack.min_rib_m * 1e3:.2f} mm wide; a finer or nearer scan is needed"
    )
