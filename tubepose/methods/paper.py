"""Method `paper`: a cylinder turned about the slot's bottom centre (paper, section IV-B, Eqs. 1 to 5)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import minimize

from tubepose.checks import Check, first_reason
from tubepose.config import Config, Objective
from tubepose.labware import RackModel, SlotModel, TubeModel
from tubepose.methods.method import EachTube
from tubepose.preprocessing import thin
from tubepose.transforms import FloatArray, make_transform, tilt_rotation
from tubepose.tube import TubePose, TubeStatus, refused


def axis_distance_m(points_m: FloatArray, origin_m: FloatArray, alpha_rad: float, beta_rad: float) -> FloatArray:
    """Distance D of points (N, 3) to the tube's axis, Eq. 2; metres, rack frame."""
    d = tilt_rotation(alpha_rad, beta_rad)[:, 2]
    return np.asarray(np.linalg.norm(np.cross(origin_m - points_m, d), axis=1))


_COSTS: dict[Objective, Callable[[FloatArray], float]] = {
    "hinge": lambda excess: float(np.maximum(excess, 0.0).sum()),
    "signed": lambda excess: float(excess.sum()),
    "l1": lambda excess: float(np.abs(excess).sum()),
    "l2": lambda excess: float((excess**2).sum()),
    "count": lambda excess: float(np.count_nonzero(excess > 0)),
}


def fit_cylinder(
    points_m: FloatArray, origin_m: FloatArray, radius_m: float, objective: Objective, max_tilt_rad: float
) -> tuple[float, float]:
    """Minimise Eq. 3 over (alpha, beta) about a fixed origin, in radians.

    The printed form of Eq. 3 has neither square nor absolute value and pulls the axis into the cloud; the hinge is the
    smooth form of what the authors' own program counts. Powell's method, as theirs, within +-`max_tilt_rad`.

    Args:
        points_m: Array of shape (N, 3), rack frame, metres.
        origin_m: The slot's bottom centre o_i, shape (3,).
        radius_m: Radius r_i of the cylinder: the largest that the scanner sees.
        objective: Which cost.
        max_tilt_rad: Bound of both angles.
    """
    cost = _COSTS[objective]
    offset = points_m - origin_m
    squared = np.einsum("ij,ij->i", offset, offset)

    def total(angles: FloatArray) -> float:
        ca, sa, cb, sb = np.cos(angles[0]), np.sin(angles[0]), np.cos(angles[1]), np.sin(angles[1])
        # |(o - p) x d|^2 = |p - o|^2 - ((p - o) d)^2 for a unit d: Eq. 2 without the cross product.
        along = offset @ np.array([sb * ca, -sa, cb * ca])
        return cost(np.sqrt(np.maximum(squared - along * along, 0.0)) - radius_m)

    bounds = [(-max_tilt_rad, max_tilt_rad)] * 2
    found = minimize(total, np.zeros(2), method="Powell", bounds=bounds, options={"xtol": 1e-5, "ftol": 1e-9})
    return float(found.x[0]), float(found.x[1])


def clearance_m(tilt_rad: float, half_size_m: float, depth_m: float, body_radius_m: float) -> float:
    """Room left at the slot's top by a tube that leans by `tilt` along one axis, Eq. 5 in its correct form, metres.

    Eq. 5 as printed holds for the elevation of the axis above the horizontal; with the tilt t it reads
    ``H tan t + r / cos t < W``, and r is the radius of the body inside the slot, not the cap's. Negative: they overlap.
    """
    t = abs(tilt_rad)
    return float(half_size_m - depth_m * np.tan(t) - body_radius_m / np.cos(t))


def wall_checks(
    alpha_rad: float, beta_rad: float, slot: SlotModel, tube: TubeModel, rack: RackModel, config: Config
) -> tuple[Check, ...]:
    """Whether the slot's walls allow a pose (Eq. 5), along x and along y.

    Rotation about y (beta) leans along x, rotation about x (alpha) along y. A bottom that may stand off the centre by
    the rack's floor play leaves that much more room.
    """
    half_x, half_y = slot.half_size_m
    radius = float(tube.body_radius_m(rack.depth_m))
    allowance = rack.floor_play_mm * 1e-3 + config.tube.tolerance_m
    found = []
    for name, angle, half in (("x", beta_rad, half_x), ("y", alpha_rad, half_y)):
        inside_mm = -1e3 * (clearance_m(angle, half, rack.depth_m, radius) + allowance)
        words = f"leans {np.rad2deg(abs(angle)):.2f} deg along the rack's {name}"
        found.append(Check("in_wall", inside_mm, 0.0, inside_mm <= 0, detail=words))
    return tuple(found)


def fit_tube(
    points_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel, config: Config, seed: int = 0
) -> TubePose:
    """The paper's method: Eqs. 1 to 4 about the slot's bottom centre, then the rejection of Eq. 5.

    Args:
        points_m: The tube's points above the rack's top, rack frame, shape (N, 3), metres.
        slot: The slot that it stands in.
        tube: Its model.
        rack: The rack's model.
        config: Sections preprocess and tube are used.
        seed: Not used; the method is deterministic.
    """
    del seed
    if len(points_m) < config.tube.min_points:
        few = Check("few_points", len(points_m), config.tube.min_points, False)
        return refused(few, tube.name, len(points_m))
    points_m = thin(points_m, config.preprocess.tube_max_points)
    origin_m = rack.bottom_center_m(slot)
    radius_m = tube.max_radius_m
    alpha, beta = fit_cylinder(points_m, origin_m, radius_m, config.tube.objective, config.tube.max_tilt_rad)
    excess = np.maximum(axis_distance_m(points_m, origin_m, alpha, beta) - radius_m, 0.0)
    checks = wall_checks(alpha, beta, slot, tube, rack, config)
    reason = first_reason(checks, tube.name)
    return TubePose(
        TubeStatus.REJECTED if reason else TubeStatus.OK,
        reason,
        make_transform(tilt_rotation(alpha, beta), origin_m),
        excess_rms_m=float(np.sqrt(np.mean(excess**2))),
        inside_share=float(np.mean(excess < config.tube.tolerance_m)),
        n_points=len(points_m),
        checks=checks,
    )


PAPER = EachTube("paper", fit_tube)
