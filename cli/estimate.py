"""`tubepose estimate`."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tubepose_cli.paths import named

if TYPE_CHECKING:
    from tubepose.batch import Job, UnnamedJob
    from tubepose.records import Row
    from tubepose.result_tables import Tables

MOST_NAMED = 5
"""Captures that one line names."""


def estimate(
    captures: Annotated[
        list[Path],
        typer.Argument(
            parser=named,
            metavar="CAPTURES",
            help="Capture folders, .ply, .pcd, .ptx, .mcap, .db3 or .bag files, BOP scenes, session folders, or "
            "folders of those.",
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(parser=named, metavar="PATH", help="Folder for the results; nothing is written anywhere else."),
    ],
    rack: Annotated[
        str | None,
        typer.Option(
            help="Rack by name or YAML file; a session knows its own. auto: the one of the catalogue that fits. "
            "grid: any rack with --pitch and --slot."
        ),
    ] = None,
    pitch: Annotated[str | None, typer.Option(help="--rack grid: distance of slots, X or XxY in mm.")] = None,
    slot: Annotated[
        str | None, typer.Option(help="--rack grid: opening, square:SIDE, square:SIDExSIDE or round:DIAMETER in mm.")
    ] = None,
    tubes: Annotated[
        str | None,
        typer.Option(help="Kinds of tube that can be there: names or files, with commas; goes before a session's own."),
    ] = None,
    method: Annotated[
        str, typer.Option(help="profile, paper, upright, slot-icp, global-icp, kiss-matcher or gicp.")
    ] = ("profile"),
    detector: Annotated[str, typer.Option(help="Source of boxes: yolo, geometric or recorded.")] = "yolo",
    model: Annotated[
        Path | None, typer.Option(help="ONNX file of --detector yolo; default: the bundled model.")
    ] = None,
    boxes: Annotated[Path | None, typer.Option(help="Boxes of --detector recorded: YOLO txt or COCO json.")] = None,
    classes: Annotated[Path | None, typer.Option(help="Class names of the boxes or the model, one a line.")] = None,
    layout: Annotated[str | None, typer.Option(help="Output layout of the model, where it cannot be told.")] = None,
    unit: Annotated[
        str | None,
        typer.Option(
            help="Unit of the clouds, m or mm; goes before capture.yaml. A bare .ply file is in m without it."
        ),
    ] = None,
    depth_scale: Annotated[
        float | None,
        typer.Option(
            metavar="METRES",
            help="Metres of one count of depth images: 0.001 for millimetres, 1 for floats in metres; goes before "
            "what files say.",
        ),
    ] = None,
    cloud_topic: Annotated[str | None, typer.Option(help="Topic of the point clouds in a recording.")] = None,
    depth_topic: Annotated[str | None, typer.Option(help="Topic of the depth images in a recording.")] = None,
    image_topic: Annotated[str | None, typer.Option(help="Topic of the images in a recording.")] = None,
    info_topic: Annotated[str | None, typer.Option(help="Topic of the CameraInfo in a recording.")] = None,
    max_stamp_difference: Annotated[
        float | None,
        typer.Option(metavar="MS", help="Stamps of picture and cloud in a recording differ by no more; default: 50."),
    ] = None,
    hint: Annotated[
        list[str] | None,
        typer.Option(
            help="Which way round the racks stand: SLOT@U,V (pixel), SLOT@top-left and the like, SLOT@X,Y,Z (metres, "
            "camera frame), or previous: as in the capture before. Twice: first a slot's place, then previous."
        ),
    ] = None,
    hints: Annotated[
        Path | None, typer.Option(help="CSV file with the columns capture, hint; goes before --hint.")
    ] = None,
    require_unambiguous: Annotated[
        bool,
        typer.Option("--require-unambiguous", help="Exit 1 where a rack may stand another way round (after writing)."),
    ] = False,
    average: Annotated[
        str | None,
        typer.Option(metavar="N|all", help="Fuse so many frames of a static recording, or all, into one."),
    ] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Seeds of a stochastic method: 0 to N-1.")] = 1,
    config: Annotated[Path | None, typer.Option(help="YAML file that changes defaults (docs/method.md).")] = None,
    overlays: Annotated[bool, typer.Option(help="Write one overlay picture per frame.")] = True,
    jobs: Annotated[
        int | None,
        typer.Option(min=1, envvar="TUBEPOSE_JOBS", help="Local processes; default: one per core."),
    ] = None,
    timeout: Annotated[
        float | None, typer.Option(min=0.001, help="Seconds that a frame may take in a process of --jobs (600).")
    ] = None,
    shard: Annotated[
        str | None, typer.Option(metavar="I/N", help="Only this part of the captures; 'tubepose merge' joins them.")
    ] = None,
    allow_outside: Annotated[
        bool, typer.Option("--allow-outside", help="Sessions and captures may name files out of their folders.")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on after the last finished frame in --out.")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Begin anew, whatever --out holds of a run.")] = False,
    fail_fast: Annotated[bool, typer.Option("--fail-fast", help="Stop at the first bad capture.")] = False,
) -> None:
    """Estimate the pose of the rack and of every tube in recorded captures.

    Writes racks, sensor, slots, estimates, checks, labware_check and timings.csv, run.json and overlays/ into --out.
    """
    from tubepose.batch import Asked
    from tubepose.batch.run_index import read_shard
    from tubepose.capture.fusion import read_average
    from tubepose.capture.session import SESSION_FILE, is_session
    from tubepose.config import load_config
    from tubepose.errors import CaptureError, kept
    from tubepose.result_folder import held_folder
    from tubepose_cli.hints import read_hints, refuse_unknown_captures
    from tubepose_cli.inputs import (
        DetectorChoice,
        capture_jobs,
        no_such_file,
        read_methods,
        read_tubes,
        refuse_idle_scale,
        refuse_idle_topics,
        refuse_twins,
        sessions_below,
    )
    from tubepose_cli.racks import read_rack
    from tubepose_cli.results import RunOptions, run_estimates
    from tubepose_cli.show import finish, say

    settings = load_config(config)
    fused = read_average(average) if average is not None else 1
    choice = read_rack(rack, pitch, slot)
    tube_models = read_tubes(tubes) if tubes is not None else ()
    if not any(path.exists() for path in captures):  # before seconds of imports
        finish([no_such_file(path) for path in captures])
    told = read_hints(hint or (), hints, choice.rack)
    methods = read_methods(method)
    source = DetectorChoice(detector, model, boxes, classes, layout, settings)
    source.factory()  # what is wrong with its files is told before any work
    part = read_shard(shard) if shard is not None else None
    topics = {"cloud": cloud_topic, "depth": depth_topic, "image": image_topic, "info": info_topic}
    all_jobs: list[Job | UnnamedJob] = []
    problems: list[str] = []
    captures = [found for path in captures for found in (sessions_below(path) or [path])]
    for path in captures:
        with kept(None if fail_fast else problems):
            found, unread = capture_jobs(
                path,
                choice,
                tube_models,
                settings,
                unit=unit,
                depth_scale_m=depth_scale,
                max_stamp_difference_ms=max_stamp_difference,
                hints=told,
                topics=topics,
                average=fused,
                allow_outside=allow_outside,
                fail_fast=fail_fast,
            )
            distinct, twins = refuse_twins(found, all_jobs)
            if twins and fail_fast:
                raise CaptureError(twins[0])
            all_jobs += distinct
            problems += [*unread, *twins]
    if not all_jobs:
        finish(problems)  # before anything of an earlier run is written over
    refuse_idle_topics(all_jobs, {**topics, "max-stamp-difference": max_stamp_difference})
    refuse_idle_scale(all_jobs, depth_scale)
    with kept(problems if problems and not fail_fast else None):
        refuse_unknown_captures(all_jobs, told)
    how = RunOptions(jobs, timeout, resume, fresh, part, fail_fast, overlays)
    with held_folder(out):
        tables = run_estimates(
            all_jobs, Asked(methods, settings, seeds), source, out, how,
            inputs=[
                *(path for path in (hints, config) if path is not None),
                *(path for path in captures if path.exists() and (path.name == SESSION_FILE or is_session(path))),
            ],
            problems=problems, averaged=average is not None,
        )  # fmt: skip
    _tell(tables, several=len(methods) > 1)
    _tell_notes(tables)
    if tubes is None and any(not job.tubes for job in all_jobs):
        say("no --tubes given: only the rack and its slots are estimated")
    finish([*problems, *tables.problems, *(_ambiguous(tables) if require_unambiguous else [])])


def _ambiguous(tables: Tables) -> list[str]:
    """One line for all captures whose rack may stand another way round; none without any."""
    rows: dict[tuple[str, str, str], Row] = {}
    for row in tables.racks:
        if row["ambiguous"]:
            rows.setdefault(_capture_of(row), row)
    if not rows:
        return []
    first = next(iter(rows.values()))
    names = list(dict.fromkeys(row["capture"] for row in rows.values()))
    told = f"{', '.join(names[:MOST_NAMED])}{', ...' if len(names) > MOST_NAMED else ''}"
    captures = len({_capture_of(row) for row in tables.racks})
    each = "; racks that stand differently need a hint each: --hints FILE.csv" if len(rows) > 1 else ""
    return [
        f"{len(rows)} of {captures} captures hold a rack that could as well stand another way round, so that slot "
        f"names may be swapped: {told}; for {first['capture']}, {_hint_words(first, tables)}"
        f"{'' if first['session'] else each}"
    ]


def _hint_words(row: Row, tables: Tables) -> str:
    """What to do about an ambiguous rack: a hint that works, and what it says."""
    from tubepose.labware import RackModel
    from tubepose.rack.turns import example_hints
    from tubepose.records import transform_of

    rack = tables.labware[row["rack"]]
    hints = example_hints(transform_of(row), rack) if isinstance(rack, RackModel) else ()
    if not hints:
        return "give a hint, --hint SLOT@U,V"
    start = "add to its trial 'hint: " if row["session"] else "give --hint "
    end = "'" if row["session"] else ""
    return f"{start}{hints[0]}{end} if its slots are named right, else {' or '.join(hints[1:])}"


def _tell(tables: Tables, *, several: bool) -> None:
    """A line for each rack of each frame, and for each capture in which there is none."""
    from tubepose_cli.show import describe_tubes, say

    with_rack = {_capture_of(row) for row in tables.racks if row["rack"]}
    tubes: dict[tuple[str, ...], list[Row]] = {}
    for row in tables.estimates:
        if not row["seed"]:  # none, or the first
            tubes.setdefault(_answer_of(row), []).append(row)
    for row in tables.racks:
        if row["rack"]:
            by = f"{row['method']}: " if several else ""
            found = describe_tubes(tubes.get(_answer_of(row), []))
            say(f"{row['capture']} frame {row['frame']}: rack {row['rack']} {_rack_words(row, tables)}; {by}{found}")
        elif _capture_of(row) in with_rack:  # else its reason is among the problems
            say(f"{row['capture']} frame {row['frame']}: {row['status']}: {row['reason']}")


def _tell_notes(tables: Tables) -> None:
    """A line for each frame in which something was passed over or taken for granted; one for all that are alike."""
    from tubepose_cli.show import say

    frames: dict[tuple[str, str], dict[int, None]] = {}
    for row in tables.racks:
        if row["capture_note"]:
            frames.setdefault((row["capture"], row["capture_note"]), {})[row["frame"]] = None
    for (capture, note), numbers in frames.items():
        first = next(iter(numbers))
        more = f" and {len(numbers) - 1} more" if len(numbers) > 1 else ""
        say(f"{capture} frame {first}{more}: note: {note}")


def _rack_words(row: Row, tables: Tables) -> str:
    """How a rack was found, and what is left open."""
    if row["status"] == "ok":
        turn = ""
        if row["ambiguous"]:
            settle = row["hint_note"] or _hint_words(row, tables)
            turn = f", may stand another way round (slot names may be swapped; {settle})"
        nats = row["named_by_nats"]
        ahead = "no other fits" if math.isinf(nats) else f"likelier than the next one by {nats:.0f} nats"
        named = "" if math.isnan(nats) else f" (named: {ahead})"
        words = f"ok{named}, inlier rmse {row['inlier_rmse_m'] * 1e3:.2f} mm{turn}"
    else:
        look = "; --rack auto tells which of the catalogue's it is" if row["status"] in ("refused", "not_found") else ""
        words = f"{row['status']}: {row['reason']}{look}"
    if row["n_racks_detected"] > 1:
        words += f" ({row['n_racks_detected']} racks in view, one is answered for: that of the best score)"
    return words


def _capture_of(row: Row) -> tuple[str, str, str]:
    return row["session"], row["trial"], row["capture"]


def _answer_of(row: Row) -> tuple[str, ...]:
    """What tells the answer of a method to a frame from all others."""
    return (*_capture_of(row), row["frame"], row["method"])
