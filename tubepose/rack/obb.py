"""The rack's rival registration: OBB start with every hypothesis, ICP on the template of the top (paper, section IV-A).

A scan of a rack's top cannot always tell which way round the rack stands, and ICP's fitness and rmse cannot tell a rack
from one of another pitch: both are measured here, by the openings too, reported, and decide about the status.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations, product

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from tubepose.capture.frame import CameraIntrinsics
from tubepose.capture.hints import TurnHint
from tubepose.config import Config, RackConfig
from tubepose.labware import RackModel
from tubepose.preprocessing import point_spacing_m, remove_outliers, thin, to_o3d, voxel_downsample
from tubepose.rack.insufficient import outline_words, too_coarse
from tubepose.rack.pose import MIN_POINTS, RackPose, RackStatus
from tubepose.rack.turns import choose_turn, unused_hint
from tubepose.rack_band import RackTop, find_rack_top
from tubepose.transforms import HALF_TURN, FloatArray, invert_transform, make_transform, transform_points, translation

COVERED_WITHIN_M = 2.5e-3
COVERAGE_STEP = 7


@dataclass(frozen=True, slots=True, eq=False)
class _Registration:
    T_camera_rack: FloatArray
    fitness: float
    inlier_rmse_m: float


@lru_cache(maxsize=16)
def rack_template_m(rack: RackModel, spacing_m: float) -> FloatArray:
    """Template of the top surface: a grid on the solid part of the top, rack frame, shape (N, 3), metres."""
    half = rack.outline_m / 2
    axes = [np.arange(-h + spacing_m / 2, h, spacing_m) for h in half]
    xy = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    xy = xy[rack.top_signed_distance_m(xy) <= 0]
    return np.column_stack([xy, np.full(len(xy), rack.height_m)])


def register_obb_icp(
    points_m: FloatArray, rack: RackModel, config: Config, hint: TurnHint | None, intrinsics: CameraIntrinsics | None
) -> RackPose:
    """One try of `register_rack` by this method, without the suspicions of unit and noise."""
    if len(points_m) < MIN_POINTS:
        reason = f"{len(points_m)} valid points on the rack, expected at least {MIN_POINTS}"
        return RackPose(RackStatus.INSUFFICIENT, reason, code="too_few_points")
    top = find_rack_top(points_m, rack, config.rack_top)
    if top is None or not top.fits(config.rack_top):
        return _not_found(points_m, top, rack, config.rack)
    band = points_m[top.band_rows]
    spacing_m = point_spacing_m(band)
    coarse = too_coarse(spacing_m, rack, config.rack)
    if coarse:
        return RackPose(RackStatus.INSUFFICIENT, coarse, spacing_m=spacing_m, code="too_coarse")
    scan = remove_outliers(voxel_downsample(band, config.preprocess.rack_voxel_m), config.preprocess)
    best, turned = _register_all(scan, top, rack, config.rack)
    margin_m = turned.inlier_rmse_m - best.inlier_rmse_m
    index, resolved_by = choose_turn(
        [best.T_camera_rack, turned.T_camera_rack], margin_m, rack, config.rack, hint, intrinsics
    )
    turns = (best, turned)
    chosen, other = turns[index], turns[1 - index]
    template_m = rack_template_m(rack, config.rack.template_spacing_m)
    in_slot, coverage = _agreement(scan, chosen.T_camera_rack, template_m, rack, config.rack)
    reason = _refusal(chosen.fitness, chosen.inlier_rmse_m, in_slot, coverage, rack, config.rack)
    return RackPose(
        RackStatus.REFUSED if reason else RackStatus.OK,
        reason,
        None if reason else chosen.T_camera_rack,
        chosen.inlier_rmse_m,
        chosen.fitness,
        in_slot,
        coverage,
        ambiguous=resolved_by == "rule" and not reason,
        resolved_by="" if reason else resolved_by,
        hint_note=unused_hint(chosen.T_camera_rack, [other.T_camera_rack], rack, hint, intrinsics)
        if resolved_by == "rule" and not reason
        else "",
        turn_margin_m=margin_m if chosen is best else -margin_m,
        spacing_m=spacing_m,
        code="other_fit" if reason else "",
    )


def _not_found(points_m: FloatArray, top: RackTop | None, rack: RackModel, config: RackConfig) -> RackPose:
    spacing_m = point_spacing_m(points_m)
    coarse = too_coarse(spacing_m, rack, config)
    if coarse:
        return RackPose(RackStatus.INSUFFICIENT, coarse, spacing_m=spacing_m, code="too_coarse")
    found = "no level band" if top is None else f"a band of {top.size_m[0] * 1e3:.1f} x {top.size_m[1] * 1e3:.1f} mm"
    return RackPose(
        RackStatus.NOT_FOUND,
        f"no top of {rack.name} ({outline_words(rack)} mm) among the points; closest: {found}",
        spacing_m=spacing_m,
        code="no_level_band" if top is None else "other_outline",
    )


def _hypotheses(top: RackTop, band_m: FloatArray, rack: RackModel) -> list[FloatArray]:
    """Every right-handed assignment of the OBB's axes to the rack's with z up, as T_camera_rack.

    Open3D gives the box's axes in any order and sign. Assignments that swap clearly different sides are left out.
    """
    box = to_o3d(band_m).get_minimal_oriented_bounding_box()
    up = top.T_camera_top[:3, 2]
    found = []
    if not np.allclose(box.R.T @ box.R, np.eye(3), atol=1e-6):
        # Open3D warns of such a box and returns it all the same.
        box = to_o3d(band_m).get_oriented_bounding_box()
    for order in permutations(range(3)):
        sides_m = box.extent[list(order[:2])]
        if np.max(np.abs(sides_m - rack.outline_m) / rack.outline_m) > 0.25:
            continue
        for signs in product((1.0, -1.0), repeat=3):
            R = box.R[:, order] * np.array(signs)
            if np.linalg.det(R) > 0 and R[:, 2] @ up > np.cos(np.deg2rad(30)):
                found.append(make_transform(R, box.center - rack.height_m * R[:, 2]))
    return found


def _register_all(
    scan_m: FloatArray, top: RackTop, rack: RackModel, config: RackConfig
) -> tuple[_Registration, _Registration]:
    """Best registration over all hypotheses, and the same turned by 180 degrees and refined."""
    template_m = rack_template_m(rack, config.template_spacing_m)
    target = to_o3d(template_m)
    source = to_o3d(scan_m)
    few = to_o3d(thin(scan_m, config.coarse_points))
    corners = np.array([[x, y, 0.0] for x in (-0.5, 0.5) for y in (-0.5, 0.5)]) * [*top.size_m, 0.0]
    outline_m = np.vstack([scan_m, transform_points(top.T_camera_top, corners)])
    starts = _hypotheses(top, outline_m, rack)
    coarse = [_icp(few, target, start, config, config.icp_distances_m[:1]) for start in starts]
    if max((r.fitness for r in coarse), default=0.0) < config.min_fitness:
        # Few points above or below the band can turn the whole box; the band's own rectangle does not see them.
        level_start = top.T_camera_top @ translation([0.0, 0.0, -rack.height_m])
        coarse.append(_icp(few, target, level_start, config, config.icp_distances_m[:1]))
    best = max(coarse, key=lambda r: (round(r.fitness, 3), -r.inlier_rmse_m))
    fine = config.icp_distances_m[1:]
    turned_start = best.T_camera_rack @ HALF_TURN
    return _icp(source, target, best.T_camera_rack, config, fine), _icp(source, target, turned_start, config, fine)


def _icp(
    source: o3d.geometry.PointCloud,
    target: o3d.geometry.PointCloud,
    start: FloatArray,
    config: RackConfig,
    distances_m: tuple[float, ...],
) -> _Registration:
    """Point-to-point ICP of the scan onto the template: each scan point has a partner, each template point need not."""
    criteria = o3d.pipelines.registration.ICPConvergenceCriteria(max_iteration=config.icp_iterations)
    method = o3d.pipelines.registration.TransformationEstimationPointToPoint()
    T_rack_camera = invert_transform(start)
    for distance_m in distances_m:
        result = o3d.pipelines.registration.registration_icp(
            source, target, distance_m, T_rack_camera, method, criteria
        )
        # Without any correspondence Open3D reports rmse 0.0 and no error.
        if result.fitness == 0.0:
            return _Registration(start, 0.0, float("inf"))
        T_rack_camera = result.transformation
    judged = o3d.pipelines.registration.evaluate_registration(source, target, config.judge_distance_m, T_rack_camera)
    return _Registration(invert_transform(T_rack_camera), float(judged.fitness), float(judged.inlier_rmse))


def _agreement(
    scan_m: FloatArray, T_camera_rack: FloatArray, template_m: FloatArray, rack: RackModel, config: RackConfig
) -> tuple[float, float]:
    """Share of the scan inside the openings, and share of the template that the scan covers."""
    in_rack = transform_points(invert_transform(T_camera_rack), scan_m)
    inside_outline = np.all(np.abs(in_rack[:, :2]) <= rack.outline_m / 2, axis=1)
    in_slot = inside_outline & (rack.top_signed_distance_m(in_rack[:, :2]) > config.slot_margin_m)
    distances, _ = cKDTree(in_rack).query(template_m[::COVERAGE_STEP], distance_upper_bound=COVERED_WITHIN_M)
    return float(in_slot.mean()), float(np.isfinite(distances).mean())


def _refusal(
    fitness: float, rmse_m: float, in_slot: float, coverage: float, rack: RackModel, config: RackConfig
) -> str:
    """Why a registration is no rack, in words; empty if it is one."""
    checks = (
        (fitness < config.min_fitness, f"fitness {fitness:.3f}, at least {config.min_fitness} expected"),
        (
            rmse_m > config.max_inlier_rmse_m,
            f"inlier rmse {rmse_m * 1e3:.2f} mm, at most {config.max_inlier_rmse_m * 1e3:.2f} mm expected",
        ),
        (
            in_slot > config.max_in_slot_share,
            f"{in_slot:.1%} of the top's points lie inside the openings of {rack.name}, "
            f"at most {config.max_in_slot_share:.1%} expected: another rack?",
        ),
        (
            coverage < config.min_coverage,
            f"{coverage:.1%} of the top seen, at least {config.min_coverage:.0%} expected",
        ),
    )
    return "; ".join(text for failed, text in checks if failed)
