"""What a scanner above sees of a tube, as points: the template of every baseline with ICP."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import open3d as o3d

from tubepose.labware import TubeModel
from tubepose.preprocessing import to_o3d
from tubepose.transforms import FloatArray

RIM_VIEW_M = 0.012


@lru_cache(maxsize=32)
def visible_template(tube: TubeModel, hidden_m: float, count: int) -> o3d.geometry.PointCloud:
    """Points with outward normals on what a scanner above sees of a tube whose lower part is hidden by the rack.

    The profile is sampled by area, evenly in angle (golden angle): no randomness.

    Args:
        tube: The tube's model.
        hidden_m: Height above the tube's bottom up to which the rack hides it, metres.
        count: Number of points.

    Returns:
        Cloud in the tube's frame, metres. It is shared: do not change it.
    """
    pieces = [_visible(tube.outer_profile_m(), hidden_m)]
    if tube.is_open:
        pieces.append(_visible(tube.cavity_profile_m(), tube.rim_height_m - RIM_VIEW_M))
    segments = np.vstack([np.hstack([piece[:-1], piece[1:]]) for piece in pieces])
    length = np.hypot(segments[:, 2] - segments[:, 0], segments[:, 3] - segments[:, 1])
    area = np.cumsum(length * (segments[:, 1] + segments[:, 3]))
    place = (np.arange(count) + 0.5) / count * area[-1]
    k = np.searchsorted(area, place)
    before = np.where(k > 0, area[k - 1], 0.0)
    t = (place - before) / (area[k] - before)
    z = segments[k, 0] + t * (segments[k, 2] - segments[k, 0])
    r = segments[k, 1] + t * (segments[k, 3] - segments[k, 1])
    turn = np.arange(count) * np.pi * (3 - np.sqrt(5))
    # The profile runs with the outside on its right: (dz, dr) turned gives the outward normal (-dr, dz).
    n_z = -(segments[k, 3] - segments[k, 1]) / length[k]
    n_r = (segments[k, 2] - segments[k, 0]) / length[k]
    cloud = to_o3d(np.column_stack([r * np.cos(turn), r * np.sin(turn), z]))
    cloud.normals = o3d.utility.Vector3dVector(np.column_stack([n_r * np.cos(turn), n_r * np.sin(turn), n_z]))
    return cloud


def _visible(profile_m: FloatArray, above_m: float) -> FloatArray:
    """Part of a profile (z, r) above a height, cut at it."""
    order = profile_m if profile_m[0, 0] <= profile_m[-1, 0] else profile_m[::-1]
    kept = order[order[:, 0] > above_m]
    cut = np.array([[above_m, np.interp(above_m, order[:, 0], order[:, 1])]])
    part = np.vstack([cut, kept])
    return part if order is profile_m else part[::-1]
