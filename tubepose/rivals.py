"""The rivals of today, with the signature of ours: KISS-Matcher (global) and small_gicp (local).

Both are packages of the extra ``rivals`` and are imported only when they are asked. Like the older rivals they look for
the tube's visible template (`baselines.visible_template`), have settings chosen on development data, and no rejection.

Of KISS-Matcher its pruning and its solver are used; pairs of features come from Open3D. Its own matcher drops a pair
whose second best partner is nearly as good. On a body that looks the same all around that is almost every pair, and the
test cannot be turned off from Python (`python -m benchmarks.kiss_matcher_pairs`).
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from importlib import import_module
from typing import Any

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from tubepose.baselines import (
    MIN_FEATURES,
    failed,
    refine,
    registration,
    scan_features,
    template_features,
    visible_template,
)
from tubepose.config import Config, RivalsConfig
from tubepose.errors import TubePoseError
from tubepose.labware import RackModel, SlotModel, TubeModel
from tubepose.transforms import (
    FloatArray,
    axis_rotation,
    invert_transform,
    make_transform,
    transform_points,
    translation,
)
from tubepose.tube import TubePose, TubeStatus

PACKAGES = {"kiss-matcher": ("kiss_matcher", "small_gicp"), "gicp": ("small_gicp",)}
MIN_COVARIANCE_POINTS = 10
COARSE_ITERATIONS = 15
COS_AGREE = float(np.cos(np.deg2rad(30)))
ROTATION_EPSILON_RAD = 1.0e-5
TRANSLATION_EPSILON_M = 1.0e-7
MILLIMETRES = 1.0e3


def require_packages(methods: Iterable[str]) -> None:
    """Import what the named methods need.

    Raises:
        TubePoseError: A package is not installed.
    """
    for method in methods:
        for package in PACKAGES.get(method, ()):
            _package(package, method)


def settings_note(method: str, config: Config, seeds: int) -> str:
    """Settings of a method of this module in one sentence, for the notes of a table."""
    rivals = config.rivals
    way = "scan onto template" if rivals.gicp_target == "template" else "template onto scan"
    gicp = (
        f"small_gicp {rivals.gicp_kind}, {way}, distances {_millimetres(*rivals.gicp_max_distance_m)}, "
        f"{rivals.gicp_neighbors} neighbours"
    )
    if method == "gicp":
        return f"gicp: {gicp}, from upright in the slot. No rejection."
    pruned = "pruning by k-core and GNC" if rivals.kiss_pruning else "GNC without pruning"
    refinement = gicp if rivals.kiss_refinement == "gicp" else "ICP as slot-icp"
    return (
        f"kiss-matcher: FPFH (radius {_millimetres(rivals.kiss_feature_radius_m)}, normals "
        f"{_millimetres(rivals.kiss_normal_radius_m)}, voxel {_millimetres(rivals.kiss_voxel_m)}), "
        f"{rivals.kiss_neighbors} partners each; KISS-Matcher's {pruned}, noise "
        f"{_millimetres(rivals.kiss_noise_bound_m)}, best of {rivals.kiss_attempts} draws of "
        f"{rivals.kiss_pairs} pairs, {seeds} seeds; then {refinement}. No rejection."
    )


def _millimetres(*lengths_m: float) -> str:
    return ", ".join(f"{length * 1e3:g}" for length in lengths_m) + " mm"


def _package(package: str, method: str) -> None:
    try:
        import_module(package)
    except ImportError:
        raise TubePoseError(
            f"method '{method}' needs the package {package}, which is not installed; in a checkout: "
            "pip install '.[rivals]'"
        ) from None


def fit_gicp(
    points_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel, config: Config, seed: int = 0
) -> TubePose:
    """small_gicp between scan and template, started upright in the slot."""
    del seed
    require_packages(["gicp"])
    start = translation(rack.bottom_center_m(slot))
    return _refine_gicp(
        points_m, start, visible_template(tube, rack.depth_m, config.icp.template_points), config.rivals
    )


def fit_kiss_matcher(
    points_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel, config: Config, seed: int = 0
) -> TubePose:
    """KISS-Matcher's pruning and solver on pairs of FPFH features, then a refinement; no prior from the rack.

    The template looks the same from all around, so that pairs agree on the spin only by chance: each attempt draws
    some of the pairs, and the attempt with the most points and normals on the template is kept.
    """
    del slot
    require_packages(["kiss-matcher"])
    rivals = config.rivals
    template = visible_template(tube, rack.depth_m, config.icp.template_points)
    features = config.icp.model_copy(
        update={name: getattr(rivals, f"kiss_{name}") for name in ("voxel_m", "normal_radius_m", "feature_radius_m")}
    )
    scan, scan_fpfh = scan_features(points_m, features)
    if len(scan.points) < MIN_FEATURES:
        return failed(f"{len(scan.points)} points after down-sampling, at least {MIN_FEATURES} expected", points_m)
    target, target_fpfh = template_features(template, features)
    pairs = _pairs(scan_fpfh.data.T, target_fpfh.data.T, rivals.kiss_neighbors)
    rng = np.random.default_rng(seed)
    best, best_share = None, 0.0
    for _ in range(rivals.kiss_attempts):
        drawn = pairs[rng.permutation(len(pairs))[: rivals.kiss_pairs]]
        start = _solve(np.asarray(scan.points)[drawn[:, 0]], np.asarray(target.points)[drawn[:, 1]], rivals)
        settled, share = _settle(scan, start, template, config) if start is not None else (None, 0.0)
        if share > best_share:
            best, best_share = settled, share
    if best is None:
        return failed(f"KISS-Matcher found no pose in {rivals.kiss_attempts} attempts", points_m)
    if rivals.kiss_refinement == "gicp":
        return _refine_gicp(points_m, best, template, rivals)
    return refine(points_m, best, template, config.icp)


def _pairs(scan: FloatArray, template: FloatArray, neighbors: int) -> FloatArray:
    """Rows (scan feature, template feature) of the nearest template features of every scan feature, shape (M, 2)."""
    _, nearest = cKDTree(template).query(scan, k=min(neighbors, len(template)))
    nearest = np.asarray(nearest).reshape(len(scan), -1)
    return np.column_stack([np.repeat(np.arange(len(scan)), nearest.shape[1]), nearest.ravel()])


def _solve(scan_m: FloatArray, template_m: FloatArray, rivals: RivalsConfig) -> FloatArray | None:
    """T_rack_tube of paired points (M, 3), or None.

    The package refuses voxels below 5 mm taken as metres: it is given millimetres, about the scan's mean.
    """
    import kiss_matcher

    bound_mm = rivals.kiss_noise_bound_m * MILLIMETRES
    settings = kiss_matcher.KISSMatcherConfig(
        voxel_size=1.0,
        use_voxel_sampling=False,
        robin_noise_bound_gain=bound_mm,
        solver_noise_bound_gain=bound_mm * rivals.kiss_solver_gain,
        enable_noise_bound_clamping=False,
    )
    matcher = kiss_matcher.KISSMatcher(settings)
    origin_m = scan_m.mean(axis=0)
    source, target = template_m * MILLIMETRES, (scan_m - origin_m) * MILLIMETRES
    try:
        if rivals.kiss_pruning:
            found = matcher.prune_and_solve(list(source.astype(np.float32)), list(target.astype(np.float32)))
        else:
            found = matcher.solve(source.T, target.T)
    except RuntimeError:
        return None
    T = make_transform(np.asarray(found.rotation), np.asarray(found.translation).ravel() / MILLIMETRES + origin_m)
    if not found.valid or matcher.get_num_final_inliers() < 3 or not np.isfinite(T).all():
        return None
    return T


def _settle(
    scan: o3d.geometry.PointCloud, T_rack_tube: FloatArray, template: o3d.geometry.PointCloud, config: Config
) -> tuple[FloatArray, float]:
    """One coarse ICP round from an attempt, and the share of the scan whose points and normals then agree."""
    result = registration.registration_icp(
        scan,
        template,
        config.icp.max_distance_m[0],
        invert_transform(T_rack_tube),
        registration.TransformationEstimationPointToPlane(),
        registration.ICPConvergenceCriteria(max_iteration=COARSE_ITERATIONS),
    )
    T_tube_rack = np.asarray(result.transformation)
    tree, normals = _indexed(template)
    distance, row = tree.query(transform_points(T_tube_rack, np.asarray(scan.points)))
    cosine = np.einsum("ij,ij->i", np.asarray(scan.normals) @ T_tube_rack[:3, :3].T, normals[row])
    share = float(np.mean((distance < config.rivals.kiss_agree_m) & (cosine > COS_AGREE)))
    return invert_transform(T_tube_rack), share


@lru_cache(maxsize=32)
def _indexed(template: o3d.geometry.PointCloud) -> tuple[Any, FloatArray]:
    return cKDTree(np.asarray(template.points)), np.asarray(template.normals)


def _refine_gicp(
    points_m: FloatArray, T_rack_tube: FloatArray, template: o3d.geometry.PointCloud, rivals: RivalsConfig
) -> TubePose:
    """Rounds of small_gicp, coarse to fine; the spin is fixed by the rule of Eq. 1."""
    import small_gicp

    if len(points_m) < MIN_COVARIANCE_POINTS:
        return failed(f"{len(points_m)} points, at least {MIN_COVARIANCE_POINTS} expected", points_m)
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
            return failed(f"{rivals.gicp_kind} found no correspondence within {distance_m * 1e3:.1f} mm", points_m)
        if not np.isfinite(T).all():
            return failed(f"{rivals.gicp_kind} diverged", points_m)
    T_tube_rack = T if onto_template else invert_transform(T)
    # The package's own error is weighted by covariances: distances are measured here.
    distance, _ = _indexed(template)[0].query(transform_points(T_tube_rack, points_m))
    near = distance[distance < rivals.gicp_max_distance_m[-1]]
    if len(near) == 0:
        return failed(f"{rivals.gicp_kind} ended away from the template", points_m)
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
