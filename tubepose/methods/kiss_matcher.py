"""Method `kiss-matcher`: KISS-Matcher (Lim et al.) for a global pose, then a refinement. No rejection is applied.

Of KISS-Matcher its pruning and its solver are used; pairs of features come from Open3D. Its own matcher drops a pair
whose second best partner is nearly as good. On a body that looks the same all around that is almost every pair, and the
test cannot be turned off from Python (`python -m benchmarks.kiss_matcher_pairs`). The packages are of the extra
``rivals`` and are imported only when they are asked. Settings were chosen on development data.
"""

from __future__ import annotations

import numpy as np
import open3d as o3d
from scipy.spatial import cKDTree

from tubepose.config import Config, RivalsConfig
from tubepose.labware import RackModel, SlotModel, TubeModel
from tubepose.methods.fpfh import MIN_FEATURES, scan_features, template_features
from tubepose.methods.gicp import nearest_on, refine_gicp, settings_words
from tubepose.methods.method import EachTube, millimetres, require_packages
from tubepose.methods.slot_icp import refine, registration
from tubepose.methods.visible_template import visible_template
from tubepose.transforms import FloatArray, invert_transform, make_transform, transform_points
from tubepose.tube import TubePose, failed

PACKAGES = ("kiss_matcher", "small_gicp")
COARSE_ITERATIONS = 15
COS_AGREE = float(np.cos(np.deg2rad(30)))
MILLIMETRES = 1.0e3


def fit_kiss_matcher(
    points_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel, config: Config, seed: int = 0
) -> TubePose:
    """KISS-Matcher's pruning and solver on pairs of FPFH features, then a refinement; no prior from the rack.

    The template looks the same from all around, so that pairs agree on the spin only by chance: each attempt draws
    some of the pairs, and the attempt with the most points and normals on the template is kept.
    """
    del slot
    require_packages("kiss-matcher", PACKAGES)
    rivals = config.rivals
    template = visible_template(tube, rack.depth_m, config.icp.template_points)
    features = config.icp.model_copy(
        update={name: getattr(rivals, f"kiss_{name}") for name in ("voxel_m", "normal_radius_m", "feature_radius_m")}
    )
    scan, scan_fpfh = scan_features(points_m, features)
    if len(scan.points) < MIN_FEATURES:
        return failed(f"{len(scan.points)} points after down-sampling, at least {MIN_FEATURES} expected", len(points_m))
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
        return failed(f"KISS-Matcher found no pose in {rivals.kiss_attempts} attempts", len(points_m))
    if rivals.kiss_refinement == "gicp":
        return refine_gicp(points_m, best, template, rivals)
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
    tree, normals = nearest_on(template)
    distance, row = tree.query(transform_points(T_tube_rack, np.asarray(scan.points)))
    cosine = np.einsum("ij,ij->i", np.asarray(scan.normals) @ T_tube_rack[:3, :3].T, normals[row])
    share = float(np.mean((distance < config.rivals.kiss_agree_m) & (cosine > COS_AGREE)))
    return invert_transform(T_tube_rack), share


def settings_note(config: Config, seeds: int) -> str:
    """Settings in one sentence, for the notes of a table."""
    rivals = config.rivals
    pruned = "pruning by k-core and GNC" if rivals.kiss_pruning else "GNC without pruning"
    refinement = settings_words(rivals) if rivals.kiss_refinement == "gicp" else "ICP as slot-icp"
    return (
        f"kiss-matcher: FPFH (radius {millimetres(rivals.kiss_feature_radius_m)}, normals "
        f"{millimetres(rivals.kiss_normal_radius_m)}, voxel {millimetres(rivals.kiss_voxel_m)}), "
        f"{rivals.kiss_neighbors} partners each; KISS-Matcher's {pruned}, noise "
        f"{millimetres(rivals.kiss_noise_bound_m)}, best of {rivals.kiss_attempts} draws of "
        f"{rivals.kiss_pairs} pairs, {seeds} seeds; then {refinement}. No rejection."
    )


KISS_MATCHER = EachTube("kiss-matcher", fit_kiss_matcher, is_stochastic=True, packages=PACKAGES, settings=settings_note)
