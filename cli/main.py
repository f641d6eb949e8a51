"""The `tubepose` command. Heavy imports stay inside the commands, so that `--help` is quick."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from tubepose import __version__
from tubepose.errors import StoppedError, TubePoseError, is_interrupt
from tubepose_cli import data, detector, labware
from tubepose_cli.bench import bench
from tubepose_cli.compare import compare
from tubepose_cli.estimate import estimate
from tubepose_cli.evaluate import evaluate
from tubepose_cli.export_bop import export_bop
from tubepose_cli.gt import gt
from tubepose_cli.measure import measure
from tubepose_cli.merge import merge
from tubepose_cli.repeat import repeat
from tubepose_cli.sensor import sensor
from tubepose_cli.simulate import simulate
from tubepose_cli.slots import slots

app = typer.Typer(
    name="tubepose",
    help="Poses of in-rack test tubes from recorded RGB-D captures.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for _command in (estimate, gt, bench, evaluate, compare, export_bop, repeat, slots, simulate, sensor, merge):
    app.command()(_command)
labware.app.command()(measure)
app.add_typer(labware.app, name="labware")
app.add_typer(data.app, name="data")
app.add_typer(detector.app, name="detector")


def _show_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"tubepose {__version__}")
        raise typer.Exit


@app.callback()
def main(
    version: Annotated[
        bool, typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Poses of in-rack test tubes from recorded RGB-D captures."""


def run() -> None:
    """Entry point: an error that the user can correct is one line on stderr and exit 1; a wrong usage is exit 2.

    A signal that stopped it is exit 128 and its number, as of a command that has not caught it: 130 of Ctrl-C.
    """
    try:
        app()
    except TubePoseError as problem:
        print(f"error: {problem}", file=sys.stderr)
        sys.exit(128 + problem.number if isinstance(problem, StoppedError) else 1)
    except OSError as problem:
        if problem.filename is None:
            raise
        print(f"error: {problem.filename}: {problem.strerror}", file=sys.stderr)
        sys.exit(1)
    except SystemError as problem:
        if not is_interrupt(problem):
            raise
        sys.exit(130)
