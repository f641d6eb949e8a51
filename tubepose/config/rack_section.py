"""Section `rack`: registration of the rack, and what it has to pass."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from tubepose.config.section import Section

RackMethod = Literal["edges", "obb-icp"]


class RackConfig(Section):
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
        max_pitch_marked_mm: The same, from where on it is marked, beyond two standard deviations: a quarter of what a
            wrong answer is.
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
    max_pitch_marked_mm: float = Field(default=0.5, gt=0)
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
    max_turn_std_deg: float = 0.3
    max_shift_std_mm: float = 0.3
    max_shift_std_held_mm: float = 0.5
    max_spacing_ratio: float = 1.0
