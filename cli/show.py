"""What the commands show: progress on a terminal, tables, problems."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    import pandas as pd


@contextmanager
def progress(title: str, total: int) -> Iterator[Callable[[], None]]:
    """A progress bar on stderr while it is a terminal; otherwise nothing. Yields the step function."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not sys.stderr.isatty(), transient=True) as bar:
        task = bar.add_task(title, total=total)
        yield lambda: bar.advance(task)


def say(text: str) -> None:
    """Talk: one line on stderr."""
    typer.echo(text, err=True)


def show_table(table: pd.DataFrame, title: str, notes: Sequence[str] = ()) -> None:
    """A table of strings on stdout, with notes under it."""
    from rich.console import Console
    from rich.table import Table

    console = Console(width=None if sys.stdout.isatty() else 160)
    shown = Table(title=title, title_justify="left", header_style="bold")
    for i, name in enumerate(table.columns):
        shown.add_column(str(name), justify="left" if i < 2 else "right")
    for row in table.itertuples(index=False):
        shown.add_row(*(str(value) for value in row))
    console.print(shown)
    for note in notes:
        console.print(f"  {note}", highlight=False, markup=False)
    console.print()


def describe_tubes(estimates: Sequence[Mapping[str, Any]]) -> str:
    """How many tubes of a frame are ok, rejected and failed, and the commonest reason."""
    counts = Counter(str(row["status"]) for row in estimates)
    words = [f"{counts['ok']} tubes ok", *(f"{counts[name]} {name}" for name in ("rejected", "failed") if counts[name])]
    reasons = Counter(str(row["reason"]) for row in estimates if row["reason"])
    why = f" ({reasons.most_common(1)[0][0]})" if reasons else ""
    return ", ".join(words) + why


def finish(problems: Sequence[str]) -> None:
    """List what could not be done and end with 1, or return if all was."""
    for problem in problems:
        say(f"error: {problem}")
    if problems:
        raise typer.Exit(1)
