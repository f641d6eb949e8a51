"""Ground truth of whole sessions as tidy rows, and its floor: the error against a simulation's exact truth."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from tubepose.batch import Job, trial_capture
from tubepose.capture.registration import refuse_foreign_frame, refuse_mirrored
from tubepose.capture.session import Session, Trial
from tubepose.errors import CaptureError, ConfigError, TubePoseError, kept
from tubepose.ground_truth import GroundTruthConfig, GroundTruthResult, measure_ground_truth
from tubepose.pose_errors import pose_errors
from tubepose.records import POSE_COLUMNS, Row, averaging_columns, pose_columns
from tubepose.simulation import read_exact_truth
from tubepose.transforms import FloatArray

TRUTH_COLUMNS = (
    "session", "trial", "capture", "slot", "tube", "status", "reason", *POSE_COLUMNS,
    "plane_rms_m", "icp_rms_m", "coverage", "n_points", "tilt_std_deg",
)  # fmt: skip
FLOOR_COLUMNS = (
    "session",
    "trial",
    "slot",
    "tube",
    "rx_deg",
    "ry_deg",
    "tilt_deg",
    "tx_mm",
    "ty_mm",
    "tz_mm",
    "cap_mm",
)


@dataclass(slots=True)
class TruthTables:
    """Rows of ground_truth.csv and ground_truth_floor.csv.

    Attributes:
        truth: One per declared tube of a trial with a printed capture.
        floor: One per measured tube of a simulated session.
        problems: One line per trial that could not be measured.
        notes: One line per average that frames are left out of.
    """

    truth: list[Row] = field(default_factory=list)
    floor: list[Row] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def measure_session(
    session: Session,
    tables: TruthTables,
    config: GroundTruthConfig,
    *,
    fail_fast: bool = False,
    on_done: Callable[[], None] | None = None,
) -> None:
    """Measure every trial of a session that has a printed capture, and add its rows to `tables`."""
    for trial in session.trials:
        with kept(None if fail_fast else tables.problems, partial(_told_of, session, trial)):
            if trial.printed is not None:
                _measure_trial(session, trial, tables, config)
        if on_done is not None:
            on_done()


def _told_of(session: Session, trial: Trial, problem: TubePoseError) -> str:
    return f"session {session.name}, trial {trial.name}, ground truth: {problem}"


def _measure_trial(session: Session, trial: Trial, tables: TruthTables, config: GroundTruthConfig) -> None:
    assert trial.printed is not None
    assert session.printed_cap is not None
    frame = next(trial_capture(session, trial, trial.printed).frames(), None)
    if frame is None:
        raise CaptureError(f"{session.folder / trial.printed}: no frame in it")
    left_out = averaging_columns(frame)["left_out_reason"]
    if left_out:
        tables.notes.append(f"session {session.name}, trial {trial.name}, ground truth: {left_out}")
    refuse_mirrored(frame)
    refuse_foreign_frame(frame)
    tubes = {slot: session.tubes[name] for slot, name in trial.tubes.items()}
    result = measure_ground_truth(frame, session.rack, tubes, session.printed_cap, trial.hint, config)
    keys = {"session": session.name, "trial": trial.name}
    tables.truth += _truth_rows(keys, frame.capture, tubes, result)
    if session.origin == "simulated":
        tables.floor += _floor_rows(keys, session, trial, result)


def _truth_rows(keys: Row, capture: str, tubes: dict[str, Any], result: GroundTruthResult) -> list[Row]:
    measured = {entry.slot: entry for entry in result.tubes}
    rows = []
    for slot, tube in tubes.items():
        entry = measured.get(slot)
        row: Row = {**keys, "capture": capture, "slot": slot, "tube": tube.name}
        if entry is None:
            row |= {"status": "refused", "reason": result.reason, **pose_columns(None), "coverage": 0.0, "n_points": 0}
        else:
            row |= {
                "status": entry.status,
                "reason": entry.reason or result.reason,
                **pose_columns(entry.T_camera_tube),
                "plane_rms_m": entry.plane_rms_m,
                "icp_rms_m": entry.icp_rms_m,
                "coverage": entry.coverage,
                "n_points": entry.n_points,
                "tilt_std_deg": float(np.rad2deg(entry.tilt_std_rad)),
            }
        rows.append(row)
    return rows


def _floor_rows(keys: Row, session: Session, trial: Trial, result: GroundTruthResult) -> list[Row]:
    exact = read_exact_truth(session.folder, trial.name)
    rows: list[Row] = []
    for entry in result.tubes:
        if entry.T_camera_tube is None or entry.slot not in exact.tubes:
            continue
        errors = _errors(
            exact.tubes[entry.slot][1], entry.T_camera_tube, session.tubes[trial.tubes[entry.slot]].height_m
        )
        rows.append({**keys, "slot": entry.slot, "tube": session.tubes[trial.tubes[entry.slot]].name, **errors})
    return rows


def _errors(T_truth: FloatArray, T_measured: FloatArray, height_m: float) -> Row:
    found = pose_errors(T_truth[None], T_measured[None], np.array([height_m]))
    return {name: float(getattr(found, name)[0]) for name in FLOOR_COLUMNS[4:]}


def exact_truth_rows(session: Session, problems: list[str] | None = None) -> list[Row]:
    """The exact poses of a simulated session as rows of ground_truth.csv: every declared tube, none refused.

    Args:
        session: The session.
        problems: Gets a line per trial whose exact truth is not there, or knows nothing of a declared tube.

    Raises:
        ConfigError: The session is recorded.
        CaptureError: What would be a line, where `problems` is None.
    """
    _refuse_recorded(session, "exact poses")
    rows: list[Row] = []
    for trial in session.trials:
        with kept(problems):
            rows += _exact_trial_rows(session, trial)
    return rows


def _refuse_recorded(session: Session, what: str) -> None:
    if session.origin != "simulated":
        raise ConfigError(f"session {session.name} is recorded: only simulated ones know {what}")


def _exact_trial_rows(session: Session, trial: Trial) -> list[Row]:
    exact, rows = read_exact_truth(session.folder, trial.name), []
    keys: Row = {"session": session.name, "trial": trial.name, "capture": "", "status": "ok", "reason": "exact"}
    for slot, name in trial.tubes.items():
        if slot not in exact.tubes:
            where = f"session {session.name}, trial {trial.name}"
            raise CaptureError(f"{where}: a tube is declared in slot {slot}, but its exact truth has none there")
        T_camera_tube = exact.tubes[slot][1]
        rows.append({**keys, "slot": slot, "tube": session.tubes[name].name, **pose_columns(T_camera_tube)})
    return rows


def with_exact_rack(jobs: Sequence[Job], session: Session, problems: list[str] | None = None) -> list[Job]:
    """The jobs of a simulated session with the rack's exact pose, to tell the rack's error from the tubes'.

    Args:
        jobs: Of the session's trials.
        session: The session.
        problems: Gets a line per trial whose exact truth is not there; its job is left out.

    Raises:
        ConfigError: The session is recorded.
        CaptureError: What would be a line, where `problems` is None.
    """
    _refuse_recorded(session, "the rack's exact pose")
    found: list[Job] = []
    for job in jobs:
        with kept(problems):
            found.append(replace(job, T_camera_rack=read_exact_truth(session.folder, job.trial).T_camera_rack))
    return found


def floor_note(floor: pd.DataFrame) -> str:
    """One sentence on the error of the ground truth against the exact truth of a simulation."""
    tilt, place = floor["tilt_deg"], np.sqrt((floor[["tx_mm", "ty_mm", "tz_mm"]] ** 2).sum(axis=1))
    return (
        f"Ground truth against the exact truth of the simulation, {len(floor)} caps: "
        f"tilt mean {tilt.mean():.3f}, max {tilt.max():.3f} deg; "
        f"position mean {place.mean():.3f}, max {place.max():.3f} mm."
    )


def refused_note(truth: pd.DataFrame) -> str:
    """One sentence on how many caps gave no truth."""
    refused = truth[truth["status"] != "ok"]
    told = []
    for reason, rows in refused.groupby("reason"):  # in the order of their words
        first, more = rows.iloc[0], f" and {len(rows) - 1} more" if len(rows) > 1 else ""
        told.append(f"{reason}: {first['trial']} {first['slot']}{more}")
    listed = f" ({'; '.join(told[:3])}{'; ...' if len(told) > 3 else ''})" if told else ""
    return f"Ground truth: {len(truth) - len(refused)} caps measured, {len(refused)} refused{listed}."
