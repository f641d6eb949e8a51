"""`tubepose compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tubepose_cli.paths import named


def compare(
    runs: Annotated[
        list[Path],
        typer.Argument(
            parser=named, metavar="RUN RUN...", help="Folders of bench or evaluate, or baseline files; first: before."
        ),
    ],
    out: Annotated[
        Path | None,
        typer.Option(parser=named, metavar="PATH", help="Folder for compare.md, .json, changes.csv."),
    ] = None,
    fail_if: Annotated[
        str | None, typer.Option("--fail-if", help="Gates with commas: kept,wrong,error,coverage,time:1.2.")
    ] = None,
    form: Annotated[str, typer.Option("--format", help="On the screen: text, markdown or json.")] = "text",
    junit: Annotated[Path | None, typer.Option(help="Write the gates as JUnit XML.")] = None,
    summary_json: Annotated[Path | None, typer.Option("--summary-json", help="Write everything as JSON.")] = None,
    other_data: Annotated[
        bool, typer.Option("--other-data", help="Gate though data, labware or versions differ.")
    ] = False,
) -> None:
    """Compare runs tube by tube: counts before means, bootstrap over captures, changes worst first."""
    from tubepose.benchmark import compare as run_comparison
    from tubepose.errors import ConfigError
    from tubepose.evaluation.gate import read_gates
    from tubepose.report.writing import json_text, write_csv, write_json, write_text
    from tubepose_cli.gating import finish_gates, write_reports
    from tubepose_cli.show import show_table

    if form not in ("text", "markdown", "json"):
        raise ConfigError(f"--format '{form}'; expected text, markdown or json")
    found = run_comparison(runs, read_gates(fail_if) if fail_if is not None else None, other_data=other_data)
    if out is not None:
        write_text(out / "compare.md", found.markdown())
        write_json(out / "compare.json", found.summary())
        write_csv(out / "changes.csv", found.changes)
    write_reports(found.gates, found.summary(), junit, summary_json)
    if form == "text":
        for table in found.tables():
            show_table(table.cells, table.caption, table.notes)
    else:
        print(found.markdown() if form == "markdown" else json_text(found.summary()), end="")
    finish_gates(found.gates)
