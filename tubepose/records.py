"""Tidy rows of the result files: what every column holds, docs/outputs.md says in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

from tubepose.capture.frame import RgbdFrame
from tubepose.checks import Check, mark_codes, said, sentence
from tubepose.detection import best_rack
from tubepose.occupancy import held_slots, stated_slots
from tubepose.pose_errors import COVARIANCE_COLUMNS, upper_half
from tubepose.rack import RackPose
from tubepose.scene import Scene, TubeEstimate
from tubepose.sensor import SensorNoise
from tubepose.stage_times import StageTime
from tubepose.transforms import FloatArray, quaternion_wxyz, tilt_rad

Row = dict[str, Any]

POSE_COLUMNS = ("tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz")
RACK_COVARIANCE_AXES = ("rx", "ry", "rz", "tx", "ty", "tz")
"""Order of a rack's covariance: small turns about its axes and shifts along them, at the centre of its top."""
RACK_COVARIANCE_COLUMNS = upper_half(RACK_COVARIANCE_AXES)
BOW_COLUMNS = ("bow_x_m", "bow_y_m", "bow_xy_m", "bow_x_std_m", "bow_y_std_m", "bow_xy_std_m")
RACK_COLUMNS = (
    "session", "trial", "capture", "frame", "timestamp_ns", "method", "rack", "status", "reason", "reason_code",
    "marks", "ambiguous",
    "resolved_by", "hint_note", "turn_margin_m", "inlier_rmse_m", "fitness", "in_slot_share", "coverage", "spacing_m",
    "level_tops", "n_racks_detected", "n_tubes_detected", "box_source", "box_score", "box_note", "capture_note",
    *POSE_COLUMNS,
    "named_by_nats", *BOW_COLUMNS, *RACK_COVARIANCE_COLUMNS,
)  # fmt: skip
SENSOR_COLUMNS = (
    "session", "trial", "capture", "frame", "timestamp_ns", "source", "independent_m", "independent_relative_std",
    "shared_m", "shared_relative_std", "correlation_m", "spacing_m", "distance_m", "n_patches", "cap_radius_m",
    "cap_slope_std", "cap_height_std_m", "outlier_source", "outlier_share", "edge_source", "edge_blur_px",
    "edge_std_px", "note", "n_frames", "n_left_out", "left_out_code", "left_out_reason",
)  # fmt: skip
CAP_RADIUS_M = 6.5e-3
"""Radius of the discs that sensor.csv speaks of: a cap of a 13 mm tube."""
SLOT_COLUMNS = (
    "session",
    "trial",
    "capture",
    "frame",
    "method",
    "slot",
    "ambiguous",
    "state",
    "p_occupied",
    "seen_share",
    "tube",
    "hull_share",
    "top_support",
    "n_points",
    "status",
    "reason",
    "reason_code",
    "rack_marks",
)
FIT_COLUMNS = ("inlier_rmse_m", "fitness", "excess_rms_m", "inside_share", "top_rms_m", "top_seen_share")
"""How well points agree with an answer: a pair for ICP, a pair for `paper`, a pair for `profile`."""
ESTIMATE_COLUMNS = (
    "session", "trial", "capture", "frame", "timestamp_ns", "method", "seed", "slot", "tube", "ambiguous", "status",
    "reason", "reason_code", "rack_marks", "confidence",
    *POSE_COLUMNS, "tilt_deg", "n_points", *FIT_COLUMNS, *COVARIANCE_COLUMNS,
)  # fmt: skip
TIMING_COLUMNS = (
    "session",
    "trial",
    "capture",
    "frame",
    "method",
    "seed",
    "stage",
    "instance",
    "duration_ms",
    "warmup",
)
CHECK_COLUMNS = (
    "session", "trial", "capture", "frame", "method", "subject", "slot", "code", "value", "limit", "passed", "decides",
    "detail",
)  # fmt: skip
LABWARE_COLUMNS = (
    "session", "trial", "capture", "frame", "quantity", "labware", "key", "defined", "measured", "std", "n",
    "tolerance", "contradicts", "write", "other_key",
)  # fmt: skip
_WHOLE = ("timestamp_ns", "seed", "n_racks_detected", "n_tubes_detected")


def to_table(rows: Sequence[Row], columns: Sequence[str]) -> pd.DataFrame:
    """Rows as a table with exactly these columns; stamps and seeds stay whole numbers (Int64)."""
    table = pd.DataFrame(list(rows), columns=list(columns))
    whole = {*_WHOLE, *(("frame",) if any(row.get("frame") is None for row in rows) else ())}
    for name in whole & set(columns):  # not by way of floats, which hold no nanoseconds
        table[name] = pd.array([row.get(name) for row in rows], dtype="Int64")
    return table


def pose_columns(T: FloatArray | None) -> Row:
    """A (4, 4) transform as the columns tx_m ... qz; NaN without one."""
    if T is None:
        return dict.fromkeys(POSE_COLUMNS, float("nan"))
    return dict(zip(POSE_COLUMNS, (*(float(value) for value in T[:3, 3]), *quaternion_wxyz(T)), strict=True))


def transform_of(row: Row) -> FloatArray:
    """The (4, 4) transform of a pose's columns, tx_m ... qz.

    Raises:
        ValueError: The row has no pose.
    """
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([row[name] for name in ("qx", "qy", "qz", "qw")]).as_matrix()
    T[:3, 3] = [row[name] for name in ("tx_m", "ty_m", "tz_m")]
    return T


def rack_row(scene: Scene) -> Row:
    """Row of racks.csv, without its keys."""
    box = best_rack(scene.detections)
    return {
        "rack": scene.rack.name,
        "n_racks_detected": sum(detection.is_rack for detection in scene.detections),
        "n_tubes_detected": sum(not detection.is_rack for detection in scene.detections),
        "box_source": box.source if box is not None else None,
        "box_score": box.score if box is not None else float("nan"),
        "box_note": box.note if box is not None else "",
        **rack_pose_row(scene.frame, scene.rack_pose),
    }


def rack_pose_row(frame: RgbdFrame, pose: RackPose) -> Row:
    """What a row of racks.csv says of the pose: all that there is to say where no rack can be named."""
    return {
        "timestamp_ns": frame.timestamp_ns,
        "status": pose.status.value,
        "reason": pose.reason,
        "reason_code": pose.reason_code,
        "marks": mark_codes(pose.checks),
        "ambiguous": pose.ambiguous,
        "resolved_by": pose.resolved_by,
        "hint_note": pose.hint_note,
        "capture_note": "; ".join(frame.notes),
        "turn_margin_m": pose.turn_margin_m,
        "inlier_rmse_m": pose.inlier_rmse_m,
        "fitness": pose.fitness,
        "in_slot_share": pose.in_slot_share,
        "coverage": pose.coverage,
        "spacing_m": pose.spacing_m,
        "level_tops": pose.level_tops,
        **pose_columns(pose.T_camera_rack),
        **_bow_columns(pose),
        **covariance_columns(pose.covariance, RACK_COVARIANCE_COLUMNS),
    }


def _bow_columns(pose: RackPose) -> Row:
    if pose.bow_m is None or pose.bow_std_m is None:
        return dict.fromkeys(BOW_COLUMNS, float("nan"))
    return dict(zip(BOW_COLUMNS, map(float, (*pose.bow_m, *pose.bow_std_m)), strict=True))


def sensor_row(keys: Row, frame: RgbdFrame, noise: SensorNoise) -> Row:
    """Row of sensor.csv."""
    return {
        **keys,
        "timestamp_ns": frame.timestamp_ns,
        **{name: getattr(noise, name) for name in SENSOR_COLUMNS if hasattr(noise, name)},
        **averaging_columns(frame),
        "cap_radius_m": CAP_RADIUS_M,
        "cap_slope_std": noise.slope_std(CAP_RADIUS_M, noise.distance_m),
        "cap_height_std_m": noise.height_std_m(CAP_RADIUS_M, noise.distance_m),
    }


MOST_NUMBERED = 8
"""Frames that are told by number."""


def averaging_columns(frame: RgbdFrame) -> Row:
    """How many frames a frame was fused of, and which are left out of it and why."""
    fused = frame.averaging
    if fused is None:
        return {"n_frames": 1, "n_left_out": 0, "left_out_code": "", "left_out_reason": ""}
    n_left = len(fused.left_out)
    words = ""
    if n_left:
        listed = [str(number) for number in fused.left_out[:MOST_NUMBERED]]
        detail = f"frame{'s' if n_left > 1 else ''} {', '.join(listed)}{', ...' if n_left > MOST_NUMBERED else ''}"
        words = sentence(said(fused.reason_code, detail, n_left, fused.n_frames), frame.capture)
    return {
        "n_frames": fused.n_frames - n_left,
        "n_left_out": n_left,
        "left_out_code": fused.reason_code,
        "left_out_reason": words,
    }


def slot_rows(keys: Row, method: str, scene: Scene, estimates: Sequence[TubeEstimate]) -> list[Row]:
    """Rows of slots.csv, one per slot of the rack; none without the rack's pose.

    What stands in no slot, or is no known tube, covers slots all the same: they are not called empty.
    """
    held = held_slots(scene, estimates)
    rows = []
    for name, stated in stated_slots(scene, estimates).items():
        estimate = held.get(name)
        said = {"state": stated.state.value, "p_occupied": stated.p_occupied, "seen_share": stated.seen_share}
        row: Row = {
            **keys,
            "method": method,
            "slot": name,
            "ambiguous": scene.rack_pose.ambiguous,
            "rack_marks": mark_codes(scene.rack_pose.checks),
            **said,
            "n_points": 0,
        }
        if estimate is not None:
            target = estimate.target
            row |= {
                "tube": target.tube.name if target.tube is not None else None,
                "hull_share": target.hull_share,
                "top_support": target.top_support,
                "n_points": len(target.points_m),
                "status": estimate.pose.status.value,
                "reason": estimate.pose.reason,
                "reason_code": estimate.pose.reason_code,
            }
        rows.append(row)
    return rows


def estimate_row(keys: Row, scene: Scene, estimate: TubeEstimate) -> Row:
    """Row of estimates.csv."""
    pose, target = estimate.pose, estimate.target
    tilt_deg = float("nan")
    if pose.T_rack_tube is not None:
        tilt_deg = float(np.rad2deg(tilt_rad(pose.T_rack_tube[:3, 2], np.array([0.0, 0.0, 1.0]))))
    return {
        **keys,
        "timestamp_ns": scene.frame.timestamp_ns,
        "method": estimate.method,
        "seed": estimate.seed,
        "slot": target.slot,
        "tube": target.tube.name if target.tube is not None else None,
        "ambiguous": scene.rack_pose.ambiguous,
        "status": pose.status.value,
        "reason": pose.reason,
        "reason_code": pose.reason_code,
        "rack_marks": mark_codes(scene.rack_pose.checks),
        "confidence": pose.confidence,
        **pose_columns(estimate.T_camera_tube),
        "tilt_deg": tilt_deg,
        "n_points": pose.n_points,
        **{name: getattr(pose, name) for name in FIT_COLUMNS},
        **covariance_columns(pose.covariance),
    }


def check_rows(keys: Row, method: str, scene: Scene, estimates: Sequence[TubeEstimate]) -> list[Row]:
    """Rows of checks.csv: every check of the rack, then those of a method's tubes."""
    found: list[tuple[str, str | None, Check]] = [("rack", None, check) for check in scene.rack_pose.checks]
    found += [("tube", e.target.slot, check) for e in estimates for check in e.pose.checks]
    return [{**keys, "method": method, "subject": of, "slot": slot, **asdict(check)} for of, slot, check in found]


def covariance_columns(covariance: FloatArray | None, columns: Sequence[str] = COVARIANCE_COLUMNS) -> Row:
    """The upper half of a covariance (5, 5) of a tube or (6, 6) of a rack as columns, rad and m; NaN without one."""
    if covariance is None:
        return dict.fromkeys(columns, float("nan"))
    half = covariance[np.triu_indices(len(covariance))]
    return dict(zip(columns, map(float, half), strict=True))


def timing_row(keys: Row, entry: StageTime, warmup: bool) -> Row:
    """Row of timings.csv."""
    return {
        **keys,
        "method": entry.method,
        "seed": entry.seed,
        "stage": entry.stage,
        "instance": entry.instance,
        "duration_ms": entry.duration_ms,
        "warmup": warmup,
    }
