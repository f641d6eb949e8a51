"""Result folders: the tables of a run, its record and its pictures, each file written whole or not at all."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tubepose.batch import DetectorFactory, Job, UnnamedJob
    from tubepose.config import Config
    from tubepose.labware import Labware
    from tubepose.records import Row
    from tubepose.result_tables import Tables
    from tubepose.scene import Scene, TubeEstimate


JUDGED_FILES = (
    "errors.csv", "summary.csv", "comparison.csv", "uncertainty.csv", "coverage.csv", "confusion.csv", "seeds.csv",
    "slot_accuracy.csv", *(f"table_{kind}.{form}" for kind in ("accuracy", "timing") for form in ("csv", "md", "tex")),
)  # fmt: skip
"""What only a run with truth writes: of an earlier one nothing stays beside other estimates."""
LONGEST_NAME = 200
"""Bytes of an overlay's name before its numbers; a file system takes 255."""


def run_estimates(
    jobs: Sequence[Job | UnnamedJob],
    methods: Sequence[str],
    detector_for: DetectorFactory,
    config: Config,
    out: Path,
    command: Sequence[str],
    *,
    seeds: int = 1,
    overlays: bool = True,
    fail_fast: bool = False,
    warm_up: bool = False,
    inputs: Sequence[Path] = (),
    labware: Sequence[Labware] = (),
    problems: Sequence[str] = (),
    **more: Any,
) -> Tables:
    """Run jobs, write their tables, run.json and overlays/ into `out`, and say how noisy they are and what contradicts.

    The tables are racks, sensor, slots, estimates, checks, labware_check and timings.csv.
    `problems` are those from before, and `labware`
    what was used besides, for the record. `JUDGED_FILES` of an earlier run are removed.

    Raises:
        StoppedError: The user stopped the run. What was done by then is written; nothing where nothing was done.
    """
    from tubepose.batch import run_jobs
    from tubepose.errors import StoppedError
    from tubepose.labware_check import pooled_rows
    from tubepose.provenance import inputs_sha256, pinned_threads, run_record
    from tubepose.report.writing import make_folder, remove_files, write_json
    from tubepose.result_tables import Tables
    from tubepose_cli.show import describe_noise, describe_sizes, progress, say, say_when_compiling

    taken: dict[str, tuple[str, ...]] = {}

    def draw(job: Job, scene: Scene, estimates: tuple[TubeEstimate, ...]) -> None:
        if overlays:
            write_overlay(out / "overlays" / overlay_name(job, scene, taken), scene, estimates)

    make_folder(out)
    used = inputs_sha256([*inputs, *(job.capture.path for job in jobs if job.capture.path.exists())], out)
    say_when_compiling()
    tables, stopped = Tables(), ""
    try:
        with pinned_threads(1), progress("captures", len(jobs)) as step:
            run_jobs(
                jobs, methods, detector_for, config, seeds=seeds, warm_up=warm_up, fail_fast=fail_fast,
                on_scene=draw, on_done=step, tables=tables,
            )  # fmt: skip
    except KeyboardInterrupt:
        stopped = f"interrupted: {tables.done} of {len(jobs)} captures are done"
        if not tables.done:
            raise StoppedError(f"{stopped}; no estimate is written to {out}") from None
    remove_files(out, JUDGED_FILES)
    sizes = pooled_rows(tables.labware_check)
    _write_tables(tables, sizes, out)
    record = run_record(
        command,
        config,
        [*tables.labware.values(), *labware],
        used,
        methods=list(methods),
        seeds=list(range(seeds)),
        threads=1,
        problems=[*problems, *tables.problems, *([stopped] if stopped else [])],
        **more,
    )
    write_json(out / "run.json", record)
    if tables.sensor:
        say(describe_noise(tables.sensor))
    for line in describe_sizes(sizes):
        say(line)
    if stopped:
        raise StoppedError(f"{stopped}, and in the tables in {out}")
    return tables


def _write_tables(tables: Tables, sizes: Sequence[Row], out: Path) -> None:
    """Every table of a run; `sizes` are the rows of labware_check.csv for the run as a whole."""
    from tubepose import records
    from tubepose.report.writing import write_csv

    for name, rows, columns in (
        ("racks", tables.racks, records.RACK_COLUMNS),
        ("sensor", tables.sensor, records.SENSOR_COLUMNS),
        ("slots", tables.slots, records.SLOT_COLUMNS),
        ("estimates", tables.estimates, records.ESTIMATE_COLUMNS),
        ("checks", tables.checks, records.CHECK_COLUMNS),
        ("labware_check", [*tables.labware_check, *sizes], records.LABWARE_COLUMNS),
        ("timings", tables.timings, records.TIMING_COLUMNS),
    ):
        write_csv(out / f"{name}.csv", records.to_table(rows, columns))


def overlay_name(job: Job, scene: Scene, taken: dict[str, tuple[str, ...]]) -> str:
    """A file name by capture and frame, not too long; `taken` tells captures apart whose names come out the same."""
    capture = scene.frame.capture
    trial = "" if job.trial in capture else job.trial  # trials may call their captures by the same name
    parts = "-".join(part for part in (job.session, trial, capture) if part)
    plain = "".join(c if c.isprintable() and c != "/" else "_" for c in parts)
    plain = plain.encode()[:LONGEST_NAME].decode(errors="ignore")
    name, key, number = plain, (job.session, job.trial, capture), 1
    while taken.setdefault(name, key) != key:
        number += 1
        name = f"{plain}-{number}"
    return f"{name}-{scene.frame.index:04d}.png"


def write_overlay(path: Path, scene: Scene, estimates: Sequence[TubeEstimate]) -> None:
    """One overlay picture."""
    import cv2

    from tubepose.report.overlay import draw_overlay
    from tubepose.report.writing import write_bytes

    _, png = cv2.imencode(".png", draw_overlay(scene, estimates))
    write_bytes(path, png.tobytes())
