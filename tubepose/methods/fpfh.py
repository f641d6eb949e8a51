"""Fast point feature histograms (FPFH) of scan and template, by Open3D: where the global baselines start from."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import open3d as o3d

from tubepose.config import IcpConfig
from tubepose.preprocessing import to_o3d
from tubepose.transforms import FloatArray

Feature = o3d.pipelines.registration.Feature
MIN_FEATURES = 10


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
        return scan, Feature()
    # Orient normals as the camera saw them: the rack's z points towards it.
    scan.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(config.normal_radius_m, 30))
    scan.orient_normals_towards_camera_location(np.array([0.0, 0.0, 1.0]))
    return scan, _fpfh(scan, config)


def _fpfh(cloud: o3d.geometry.PointCloud, config: IcpConfig) -> Feature:
    radius = o3d.geometry.KDTreeSearchParamHybrid(config.feature_radius_m, 100)
    return o3d.pipelines.registration.compute_fpfh_feature(cloud, radius)  # type: ignore[call-arg]  # stub lacks a default
