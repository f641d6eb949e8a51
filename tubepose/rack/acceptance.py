"""When a registration is a rack, and what to say when it is not (paper, section IV-A, with tests of our own).

Fitness and rmse accept a rack of another pitch, so the openings are looked at as well; and a capture that cannot show
the ribs, or whose depth waves more than a registration may be off, is told apart from a wrong rack.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from tubepose.config import RackConfig
from tubepose.labware import RackModel
from tubepose.transforms import FloatArray, invert_transform, transform_points

COVERED_WITHIN_M = 2.5e-3
COVERAGE_STEP = 7


def agreement(
    scan_m: FloatArray, T_camera_rack: FloatArray, template_m: FloatArray, rack: RackModel, config: RackConfig
) -> tuple[float, float]:
    """Share of the scan inside the openings, and share of the template that the scan covers."""
    in_rack = transform_points(invert_transform(T_camera_rack), scan_m)
    inside_outline = np.all(np.abs(in_rack[:, :2]) <= rack.outline_m / 2, axis=1)
    in_slot = inside_outline & (rack.top_signed_distance_m(in_rack[:, :2]) > config.slot_margin_m)
    distances, _ = cKDTree(in_rack).query(template_m[::COVERAGE_STEP], distance_upper_bound=COVERED_WITHIN_M)
    return float(in_slot.mean()), float(np.isfinite(distances).mean())


def outline_words(rack: RackModel) -> str:
    """Sides of the top, in words, millimetres."""
    return " x ".join(f"{side:g}" for side in rack.outline_mm)


def refusal(fitness: float, rmse_m: float, in_slot: float, coverage: float, rack: RackModel, config: RackConfig) -> str:
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


def too_noisy(noise_m: float, reason: str, config: RackConfig) -> str:
    """Sentence for depth that scatters more than a registration may be off."""
    return (
        f"depth scatters by {noise_m * 1e3:.1f} mm on level patches, "
        f"at most {config.max_inlier_rmse_m * 1e3:.1f} mm can be registered ({reason})"
    )


def too_coarse(spacing_m: float, rack: RackModel, config: RackConfig) -> str:
    """Sentence for points farther apart than the narrowest rib is wide; empty if they are not, or it is not known."""
    limit_m = config.max_spacing_ratio * rack.min_rib_m
    if not spacing_m > limit_m:
        return ""
    return (
        f"points are {spacing_m * 1e3:.2f} mm apart, and the ribs of {rack.name} are "
        f"{rack.min_rib_m * 1e3:.2f} mm wide; a finer or nearer scan is needed"
    )
