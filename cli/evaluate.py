"""`tubepose evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tubepose_cli.paths import named


def evaluate(
    estimates: Annotated[
        list[Path],
        typer.Argument(
            parser=named,
            metavar="ESTIMATES",
            help="CSV or JSON in the columns of estimates.csv, BOP results, TUM rows (.txt), or folders of runs.",
        ),
    ],
    truth: Annotated[
        list[Path],
        typer.Option(parser=named, metavar="PATH", help="Session folder (again for more), or one ground_truth.csv."),
    ],
    out: Annotated[Path, typer.Option(parser=named, metavar="PATH", help="Folder for the results.")],
    mapping: Annotated[
        Path | None, typer.Option(help="YAML: method, scenes, objects, origin, axis, unit (docs/evaluation.md).")
    ] = None,
    tubes: Annotated[
        str | None, typer.Option(help="Tubes of a ground_truth.csv that the catalogue lacks: files, with commas.")
    ] = None,
    match_mm: Annotated[
        float, typer.Option("--match-mm", min=0.1, help="Rows without a slot claim a true tube within this distance.")
    ] = 20.0,
    exact_truth: Annotated[
        bool, typer.Option("--exact-truth", help="Judge by the exact poses of a simulated session.")
    ] = False,
) -> None:
    """Judge the estimates of any method by the ground truth: the tables of bench, failures counted alike."""
    from tubepose.benchmark import EvaluateOptions
    from tubepose.benchmark import evaluate as run_evaluation
    from tubepose.foreign import read_mapping
    from tubepose_cli.inputs import read_tubes
    from tubepose_cli.show import finish, progress, say, show_table

    options = EvaluateOptions(
        read_mapping(mapping), read_tubes(tubes) if tubes is not None else (), match_mm, exact_truth
    )
    found = run_evaluation(estimates, truth, out, options=options, progress=progress)
    show_table(found.accuracy.cells, found.accuracy.caption, found.accuracy.notes)
    say(f"all tables and rows: {out}")
    finish(found.problems)
