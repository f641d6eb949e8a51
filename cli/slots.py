"""`tubepose slots`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from tubepose_cli.paths import named

if TYPE_CHECKING:
    import pandas as pd

    from tubepose.labware import RackModel

MARKS = {"empty": ".", "not_seen": "?", "unclear": "~"}


def slots(
    captures: Annotated[
        list[Path], typer.Argument(parser=named, metavar="CAPTURES", help="Captures, or the folder of a run.")
    ],
    out: Annotated[Path, typer.Option(parser=named, metavar="PATH", help="Folder for the results.")],
    expect: Annotated[
        Path | None, typer.Option(help="Declared map: CSV (slot,tube), session, JSON by slot, PyLabRobot rack.")
    ] = None,
    allow: Annotated[str, typer.Option(help="Findings that are no failure, with commas: not_seen,unclear.")] = "",
    max_tilt_deg: Annotated[
        float, typer.Option("--max-tilt-deg", min=0, help="A tube that leans more is tilted.")
    ] = 10,
    max_seat_mm: Annotated[
        float, typer.Option("--max-seat-mm", min=0, help="Off the slot floor by more: not seated.")
    ] = 3,
    rack: Annotated[str | None, typer.Option(help="Rack by name or YAML file; auto: of the catalogue.")] = None,
    tubes: Annotated[str | None, typer.Option(help="Kinds of tube that can be there: names or files.")] = None,
    method: Annotated[str, typer.Option(help="One method.")] = "profile",
    detector: Annotated[str, typer.Option(help="Source of boxes: yolo or geometric.")] = "yolo",
) -> None:
    """Show what stands in every slot, and compare it with what was declared; exit 1 where they differ."""
    from tubepose.errors import ConfigError
    from tubepose.evaluation.slot_map import FINDINGS, MapLimits, compare_map, slot_map
    from tubepose.foreign.expected_slots import read_expected
    from tubepose.report.writing import write_csv, write_json
    from tubepose_cli.estimated import Asked, read_tables, run_folder
    from tubepose_cli.show import finish, say

    allowed = {word.strip() for word in allow.split(",") if word.strip()}
    if allowed - set(FINDINGS):
        raise ConfigError(
            f"--allow: unknown {', '.join(sorted(allowed - set(FINDINGS)))}; known: {', '.join(FINDINGS)}"
        )
    folder, problems = run_folder(captures, Asked(rack, tubes, method, detector), out)
    tables = [cast("pd.DataFrame", table) for table in read_tables(folder, "slots", "estimates", "racks")]
    methods = list(tables[0]["method"].unique())
    chosen = method if method in methods or not methods else methods[0]
    of_slots, estimates, racks = (table[table["method"] == chosen] for table in tables)
    found = slot_map(of_slots, estimates, racks, _racks(captures, rack, racks))
    if expect is not None:
        known = _known_tubes(tubes, estimates, captures)
        found = compare_map(found, read_expected(expect, known), MapLimits(max_tilt_deg, max_seat_mm))
    _show(found)
    write_csv(out / "slot_map.csv", found)
    write_json(out / "slot_map.json", {"slots": found.astype("object").where(found.notna(), None).to_dict("records")})
    say(f"slot map: {out}")
    if found.empty:
        problems.append(
            "no rack with a pose, so no slot map" if not len(of_slots) else "no capture of the map is declared"
        )
    finish([*problems, *(_differences(found, allowed) if expect is not None else [])])


def _racks(captures: list[Path], rack: str | None, rows: pd.DataFrame) -> dict[str, RackModel]:
    """The racks that are named, as far as their definitions are at hand."""
    from tubepose.capture.session import is_session, load_session
    from tubepose.errors import LabwareError
    from tubepose.labware import load_rack

    models = [load_session(path).rack for path in captures if is_session(path)]
    for name in [rack] if rack not in (None, "auto", "grid") else list(rows["rack"].dropna().unique()):
        try:
            models.append(load_rack(str(name)))
        except LabwareError:
            continue
    return {model.name: model for model in models}


def _known_tubes(tubes: str | None, estimates: pd.DataFrame, captures: list[Path]) -> set[str]:
    from tubepose.capture.session import is_session, load_session
    from tubepose.labware import TubeModel, catalogue
    from tubepose_cli.inputs import read_tubes

    found = {str(name) for name in estimates["tube"].dropna().unique()}
    found |= {name for path in captures if is_session(path) for name in load_session(path).types}
    found |= {item.name for item in catalogue().values() if isinstance(item, TubeModel)}
    return found | ({tube.name for tube in read_tubes(tubes)} if tubes is not None else set())


def _show(found: pd.DataFrame) -> None:
    """A grid per frame: a letter per type of tube, marks for the rest."""
    from tubepose.evaluation.slot_map import grid
    from tubepose_cli.show import show_table

    types = sorted(found["tube"].dropna().unique())
    letters = {name: chr(ord("a") + i % 26) for i, name in enumerate(types)}
    for key, rows in found.groupby(["session", "trial", "capture", "frame"], sort=False, dropna=False):
        marks = [MARKS.get(row["state"]) or letters.get(row["tube"], "x") for row in rows.to_dict("records")]
        if "finding" in rows:
            marks = [mark + ("" if ok else "!") for mark, ok in zip(marks, rows["finding"] == "ok", strict=True)]
        legend = "; ".join(
            [*(f"{letter} {name}" for name, letter in letters.items()), ". empty, ? not seen, ~ unclear"]
        )
        notes = [f"{legend}, x occupied by an unknown one{', ! not as declared' if 'finding' in rows else ''}"]
        if rows["ambiguous"].astype(bool).any():
            notes.append("the rack may stand another way round: slot names may be swapped; give a hint")
        show_table(grid(rows.assign(mark=marks), "mark"), " ".join(str(part) for part in key if str(part)), notes)


def _differences(found: pd.DataFrame, allowed: set[str]) -> list[str]:
    """A line per capture and finding; and one where slot names may be swapped."""
    lines = []
    for key, rows in found.groupby(["capture", "finding"], sort=False):
        capture, finding = map(str, key)
        if finding != "ok" and finding not in allowed:
            lines.append(f"{capture}: {len(rows)} {finding.replace('_', ' ')}: {', '.join(rows['slot'])}")
    for name, rows in found.groupby("capture", sort=False):
        if rows["ambiguous"].astype(bool).any():
            lines.append(f"{name!s}: the rack may stand another way round, so that slot names may be swapped")
    return lines
