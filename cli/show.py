"""What the commands show: progress on a terminal, tables, problems."""

from __future__ import annotations

import itertools
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    import pandas as pd


LINE_SECONDS = 60.0
"""Without a terminal, progress is one line in this time; a command that is done sooner says nothing."""


@contextmanager
def progress(title: str, total: int) -> Iterator[Callable[[], None]]:
    """Progress on stderr, see `counted_progress`. Yields the step function."""
    done = itertools.count(1)
    with counted_progress(title) as show:
        show(0, total)
        yield lambda: show(next(done), total)


@contextmanager
def counted_progress(title: str) -> Iterator[Callable[[int, int], None]]:
    """Progress on stderr: a bar while it is a terminal, otherwise a line now and then; both with the time left.

    Yields the function that takes the number done and the number in all.
    """
    if not sys.stderr.isatty():
        yield _Lines(title)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task(title, total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


class _Lines:
    """Progress where nobody watches a bar: a line a minute, so that a log shows that it goes on and until when."""

    def __init__(self, title: str) -> None:
        self.title = title
        self.begun = self.told = time.monotonic()

    def __call__(self, done: int, total: int) -> None:
        now = time.monotonic()
        if done == 0 or done == total or now - self.told < LINE_SECONDS:
            return
        self.told = now
        say(f"{self.title}: {done}/{total}, about {_duration((now - self.begun) / done * (total - done))} left")


def _duration(seconds: float) -> str:
    """A time in the unit that a person would use."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"


def say(text: str) -> None:
    """Talk: one line on stderr, whatever names it quotes."""
    from tubepose.errors import one_line

    typer.echo(one_line(text), err=True)


def describe_noise(rows: Sequence[Mapping[str, Any]]) -> str:
    """The sensor's noise in one line, from rows of sensor.csv: medians over the frames in which it was measured."""
    from statistics import median

    surfaces = {"table": "on the table", "rack_top": "on the rack's top"}
    measured = [row for row in rows if row["source"] in surfaces]
    edges = [row for row in rows if row["edge_source"] != "prior"]

    def middle(name: str, of: Sequence[Mapping[str, Any]]) -> float:
        return median(float(row[name]) for row in of or rows)

    where = "assumed, not measured"
    if measured:
        found = sorted({row["source"] for row in measured}, key=list(surfaces).index)
        frames = f" in {len(measured)} of {len(rows)} frames" if len(rows) > 1 else ""
        places = " or ".join(surfaces[name] for name in found)
        where = f"measured {places}{frames}, {middle('n_patches', measured):.0f} patches"
    values = [middle(name, measured) * 1e3 for name in ("independent_m", "shared_m", "correlation_m")]
    text = "depth noise: {:.2g} mm independent, {:.2g} mm shared over {:.2g} mm".format(*values)
    assumed = "" if edges else " (assumed)"
    notes = list(dict.fromkeys(str(row["note"]) for row in measured if row["note"]))
    return "; ".join([f"{text} ({where}), edges {middle('edge_blur_px', edges):.1f} px{assumed}", *notes[:1]])


def describe_averaging(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """How many frames were averaged, and a line for each average that frames are left out of; rows of sensor.csv."""
    counts = sorted({int(row["n_frames"]) for row in rows})
    if not rows or (counts[-1] == 1 and not any(row["n_left_out"] for row in rows)):
        return ["no capture has more than one frame: nothing is averaged"] if rows else []
    each = f"{counts[0]}" if counts[0] == counts[-1] else f"{counts[0]} to {counts[-1]}"
    lines = [f"averaged: {each} frames in each of {len(rows)}; the noise is that of the averages"]
    return lines + [str(row["left_out_reason"]) for row in rows if row["n_left_out"]]


def describe_sizes(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line for each size that contradicts its file, from the rows of labware_check.csv over the run."""
    things = {
        "pitch_x_mm": "slots {} mm apart along x",
        "pitch_y_mm": "slots {} mm apart along y",
        "opening_mm": "openings of {} mm",
        "outline_x_mm": "an outline of {} mm along x",
        "outline_y_mm": "an outline of {} mm along y",
        "floor_mm": "the floor of the slots {} mm above the rack's base",
        "scale": "everything {} times as large",
        "top_height_mm": "caps {} mm high",
        "cap_diameter_mm": "caps {} mm wide",
    }
    return [_size_line(row, things[str(row["quantity"])]) for row in rows if row["contradicts"]]


def _size_line(row: Mapping[str, Any], thing: str) -> str:
    digits = {"scale": 4, "pitch_x_mm": 2, "pitch_y_mm": 2}.get(str(row["quantity"]), 1)
    of_tubes = row["quantity"] in ("top_height_mm", "cap_diameter_mm")
    counted = f"{row['n']} {'tube' if of_tubes else 'frame'}{'s' if row['n'] > 1 else ''}"
    seen = thing.format(f"{row['measured']:.{digits}f}") + f" ({counted}, +-{row['std']:.{digits}f})"
    other = {"": "", "another type": ", or it is another type"}.get(row["other_key"], f", or {row['other_key']}")
    do = f"correct {row['key']} to {row['write']:.{digits}f}{other}"
    if row["quantity"] == "scale":
        do = f"multiply {row['key']} by {row['write']:.{digits}f}{other}"
    return f"labware: the scan shows {seen}, {row['labware']} says {row['defined']:g}: {do}"


def say_when_compiling() -> None:
    """One line before loops are compiled: it takes a while, and the machine code is kept."""
    from tubepose.compiled import before_compiling

    before_compiling(lambda: say("compiling for this machine: up to a minute; it is kept, so later runs begin at once"))


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
    why, codes = "", Counter(str(row["reason_code"]) for row in estimates if row["reason"])
    if codes:
        commonest = codes.most_common(1)[0][0]
        why = f" ({next(row['reason'] for row in estimates if row['reason'] and row['reason_code'] == commonest)})"
    return ", ".join(words) + why


def finish(problems: Sequence[str]) -> None:
    """List what could not be done and end with 1, or return if all was."""
    for problem in problems:
        say(f"error: {problem}")
    if problems:
        raise typer.Exit(1)
