"""What the ground truth returns, and every number that it may be tuned by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tubepose.transforms import FloatArray

Status = Literal["ok", "refused"]


@dataclass(frozen=True, slots=True)
class GroundTruthConfig:
    """Thresholds of the ground truth; none was fitted to a capture that a table is computed on.

    Attributes:
        seed: Seed of the RANSAC plane segmentation.
        level_distance_m: RANSAC inlier distance of table and rack top; flat to about 1 mm in real scans.
        level_planes: How many planes are taken out of the scene in search of table and rack top.
        level_points: Points that this search sees: enough for planes of a thousandth of the scene.
        top_band_m: Half thickness of the rack's top about its plane: real racks spread by 0.6 to 1.1 mm.
        outline_excess_m: How much longer than the defined outline the seen top may be: two mixed pixels a side.
        outline_loss_m: How much shorter it may be: one border row of slots lost in the shadow of its caps.
        min_on_solid: Smallest share of top points on the solid part of the defined top; another pitch has less.
        sure_on_solid: From this share on no other level is tried.
        height_tolerance_m: How far a square may stand off the height that slot floor, tube and cap give; a cap that is
            badly seated, or a tube of another type, is farther off.
        search_margin_m: Squares are searched this far beyond the heights of the declared tubes, to name the wrong ones.
        jump_m: Height step between neighbouring pixels that separates two caps: a leaning cap stays below it.
        plane_distance_m: RANSAC inlier distance of a square: 5 times the noise of a structured-light scanner.
        plane_iterations: RANSAC iterations; a candidate is mostly plane, so few are needed.
        min_points: A square with fewer points is not measured; 16.7 mm at 0.84 mm spacing has 400.
        edge_inset_m: Width of the square's border that the plane fit leaves out: lens blur bends depth there.
        outlier_m: Points farther from the plane than this are no part of the top, and do not count in its rms.
        icp_iterations: Iterations of the square template ICP.
        edge_tolerance_m: How much a strip of the square may be longer or shorter than usual, beyond its sampling: lens
            blur moves each edge by half a pixel or so, out or in.
        max_width_loss_m: Missing width, beyond one point spacing, that may stay unexplained; half of it can be an
            error of the centre.
        higher_m: A neighbour this much higher can shadow or hide a square's edge.
        reach_m: How far beyond an edge such a neighbour is looked for.
        max_plane_rms_m: A larger rms is a bent or melted cap, or not a plane: 0.3 mm over 16.7 mm is 1 deg of tilt.
        max_icp_rms_m: A larger rms of the edges is not this square.
        min_coverage: Smallest share of the square with points; below it edges are guessed.
        max_tilt_rad: More tilt than any slot allows: the cap sits crooked, or the plane is something else.
        slot_tolerance_m: How far a tube's bottom may lie from its slot's centre, beyond the rack's floor play.
        second_cap_share: A second candidate on a slot is a second cap from this share of the square's area.
    """

    seed: int = 0
    level_distance_m: float = 1.5e-3
    level_planes: int = 6
    level_points: int = 40_000
    top_band_m: float = 1.0e-3
    outline_excess_m: float = 4.0e-3
    outline_loss_m: float = 25.0e-3
    min_on_solid: float = 0.8
    sure_on_solid: float = 0.95
    height_tolerance_m: float = 3.0e-3
    search_margin_m: float = 8.0e-3
    jump_m: float = 0.8e-3
    plane_distance_m: float = 0.5e-3
    plane_iterations: int = 200
    min_points: int = 100
    edge_inset_m: float = 1.0e-3
    outlier_m: float = 1.5e-3
    icp_iterations: int = 20
    edge_tolerance_m: float = 0.5e-3
    max_width_loss_m: float = 0.4e-3
    higher_m: float = 2.0e-3
    reach_m: float = 6.0e-3
    max_plane_rms_m: float = 0.3e-3
    max_icp_rms_m: float = 0.5e-3
    min_coverage: float = 0.6
    max_tilt_rad: float = 0.174533
    slot_tolerance_m: float = 2.0e-3
    second_cap_share: float = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class TubeTruth:
    """True pose of one declared tube, or why there is none.

    Attributes:
        slot: Slot that the session declares.
        tube: Name of the tube model.
        status: ``ok`` or ``refused``.
        reason: Why it was refused; empty for ``ok``.
        T_camera_tube: Array of shape (4, 4): origin at the tube's bottom, z the square's normal, spin by
            `tubepose.transforms.axis_rotation` in the rack frame; metres. None unless ``ok``.
        plane_rms_m: RMS distance of the square's points to its plane, metres; NaN without a square.
        icp_rms_m: RMS distance of its outermost points to the template's edges, metres; NaN without a square.
        coverage: Share of the square that has points, 0 to 1; 0 without a square.
        n_points: Points of the square that the plane was fitted to.
        tilt_std_rad: Standard deviation of the normal's direction from the plane fit's residuals, both tilt axes
            together, radians, with the error that neighbouring points share. NaN without a square.
    """

    slot: str
    tube: str
    status: Status
    reason: str = ""
    T_camera_tube: FloatArray | None = None
    plane_rms_m: float = float("nan")
    icp_rms_m: float = float("nan")
    coverage: float = 0.0
    n_points: int = 0
    tilt_std_rad: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class GroundTruthResult:
    """Truth of one frame with printed caps.

    Attributes:
        status: ``ok`` (single tubes may still be refused) or ``refused``.
        reason: Why the frame was refused; empty for ``ok``.
        T_camera_rack: Array of shape (4, 4), measured here from the rack's top, metres; None for a refused frame.
        ambiguous: True when neither the caps nor a hint tell how the rack is turned; the frame is refused then.
        tubes: One entry for every declared slot, in the order of the declaration.
        undeclared_slots: Slots where a cap stands that the session does not declare.
    """

    status: Status
    reason: str
    T_camera_rack: FloatArray | None
    ambiguous: bool
    tubes: tuple[TubeTruth, ...]
    undeclared_slots: tuple[str, ...] = ()
