"""What the wall below a tube's cap or rim says of its axis, where the points on it can be believed.

Light comes out of milky plastic where it was scattered to, clear plastic shows what lies behind it, and a paper label
lies where the wall is. The three are told apart by what the points do: points of a surface pile up at its radius,
those of scattered light do not. So the evidence of a wall is weighed by its peak: the share of the points near the
radius that are more than those beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.config import ProfileConfig
from tubepose.labware import RackModel, TubeModel
from tubepose.profile.fit_kernels import wall_rows, wall_sums
from tubepose.profile.posterior import Evidence, no_evidence, per_model
from tubepose.profile.standing import Standing
from tubepose.transforms import FloatArray

PEAK = 2.0
"""Points within this many standard deviations are the peak, those up to twice as far its background."""
SKIRT_GAP_M = 1.0e-3


@dataclass(frozen=True, slots=True)
class WallNoise:
    """What the sensor's noise does to the distance of a wall's points from its axis.

    Attributes:
        independent_m: Standard deviation of a point's own part, metres: of its depth, times the sine of the angle
            between line of sight and wall.
        shared_m: Of the part that neighbours share.
        patch_points: How many points share it.
    """

    independent_m: float
    shared_m: float
    patch_points: float


NO_WALL_NOISE = WallNoise(0.0, 0.0, 1.0)


def wall_evidence(
    standing: Standing,
    label: NDArray[np.intp],
    pose: FloatArray,
    centers_m: FloatArray,
    tubes: Sequence[TubeModel],
    rack: RackModel,
    config: ProfileConfig,
    noise: WallNoise | None = None,
) -> Evidence:
    """Evidence of the walls of all tubes, linearised at their poses.

    Residual of a point at height s above the tube's bottom and distance rho from its axis: ``rho - r(s)``, r the body's
    radius. It moves with the axis at that height, ``-n (u + (s - q) a)``, n the direction from the axis to the point.
    The wall's true radius is an unknown of its own with a prior: points lie on the camera's side alone, where a wider
    wall and a nearer axis look the same.

    Args:
        standing: Points above the rack's top.
        label: Tube of each point, -1 for none.
        pose: (u, v, a, b) of every tube, shape (T, 4), metres and slopes.
        centers_m: Centre of every tube's slot, shape (T, 2).
        tubes: Type of every tube.
        rack: The rack.
        config: Noise of walls that can be believed.
        noise: Of the sensor, which adds to it; None counts as none.
    """
    count = len(tubes)
    if count == 0:
        return no_evidence(0)
    held = per_model(tubes, lambda tube: tube.pivot_height_m)
    skirt = per_model(tubes, _skirt_m) - SKIRT_GAP_M
    body = per_model(tubes, lambda tube: [tube.body.bottom_diameter_mm, tube.body.top_diameter_mm]) * 0.5e-3
    ends = per_model(tubes, lambda tube: [tube.body.bottom_height_mm, tube.body.height_mm]) * 1e-3
    noise = NO_WALL_NOISE if noise is None else noise
    sigma = float(np.sqrt(config.wall_noise_m**2 + noise.independent_m**2 + noise.shared_m**2))
    own2 = config.wall_noise_m**2 + noise.independent_m**2
    counted2 = own2 * config.wall_redundancy + noise.shared_m**2 * max(noise.patch_points, config.wall_redundancy)
    # The cut through a leaning tube is an ellipse: across the lean the radius, along it longer by 1 / cos.
    residual, normal, above, of = wall_rows(
        standing.points_m, label, standing.camera_m, pose, centers_m, rack.floor_m, held, skirt, body, ends,
        2 * PEAK * sigma,
    )  # fmt: skip
    near = np.abs(residual) < PEAK * sigma
    n_near, n_beside = (np.bincount(of[chosen], minlength=count) for chosen in (near, ~near))
    peak = np.clip((n_near - n_beside) / np.maximum(n_near, 1), 0.0, 1.0)
    weight = peak**2 * (n_near >= config.min_wall_points) / counted2
    # The residual is wanted to vanish: rows x = target; the radius, the last unknown, is marginalised.
    matrix, vector = wall_sums(residual, normal, above, of, pose, weight, PEAK * sigma)
    matrix[:, 4, 4] += 1 / config.wall_radius_m**2
    gain = matrix[:, :4, 4] / matrix[:, 4, 4][:, None]
    return Evidence(
        matrix[:, :4, :4] - gain[:, :, None] * matrix[:, None, 4, :4], vector[:, :4] - gain * vector[:, 4][:, None]
    )


def _skirt_m(tube: TubeModel) -> float:
    """Height of the lower edge of a tube's cap or flange, or of its rim, metres."""
    return tube.height_m - (tube.cap.height_mm * 1e-3 if tube.cap is not None else 0.0)
