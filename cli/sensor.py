"""`tubepose sensor`."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tubepose_cli.paths import named

if TYPE_CHECKING:
    import pandas as pd

    from tubepose.camera_report import CameraReport
    from tubepose.capture.fusion import Average
    from tubepose.config import Config
    from tubepose.labware import RackModel, TubeModel

NOISE_FILE, EXPECTED_FILE = "camera_noise.csv", "camera_expected.csv"


def sensor(
    captures: Annotated[
        list[Path], typer.Argument(parser=named, metavar="CAPTURES", help="Captures, or folders of them.")
    ],
    rack: Annotated[str | None, typer.Option(help="What to expect for this rack: name or YAML file.")] = None,
    tubes: Annotated[str | None, typer.Option(help="And for these tubes in it: names or files, with commas.")] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of the clouds, m or mm.")] = None,
    frames: Annotated[int, typer.Option(min=1, help="Frames of a recording that are read, of a still scene.")] = 9,
    average: Annotated[
        str | None, typer.Option(metavar="N|all", help="Measure averages of so many frames instead of single ones.")
    ] = None,
    config: Annotated[Path | None, typer.Option(help="YAML file that changes defaults (docs/method.md).")] = None,
    out: Annotated[
        Path | None, typer.Option(parser=named, metavar="PATH", help="Folder for the tables as CSV and run.json.")
    ] = None,
) -> None:
    """What a camera does to depth, measured on planes and edges of captures, and what can be expected of it.

    Point the camera at anything flat and well textured, a table with things on it, say. Writes camera_noise.csv,
    camera_expected.csv and run.json into --out.
    """
    from tubepose.capture.fusion import read_average
    from tubepose.config import load_config
    from tubepose.errors import ConfigError
    from tubepose.labware import load_rack
    from tubepose_cli.inputs import read_tubes
    from tubepose_cli.show import finish

    settings = load_config(config)
    fused = read_average(average) if average is not None else 1
    if tubes is not None and rack is None:
        raise ConfigError("--tubes given, but no rack that they stand in; give --rack too")
    model = load_rack(rack) if rack is not None else None
    tube_models = read_tubes(tubes) if tubes is not None else ()
    reports, problems = _reports(captures, unit, fused, frames, settings, model, tube_models)
    if reports:
        _show(reports)
        if out is not None:
            _write(out, reports, settings, [*([model] if model is not None else []), *tube_models], captures, problems)
    finish(problems)


def _reports(
    captures: list[Path],
    unit: str | None,
    average: Average,
    n_frames: int,
    config: Config,
    rack: RackModel | None,
    tubes: tuple[TubeModel, ...],
) -> tuple[list[CameraReport], list[str]]:
    """One report per capture, and one line per capture that has none."""
    from tubepose.camera_report import measure_camera
    from tubepose.capture.source import open_captures
    from tubepose.errors import CaptureError, kept
    from tubepose_cli.inputs import no_such_file

    reports: list[CameraReport] = []
    problems: list[str] = []
    for path in captures:
        with kept(problems):
            if not path.exists():
                raise CaptureError(no_such_file(path))
            for capture in open_captures(path, unit=unit, average=average):
                with kept(problems):
                    read = list(itertools.islice(capture.frames(), n_frames))
                    reports.append(measure_camera(read, str(capture.path), config, rack, tubes))
    return reports, problems


def _show(reports: list[CameraReport]) -> None:
    """Both tables on the screen."""
    from tubepose_cli.show import show_table

    notes = [
        "Noise: standard deviation along the plane's normal; own: each point's; shared: what neighbours share, over "
        "its 1/e length. Edges: 10 to 90 % of a depth step, the sharper quartile. In time: a pixel about its mean."
    ]
    cells = [_noise_cells(row) for report in reports for row in report.noise]
    show_table(_told(cells), "Depth noise of the camera, measured", notes)
    known = [_expected_cells(row) for report in reports for row in report.expected]
    if not known:
        return
    words = [
        "Standard deviations, computed from the noise above (docs/method.md, Expectation): seen from straight above, "
        "nothing hidden, the depth's scale right. Across: by the edges of depth alone.",
        *(line for report in reports for line in report.sentences),
    ]
    show_table(_told(known), "What can be expected, here and nearer", words)


def _noise_cells(row: dict[str, Any]) -> dict[str, str]:
    return {
        "Capture": row["capture"],
        "Plane at (m)": f"{row['distance_m']:.3f}",
        "Noise (mm)": f"{row['total_std_m'] * 1e3:.2f}",
        "own / shared (mm)": f"{row['independent_m'] * 1e3:.2f} / {row['shared_m'] * 1e3:.2f}",
        "over (mm)": f"{row['correlation_m'] * 1e3:.1f}",
        "Spacing (mm)": f"{row['spacing_m'] * 1e3:.2f}",
        "Plane of a cap (deg)": f"{row['cap_slope_deg']:.1f}",
        "Missing": "-" if row["missing_share"] != row["missing_share"] else f"{row['missing_share']:.1%}",
        "Edges (px)": f"{row['edge_ramp_px']:.0f}" if "edge_ramp_px" in row else "-",
        "In time (mm)": f"{row['in_time_m'] * 1e3:.2f}" if "in_time_m" in row else "-",
        "Drift": f"{row['drift_share']:+.2%}" if "drift_share" in row else "-",
    }


def _expected_cells(row: dict[str, Any]) -> dict[str, str]:
    of_tube = bool(row["tube"])
    return {
        "Capture": row["capture"],
        "Distance (m)": f"{row['distance_m']:.3f}",
        "Rack: tilt (deg)": f"{row['rack_tilt_deg']:.2f}",
        "height (mm)": f"{row['rack_height_mm']:.2f}",
        "across (mm)": f"{row['rack_across_mm']:.2f}",
        "Opening (px)": "-" if row["opening_px"] != row["opening_px"] else f"{row['opening_px']:.0f}",
        "Tube": row["tube"] or "-",
        "tilt (deg)": f"{row['tube_tilt_deg']:.2f}" if of_tube else "-",
        "by slot alone": f"{row['slot_tilt_deg']:.2f}" if of_tube else "-",
        "bottom (mm)": f"{row['tube_place_mm']:.2f}" if of_tube else "-",
        "measured": row["measured"] or "-",
    }


def _told(cells: list[dict[str, str]]) -> pd.DataFrame:
    """Cells as a table; without the name of the capture where there is one."""
    import pandas as pd

    table = pd.DataFrame(cells)
    return table.drop(columns="Capture") if len({row["Capture"] for row in cells}) == 1 else table


def _write(
    out: Path,
    reports: list[CameraReport],
    config: Config,
    labware: list[RackModel | TubeModel],
    captures: list[Path],
    problems: list[str],
) -> None:
    """CSV files and run.json."""
    import pandas as pd

    from tubepose.camera_report import EXPECTED_COLUMNS, NOISE_COLUMNS
    from tubepose.provenance import inputs_sha256, run_record
    from tubepose.report.writing import make_folder, remove_files, write_csv, write_json
    from tubepose_cli.show import say

    make_folder(out)
    used = inputs_sha256([path for path in captures if path.exists()], out)
    noise = [row for report in reports for row in report.noise]
    write_csv(out / NOISE_FILE, pd.DataFrame(noise, columns=list(NOISE_COLUMNS)))
    known = [row for report in reports for row in report.expected]
    if known:
        write_csv(out / EXPECTED_FILE, pd.DataFrame(known, columns=list(EXPECTED_COLUMNS)))
    else:
        remove_files(out, [EXPECTED_FILE])
    write_json(out / "run.json", run_record(sys.argv, config, labware, used, problems=problems))
    say(f"tables: {out}")
