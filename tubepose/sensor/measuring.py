"""The noise of the sensor, measured in a capture without truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.config import SensorConfig
from tubepose.labware import RackModel
from tubepose.sensor.discs import measure_discs
from tubepose.sensor.edges import edge_blur
from tubepose.sensor.noise import RACK_TOP, TABLE, DiscNoise, SensorNoise, prior_noise
from tubepose.sensor.surfaces import LevelSurface, table_beside, top_of_rack
from tubepose.sensor.variances import ErrorParts, error_parts
from tubepose.transforms import FloatArray

COMPARED_M = 6.5e-3
"""Radius of the discs that two surfaces are compared by: a cap's."""
SURE = 2.0
"""Standard deviations by which a surface's noise must be known before another one's is doubted for it."""
ASKED_POINTS = 400
UPPER_BOUND = "no table is seen: stray light on the rack's ribs counts as noise, so caps may have less"
"""What is said of a rack's top that is alone: light from slots and tubes bends ribs, and caps stand above it."""


@dataclass(frozen=True, slots=True, eq=False)
class _Source:
    """A surface's noise, ready to be believed or not."""

    name: str
    surface: LevelSurface
    parts: ErrorParts
    spacing_m: float
    discs: tuple[DiscNoise, ...]
    outlier_share: float


def measure_noise(
    frame: RgbdFrame,
    intrinsics: CameraIntrinsics | None,
    T_camera_rack: FloatArray | None,
    rack: RackModel,
    config: SensorConfig,
) -> SensorNoise:
    """Noise of a capture, from surfaces that are level whatever stands in the rack.

    Planes are fitted to discs on the table beside the rack; the scatter of their slopes and heights is what a plane
    through a cap suffers. Independent and shared error follow from a nested analysis of variance. The solid part of the
    rack's top is a second witness, and the only one where no table is seen.

    Args:
        frame: The frame, with pixels or without.
        intrinsics: Of its pixels; None for a cloud without.
        T_camera_rack: Pose of the rack, shape (4, 4), metres; None where it is not known.
        rack: The rack.
        config: How it is measured, and what is assumed of what is not.

    Returns:
        The noise. What could not be measured is the prior, and says so.
    """
    if T_camera_rack is None:
        return prior_noise(config, "the rack's pose is not known")
    table = table_beside(frame, T_camera_rack, rack, config)
    top = top_of_rack(frame, T_camera_rack, rack, config)
    beside = None if table is None else _source(TABLE, table, config)
    above = None if top is None else _source(RACK_TOP, top, config)
    noise = _believed(beside, above, config)
    if table is None or beside is None or not frame.organised or intrinsics is None:
        return noise
    top_std = top.std_m if top is not None else 0.0
    blur = edge_blur(frame, intrinsics, T_camera_rack, rack, table, top_std)
    if blur is None:
        return noise
    return replace(noise, edge_blur_px=blur.blur_px, edge_std_px=blur.std_px, edge_source="rack_outline")


def _source(name: str, surface: LevelSurface, config: SensorConfig) -> _Source | None:
    """The noise of a surface; discs are not laid on a rack's top, whose openings cut into them."""
    discs, area_m2, outliers = measure_discs(surface, config) if name != RACK_TOP else ((), np.nan, np.nan)
    spacing = float(np.sqrt(area_m2)) if np.isfinite(area_m2) else point_spacing_m(surface.rows)
    parts = error_parts(surface, spacing)
    return None if parts is None else _Source(name, surface, parts, spacing, discs, outliers)


def noise_on_surface(name: str, surface: LevelSurface, config: SensorConfig) -> SensorNoise | None:
    """Noise of a surface alone, under a name of its own; None where too few of its points tell it.

    Args:
        name: What `SensorNoise.source` shall say.
        surface: The surface.
        config: How noise is measured, and what is assumed of what is not.
    """
    source = _source(name, surface, config)
    return None if source is None else _noise(source, config, "")


def point_spacing_m(rows: FloatArray) -> float:
    """Distance of neighbouring points of a surface with narrow parts: the median over points of their four nearest's.

    Args:
        rows: Points, shape (N, 4): x, y, z and depth, metres.
    """
    xy = rows[:, :2]
    asked = xy[:: max(1, len(xy) // ASKED_POINTS)]
    tree = cKDTree(xy)
    near = np.asarray(tree.query(asked, k=5)[0])
    return float(np.median(np.mean(near[:, 1:], axis=1)))


def _believed(beside: _Source | None, above: _Source | None, config: SensorConfig) -> SensorNoise:
    """The table's noise, or the top's where there is no table, or where the table's is much greater."""
    if beside is None and above is None:
        return prior_noise(config, "no level surface was seen beside the rack or on its top")
    if beside is None or above is None:
        return _noise(beside or above, config, UPPER_BOUND if beside is None else "")
    of_table, of_top = _noise(beside, config, ""), _noise(above, config, "")
    depth = of_top.distance_m
    here, there = of_table.slope_std(COMPARED_M, depth), of_top.slope_std(COMPARED_M, depth)
    if here <= config.contradiction * (1 + SURE * above.parts.shared_relative_std) * there:
        if there > config.contradiction * here:
            words = f"the rack's top has {there / here:.1f} times the table's slope noise; the table's is taken"
            return replace(of_table, note=words)
        return of_table
    words = f"the table has {here / there:.1f} times the slope noise of the rack's top, which is taken"
    return replace(of_top, note=words)


def _noise(source: _Source | None, config: SensorConfig, note: str) -> SensorNoise:
    if source is None:
        return prior_noise(config, note)
    parts, measured = source.parts, np.isfinite(source.outlier_share)
    return SensorNoise(
        independent_m=parts.independent_m,
        independent_relative_std=parts.independent_relative_std,
        shared_m=parts.shared_m,
        shared_relative_std=parts.shared_relative_std,
        correlation_m=parts.correlation_m,
        spacing_m=source.spacing_m,
        outlier_share=source.outlier_share if measured else config.outlier_share,
        edge_blur_px=config.edge_blur_px,
        edge_std_px=float("nan"),
        distance_m=source.surface.distance_m,
        discs=source.discs,
        n_patches=max((disc.n_discs for disc in source.discs), default=parts.n_patches),
        source=source.name,
        outlier_source=source.name if measured else "prior",
        note=note,
    )
