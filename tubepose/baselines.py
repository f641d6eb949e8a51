"""The rivals, with the signature of ours: upright in the slot, ICP from the slot prior, global registration + ICP.

The paper compares with Open3D's global registration + ICP and gives no parameters. Here it has its best chance: the
template is only what a scanner above can see of the CAD profile, every scan point looks for its partner on the template
(the scan is partial, the template is whole), and its settings are printed with the tables. No rejection is applied.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import open3d as o3d

from tubepose.checks import said
from tubepose.config import Config, IcpConfig
from tubepose.labware import RackModel, SlotModel, TubeModel
from tubepose.preprocessing import to_o3d
from tubepose.transforms import FloatArray, axis_rotation, invert_transform, make_transform, translation
from tubepose.tube import TubePose, TubeStatus, refused

registration = o3d.pipelines.registration
Feature = o3d.pipelines.registration.Feature
RIM_VIEW_M = 0.012
MIN_FEATURES = 10


def fit_upright(
    points_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel, config: Config, seed: int = 0
) -> TubePose:
    """The trivial answer: bottom at the slot's centre, axis along the rack's normal. It looks at no point."""
    del config, seed, tube
    T_rack_tube = translation(rack.bottom_center_m(slot))
    return TubePose(TubeStatus.OK, "", T_rack_tube, n_points=len(points_m))


def fit_slot_icp(
    points_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel, config: Config, seed: int = 0
) -> TubePose:
    """ICP onto the tube's template, started upright in the slot."""
    del seed
    start = translation(rack.bottom_center_m(slot))
    if len(points_m) < 3:
        return failed("fewer than 3 points", points_m)
    return refine(points_m, start, visible_template(tube, rack.depth_m, config.icp.template_points), config.icp)


def fit_global_icp(
    points_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel, config: Config, seed: int = 0
) -> TubePose:
    """Global registration (FPFH features, RANSAC) + ICP, without any prior from the rack."""
    del slot
    template = visible_template(tube, rack.depth_m, config.icp.template_points)
    target, target_features = template_features(template, config.icp)
    scan, features = scan_features(points_m, config.icp)
    if len(scan.points) < MIN_FEATURES:
        return failed(f"{len(scan.points)} points after down-sampling, at least {MIN_FEATURES} expected", points_m)
    o3d.utility.random.seed(seed)
    found = registration.registration_ransac_based_on_feature_matching(
        scan,
        target,
        features,
        target_features,
        config.icp.mutual_filter,
        config.icp.ransac_distance_m,
        registration.TransformationEstimationPointToPoint(False),
        3,
        [
            registration.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            registration.CorrespondenceCheckerBasedOnDistance(config.icp.ransac_distance_m),
            # Normals are known to point outwards on both sides: without this test a cap's disc fits upside down.
            registration.CorrespondenceCheckerBasedOnNormal(np.deg2rad(30)),
        ],
        registration.RANSACConvergenceCriteria(config.icp.ransac_iterations, config.icp.ransac_confidence),
    )
    if found.fitness == 0.0:
        return failed("global registration found no correspondence", points_m)
    return refine(points_m, invert_transform(found.transformation), template, config.icp)


def failed(reason: str, points_m: FloatArray) -> TubePose:
    """No pose, and why."""
    return refused(said("no_pose", reason), n_points=len(points_m), status=TubeStatus.FAILED)


def refine(
    points_m: FloatArray, T_rack_tube: FloatArray, template: o3d.geometry.PointCloud, config: IcpConfig
) -> TubePose:
    """ICP rounds, coarse to fine, of the scan onto the template; the spin is fixed by the rule of Eq. 1.

    Args:
        points_m: Scan, rack frame, shape (N, 3), metres.
        T_rack_tube: Start, shape (4, 4), metres.
        template: Points with normals in the tube's frame, metres.
        config: Distances, iterations and the kind of estimation.
    """
    method = (
        registration.TransformationEstimationPointToPlane()
        if config.estimation == "point_to_plane"
        else registration.TransformationEstimationPointToPoint()
    )
    criteria = registration.ICPConvergenceCriteria(max_iteration=config.iterations)
    scan = to_o3d(points_m)
    T_tube_rack = invert_transform(T_rack_tube)
    fitness, rmse = 0.0, float("nan")
    for distance_m in config.max_distance_m:
        result = registration.registration_icp(scan, template, distance_m, T_tube_rack, method, criteria)
        # Open3D returns its start, fitness 0 and rmse 0.0 when nothing corresponds.
        if result.fitness == 0.0:
            return failed(f"ICP found no correspondence within {distance_m * 1e3:.1f} mm", points_m)
        T_tube_rack, fitness, rmse = result.transformation, float(result.fitness), float(result.inlier_rmse)
    T = invert_transform(T_tube_rack)
    T_fixed_spin = make_transform(axis_rotation(T[:3, 2]), T[:3, 3])
    return TubePose(TubeStatus.OK, "", T_fixed_spin, inlier_rmse_m=rmse, fitness=fitness, n_points=len(points_m))


@lru_cache(maxsize=32)
def visible_template(tube: TubeModel, hidden_m: float, count: int) -> o3d.geometry.PointCloud:
    """Points with outward normals on what a scanner above sees of a tube whose lower part is hidden by the rack.

    The profile is sampled by area, evenly in angle (golden angle): no randomness.

    Args:
        tube: The tube's model.
        hidden_m: Height above the tube's bottom up to which the rack hides it, metres.
        count: Number of points.

    Returns:
        Cloud in the tube's frame, metres. It is shared: do not change it.
    """
    pieces = [_visible(tube.outer_profile_m(), hidden_m)]
    if tube.is_open:
        pieces.append(_visible(tube.cavity_profile_m(), tube.rim_height_m - RIM_VIEW_M))
    segments = np.vstack([np.hstack([piece[:-1], piece[1:]]) for piece in pieces])
    length = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    area = np.cumsum(length * (segments[:, 1] + segments[:, 3]))
    place = (np.arange(count) + 0.5) / count * area[-1]
    k = np.searchsorted(area, place)
    before = np.where(k > 0, area[k - 1], 0.0)
    t = (place - before) / (area[k] - before)
    z = segments[k, 0] + t * (segments[k, 2] - segments[k, 0])
    r = segments[k, 1] + t * (segments[k, 3] - segments[k, 1])
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    # The profile runs with the outside on its right: (dz, dr) turned gives the outward normal (-dr, dz).
    n_z = -(segments[k, 3] - segments[k, 1]) / length[k]
    n_r = (segments[k, 2] - segments[k, 0]) / length[k]
    cloud = to_o3d(np.column_stack([r * np.cos(turn), r * np.sin(turn), z]))
    cloud.normals = o3d.utility.Vector3dVector(np.column_stack([n_r * np.cos(turn), n_r * np.sin(turn), n_z]))
    return cloud


def _visible(profile_m: FloatArray, above_m: float) -> FloatArray:
    """Part of a profile (z, r) above a height, cut at it."""
    order = profile_m if profile_m[0, 0] <= profile_m[-1, 0] else profile_m[::-1]
    kept = order[order[:, 0] > above_m]
    cut = np.array([[above_m, np.interp(above_m, order[:, 0], order[:, 1])]])
    part = np.vstack([cut, kept])
    return part if order is profile_m else part[::-1]


@lru_cache(maxsize=32)
def template_features(template: o3d.geometry.PointCloud, config: IcpConfig) -> tuple[o3d.geometry.PointCloud, Feature]:
    """Down-sampled template with unit normals (tube frame, metres) and its FPFH features, made once per tube."""
    target = template.voxel_down_sample(config.voxel_m)
    target.normalize_normals()
    return target, _fpfh(target, config)


def scan_features(points_m: FloatArray, config: IcpConfig) -> tuple[o3d.geometry.PointCloud, Feature]:
    """The scan (N, 3), rack frame, metres, down-sampled, with normals as the camera saw them, and its FPFH features."""
    scan = to_o3d(points_m).voxel_down_sample(config.voxel_m)
    if len(scan.points) < MIN_FEATURES:
        return scan, registration.Feature()
    # Orient normals as the camera saw them: the rack's z points towards it.
    scan.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(config.normal_radius_m, 30))
    scan.orient_normals_towards_camera_location(np.array([0.0, 0.0, 1.0]))
    return scan, _fpfh(scan, config)


def _fpfh(cloud: o3d.geometry.PointCloud, config: IcpConfig) -> Feature:
    radius = o3d.geometry.KDTreeSearchParamHybrid(config.feature_radius_m, 100)
    return registration.compute_fpfh_feature(cloud, radius)  # type: ignore[call-arg]  # stub lacks a default
