"""`tubepose simulate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer


def simulate(
    out: Annotated[Path, typer.Argument(help="New folder for the simulated session.")],
    rack: Annotated[str, typer.Option(help="Rack by name or YAML file.")],
    tubes: Annotated[str, typer.Option(help="Tubes, names or files, with commas.")],
    trials: Annotated[int, typer.Option(min=1, help="Trials per kind of tube.")] = 2,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same bytes.")] = 0,
    sensor: Annotated[str, typer.Option(help="Sensor model: raycast.")] = "raycast",
    resolution: Annotated[int, typer.Option(min=64, max=2064, help="Side of the square image, pixels.")] = 1376,
    cap: Annotated[str, typer.Option(help="Printed cap of the ground truth.")] = "printed-square-16.7",
    fill: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, help="Share of occupied slots; default: 0.1 to 0.4.")
    ] = None,
    mixed: Annotated[bool, typer.Option("--mixed", help="All kinds of tube in every trial.")] = False,
    capture_format: Annotated[
        Literal["folder", "mcap"], typer.Option("--format", help="Kind of capture files.")
    ] = "folder",
) -> None:
    """Make a SIMULATED session like the paper's: printed and original caps, exact truth apart."""
    from tubepose.errors import CaptureError, ConfigError
    from tubepose.labware import load_cap, load_rack
    from tubepose.provenance import pinned_threads
    from tubepose.simulation import SENSORS, simulate_session
    from tubepose_cli.inputs import read_tubes, unknown_name
    from tubepose_cli.show import progress, say

    if sensor not in SENSORS:
        raise ConfigError(unknown_name("sensor", sensor, SENSORS))
    models = read_tubes(tubes)
    if not models:
        raise ConfigError("--tubes names no tube; see 'tubepose labware list'")
    total = 2 * trials * (1 if mixed else len(models))
    rack_model, cap_model = load_rack(rack), load_cap(cap)
    try:
        with pinned_threads(0), progress("simulated captures", total) as step:
            simulate_session(
                out, rack_model, models, trials=trials, seed=seed, cap=cap_model, sensor=sensor,
                resolution=resolution, fill=fill, mixed=mixed, capture_format=capture_format,
                progress=lambda _done, _total: step(),
            )  # fmt: skip
    except OSError as problem:
        raise CaptureError(f"{out}: cannot be written ({problem.strerror}); choose another place") from None
    say(f"{out}: {total} simulated captures in {total // 2} trials; next: tubepose bench {out} --out RESULTS")
