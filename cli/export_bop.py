"""`tubepose export-bop`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tubepose_cli.paths import named


def export_bop(
    sessions: Annotated[list[Path], typer.Argument(parser=named, metavar="SESSIONS", help="Session folders.")],
    out: Annotated[Path, typer.Option(parser=named, metavar="PATH", help="Folder of the data set; a new one.")],
    estimates: Annotated[
        Path | None, typer.Option(help="Folder of a run, whose estimates become BOP results, a file a method.")
    ] = None,
    exact_truth: Annotated[
        bool, typer.Option("--exact-truth", help="Take the exact poses of a simulated session.")
    ] = False,
) -> None:
    """Write sessions in the BOP layout (models, images, poses, targets), and estimates as BOP results."""
    from tubepose.benchmark.bop_layout import export_bop as export
    from tubepose.foreign import ForeignMapping, read_estimates
    from tubepose_cli.inputs import find_sessions
    from tubepose_cli.show import finish, progress, say

    folders, problems = find_sessions(sessions)
    if not folders:
        finish(problems)
    rows = read_estimates(estimates / "estimates.csv", ForeignMapping(), {}) if estimates is not None else None
    found = export(folders, out, exact_truth=exact_truth, estimates=rows, progress=progress)
    say(f"{len(found.scenes)} images, {len(found.objects)} models: {out}")
    finish([*problems, *found.problems])
