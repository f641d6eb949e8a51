"""Every tunable number of the estimators: one frozen section per stage, defaults beside the reason for them.

A user's YAML file (``--config``) may set any of them; an unknown key fails and names the known ones.
No default was fitted to a capture that a table of ours is computed on; docs/method.md says where each is from.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, Self

from pydantic import BaseModel, Field, model_validator

from tubepose.errors import ConfigError
from tubepose.labware.definition import StrictModel
from tubepose.labware.reading import read_yaml, validate

Objective = Literal["hinge", "signed", "l1", "l2", "count"]
RackMethod = Literal["edges", "obb-icp"]


class _Section(StrictModel):
    """A gate of NaN would be open, and nothing here means anything below zero."""

    @model_validator(mode="after")
    def _check_numbers(self) -> Self:
        """Counts are 1 or more, and so are the numbers of a list more than 0; what else may not be 0 says so itself."""
        for name, value in self:
            if isinstance(value, bool | str | BaseModel):
                continue
            least = 1 if isinstance(value, int) and name != "seed" else 0
            if isinstance(value, tuple) and (not value or min(value) <= 0):
                raise ValueError(f"{name}: expected one or more numbers, all more than 0, found {list(value)}")
            if not isinstance(value, tuple) and value < least:
                raise ValueError(f"{name}: expected {least} or more, found {value}")
        return self


class PreprocessConfig(_Section):
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


class RackTopConfig(_Section):
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


class RackConfig(_Section):
    """Registration of the rack (paper, section IV-A).

    Attributes:
        method: ``edges``: plane and edges of the top's ribs, openings and outline; ``obb-icp``: the paper's way,
            oriented bounding box and ICP. The fields from template_spacing_m to coarse_points, min_fitness and
            min_coverage are the latter's alone.
        template_spacing_m: Grid of the template of the top surface.
        icp_distances_m: Correspondence distance of each ICP round, coarse to fine.
        icp_iterations: Iterations per round.
        coarse_points: Points of the scan that the first round of every hypothesis sees.
        judge_distance_m: Correspondence distance at which fitness and rmse of the result are stated and judged.
        max_inlier_rmse_m: A larger inlier rmse is no rack (a real scan of the right rack reaches 1.0 mm).
        min_fitness: Smallest share of the scan's top points with a correspondence.
        slot_margin_m: A point farther than this inside an opening contradicts the template.
        max_in_slot_share: Largest share of such points: fitness alone accepts a rack of another pitch.
        min_coverage: Smallest share of the template that is seen.
        ambiguous_margin_m: Two turns whose rmse differ by less are not told apart by geometry.
        left_alone_m: A corner of a rack's top that has moved farther since an earlier frame, metres, is one of a rack
            that was handled, and may have been turned: hint `previous` decides nothing. Ten times the error of a pose,
            less than half the pitch of most racks; what is lifted and put back by hand is seldom back so exactly.
        edge_margin_m: The same for method ``edges``, which judges a thinner layer: three pixels.
        max_stray_share: Largest share of such points. On `dev` the right rack has up to 5 %, whatever stands in it, a
            rack of another pitch 12 % or more.
        max_outside_share: Largest share of the top's points just outside the outline (right rack: 0.1 %).
        max_gain: Nats by which a named alternative (a row or column more or fewer, no openings, another rack of the
            catalogue) may be likelier than the rack; `python -m benchmarks.rack_checks` prints what right and wrong
            files give.
        max_pitch_mm: How far the outermost slots may lie from where the rack's file has them, because of another pitch;
            beyond three standard deviations of its measurement, as with those below. Half of what a wrong answer is.
        max_openings_mm: How much wider or narrower openings may be: blur moves their edges by up to 0.6 mm each.
        max_outline_mm: How much larger or smaller the outline may be.
        max_scale: Largest difference of scale, as a share, of everything that is seen of the rack.
        max_scale_shift_mm: A difference of scale that moves the rack by more along the line of sight is marked, beyond
            two standard deviations.
        scale_std: Standard deviation of the cloud's scale before the capture tells more, as a share. Default: stereo
            cameras drift by 0.5 % in hours. State what your sensor's calibration keeps; scanners reach 0.0005.
        max_scale_unknown_mm: What three standard deviations of the scale, by the capture and that, may move a rack
            along the line of sight before it is marked: the distance that makes a pose wrong.
        edge_std_mm: How far a sensor's blur and a projector's shadow move the edge of an outline.
        max_tops_off: How far the tops of what stands in the slots may lie from the slots' centres, median, as a share
            of the distance of slots: tubes lean by a tenth, and tops anywhere give 0.4.
        max_bow_mm: Largest bow of a face, at the ends of its outline (two of two real racks: 0.7 to 2 mm).
        max_floor_mm: How far the slots' floor may be seen from where the file has it, beside three standard deviations.
        min_seen: Smallest share of the template that is seen: a rack full of caps shows 5 to 24 %.
        min_seen_held: The same where the tops of what stands in the rack tell its level.
        clear_seen: With this share seen, an accepted pose is not compared with all others that the search finds; with
            less, tops of tubes hold the rack level where they can, and tubes in 60 % of its slots spare the comparison.
        max_unseen_share: Largest share of the top with no points on it, above or below: half of it makes a rack of
            another shape fit.
        min_slot_margin: Smallest evidence, in nats, against the rack standing a slot farther.
        min_rival_ratio: Smallest ratio of the evidence of a pose to that of the next one that is accepted too.
        max_level_deg: Where less than clear_seen is seen, the largest tilt off the level that the search found, unless
            tops of tubes hold the rack.
        max_turn_std_deg: Largest standard deviation of a pose about any axis.
        max_shift_std_mm: Largest standard deviation of a pose along any axis.
        max_shift_std_held_mm: The same where tops of tubes hold the rack.
        max_spacing_ratio: Largest point spacing, in units of the rack's narrowest rib; coarser is insufficient.
    """

    method: RackMethod = "edges"
    template_spacing_m: float = Field(default=5.0e-4, gt=0)
    icp_distances_m: tuple[float, ...] = (6.0e-3, 3.0e-3, 1.2e-3)
    icp_iterations: int = 60
    coarse_points: int = 2000
    judge_distance_m: float = 3.0e-3
    max_inlier_rmse_m: float = 1.1e-3
    min_fitness: float = 0.9
    slot_margin_m: float = 1.5e-3
    max_in_slot_share: float = 0.06
    min_coverage: float = 0.25
    ambiguous_margin_m: float = 5.0e-5
    left_alone_m: float = Field(default=5.0e-3, gt=0)
    edge_margin_m: float = 6.0e-4
    max_stray_share: float = 0.08
    max_outside_share: float = 0.01
    max_gain: float = 60.0
    max_pitch_mm: float = 1.0
    max_openings_mm: float = 2.0
    max_outline_mm: float = 6.0
    max_scale: float = 0.0075
    max_scale_shift_mm: float = 1.2
    scale_std: float = Field(default=0.005, gt=0)
    max_scale_unknown_mm: float = Field(default=2.0, gt=0)
    edge_std_mm: float = 0.3
    max_tops_off: float = 0.25
    max_bow_mm: float = 4.0
    max_floor_mm: float = 2.0
    min_seen: float = 0.1
    min_seen_held: float = 0.03
    clear_seen: float = 0.25
    max_unseen_share: float = 0.4
    min_slot_margin: float = 10.0
    min_rival_ratio: float = 1.5
    max_level_deg: float = 1.5
    max_turn_std_deg: float = 0.3
    max_shift_std_mm: float = 0.3
    max_shift_std_held_mm: float = 0.5
    max_spacing_ratio: float = 1.0


class SensorConfig(_Section):
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


class SlotConfig(_Section):
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


class TubeConfig(_Section):
    """The cylinder fit about the slot's bottom centre (paper, Eqs. 1 to 5).

    Attributes:
        objective: Cost of Eq. 3: ``hinge`` sum max(D - r, 0); ``signed`` sum (D - r), as printed; ``l1``; ``l2``;
            ``count`` of D > r, as in the authors' own program.
        max_tilt_rad: Bound of alpha and beta in the search.
        tolerance_m: Added to the clearance of Eq. 5, beside the rack's floor play, for the fit's error at the top.
        min_points: Fewer points reject the tube.
    """

    objective: Objective = "hinge"
    max_tilt_rad: float = 0.0872665
    tolerance_m: float = 5.0e-4
    min_points: int = 25


class ProfileConfig(_Section):
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
        max_higher: Largest share of the points over a top's middle that lie above it: ghosts are a tenth at most.
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
    max_higher: float = Field(default=0.25, gt=0)
    max_height_error_m: float = 1.2e-3
    max_runner_up: float = 0.9
    max_tilt_std_rad: float = 0.0105


class IcpConfig(_Section):
    """The rivals' registration (paper, section V-B): Open3D, same points, settings printed with the tables.

    Attributes:
        template_points: Points sampled from the visible part of the tube's profile.
        max_distance_m: Correspondence distances of the ICP rounds, coarse to fine.
        iterations: Iterations per round.
        estimation: Point-to-plane or point-to-point.
        voxel_m: Voxel of the global registration.
        normal_radius_m: Radius of the normals.
        feature_radius_m: Radius of the FPFH features.
        mutual_filter: Keep only feature pairs that are each other's nearest.
        ransac_distance_m: Inlier distance of the RANSAC.
        ransac_iterations: Most RANSAC iterations.
        ransac_confidence: RANSAC stops at this confidence.
    """

    template_points: int = 2000
    max_distance_m: tuple[float, ...] = (4.0e-3, 1.5e-3)
    iterations: int = 50
    estimation: Literal["point_to_plane", "point_to_point"] = "point_to_plane"
    voxel_m: float = Field(default=1.0e-3, gt=0)
    normal_radius_m: float = 3.0e-3
    feature_radius_m: float = 6.0e-3
    mutual_filter: bool = False
    ransac_distance_m: float = 1.5e-3
    ransac_iterations: int = 100_000
    ransac_confidence: float = 0.999


class RivalsConfig(_Section):
    """The rivals of the extra ``rivals``: KISS-Matcher and small_gicp; settings printed with the tables.

    Attributes:
        kiss_voxel_m: Voxel of the features.
        kiss_normal_radius_m: Radius of the normals.
        kiss_feature_radius_m: Radius of the FPFH features.
        kiss_neighbors: How many of the template's features each scan feature is paired with.
        kiss_pairs: Pairs that one attempt sees, drawn by the seed.
        kiss_noise_bound_m: Noise bound of the pruning by pairwise distances; the solver's is `kiss_solver_gain` of it.
        kiss_solver_gain: At most 1.
        kiss_pruning: Prune the pairs by k-core before they are solved.
        kiss_attempts: Draws of pairs; the best by agreement of points and normals is kept.
        kiss_agree_m: A point this near to the template, with a normal within 30 degrees, agrees.
        kiss_refinement: ``icp``, as the other rivals, or ``gicp``.
        gicp_kind: Registration of small_gicp.
        gicp_target: ``template``: scan onto template; ``scan``: template onto scan.
        gicp_max_distance_m: Correspondence distances of the rounds, coarse to fine.
        gicp_neighbors: Neighbours of a point's covariance.
        gicp_iterations: Iterations per round.
    """

    kiss_voxel_m: float = Field(default=0.7e-3, gt=0)
    kiss_normal_radius_m: float = Field(default=2.4e-3, gt=0)
    kiss_feature_radius_m: float = Field(default=4.0e-3, gt=0)
    kiss_neighbors: int = Field(default=10, ge=1)
    kiss_pairs: int = Field(default=200, ge=3)
    kiss_noise_bound_m: float = Field(default=2.0e-3, gt=0)
    kiss_solver_gain: float = Field(default=0.75, gt=0, le=1)
    kiss_pruning: bool = True
    kiss_attempts: int = Field(default=40, ge=1)
    kiss_agree_m: float = Field(default=1.5e-3, gt=0)
    kiss_refinement: Literal["icp", "gicp"] = "gicp"
    gicp_kind: Literal["GICP", "PLANE_ICP", "ICP"] = "GICP"
    gicp_target: Literal["template", "scan"] = "template"
    gicp_max_distance_m: tuple[float, ...] = Field(default=(1.5e-3,), min_length=1)
    gicp_neighbors: int = Field(default=7, ge=5)
    gicp_iterations: int = Field(default=50, ge=1)


class Config(_Section):
    """All sections."""

    preprocess: PreprocessConfig = PreprocessConfig()
    rack_top: RackTopConfig = RackTopConfig()
    rack: RackConfig = RackConfig()
    sensor: SensorConfig = SensorConfig()
    slots: SlotConfig = SlotConfig()
    tube: TubeConfig = TubeConfig()
    profile: ProfileConfig = ProfileConfig()
    icp: IcpConfig = IcpConfig()
    rivals: RivalsConfig = RivalsConfig()


def load_config(path: Path | None) -> Config:
    """Defaults, changed by the YAML file if one is given.

    Raises:
        ConfigError: The file is missing, or has an unknown key or a wrong value.
    """
    if path is None:
        return Config()
    return validate(Config, read_yaml(path, ConfigError), str(path), ConfigError)
