"""Section `slots`: which slot holds which tube."""

from __future__ import annotations

from tubepose.config.section import Section


class SlotConfig(Section):
    """Which slot holds which tube (paper, section IV-B).

    Attributes:
        top_band_m: Points this near the height of a known tube's top are its cap or rim (detector ``geometric``).
        clearance_m: Points must stand this far above the rack's top to be a tube's.
        reach_m: How far beyond a tube's largest radius its points may lie from its slot's axis at the top: the lean.
        min_share: Smallest share of the projected hull's area for a slot to hold the tube.
        height_tolerance_m: Largest difference between the measured and the defined height of a tube type.
        open_depth_m: How far below its height an open tube can be measured: light returns from below its rim.
    """

    top_band_m: float = 2.5e-3
    clearance_m: float = 4.0e-3
    reach_m: float = 4.0e-3
    min_share: float = 0.2
    height_tolerance_m: float = 2.5e-3
    open_depth_m: float = 3.5e-3
