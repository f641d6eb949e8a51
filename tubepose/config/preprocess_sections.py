"""Sections `preprocess` and `rack_top`: points before any pose."""

from __future__ import annotations

from pydantic import Field

from tubepose.config.section import Section


class PreprocessConfig(Section):
    """Outlier removal and down-sampling (paper, section III and Table II, note 3).

    Attributes:
        outlier_neighbors: Neighbours per point of the statistical outlier removal.
        outlier_std_ratio: A point farther from its neighbours than mean + ratio * std is removed.
        rack_voxel_m: Voxel of the rack's points before registration.
        tube_max_points: Points per tube that the fits see (evenly thinned beyond that).
        min_tube_points: Fewer points than this above a slot are not a tube.
    """

    outlier_neighbors: int = 20
    outlier_std_ratio: float = Field(default=2.0, gt=0)
    rack_voxel_m: float = Field(default=1.0e-3, gt=0)
    tube_max_points: int = 400
    min_tube_points: int = 25


class RackTopConfig(Section):
    """Finding the height band of the rack's top (detector ``geometric`` and the rack's registration).

    Attributes:
        plane_distance_m: RANSAC inlier distance of the first plane (table, or the top itself).
        plane_iterations: RANSAC iterations.
        max_planes: How many dominant planes are tried as "level".
        bin_m: Bin of the height histogram.
        max_bands: How many of its peaks are tried, the fullest first (method ``edges``).
        band_m: Half thickness of the band about a histogram peak.
        outline_tolerance_m: Allowed difference of the measured and the defined outline, per side.
        max_in_slot_share: Largest share of the band in the openings; the slots' floor has nearly all of it there.
        search_points: Points of the cloud that the search sees, evenly thinned.
        coarse_points: The same for method ``edges``; of a cloud of more than three times as many, a third.
        seed: Seed of the RANSAC.
    """

    plane_distance_m: float = 2.0e-3
    plane_iterations: int = 300
    max_planes: int = 3
    bin_m: float = Field(default=1.0e-3, gt=0)
    max_bands: int = 8
    band_m: float = 2.0e-3
    outline_tolerance_m: float = 5.0e-3
    max_in_slot_share: float = 0.3
    search_points: int = 100_000
    coarse_points: int = 20_000
    seed: int = 0
