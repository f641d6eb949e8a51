"""Method `global-icp`: FPFH features, RANSAC and ICP by Open3D, without any prior from the rack (paper, section V-B).

The paper compares with Open3D's global registration + ICP and gives no parameters. Here it has its best chance: the
template is only what a scanner above can see of the tube, and its settings are printed with the tables. No rejection is
applied.
"""

from __future__ import annotations

import numpy as np
import open3d as o3d

from tubepose.config import Config
from tubepose.labware import RackModel, SlotModel, TubeModel
from tubepose.methods.fpfh import MIN_FEATURES, scan_features, template_features
from tubepose.methods.method import EachTube, millimetres
from tubepose.methods.slot_icp import refine, registration
from tubepose.methods.visible_template import visible_template
from tubepose.transforms import FloatArray, invert_transform
from tubepose.tube import TubePose, failed


def fit_global_icp(
    points_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel, config: Config, seed: int = 0
) -> TubePose:
    """Global registration (FPFH features, RANSAC) + ICP, without any prior from the rack."""
    del slot
    template = visible_template(tube, rack.depth_m, config.icp.template_points)
    target, target_features = template_features(template, config.icp)
    scan, features = scan_features(points_m, config.icp)
    if len(scan.points) < MIN_FEATURES:
        return failed(f"{len(scan.points)} points after down-sampling, at least {MIN_FEATURES} expected", len(points_m))
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
        return failed("global registration found no correspondence", len(points_m))
    return refine(points_m, invert_transform(found.transformation), template, config.icp)


def settings_note(config: Config, seeds: int) -> str:
    """Settings in one sentence, for the notes of a table."""
    icp = config.icp
    return (
        f"global-icp: Open3D FPFH (radius {millimetres(icp.feature_radius_m)}, normals "
        f"{millimetres(icp.normal_radius_m)}, voxel {millimetres(icp.voxel_m)}) + RANSAC "
        f"({icp.ransac_iterations} iterations, {millimetres(icp.ransac_distance_m)}), "
        f"{seeds} seeds; then ICP {icp.estimation}, distances {millimetres(*icp.max_distance_m)}, as slot-icp. "
        "No rejection in either."
    )


GLOBAL_ICP = EachTube("global-icp", fit_global_icp, is_stochastic=True, settings=settings_note)
