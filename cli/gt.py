"""`tubepose gt`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tubepose_cli.paths import named

if TYPE_CHECKING:
    from tubepose.labware import Labware


def gt(
    sessions: Annotated[list[Path], typer.Argument(parser=named, metavar="SESSIONS", help="Session folders.")],
    out: Annotated[Path, typer.Option(parser=named, metavar="PATH", help="Folder for the results.")],
    average: Annotated[
        str | None,
        typer.Option(metavar="N|all", help="Fuse so many frames of a static recording, or all, into one."),
    ] = None,
    fail_fast: Annotated[bool, typer.Option("--fail-fast", help="Stop at the first bad capture.")] = False,
) -> None:
    """Measure the true poses of tubes from their printed caps (plane segmentation + square template ICP).

    Writes ground_truth.csv and run.json into --out; on simulated sessions ground_truth_floor.csv too, its error against
    the exact truth.
    """
    from tubepose.benchmark import measure_sessions
    from tubepose.capture.fusion import read_average
    from tubepose.config import Config
    from tubepose.provenance import inputs_sha256, run_record
    from tubepose.report.writing import write_json
    from tubepose_cli.inputs import find_sessions
    from tubepose_cli.show import finish, progress, say

    fused = read_average(average) if average is not None else 1
    folders, problems = find_sessions(sessions, fail_fast=fail_fast)
    used = inputs_sha256(folders, out)
    measured = measure_sessions(folders, out, average=fused, fail_fast=fail_fast, progress=progress)
    problems += measured.problems
    if not measured.sessions:
        finish(problems)
    caps = [session.printed_cap for session in measured.sessions if session.printed_cap is not None]
    labware: list[Labware] = []
    for session in measured.sessions:
        labware += [session.rack, *session.tubes.values()]
    record = run_record(
        sys.argv, Config(), [*labware, *caps], used, problems=problems, ground_truth_config=measured.config
    )
    write_json(out / "run.json", record)
    for line in measured.notes:
        say(line)
    finish(problems)
