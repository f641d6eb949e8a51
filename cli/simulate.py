"""`tubepose simulate`."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tubepose_cli.paths import named

if TYPE_CHECKING:
    from tubepose.simulation import SceneVariation
    from tubepose.simulation.stereo import StereoCamera

RESOLUTION = 1376


def simulate(
    out: Annotated[Path, typer.Argument(parser=named, metavar="OUT", help="New folder for the simulated session.")],
    rack: Annotated[str, typer.Option(help="Rack by name or YAML file.")],
    tubes: Annotated[str, typer.Option(help="Tubes, names or files, with commas.")],
    trials: Annotated[int, typer.Option(min=1, help="Trials per kind of tube.")] = 2,
    seed: Annotated[int, typer.Option(min=0, help="The same seed gives the same bytes.")] = 0,
    sensor: Annotated[str, typer.Option(help="Sensor model: raycast, structured-light or stereo.")] = "raycast",
    camera: Annotated[
        str | None, typer.Option(help="Camera of --sensor stereo: d405, d435, d435-640, or a YAML file.")
    ] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames of each capture; several make it a recording.")] = 1,
    resolution: Annotated[
        int | None, typer.Option(min=64, max=2064, help="Side of a scanner's square image, pixels [default: 1376].")
    ] = None,
    cap: Annotated[str, typer.Option(help="Printed cap of the ground truth.")] = "printed-square-16.7",
    mixed: Annotated[bool, typer.Option("--mixed", help="All kinds of tube in every trial.")] = False,
    scenes: Annotated[Path | None, typer.Option(help="YAML file of what varies; see docs/simulation.md.")] = None,
    fill: Annotated[
        str | None, typer.Option(metavar="SHARE", help="Occupied slots: 0.3 or 0.1-0.4, which is the default.")
    ] = None,
    scattering: Annotated[
        str | None, typer.Option(metavar="RANGE", help="Of see-through walls, per mm: 0.4 or 0-1.")
    ] = None,
    liquid: Annotated[float | None, typer.Option(metavar="SHARE", help="Share of the tubes that hold liquid.")] = None,
    labels: Annotated[float | None, typer.Option(metavar="SHARE", help="Share of the tubes with a label.")] = None,
    perfect_parts: Annotated[bool, typer.Option("--perfect-parts", help="Caps exactly as defined and seated.")] = False,
    no_calibration_error: Annotated[
        bool, typer.Option("--no-calibration-error", help="A camera that is calibrated exactly.")
    ] = False,
    capture_format: Annotated[
        Literal["folder", "mcap"] | None,
        typer.Option("--format", help="Kind of capture files [default: folder; mcap for several frames]."),
    ] = None,
    threads: Annotated[int, typer.Option(min=0, help="0: one per core. They change no byte.")] = 0,
) -> None:
    """Make a SIMULATED session like the paper's: printed and original caps, exact truth apart."""
    from tubepose.errors import CaptureError, ConfigError
    from tubepose.labware import load_cap, load_rack
    from tubepose.simulation import SENSORS, simulate_session
    from tubepose_cli.inputs import read_tubes, unknown_name
    from tubepose_cli.show import counted_progress, say

    if sensor not in SENSORS:
        raise ConfigError(unknown_name("sensor", sensor, SENSORS))
    seen_by = _stereo_camera(sensor, camera, resolution)
    models = read_tubes(tubes)
    variation = _variation(scenes, fill, scattering, liquid, labels, perfect_parts)
    total = 2 * trials * (1 if mixed else len(models))
    rack_model, cap_model = load_rack(rack), load_cap(cap)
    try:
        with counted_progress("simulated captures") as show:
            simulate_session(
                out, rack_model, models, trials=trials, seed=seed, cap=cap_model, sensor=sensor,
                resolution=resolution or RESOLUTION, camera=seen_by, frames=frames, variation=variation, mixed=mixed,
                calibration_error=not no_calibration_error, threads=threads or available_cores(), progress=show,
                capture_format=capture_format or ("folder" if frames == 1 else "mcap"),
            )  # fmt: skip
    except OSError as problem:
        raise CaptureError(f"{out}: cannot be written ({problem.strerror}); choose another place") from None
    say(f"{out}: {total} simulated captures in {total // 2} trials; next: tubepose bench {out} --out RESULTS")


def _stereo_camera(sensor: str, camera: str | None, resolution: int | None) -> StereoCamera | None:
    """The camera of ``--sensor stereo``; options that a sensor has no use for are refused."""
    from tubepose.errors import ConfigError

    if sensor != "stereo":
        if camera is not None:
            raise ConfigError(f"--camera given, but --sensor {sensor} has no use for it; give --sensor stereo")
        return None
    from tubepose.simulation.stereo import CAMERAS, load_stereo_camera

    if resolution is not None:
        raise ConfigError("--resolution given, but the size of a stereo image is its camera's; leave it out")
    if camera is None:
        raise ConfigError(f"--sensor stereo needs --camera: {', '.join(CAMERAS)}, or a YAML file")
    return load_stereo_camera(camera)


def available_cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _variation(
    scenes: Path | None,
    fill: str | None,
    scattering: str | None,
    liquid: float | None,
    labels: float | None,
    perfect_parts: bool,
) -> SceneVariation:
    """What varies: a flag before the file, the file before the default."""
    from tubepose.simulation import SceneVariation, load_scene_variation
    from tubepose.simulation.variation import Tolerances, scene_variation

    base = SceneVariation() if scenes is None else load_scene_variation(scenes)
    flags: dict[str, tuple[str, Any]] = {
        "--fill": ("fill", fill and read_range("--fill", fill)),
        "--scattering": ("scattering_per_mm", scattering and read_range("--scattering", scattering)),
        "--liquid": ("liquid_share", liquid),
        "--labels": ("label_share", labels),
        "--perfect-parts": ("tolerances", dict.fromkeys(Tolerances.model_fields, 0.0) if perfect_parts else None),
    }
    for flag, (key, value) in flags.items():
        if value is not None:
            base = scene_variation(base.model_dump() | {key: value}, flag)
    return base


def read_range(flag: str, text: str) -> tuple[float, float]:
    """``0.3`` or ``0.1-0.4``."""
    from tubepose.errors import ConfigError

    number = r"(\d+\.?\d*|\.\d+)"
    found = re.fullmatch(f"{number}(?:-{number})?", text)
    if found is None:
        raise ConfigError(f"{flag} {text}: expected a number or a range, for example 0.3 or 0.1-0.4")
    return float(found[1]), float(found[2] or found[1])
