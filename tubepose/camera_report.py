"""What a camera does to depth and what can be expected of it, as rows of tables: `tubepose sensor`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from tubepose.capture.frame import RgbdFrame
from tubepose.config import Config
from tubepose.errors import CaptureError
from tubepose.expectation import expected, sufficient_distance_m
from tubepose.labware import RackModel, TubeModel
from tubepose.sensor.free_edges import free_edges
from tubepose.sensor.free_planes import PlaneNoise, planes_of
from tubepose.sensor.in_time import InTime, in_time

Row = dict[str, Any]
CAP_RADIUS_M = 6.5e-3
"""Radius of the disc whose plane is told: a cap of a 13 mm tube."""
NOISE_COLUMNS = (
    "capture", "plane", "distance_m", "n_points", "n_averaged", "total_std_m", "independent_m",
    "independent_relative_std", "shared_m", "shared_relative_std", "correlation_m", "spacing_m", "cap_slope_deg",
    "missing_share", "edge_ramp_px", "edge_ramp_std_px", "edge_blur_px", "n_edges", "n_frames", "in_time_m",
    "in_time_share", "drift_share", "drift_std_share", "flicker_share",
)  # fmt: skip
EXPECTED_COLUMNS = (
    "capture", "rack", "distance_m", "rack_tilt_deg", "rack_height_mm", "rack_across_mm", "opening_px", "tube",
    "tube_tilt_deg", "slot_tilt_deg", "tube_place_mm", "cap_plane_deg", "measured",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class CameraReport:
    """What one capture says of its camera.

    Attributes:
        noise: Rows of camera_noise.csv, one per plane.
        expected: Rows of camera_expected.csv; none without a rack.
        sentences: From which distance on depth alone tells the rack's pose; none without a rack.
    """

    noise: tuple[Row, ...]
    expected: tuple[Row, ...] = ()
    sentences: tuple[str, ...] = ()


def measure_camera(
    frames: Sequence[RgbdFrame],
    where: str,
    config: Config,
    rack: RackModel | None = None,
    tubes: Sequence[TubeModel] = (),
) -> CameraReport:
    """Measure a camera on the planes and edges of its first frame, and in time over all of them.

    Args:
        frames: Frames of a scene and a camera that do not move.
        where: Start of error messages.
        config: Of the measurement and of the estimator.
        rack: What is to be expected for; None: nothing.
        tubes: Kinds of tube in it.

    Raises:
        CaptureError: There is no frame, or no plane in it.
    """
    if not frames:
        raise CaptureError(f"{where}: no frame in it; expected one or more")
    first = frames[0]
    planes = planes_of(first, config.sensor)
    if not planes:
        raise CaptureError(
            f"{where}: no plane is seen that holds a twentieth of the points; point the camera at a table or a wall"
        )
    edges, drift = free_edges(first), in_time(frames)
    of_edges: Row = {}
    if edges is not None:
        of_edges = {
            "edge_ramp_px": edges.ramp_px,
            "edge_ramp_std_px": edges.ramp_std_px,
            "edge_blur_px": edges.blur_px,
            "n_edges": edges.n_lines,
        }
    noise = tuple(_noise_row(first, n, plane, drift) | of_edges for n, plane in enumerate(planes, 1))
    if rack is None:
        return CameraReport(noise)
    known = expected(planes[0], edges, first.intrinsics, rack, tubes, config)
    rows = tuple({"capture": first.capture, "rack": rack.name, **asdict(one)} for one in known)
    enough = sufficient_distance_m(planes[0], edges, first.intrinsics, rack, config)
    limits = f"{config.rack.max_turn_std_deg:g} deg and {config.rack.max_shift_std_mm:g} mm"
    from_where = (
        f"at {enough:.2f} m and nearer" if enough is not None else "at no distance at which it is in the picture"
    )
    told = f"{first.capture}: by depth alone rack {rack.name} is known to {limits} {from_where}."
    return CameraReport(noise, rows, (told,))


def _noise_row(frame: RgbdFrame, number: int, plane: PlaneNoise, drift: InTime | None) -> Row:
    noise, fused = plane.noise, frame.averaging
    row: Row = {
        "capture": frame.capture,
        "plane": number,
        "n_points": plane.n_points,
        "n_averaged": 1 if fused is None else fused.n_frames - len(fused.left_out),
        "total_std_m": plane.total_std_m,
        "cap_slope_deg": float(np.rad2deg(noise.slope_std(CAP_RADIUS_M, noise.distance_m))),
        "missing_share": plane.missing_share,
    }
    row |= {name: getattr(noise, name) for name in NOISE_COLUMNS if name not in row and name in _OF_NOISE}
    if drift is not None:
        in_time_m = drift.std_share * noise.distance_m
        row |= {
            "n_frames": drift.n_frames,
            "in_time_m": in_time_m,
            "in_time_share": (in_time_m / plane.total_std_m) ** 2 if plane.total_std_m > 0 else float("nan"),
            "drift_share": drift.drift_share,
            "drift_std_share": drift.drift_std_share,
            "flicker_share": drift.flicker_share,
        }
    return row


_OF_NOISE = (
    "distance_m", "independent_m", "independent_relative_std", "shared_m", "shared_relative_std", "correlation_m",
    "spacing_m",
)  # fmt: skip
