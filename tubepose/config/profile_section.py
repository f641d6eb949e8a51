"""Section `profile`: the estimator that looks at the whole frame."""

from __future__ import annotations

from pydantic import Field

from tubepose.config.section import Section


class ProfileConfig(Section):
    """The whole-profile estimator `profile` (docs/method.md, "Profile").

    Attributes:
        top_band_m: Points this near a closed top's expected height can be of it.
        rim_depth_m: Points this far below an open rim's height can be of it.
        min_support: Least share of a top that is seen, less the share of its surroundings.
        min_rim_support: The same of an open rim.
        min_rim_evidence: Least product of a rim's support and of the share of its ring that is seen in the image.
        min_ring_odds: Least log odds of a ring that the image alone shows to be a rim (docs/method.md, "Faint rims").
        min_sectors: Least share of a top's circle whose end is seen.
        reach_m: Added to what a slot lets a tube's top reach, for the rack's error and for looser slots.
        plane_points: Points of a top that its plane is fitted to.
        min_top_points: Fewer points than this make no plane.
        edge_ramp_m: Width of the ramp that the end of a top is, beyond that of today's scanner: set frame by frame.
        outline_noise_m: Standard deviation of the radius at which a sector of a top ends.
        outline_bias_m: Standard deviation of a circle's middle beyond what its sectors explain.
        rim_noise_m: As `outline_noise_m`, of the bright ring of a rim.
        rim_bias_m: As `outline_bias_m`, of the bright ring of a rim.
        faint_rim_bias_m: The same of a rim that the image alone shows.
        even_rim_m: Standard deviation of the middle of such a rim where it is neither a bright ring nor a dark one.
        lone_rim_m: What is added to that of a torn ring that is not found again as one of even gray.
        torn_rim_m: What is added to it, by the share of the ring's free sectors that do not look like one.
        wall_noise_m: Standard deviation of points on a wall that can be believed, a label's say.
        wall_radius_m: Standard deviation of a wall's radius.
        wall_redundancy: How many neighbouring points of a wall count as one: they share their error.
        min_wall_points: Fewer points near a wall's radius say nothing.
        cap_height_m: Standard deviation of the height at which a cap sits, with the scanner's own error.
        cap_radius_m: Standard deviation of a cap's radius about its definition: moulded caps hold 0.1 mm.
        top_radius_m: Standard deviation of one top's measured radius beside its circle's own: light at its edge.
        type_height_m: Standard deviation of what a type's height is off in a file that is not right: by a ruler.
        min_type_odds: Least log odds (nats) of a top's type against every other given one and another type: 99 to 1.
        cap_tilt_rad: Standard deviation of how crooked a cap sits, about each of two axes.
        slope_std: Width of the proposal in the slope of the axis; wider than any slot allows.
        slot_tolerance_m: How soft the walls of the slot and the edge of its floor's play are.
        min_allowed: Least share of what the measurements leave open that the slot must allow.
        max_higher: Largest share of the points over a top's middle that lie above it: ghosts in clear tubes
            are a sixth at most.
        max_filled: Largest share of the points in an open tube's mouth that lie at one height near its rim.
            Ghosts in clear tubes are a sixth at most.
        max_runner_up: A type whose top another one fits with this share of its support is not told apart.
        max_height_error_m: A closed top farther off its height than this is rejected: four times `cap_height_m`. It
            grows with the noise of heights as that standard deviation does.
        max_tilt_std_rad: A tilt that is not known better than this is rejected.
        widening_m: Standard deviation of a circle's apparent radius, and of how elliptic it looks.
    """

    top_band_m: float = 1.5e-3
    rim_depth_m: float = 3.5e-3
    min_support: float = 0.3
    min_rim_support: float = 0.1
    min_rim_evidence: float = 0.11
    min_ring_odds: float = 1.5
    min_sectors: float = 0.4
    reach_m: float = 1.5e-3
    plane_points: int = 400
    min_top_points: int = 30
    edge_ramp_m: float = 0.0
    outline_noise_m: float = 1.7e-4
    outline_bias_m: float = 9.0e-5
    widening_m: float = Field(default=3.0e-4, gt=0)
    rim_noise_m: float = 2.0e-4
    rim_bias_m: float = 5.0e-5
    faint_rim_bias_m: float = 2.0e-4
    even_rim_m: float = 3.2e-4
    lone_rim_m: float = 8.0e-4
    torn_rim_m: float = 6.0e-4
    cap_height_m: float = Field(default=3.0e-4, gt=0)
    cap_radius_m: float = Field(default=1.0e-4, gt=0)
    top_radius_m: float = Field(default=1.4e-4, gt=0)
    type_height_m: float = Field(default=1.0e-3, gt=0)
    min_type_odds: float = 4.6
    cap_tilt_rad: float = 0.0030
    wall_noise_m: float = Field(default=1.5e-4, gt=0)
    wall_radius_m: float = Field(default=1.0e-4, gt=0)
    wall_redundancy: float = Field(default=6.0, gt=0)
    min_wall_points: int = 12
    slope_std: float = Field(default=0.035, gt=0)
    slot_tolerance_m: float = 1.0e-4
    min_allowed: float = 1.0e-3
    max_higher: float = Field(default=0.3, gt=0)
    max_filled: float = Field(default=0.5, gt=0)
    max_height_error_m: float = 1.2e-3
    max_runner_up: float = 0.9
    max_tilt_std_rad: float = 0.0105
