"""`tubepose labware measure`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tubepose.labware import RackModel
    from tubepose.labware_measure import MeasuredRack


def measure(
    capture: Annotated[Path, typer.Argument(metavar="CAPTURE", help="One capture, as estimate takes it.")],
    like: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|FILE", help="A rack to begin with and to compare with; needed where slots make no grid."
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Write the measured rack to this .yaml file.")] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of the cloud, m or mm; as for estimate.")] = None,
    depth_scale: Annotated[
        float | None, typer.Option(metavar="METRES", help="Metres of one count of depth images; as for estimate.")
    ] = None,
) -> None:
    """Measure a rack, and the tops of the tubes in it, from a scan, with standard deviations.

    The table goes to stdout; --out writes the rack as a definition.
    """
    from rich.table import Table

    from tubepose.capture.source import open_captures
    from tubepose.config import Config
    from tubepose.errors import CaptureError, LabwareError
    from tubepose.labware import load_rack
    from tubepose.labware_measure import measure_rack
    from tubepose_cli.labware import print_table
    from tubepose_cli.show import say

    if out is not None and (out.suffix not in (".yaml", ".yml") or not out.parent.is_dir()):
        raise LabwareError(f"--out {out}: expected a .yaml file in a folder that exists")
    nominal = load_rack(like) if like is not None else None
    found = open_captures(capture, unit=unit, depth_scale_m=depth_scale)
    if len(found) != 1:
        raise CaptureError(f"{capture}: {len(found)} captures; give one of them, such as {found[0].path}")
    frame = next(iter(found[0].frames()), None)
    if frame is None:
        raise CaptureError(f"{capture}: no frame in it")
    measured = measure_rack(frame, Config(), nominal)
    table = Table(box=None, pad_edge=False)
    for heading in ("quantity", "measured", "std", "n", "defined", "difference"):
        table.add_column(heading, no_wrap=True)
    for size in measured.sizes:
        known = not math.isnan(size.nominal)
        table.add_row(
            size.quantity, f"{size.value:.2f}", f"{size.std:.2f}", str(size.count or ""),
            f"{size.nominal:.2f}" if known else "", f"{size.value - size.nominal:+.2f}" if known else "",
        )  # fmt: skip
    print_table(table)
    say(_grid_words(measured))
    missing = _missing(measured, nominal)
    if missing:
        say(missing)
    if out is not None:
        _write(out, measured.rack, missing)
        say(f"wrote {out}")


def _grid_words(measured: MeasuredRack) -> str:
    slots, grid = measured.rack.all_slots, measured.rack.grid
    shape = slots[0].shape
    if grid is None:
        return f"{len(slots)} slots, {shape} openings"
    return f"{grid.rows} rows of {grid.columns} slots, {shape} openings"


def _missing(measured: MeasuredRack, like: RackModel | None) -> str:
    """What could not be measured, and where its numbers are from."""
    parts = [
        *([] if measured.known_height else ["height_mm (no table is seen beside the rack)"]),
        *([] if measured.known_floor else ["floor_mm (the slots' floor is not seen)"]),
    ]
    if not parts:
        return ""
    source = f"they are those of {like.name}" if like is not None else "measure them, and correct the file"
    return f"not measured: {', '.join(parts)}; {source}"


def _write(out: Path, rack: RackModel, missing: str) -> None:
    """Write a definition: aside first, then renamed."""
    import yaml

    data = rack.model_dump(mode="json", exclude_defaults=True, exclude={"kind"})
    head = f"# {missing}\n" if missing else ""
    text = yaml.safe_dump({"kind": "rack", **data}, sort_keys=False, default_flow_style=None, width=120)
    aside = out.with_name(f".{out.name}.part")
    aside.write_text(head + text, encoding="utf-8")
    aside.replace(out)
