"""What can be expected of a camera for a rack and a tube, from its measured noise (docs/method.md, "Expectation").

The rack's face is a plane through errors with the covariance that was measured on a plane of the capture; its place
across the line of sight is that of the outline's blurred edges. A tube has the posterior of method ``profile`` of one
that stands in the middle of its slot. Noise lives in pixels: at another distance errors and their lengths grow with it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tubepose.capture.frame import CameraIntrinsics
from tubepose.config import Config
from tubepose.labware import RackModel, TubeModel
from tubepose.profile.outline import SECTORS
from tubepose.profile.plane import EDGE_M
from tubepose.profile.posterior import Evidence, combine, evidence, no_evidence
from tubepose.profile.tops import top_radius_m
from tubepose.sensor.free_edges import FreeEdges
from tubepose.sensor.free_planes import PlaneNoise
from tubepose.transforms import FloatArray

FACE_POINTS = 300
"""Places on a rack's face at which its errors are laid out."""
FAR_M = 2.0
"""Distance from which on nearer ones are tried."""
SEARCHED = 60
"""Distances that are tried, 5 % apart."""
STEPS = 5
"""Distances that are told, from the capture's own to the nearest one."""
BORDER = 0.95
"""Share of the picture that a rack may fill."""


@dataclass(frozen=True, slots=True)
class Expected:
    """What to expect at one distance; standard deviations, nan where it does not apply.

    Attributes:
        distance_m: Depth of the rack's face.
        rack_tilt_deg: Of the face's normal, about each of its two axes (the worse one).
        rack_height_mm: Of the face along its normal.
        rack_across_mm: Of the rack along its face, by the edges of depth alone (the worse one).
        opening_px: Width of an opening in the picture; NaN without intrinsics.
        tube: Name of the tube; empty without one.
        tube_tilt_deg: Of its axis, about each of two axes.
        slot_tilt_deg: The same by the slot alone.
        tube_place_mm: Of its bottom across its axis, in the rack's frame.
        cap_plane_deg: Of the plane of its cap alone; NaN for an open tube.
        measured: ``tilt`` if its tilt is known well enough to be told, else ``position``.
    """

    distance_m: float
    rack_tilt_deg: float
    rack_height_mm: float
    rack_across_mm: float
    opening_px: float
    tube: str = ""
    tube_tilt_deg: float = float("nan")
    slot_tilt_deg: float = float("nan")
    tube_place_mm: float = float("nan")
    cap_plane_deg: float = float("nan")
    measured: str = ""


def expected(
    plane: PlaneNoise,
    edges: FreeEdges | None,
    camera: CameraIntrinsics | None,
    rack: RackModel,
    tubes: Sequence[TubeModel],
    config: Config,
) -> tuple[Expected, ...]:
    """What can be expected at the distance of a plane and nearer.

    Args:
        plane: The noise, measured.
        edges: Ramps of depth edges; the prior's blur where they were not measured.
        camera: Of the picture; without it only the plane's own distance is told.
        rack: The rack.
        tubes: Kinds of tube; none: the rack alone.
        config: Of the estimator.

    Returns:
        One entry per distance, and for each of them one per tube; nearer ones come later.
    """
    found = []
    for distance_m in distances_m(plane.noise.distance_m, camera, rack, tubes):
        face = _face(plane, edges, camera, rack, config, distance_m)
        of_tubes = [_with_tube(face, plane, edges, rack, tube, config) for tube in tubes]
        found += of_tubes or [face]
    return tuple(found)


def sufficient_distance_m(
    plane: PlaneNoise, edges: FreeEdges | None, camera: CameraIntrinsics | None, rack: RackModel, config: Config
) -> float | None:
    """Farthest distance at which depth alone tells a rack's pose as well as method ``edges`` asks for.

    That is `max_turn_std_deg` and `max_shift_std_mm`; None where no distance at which the rack is in the picture does.

    Args:
        plane: The noise, measured.
        edges: Ramps of depth edges.
        camera: Of the picture.
        rack: The rack.
        config: Its section `rack` has the limits.
    """
    nearest = min(distances_m(FAR_M, camera, rack, ()))
    for distance_m in np.geomspace(FAR_M, min(nearest, FAR_M), SEARCHED).tolist():
        face = _face(plane, edges, camera, rack, config, distance_m)
        turned = face.rack_tilt_deg <= config.rack.max_turn_std_deg
        if turned and max(face.rack_height_mm, face.rack_across_mm) <= config.rack.max_shift_std_mm:
            return float(distance_m)
    return None


def distances_m(
    farthest_m: float, camera: CameraIntrinsics | None, rack: RackModel, tubes: Sequence[TubeModel]
) -> tuple[float, ...]:
    """From a distance down to the nearest one at which all of a rack and its tubes are in the picture, in equal ratios.

    Only the first one without intrinsics, or where the rack is already too near.
    """
    if camera is None:
        return (farthest_m,)
    sides = sorted(zip(rack.outline_m, (rack.outline_m[1], rack.outline_m[0]), strict=True), reverse=True)
    fits = [max(x * camera.fx / (BORDER * camera.width), y * camera.fy / (BORDER * camera.height)) for x, y in sides]
    stand = max([rack.floor_m + tube.height_m - rack.height_m for tube in tubes] or [0.0])
    # The tops of tubes are nearer than the face.
    nearest = float(min(fits)) + max(stand, 0.0)
    if nearest >= farthest_m:
        return (farthest_m,)
    return tuple(float(d) for d in np.geomspace(farthest_m, nearest, STEPS))


def _blur_m(edges: FreeEdges | None, plane: PlaneNoise, config: Config, distance_m: float) -> float:
    """Width of a depth edge's ramp on a surface at a distance, metres."""
    px = config.sensor.edge_blur_px if edges is None else edges.ramp_px
    return px * plane.noise.spacing_m * distance_m / plane.noise.distance_m


def _face(
    plane: PlaneNoise,
    edges: FreeEdges | None,
    camera: CameraIntrinsics | None,
    rack: RackModel,
    config: Config,
    distance_m: float,
) -> Expected:
    """The rack alone."""
    scale = distance_m / plane.noise.distance_m
    slopes, height_m = plane_std(plane, rack, scale)
    blur_m = _blur_m(edges, plane, config, distance_m)
    # A ramp ends anywhere within its width, anew every so many pixels; two sides tell each direction.
    sides = rack.outline_m[::-1]
    across = blur_m / np.sqrt(12) / np.sqrt(np.maximum(2 * sides / max(blur_m, plane.noise.spacing_m * scale), 1))
    opening = float("nan")
    if camera is not None:
        opening = float(2 * rack.all_slots[0].half_size_m.min() * camera.fx / distance_m)
    return Expected(distance_m, float(np.rad2deg(slopes.max())), height_m * 1e3, float(across.max()) * 1e3, opening)


def plane_std(plane: PlaneNoise, rack: RackModel, scale: float) -> tuple[FloatArray, float]:
    """Standard deviations of the slopes (2,) and of the height (metres) of a plane through the solid part of a face.

    Least squares through points whose errors have the measured covariance; errors and lengths times a scale.
    """
    xy = _solid_points(rack)
    apart = np.linalg.norm(xy[:, None] - xy, axis=2) / scale
    covariance = np.zeros_like(apart)
    if len(plane.lag_m):
        covariance = np.interp(apart, plane.lag_m, plane.covariance_m2, right=0.0) * scale**2
    design = np.column_stack([np.ones(len(xy)), xy])
    weights = np.linalg.solve(design.T @ design, design.T)
    # What was measured need not be a covariance: where it says less than nothing it says nothing.
    found = np.sqrt(np.maximum(np.einsum("ki,ij,kj->k", weights, covariance, weights, optimize=True), 0.0))
    return np.asarray(found[1:]), float(found[0])


@lru_cache(maxsize=8)
def _solid_points(rack: RackModel) -> FloatArray:
    """Places (N, 2) of a regular grid on the solid part of a rack's face, metres."""
    half = rack.outline_m / 2
    pitch = float(np.sqrt(np.prod(2 * half) / (2.5 * FACE_POINTS)))
    x, y = (np.arange(-h + pitch / 2, h, pitch) for h in half)
    xy = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2)
    solid = np.ones(len(xy), bool)
    for slot in rack.all_slots:
        solid &= np.asarray(slot.signed_distance_m(xy)) > 0
    kept = xy[solid] if np.count_nonzero(solid) >= 12 else xy
    return np.asarray(kept[:: max(1, len(kept) // FACE_POINTS)])


def _with_tube(
    face: Expected, plane: PlaneNoise, edges: FreeEdges | None, rack: RackModel, tube: TubeModel, config: Config
) -> Expected:
    """The same with a tube that stands upright in the rack's first slot, from straight above."""
    slot, settings = rack.all_slots[0], config.profile
    lever_m = tube.height_m - tube.pivot_height_m
    depth_m = face.distance_m - max(rack.floor_m + tube.height_m - rack.height_m, 0.0)
    circle, along = _top(plane, edges, tube, config, depth_m, lever_m)
    alone = combine(no_evidence(1), [slot], [tube], rack, settings).covariance[0]
    seen = combine(circle + along, [slot], [tube], rack, settings).covariance[0]
    held = tube.pivot_height_m
    jacobian = np.array([[1.0, 0, -held, 0], [0, 1.0, 0, -held]])
    place = float(np.sqrt(np.trace(jacobian @ seen @ jacobian.T) / 2))
    tilt, by_slot = (float(np.sqrt((one[2, 2] + one[3, 3]) / 2)) for one in (seen, alone))
    cap = float("nan")
    if not tube.is_open:
        cap = float(np.rad2deg(1 / np.sqrt(along.matrix[0, 2, 2])))
    values = {name: getattr(face, name) for name in Expected.__dataclass_fields__ if name not in _OF_TUBES}
    return Expected(
        **values,
        tube=tube.name,
        tube_tilt_deg=float(np.rad2deg(tilt)),
        slot_tilt_deg=float(np.rad2deg(by_slot)),
        tube_place_mm=place * 1e3,
        cap_plane_deg=cap,
        measured="tilt" if tilt <= settings.max_tilt_std_rad else "position",
    )


_OF_TUBES = ("tube", "tube_tilt_deg", "slot_tilt_deg", "tube_place_mm", "cap_plane_deg", "measured")


def _top(
    plane: PlaneNoise, edges: FreeEdges | None, tube: TubeModel, config: Config, depth_m: float, lever_m: float
) -> tuple[Evidence, Evidence]:
    """What the circle of a tube's top and the plane of its cap say of its axis."""
    settings, radius_m = config.profile, top_radius_m(tube)
    blur_m = _blur_m(edges, plane, config, depth_m)
    sigma_m = float(np.hypot(settings.outline_noise_m, blur_m / np.sqrt(12)))
    # Sectors that share a ramp's width share its error.
    sectors = min(float(SECTORS), max(2 * np.pi * radius_m / max(blur_m, 1e-6), 3.0))
    middle_var = 2 * sigma_m**2 / sectors + settings.outline_bias_m**2
    through = np.zeros((1, 2, 4))
    through[0, [0, 1], [0, 1]], through[0, [0, 1], [2, 3]] = 1.0, lever_m
    circle = evidence(through, np.zeros((1, 2)), middle_var * np.eye(2)[None])
    if tube.is_open:
        return circle, no_evidence(1)
    slope_std = plane.noise.slope_std(max(radius_m - EDGE_M, 2e-3), depth_m)
    along = np.zeros((1, 2, 4))
    along[0, [0, 1], [2, 3]] = 1.0
    variance = slope_std**2 + settings.cap_tilt_rad**2
    return circle, evidence(along, np.zeros((1, 2)), variance * np.eye(2)[None])
