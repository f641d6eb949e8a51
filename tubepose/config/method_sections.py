"""Sections `tube`, `icp` and `rivals`: the paper's method and the baselines."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from tubepose.config.section import Section

Objective = Literal["hinge", "signed", "l1", "l2", "count"]


class TubeConfig(Section):
    """The cylinder fit about the slot's bottom centre (paper, Eqs. 1 to 5).

    Attributes:
        objective: Cost of Eq. 3: ``hinge`` sum max(D - r, 0); ``signed`` sum (D - r), as printed; ``l1``; ``l2``;
            ``count`` of D > r, as in the authors' own program.
        max_tilt_rad: Bound of alpha and beta in the search.
        tolerance_m: Added to the clearance of Eq. 5, beside the rack's floor play, for the fit's error at the top.
        min_points: Fewer points reject the tube.
    """

    objective: Objective = "hinge"
    max_tilt_rad: float = 0.0872665
    tolerance_m: float = 5.0e-4
    min_points: int = 25


class IcpConfig(Section):
    """The rivals' registration (paper, section V-B): Open3D, same points, settings printed with the tables.

    Attributes:
        template_points: Points sampled from the visible part of the tube's profile.
        max_distance_m: Correspondence distances of the ICP rounds, coarse to fine.
        iterations: Iterations per round.
        estimation: Point-to-plane or point-to-point.
        voxel_m: Voxel of the global registration.
        normal_radius_m: Radius of the normals.
        feature_radius_m: Radius of the FPFH features.
        mutual_filter: Keep only feature pairs that are each other's nearest.
        ransac_distance_m: Inlier distance of the RANSAC.
        ransac_iterations: Most RANSAC iterations.
        ransac_confidence: RANSAC stops at this confidence.
    """

    template_points: int = 2000
    max_distance_m: tuple[float, ...] = (4.0e-3, 1.5e-3)
    iterations: int = 50
    estimation: Literal["point_to_plane", "point_to_point"] = "point_to_plane"
    voxel_m: float = Field(default=1.0e-3, gt=0)
    normal_radius_m: float = 3.0e-3
    feature_radius_m: float = 6.0e-3
    mutual_filter: bool = False
    ransac_distance_m: float = 1.5e-3
    ransac_iterations: int = 100_000
    ransac_confidence: float = 0.999


class RivalsConfig(Section):
    """The rivals of the extra ``rivals``: KISS-Matcher and small_gicp; settings printed with the tables.

    Attributes:
        kiss_voxel_m: Voxel of the features.
        kiss_normal_radius_m: Radius of the normals.
        kiss_feature_radius_m: Radius of the FPFH features.
        kiss_neighbors: How many of the template's features each scan feature is paired with.
        kiss_pairs: Pairs that one attempt sees, drawn by the seed.
        kiss_noise_bound_m: Noise bound of the pruning by pairwise distances; the solver's is `kiss_solver_gain` of it.
        kiss_solver_gain: At most 1.
        kiss_pruning: Prune the pairs by k-core before they are solved.
        kiss_attempts: Draws of pairs; the best by agreement of points and normals is kept.
        kiss_agree_m: A point this near to the template, with a normal within 30 degrees, agrees.
        kiss_refinement: ``icp``, as the other rivals, or ``gicp``.
        gicp_kind: Registration of small_gicp.
        gicp_target: ``template``: scan onto template; ``scan``: template onto scan.
        gicp_max_distance_m: Correspondence distances of the rounds, coarse to fine.
        gicp_neighbors: Neighbours of a point's covariance.
        gicp_iterations: Iterations per round.
    """

    kiss_voxel_m: float = Field(default=0.7e-3, gt=0)
    kiss_normal_radius_m: float = Field(default=2.4e-3, gt=0)
    kiss_feature_radius_m: float = Field(default=4.0e-3, gt=0)
    kiss_neighbors: int = Field(default=10, ge=1)
    kiss_pairs: int = Field(default=200, ge=3)
    kiss_noise_bound_m: float = Field(default=2.0e-3, gt=0)
    kiss_solver_gain: float = Field(default=0.75, gt=0, le=1)
    kiss_pruning: bool = True
    kiss_attempts: int = Field(default=40, ge=1)
    kiss_agree_m: float = Field(default=1.5e-3, gt=0)
    kiss_refinement: Literal["icp", "gicp"] = "gicp"
    gicp_kind: Literal["GICP", "PLANE_ICP", "ICP"] = "GICP"
    gicp_target: Literal["template", "scan"] = "template"
    gicp_max_distance_m: tuple[float, ...] = Field(default=(1.5e-3,), min_length=1)
    gicp_neighbors: int = Field(default=7, ge=5)
    gicp_iterations: int = Field(default=50, ge=1)
