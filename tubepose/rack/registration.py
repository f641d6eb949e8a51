"""A registration of the rack by one of the two methods, and what to say when it fails.

Either way a registration that contradicts the rack's definition is refused, and what a capture cannot show is told
apart from a wrong rack.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from tubepose.capture.frame import CameraIntrinsics
from tubepose.capture.hints import TurnHint
from tubepose.checks import reason
from tubepose.config import Config
from tubepose.labware import RackModel
from tubepose.preprocessing import level_noise_m, plausible_unit_factors, thin
from tubepose.rack.edges import register_edges
from tubepose.rack.insufficient import outline_words, too_noisy
from tubepose.rack.obb import register_obb_icp
from tubepose.rack.pose import MIN_POINTS, RackPose, RackStatus
from tubepose.rack.viewpoint import viewpoint_checks
from tubepose.transforms import FloatArray

_Method = Callable[
    [FloatArray, RackModel, Config, TurnHint | None, CameraIntrinsics | None],
    RackPose,
]
# Points that tell a smooth scan, or a rough one, from a doubtful one, and shares of the limit where they do.
NOISE_POINTS = 20_000
CLEAR_NOISE = (0.75, 1.3)
_METHODS: dict[str, _Method] = {"edges": register_edges, "obb-icp": register_obb_icp}


def register_rack(
    points_m: FloatArray,
    rack: RackModel,
    config: Config,
    hint: TurnHint | None = None,
    intrinsics: CameraIntrinsics | None = None,
) -> RackPose:
    """Estimate a rack's pose from the points that a detector gave it.

    Args:
        points_m: Array of shape (N, 3), camera frame, metres, without NaN: the rack's box, with whatever stands in it,
            or the whole frame.
        rack: The rack's definition.
        config: Sections preprocess, rack_top and rack are used; `rack.method` names the method.
        hint: Where a slot is or where the rack stood before, to tell its turns apart.
        intrinsics: Of the image that a pixel of the hint is of; without them it is not used.
    """
    method = _METHODS[config.rack.method]
    pose = method(points_m, rack, config, hint, intrinsics)
    if pose.status is RackStatus.OK:
        return _seen_from_origin(pose, points_m, rack)
    if len(points_m) < MIN_POINTS:
        return pose
    # Asked of a too coarse scan as well: millimetres read as metres are one.
    reason = _unit_suspicion(points_m, rack, config, method)
    if reason:
        return replace(pose, status=RackStatus.UNIT, reason=reason, code="wrong_unit")
    if pose.status is not RackStatus.INSUFFICIENT:
        noise_m = _noise_m(points_m, config)
        if noise_m > config.rack.max_inlier_rmse_m:
            words = too_noisy(noise_m, pose.reason, config.rack)
            return replace(pose, status=RackStatus.INSUFFICIENT, reason=words, code="too_noisy")
    return pose


def _seen_from_origin(pose: RackPose, points_m: FloatArray, rack: RackModel) -> RackPose:
    """The same pose, refused where its face was not seen from the origin."""
    assert pose.T_camera_rack is not None
    checks = tuple(viewpoint_checks(points_m, pose.T_camera_rack, rack))
    said = reason(checks, rack.name)
    if not said:
        return replace(pose, checks=pose.checks + checks)
    return RackPose(RackStatus.REFUSED, said, spacing_m=pose.spacing_m, checks=pose.checks + checks)


def _noise_m(points_m: FloatArray, config: Config) -> float:
    """How far depth scatters, metres: told by a sample, and by all points where that is near the limit."""
    noise_m = level_noise_m(thin(points_m, NOISE_POINTS), config.rack_top)
    low, high = CLEAR_NOISE
    if noise_m < low * config.rack.max_inlier_rmse_m or noise_m > high * config.rack.max_inlier_rmse_m:
        return noise_m
    return level_noise_m(points_m, config.rack_top)


def _unit_suspicion(points_m: FloatArray, rack: RackModel, config: Config, method: _Method) -> str:
    """A sentence when the rack is there at another scale, accepted by every test that a pose has to pass."""
    for factor in plausible_unit_factors(points_m, rack):
        if method(points_m / factor, rack, config, None, None).status is RackStatus.OK:
            size = f"{factor:g} times larger" if factor > 1 else f"{1 / factor:g} times smaller"
            unit = "--unit m or mm; " if max(factor, 1 / factor) > 100 else ""
            return (
                f"a rack of this shape is there, but {size} than {rack.name} ({outline_words(rack)} mm): "
                f"is the unit of the capture declared right ({unit}of depth images --depth-scale, {1 / factor:g} "
                "times the metres per count of now)?"
            )
    return ""
