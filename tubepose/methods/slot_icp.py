"""Method `slot-icp`: ICP onto the tube's template from upright in its slot, by Open3D. No rejection is applied.

Every scan point looks for its partner on the template: the scan is partial, the template is whole.
"""

from __future__ import annotations

import open3d as o3d

from tubepose.config import Config, IcpConfig
from tubepose.labware import RackModel, SlotModel, TubeModel
from tubepose.methods.method import EachTube
from tubepose.methods.visible_template import visible_template
from tubepose.preprocessing import to_o3d
from tubepose.transforms import FloatArray, axis_rotation, invert_transform, make_transform, translation
from tubepose.tube import TubePose, TubeStatus, failed

registration = o3d.pipelines.registration


def fit_slot_icp(
    points_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel, config: Config, seed: int = 0
) -> TubePose:
    """ICP onto the tube's template, started upright in the slot."""
    del seed
    start = translation(rack.bottom_center_m(slot))
    if len(points_m) < 3:
        return failed("fewer than 3 points", len(points_m))
    return refine(points_m, start, visible_template(tube, rack.depth_m, config.icp.template_points), config.icp)


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
            return failed(f"ICP found no correspondence within {distance_m * 1e3:.1f} mm", len(points_m))
        T_tube_rack, fitness, rmse = result.transformation, float(result.fitness), float(result.inlier_rmse)
    T = invert_transform(T_tube_rack)
    T_fixed_spin = make_transform(axis_rotation(T[:3, 2]), T[:3, 3])
    return TubePose(TubeStatus.OK, "", T_fixed_spin, inlier_rmse_m=rmse, fitness=fitness, n_points=len(points_m))


SLOT_ICP = EachTube("slot-icp", fit_slot_icp)
