"""Ground truth of whole sessions: measured from printed caps or exact, written, summed up in words."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from tubepose.capture.fusion import Average
from tubepose.capture.session import Session, load_session
from tubepose.errors import CaptureError, kept
from tubepose.ground_truth import GroundTruthConfig
from tubepose.provenance import pinned_threads
from tubepose.records import to_table
from tubepose.report.writing import make_folder, remove_files, write_csv
from tubepose.truth_tables import (
    FLOOR_COLUMNS,
    TRUTH_COLUMNS,
    TruthTables,
    exact_truth_rows,
    floor_note,
    measure_session,
    refused_note,
)

FLOOR_FILE = "ground_truth_floor.csv"
EXACT_NOTE = "Truth: the exact poses of the simulation, not those measured from printed caps."
Progress = Callable[[str, int], AbstractContextManager[Callable[[], None]]]
"""Shows progress: is given a title and a number of steps, and yields the function that a step calls when it is done."""


@contextmanager
def silent(title: str, total: int) -> Iterator[Callable[[], None]]:  # noqa: ARG001
    """Progress that nobody watches."""
    yield lambda: None


@dataclass(frozen=True, slots=True, eq=False)
class MeasuredTruth:
    """What was measured.

    Attributes:
        sessions: The sessions that could be read.
        truth: Table of ground_truth.csv.
        floor: Table of ground_truth_floor.csv; empty without a simulated session.
        notes: In words.
        problems: One line per session or trial that could not be done.
        config: The thresholds that were used.
    """

    sessions: tuple[Session, ...]
    truth: pd.DataFrame
    floor: pd.DataFrame
    notes: tuple[str, ...]
    problems: tuple[str, ...]
    config: dict[str, Any]


def measure_sessions(
    folders: Sequence[Path],
    out: Path | None,
    *,
    exact: bool = False,
    average: Average = 1,
    fail_fast: bool = False,
    progress: Progress = silent,
) -> MeasuredTruth:
    """Measure all sessions, or take the exact poses of simulated ones, and write ground_truth.csv into `out`, if any.

    ground_truth_floor.csv is written too if one that was measured is simulated.

    Args:
        folders: Session folders.
        out: Folder for the files; None to write none.
        exact: Take the exact poses of simulated sessions.
        average: How many frames of a static recording are fused into one.
        fail_fast: Raise the first problem instead of keeping it.
        progress: Shows how far it is.

    Raises:
        CaptureError: A session cannot be measured, and `fail_fast` is set.
    """
    sessions: list[Session] = []
    problems: list[str] = []
    for folder in folders:
        with kept(None if fail_fast else problems):
            session = load_session(folder, average)
            twin = next((other for other in sessions if other.name == session.name), None)
            if twin is not None:
                same = f"its session name '{session.name}' is that of {twin.folder} too"
                raise CaptureError(f"{folder}: {same}; change 'name' in one of them")
            _refuse_other_definitions(session, sessions)
            sessions.append(session)
    config = GroundTruthConfig()
    tables = TruthTables()
    if not sessions:
        nothing = to_table([], TRUTH_COLUMNS), to_table([], FLOOR_COLUMNS)
        return MeasuredTruth((), *nothing, (), tuple(problems), asdict(config))
    if out is not None:
        make_folder(out)
    with pinned_threads(1), progress("ground truth", sum(len(s.trials) for s in sessions)) as step:
        for session in sessions:
            if not exact:
                measure_session(session, tables, config, fail_fast=fail_fast, on_done=step)
                continue
            keep = None if fail_fast else tables.problems
            with kept(keep):
                tables.truth += exact_truth_rows(session, keep)
    truth, floor = to_table(tables.truth, TRUTH_COLUMNS), to_table(tables.floor, FLOOR_COLUMNS)
    if out is not None:
        _write(out, truth, floor)
    notes = [EXACT_NOTE if exact else refused_note(truth), *tables.notes, *([floor_note(floor)] if len(floor) else [])]
    return MeasuredTruth(tuple(sessions), truth, floor, tuple(notes), (*problems, *tables.problems), asdict(config))


def _write(out: Path, truth: pd.DataFrame, floor: pd.DataFrame) -> None:
    write_csv(out / "ground_truth.csv", truth)
    if len(floor):
        write_csv(out / FLOOR_FILE, floor)
    else:
        remove_files(out, [FLOOR_FILE])


def _refuse_other_definitions(session: Session, others: Sequence[Session]) -> None:
    """Tables know labware by name: one name has to mean one thing in a run.

    Raises:
        CaptureError: Another session has other labware of the same name.
    """
    for other in others:
        known = {other.rack.name: other.rack, **other.types}
        for name, item in {session.rack.name: session.rack, **session.types}.items():
            if known.get(name, item) != item:
                raise CaptureError(
                    f"{session.folder}: '{name}' is defined otherwise than in {other.folder}; "
                    "give one of them another name, or run the sessions one by one"
                )
