"""Method `gicp`: generalized ICP (Segal et al.) by small_gicp, from upright in the slot. No rejection is applied.

The package is of the extra ``rivals`` and is imported only when it is asked. Settings were chosen on development data.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from tubepose.config import Config, RivalsConfig
from tubepose.labware import RackModel, SlotModel, TubeModel
from tubepose.methods.method import EachTube, millimetres, require_packages
from tubepose.methods.visible_template import visible_template
from tubepose.transforms import (
    FloatArray,
    axis_rotation,
    invert_transform,
    make_transform,
    transform_points,
    translation,
)
from tubepose.tube import TubePose, TubeStatus, failed

PACKAGES = ("small_gicp",)
MIN_COVARIANCE_POINTS = 10
ROTATION_EPSILON_RAD = 1.0e-5
TRANSLATION_EPSILON_M = 1.0e-7


def fit_gicp(
    points_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel, config: Config, seed: int = 0
) -> TubePose:
    """small_gicp between scan and template, started upright in the slot."""
    del seed
    require_packages("gicp", PACKAGES)
    start = translation(rack.bottom_center_m(slot))
    return refine_gicp(points_m, start, visible_template(tube, rack.depth_m, config.icp.template_points), config.rivals)


def refine_gicp(
    points_m: FloatArray, T_rack_tube: FloatArray, template: o3d.geometry.PointCloud, rivals: RivalsConfig
) -> TubePose:
    """Rounds of small_gicp, coarse to fine; the spin is fixed by the rule of Eq. 1."""
    import small_gicp

    if len(points_m) < MIN_COVARIANCE_POINTS:
        return failed(f"{len(points_m)} points, at least {MIN_COVARIANCE_POINTS} expected", len(points_m))
    scan, model = _prepared(points_m, rivals.gicp_neighbors), _prepared_template(template, rivals.gicp_neighbors)
    onto_template = rivals.gicp_target == "template"
    (target, tree), (source, _) = (model, scan) if onto_template else (scan, model)
    T = invert_transform(T_rack_tube) if onto_template else T_rack_tube
    for distance_m in rivals.gicp_max_distance_m:
        found = small_gicp.align(
            target,
            source,
            tree,
            T,
            registration_type=rivals.gicp_kind,
            max_correspondence_distance=distance_m,
            max_iterations=rivals.gicp_iterations,
            rotation_epsilon=ROTATION_EPSILON_RAD,
            translation_epsilon=TRANSLATION_EPSILON_M,
        )
        T = np.asarray(found.T_target_source)
        if found.num_inliers < 3:
            return failed(f"{rivals.gicp_kind} found no correspondence within {distance_m * 1e3:.1f} mm", len(points_m))
        if not np.isfinite(T).all():
            return failed(f"{rivals.gicp_kind} diverged", len(points_m))
    T_tube_rack = T if onto_template else invert_transform(T)
    # The package's own error is weighted by covariances: distances are measured here.
    distance, _ = nearest_on(template)[0].query(transform_points(T_tube_rack, points_m))
    near = distance[distance < rivals.gicp_max_distance_m[-1]]
    if len(near) == 0:
        return failed(f"{rivals.gicp_kind} ended away from the template", len(points_m))
    fitness, rmse_m = len(near) / len(points_m), float(np.sqrt(np.mean(near**2)))
    T = invert_transform(T_tube_rack)
    T_fixed_spin = make_transform(axis_rotation(T[:3, 2]), T[:3, 3])
    return TubePose(TubeStatus.OK, "", T_fixed_spin, inlier_rmse_m=rmse_m, fitness=fitness, n_points=len(points_m))


def _prepared(points_m: FloatArray, neighbors: int) -> tuple[Any, Any]:
    """Cloud with normals and covariances, and its tree, as small_gicp wants them."""
    import small_gicp

    cloud = small_gicp.PointCloud(np.ascontiguousarray(points_m, dtype=float))
    tree = small_gicp.KdTree(cloud)
    small_gicp.estimate_normals_covariances(cloud, tree, neighbors)
    return cloud, tree


@lru_cache(maxsize=32)
def _prepared_template(template: o3d.geometry.PointCloud, neighbors: int) -> tuple[Any, Any]:
    return _prepared(np.asarray(template.points), neighbors)


@lru_cache(maxsize=32)
def nearest_on(template: o3d.geometry.PointCloud) -> tuple[Any, FloatArray]:
    """Tree of a template's points, and their normals."""
    return cKDTree(np.asarray(template.points)), np.asarray(template.normals)


def settings_words(rivals: RivalsConfig) -> str:
    """Settings in a few words."""
    way = "scan onto template" if rivals.gicp_target == "template" else "template onto scan"
    return (
        f"small_gicp {rivals.gicp_kind}, {way}, distances {millimetres(*rivals.gicp_max_distance_m)}, "
        f"{rivals.gicp_neighbors} neighbours"
    )


def settings_note(config: Config, seeds: int) -> str:
    """Settings in one sentence, for the notes of a table."""
    del seeds
    return f"gicp: {settings_words(config.rivals)}, from upright in the slot. No rejection."


GICP = EachTube("gicp", fit_gicp, packages=PACKAGES, settings=settings_note)
