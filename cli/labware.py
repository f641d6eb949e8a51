"""`tubepose labware`: the catalogue, one definition in words and as a drawing, and the check of a file."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from rich.table import Table

    from tubepose.labware import CapModel, Labware, RackModel, TubeModel

app = typer.Typer(no_args_is_help=True, help="Racks, tubes and printed caps: list, show, check and measure them.")


@app.command("list")
def list_labware() -> None:
    """List the built-in catalogue."""
    from rich.table import Table

    from tubepose.labware import catalogue

    table = Table(box=None, pad_edge=False)
    for heading in ("kind", "name", "description"):
        table.add_column(heading, no_wrap=heading != "description", overflow="fold")
    for item in sorted(catalogue().values(), key=lambda item: (_ORDER[item.kind], item.name)):
        table.add_row(item.kind, item.name, item.description)
    print_table(table)


@app.command()
def show(
    name_or_file: Annotated[str, typer.Argument(metavar="NAME|FILE", help="Catalogue name or YAML file.")],
    out: Annotated[Path | None, typer.Option(help="Write the drawing to this .png file.")] = None,
) -> None:
    """Print the measures of one definition; with --out also draw it."""
    from rich.table import Table

    item = _find(name_or_file)
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for word, value in (("name", f"{item.name} ({item.kind})"), *_describe(item)):
        table.add_row(word, value)
    print_table(table)
    if out is not None:
        _draw(item, out)


@app.command()
def check(files: Annotated[list[Path], typer.Argument(metavar="FILE...", help="Definition files.")]) -> None:
    """Check definition files: `ok` or one line that says what is wrong; exit 1 if any is wrong."""
    from tubepose.errors import LabwareError
    from tubepose.labware import read_labware

    wrong = 0
    for file in files:
        try:
            item = read_labware(file)
        except LabwareError as problem:
            typer.echo(f"error: {problem}", err=True)
            wrong += 1
        else:
            typer.echo(f"{file}: ok ({item.kind} {item.name})")
    if wrong:
        raise typer.Exit(1)


_ORDER = {"rack": 0, "tube": 1, "cap": 2}


def _find(name_or_file: str) -> Labware:
    import difflib

    from tubepose.errors import LabwareError
    from tubepose.labware import catalogue, read_labware
    from tubepose.labware.reading import LABWARE_SUFFIXES

    known = catalogue()
    if name_or_file in known:
        return known[name_or_file]
    if Path(name_or_file).suffix in LABWARE_SUFFIXES:
        return read_labware(Path(name_or_file))
    close = difflib.get_close_matches(name_or_file, known, n=1)
    guess = f"; did you mean '{close[0]}'?" if close else ";"
    raise LabwareError(
        f"unknown labware '{name_or_file}'{guess} see 'tubepose labware list', or give a .yaml or .json file"
    )


def print_table(table: Table) -> None:
    """Show a table on stdout, its lines whole where that is no terminal."""
    from rich.console import Console

    # Into a pipe or file go whole lines.
    Console(width=None if sys.stdout.isatty() else 250, markup=False, highlight=False).print(table)


def _draw(item: Labware, out: Path) -> None:
    from tubepose.errors import LabwareError
    from tubepose.labware.drawing import draw_labware

    if out.suffix.lower() != ".png":
        raise LabwareError(f"--out {out}: expected a file name that ends in .png")
    if not out.parent.is_dir():
        raise LabwareError(f"--out {out}: folder {out.parent} does not exist; make it first")
    aside = out.with_name(f".{out.stem}.part.png")
    draw_labware(item).savefig(aside, dpi=110)
    aside.replace(out)
    typer.echo(f"wrote {out}", err=True)


def _describe(item: Labware) -> list[tuple[str, str]]:
    from tubepose.labware import RackModel, TubeModel

    if isinstance(item, RackModel):
        measures = _describe_rack(item)
    elif isinstance(item, TubeModel):
        measures = _describe_tube(item)
    else:
        measures = _describe_cap(item)
    return [("description", item.description or "-"), *measures, ("source", item.source or "-")]


def _describe_rack(rack: RackModel) -> list[tuple[str, str]]:
    rows: dict[float, list[str]] = {}
    for slot in rack.all_slots:
        rows.setdefault(slot.center_mm[1], []).append(slot.name)
    openings = {(slot.shape, slot.size_mm) for slot in rack.all_slots}
    lines = [
        ("outline", f"{rack.outline_mm[0]:g} x {rack.outline_mm[1]:g} mm (x, y), {rack.height_mm:g} mm high"),
        (
            "slot floor",
            f"{rack.floor_mm:g} mm above the base, {rack.depth_m * 1e3:g} mm deep, play {rack.floor_play_mm:g} mm",
        ),
        ("openings", "; ".join(sorted(f"{shape} {size[0]:g} x {size[1]:g} mm" for shape, size in openings))),
        ("narrowest rib", f"{rack.min_rib_m * 1e3:.2f} mm"),
    ]
    if rack.grid is not None:
        grid = rack.grid
        pitch = f"{grid.pitch_mm[0]:g} x {grid.pitch_mm[1]:g} mm (x, y)"
        lines.insert(2, ("grid", f"{grid.rows} rows, {grid.columns} columns, pitch {pitch}"))
    slots = "\n".join(" ".join(names) for _, names in sorted(rows.items(), reverse=True))
    return [*lines, (f"slots ({len(rack.all_slots)})", slots)]


def _describe_tube(tube: TubeModel) -> list[tuple[str, str]]:
    body, cap = tube.body, tube.cap
    taper = f"{body.bottom_diameter_mm:g} mm at the bottom, {body.top_diameter_mm:g} mm at the rim"
    lines = [
        ("height", f"{tube.height_mm:g} mm with cap, rim at {body.height_mm:g} mm"),
        ("body", f"{taper}, wall {body.wall_mm:g} mm, {body.material}"),
        ("bottom", body.bottom + (f", cone {body.cone_height_mm:g} mm" if body.bottom == "conical" else "")),
    ]
    if cap is None:
        lines.append(("cap", "none, open"))
    else:
        word = "flange" if cap.open else "cap"
        stands = "ends with the rim" if cap.open else f"top {cap.top_mm:g} mm above the rim"
        lines.append((word, f"{cap.diameter_mm:g} mm wide, {cap.height_mm:g} mm high, {stands}, {cap.material}"))
    return [*lines, ("classes", ", ".join(tube.classes) or "-")]


def _describe_cap(cap: CapModel) -> list[tuple[str, str]]:
    return [
        ("square", f"{cap.square_mm:g} mm, {cap.thickness_mm:g} mm thick"),
        ("seat", f"top {cap.seat_mm:g} mm above the rim of the tube"),
    ]
