"""`tubepose repeat`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

from tubepose_cli.paths import named

if TYPE_CHECKING:
    import pandas as pd


def repeat(
    captures: Annotated[
        list[Path],
        typer.Argument(
            parser=named, metavar="CAPTURES", help="Captures of one unchanged scene, or the folder of a run."
        ),
    ],
    out: Annotated[Path, typer.Option(parser=named, metavar="PATH", help="Folder for the results.")],
    rack: Annotated[str | None, typer.Option(help="Rack by name or YAML file; auto: of the catalogue.")] = None,
    tubes: Annotated[str | None, typer.Option(help="Kinds of tube that can be there: names or files.")] = None,
    method: Annotated[str, typer.Option(help="Methods with commas.")] = "profile",
    detector: Annotated[str, typer.Option(help="Source of boxes: yolo or geometric.")] = "yolo",
) -> None:
    """Judge a method without truth: repeatability, honesty of covariances and drift over frames of a still scene."""
    from tubepose.evaluation.repeatability import LEAST_FRAMES, drifts, innovations, repeatability
    from tubepose.report.writing import write_csv
    from tubepose_cli.estimated import Asked, read_tables, run_folder
    from tubepose_cli.show import finish, say, show_table

    folder, problems = run_folder(captures, Asked(rack, tubes, method, detector), out)
    estimates, racks = (cast("pd.DataFrame", table) for table in read_tables(folder, "estimates", "racks"))
    frames = len(racks[["session", "trial", "capture", "frame"]].drop_duplicates())
    if frames < LEAST_FRAMES:
        finish([*problems, f"{folder}: {frames} frames; {LEAST_FRAMES} or more of one unchanged scene are needed"])
    spread, honest, drift = repeatability(estimates, racks), innovations(estimates), drifts(estimates, racks)
    for name, table in (("repeatability", spread), ("innovation", honest), ("drift", drift)):
        write_csv(out / f"{name}.csv", table)
    notes = ["What all frames share does not show: calibration, sizes of labware, a bias of the method."]
    shown = spread.map(lambda value: f"{value:.3f}" if isinstance(value, float) else str(value))
    show_table(shown, f"Standard deviation over {frames} frames", notes)
    for row in honest.to_dict("records"):
        word = "" if row["consistent"] else ": stated covariances are too small"
        interval = f"95 % interval {row['ci95_low']:.2f} to {row['ci95_high']:.2f}"
        say(f"{row['method']}: normalised innovation {row['nis_mean']:.2f} ({interval}; 1 if honest){word}")
    say(f"all tables: {out}")
    finish([*problems, *_alarms(drift)])


def _alarms(drift: pd.DataFrame) -> list[str]:
    lines = []
    for row in drift[drift["alarm"]].to_dict("records"):
        what = (
            "the rack or the camera moved" if row["subject"] == "rack_or_camera" else f"the tube in {row['slot']} moved"
        )
        unit = str(row["axis"]).rpartition("_")[2]
        step = f"{row['step']:+.3g} {unit} at frame {row['step_at']}"
        words = f"{row['axis']} {row['per_frame']:+.3g} {unit} a frame, or {step}"
        lines.append(f"{row['method']}: {what}: {words} (p = {row['p']:.1g})")
    return lines
