"""Section `sensor`: the noise of the sensor."""

from __future__ import annotations

from pydantic import Field

from tubepose.config.section import Section


class SensorConfig(Section):
    """Noise of the sensor: how it is measured in a capture, and what is assumed where it cannot be.

    Attributes:
        independent_m: Prior: standard deviation of a point's own error (ribs of REAL PhoXi scans: 0.07 to 0.08 mm).
        shared_m: Prior: standard deviation of the error that neighbours share (SIMULATED structured light; up to 0.15
            mm on the ribs of the same REAL scans).
        correlation_m: Prior: distance at which the shared error's correlation is 1/e (2 to 3 mm on those ribs).
        spacing_m: Prior: distance of neighbouring points (REAL PhoXi M: 0.4 mm at 0.65 m).
        distance_m: Prior: depth at which these hold (that scanner's working distance).
        outlier_share: Prior: share of points far off the surface that they are of.
        edge_blur_px: Prior: valid pixels between the two sides of a depth step (sharp: 0; one pixel can lie on both).
        radii_m: Radii of the discs whose slopes and heights are measured: those of caps.
        discs: Discs of one radius at most: 150 tell a standard deviation to 4 %, twice as well takes four times as
            many.
        least_discs: With fewer discs than this, which tell it to 15 %, the noise model takes their place.
        least_points: A surface of fewer points tells nothing.
        reach_m: How far beside the rack the table is looked at: farther off, the sensor may be another.
        margin_m: So near the outline it is not: depth is smeared there (REAL stereo: 3 to 10 mm at 0.3 m).
        inside_m: How far from any edge the points of the rack's top must lie.
        max_bow_m: Points of the rack's top lie this near its defined height: bow (REAL racks: 2 mm) and noise.
        contradiction: Two surfaces whose slope noise differs by more than this factor contradict each other: the
            greater has a pattern, gloss or stray light in it. REAL materials differ by less than 2.
    """

    independent_m: float = Field(default=7.5e-5, gt=0)
    shared_m: float = 2.0e-5
    correlation_m: float = Field(default=3.0e-3, gt=0)
    spacing_m: float = Field(default=4.2e-4, gt=0)
    distance_m: float = Field(default=0.65, gt=0)
    outlier_share: float = Field(default=0.01, lt=1)
    edge_blur_px: float = 1.0
    radii_m: tuple[float, ...] = (4.0e-3, 6.5e-3, 1.0e-2)
    discs: int = 150
    least_discs: int = 12
    least_points: int = 1000
    reach_m: float = 0.1
    margin_m: float = 0.01
    inside_m: float = 1.0e-3
    max_bow_m: float = 4.0e-3
    contradiction: float = Field(default=2.0, gt=1)
