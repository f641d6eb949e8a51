"""`tubepose bench`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tubepose_cli.paths import named

if TYPE_CHECKING:
    from collections.abc import Sequence

    import pandas as pd

    from tubepose.batch import Job
    from tubepose.config import Config
    from tubepose.result_tables import Tables
    from tubepose_cli.truth import MeasuredTruth

ALL_METHODS = "upright,profile,paper,slot-icp,global-icp"


def bench(
    sessions: Annotated[
        list[Path] | None,
        typer.Argument(parser=named, metavar="SESSIONS", help="Session folders; default: the sample."),
    ] = None,
    out: Annotated[
        Path,
        typer.Option(parser=named, metavar="PATH", help="Folder for the results; nothing is written anywhere else."),
    ] = Path("out/bench"),
    methods: Annotated[str, typer.Option(help="Methods with commas; 'upright' is the trivial answer.")] = ALL_METHODS,
    seeds: Annotated[int, typer.Option(min=1, help="Seeds of a stochastic method: 0 to N-1.")] = 3,
    detector: Annotated[str, typer.Option(help="Source of boxes: yolo, geometric or recorded.")] = "yolo",
    model: Annotated[
        Path | None, typer.Option(help="ONNX file of --detector yolo; default: the bundled model.")
    ] = None,
    boxes: Annotated[Path | None, typer.Option(help="Boxes of --detector recorded: YOLO txt or COCO json.")] = None,
    classes: Annotated[Path | None, typer.Option(help="Class names of the boxes or the model, one a line.")] = None,
    layout: Annotated[str | None, typer.Option(help="Output layout of the model, where it cannot be told.")] = None,
    config: Annotated[Path | None, typer.Option(help="YAML file that changes defaults (docs/method.md).")] = None,
    overlays: Annotated[bool, typer.Option(help="Write one overlay picture per frame.")] = False,
    known_rack: Annotated[
        bool, typer.Option("--known-rack", help="Take the rack's pose from the exact truth (simulated sessions only).")
    ] = False,
    exact_truth: Annotated[
        bool,
        typer.Option("--exact-truth", help="Judge by the exact poses of the simulation, not by measured printed caps."),
    ] = False,
    all_tubes: Annotated[
        bool, typer.Option("--all-tubes", help="Any of a session's types may stand in any trial: tells types apart.")
    ] = False,
    published: Annotated[bool, typer.Option("--published", help="Add the paper's own figures to the tables.")] = False,
    average: Annotated[
        str | None,
        typer.Option(metavar="N|all", help="Fuse so many frames of a static recording, or all, into one."),
    ] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on after the last finished frame in --out.")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Begin anew, whatever --out holds of a run.")] = False,
    fail_fast: Annotated[bool, typer.Option("--fail-fast", help="Stop at the first bad capture.")] = False,
) -> None:
    """Run every method on sessions, compare with the ground truth, and print the paper's two tables.

    Writes what estimate and gt write, and errors, summary, comparison, uncertainty, coverage, confusion, seeds and
    slot_accuracy.csv, table_accuracy.{csv,md,tex} and table_timing.{csv,md,tex} into --out.
    """
    from dataclasses import replace

    from tubepose.batch import Asked, session_jobs
    from tubepose.capture.fusion import read_average
    from tubepose.config import load_config
    from tubepose.errors import kept
    from tubepose.result_folder import held_folder
    from tubepose.truth_tables import with_exact_rack
    from tubepose_cli.inputs import DetectorChoice, find_sessions, read_methods, sample_session
    from tubepose_cli.results import RunOptions, run_estimates
    from tubepose_cli.show import finish, say
    from tubepose_cli.truth import measure_sessions

    settings = load_config(config)
    fused = read_average(average) if average is not None else 1
    names = read_methods(methods)
    source = DetectorChoice(detector, model, boxes, classes, layout, settings)
    source.factory()  # what is wrong with its files is told before any work
    jobs: list[Job] = []
    folders, problems = find_sessions(sessions or [sample_session()], fail_fast=fail_fast)
    with held_folder(out):
        measured = measure_sessions(folders, out, exact=exact_truth, average=fused, fail_fast=fail_fast)
        if not measured.sessions:
            finish([*problems, *measured.problems])  # before anything of an earlier run is written over
        for session in measured.sessions:
            keep = None if fail_fast else problems
            with kept(keep):
                found, unread = session_jobs(session, fail_fast=fail_fast)
                problems += unread
                if all_tubes:
                    found = [replace(job, tubes=tuple(session.types.values())) for job in found]
                jobs += with_exact_rack(found, session, keep) if known_rack else found
        problems = list(dict.fromkeys([*problems, *measured.problems]))  # both can miss the same file of a trial
        tables = run_estimates(
            jobs, Asked(names, settings, seeds, warm_up=True), source, out,
            RunOptions(resume=resume, fresh=fresh, fail_fast=fail_fast, overlays=overlays),
            inputs=[*([config] if config is not None else []), *(session.folder for session in measured.sessions)],
            labware=[] if exact_truth else [s.printed_cap for s in measured.sessions if s.printed_cap is not None],
            problems=problems, averaged=average is not None, ground_truth_config=measured.config,
        )  # fmt: skip
    if len(measured.truth):
        _report(tables, measured, jobs, names, settings, out, seeds, published)
    elif not exact_truth:
        say("no trial has a capture with printed caps that could be measured: no errors, no tables")
    finish([*problems, *tables.problems])


def _report(
    tables: Tables, measured: MeasuredTruth, jobs: Sequence[Job], methods: Sequence[str], config: Config, out: Path,
    seeds: int, published: bool,
) -> None:  # fmt: skip
    """Evaluate, write and print."""
    from tubepose.confusion import confusion
    from tubepose.evaluation import compare, evaluate, seed_spread, slot_accuracy, summarise
    from tubepose.methods import METHODS, foremost
    from tubepose.records import ESTIMATE_COLUMNS, RACK_COLUMNS, SLOT_COLUMNS, TIMING_COLUMNS, to_table
    from tubepose.report.tables import accuracy_table, timing_table
    from tubepose.report.writing import write_csv, write_table
    from tubepose.uncertainty import coverage, uncertainty
    from tubepose_cli.show import say, show_table

    estimates = to_table(tables.estimates, ESTIMATE_COLUMNS)
    tube_models = {name: tube for session in measured.sessions for name, tube in session.types.items()}
    seeds_of_methods = {name: range(seeds) for name, method in METHODS.items() if method.is_stochastic}
    errors = evaluate(
        estimates, measured.truth, tube_models, methods,
        racks=to_table(tables.racks, RACK_COLUMNS), seeds=seeds_of_methods,
    )  # fmt: skip
    summary = summarise(errors, methods)
    write_csv(out / "errors.csv", errors)
    write_csv(out / "summary.csv", summary)
    write_csv(out / "comparison.csv", compare(errors, foremost(methods)))
    write_csv(out / "uncertainty.csv", uncertainty(errors))
    write_csv(out / "coverage.csv", coverage(errors))
    write_csv(out / "confusion.csv", confusion(errors))
    write_csv(out / "seeds.csv", seed_spread(errors))
    slots = slot_accuracy(to_table(tables.slots, SLOT_COLUMNS), measured.truth)
    write_csv(out / "slot_accuracy.csv", slots)
    notes = [_data_note(measured, jobs), *measured.notes, *_rack_notes(tables), *_slot_notes(slots)]
    notes += [*_uncertainty_notes(errors, measured), *_confusion_notes(errors)]
    notes += [note for name in methods if (note := METHODS[name].note(config, seeds))]
    if any(METHODS[name].is_stochastic for name in methods):
        notes += _spread_notes(seed_spread(errors))
    accuracy = accuracy_table(summary, notes, published)
    timing = timing_table(to_table(tables.timings, TIMING_COLUMNS), [_machine_note()], published)
    for name, table in (("table_accuracy", accuracy), ("table_timing", timing)):
        write_table(out, name, table)
        show_table(table.cells, table.caption, table.notes)
    say(f"all tables and rows: {out}")


def _data_note(measured: MeasuredTruth, jobs: Sequence[Job]) -> str:
    kinds = sorted({session.origin for session in measured.sessions})
    sensors = sorted({session.sensor for session in measured.sessions})
    racks = sorted({job.rack.name for job in jobs})
    kind = "SIMULATED data, no real scan" if kinds == ["simulated"] else " and ".join(kinds) + " data"
    given = "its pose given" if any(job.T_camera_rack is not None for job in jobs) else "its pose estimated, not given"
    seen = f"sensor {', '.join(sensors)}; rack {', '.join(racks)}, {given}"
    return f"{kind}: {len(jobs)} captures; {seen}."


def _rack_notes(tables: Tables) -> list[str]:
    frames = {(row["session"], row["trial"], row["capture"], row["frame"]): row["status"] for row in tables.racks}
    ok = sum(status == "ok" for status in frames.values())
    return [f"Racks: {ok} of {len(frames)} frames with an accepted pose."]


def _slot_notes(slots: pd.DataFrame) -> list[str]:
    """Slots that were found, once for all methods that share them."""
    told: dict[str, list[str]] = {}
    for row in slots.to_dict("records"):
        words = (
            f"{row['n_found']} of {row['n_occupied']} occupied ones found ({row['n_called_empty']} called empty), "
            f"{row['n_left_empty']} of {row['n_empty']} empty ones left empty ({row['n_called_occupied']} called "
            f"occupied), {row['n_not_seen']} not seen, {row['n_unclear']} unclear"
        )
        told.setdefault(words, []).append(str(row["method"]))
    return [f"Slots ({', '.join(methods)}): {words}." for words, methods in told.items()] or ["Slots: none judged."]


def _confusion_notes(errors: pd.DataFrame) -> list[str]:
    """Types that were taken for others, where more than one could stand in a trial."""
    from tubepose.confusion import confusion

    rows = confusion(errors).to_dict("records")
    wrong = [row for row in rows if row["tube_estimated"] not in (row["tube"], "none")]
    told = "; ".join(f"{r['method']}: {r['n']} {r['tube']} taken for {r['tube_estimated']}" for r in wrong)
    return [f"Types taken for others: {told}."] if told else []


def _uncertainty_notes(errors: pd.DataFrame, measured: MeasuredTruth) -> list[str]:
    """How honest stated errors are; a measured truth has an error of its own, which no estimator can state."""
    from tubepose.uncertainty import ALL_TUBES, uncertainty
    from tubepose_cli.truth import EXACT_NOTE

    rows = [row for row in uncertainty(errors).to_dict("records") if row["tube"] == ALL_TUBES]
    own = "" if EXACT_NOTE in measured.notes else " (the truth's own error is not in that)"
    return [
        f"{row['method']}: {row['inside_95']:.1%} of {row['n']} truths inside the stated 95 % region{own}; "
        f"mean tilt error {row['tilt_deg_all']:.2f} deg of all, {row['tilt_deg_best_half']:.2f} of the better half."
        for row in rows
    ]


def _spread_notes(spread: pd.DataFrame) -> list[str]:
    rows = [row for row in spread.to_dict("records") if row["n_seeds"] > 1]
    if not rows:
        return []
    told = "; ".join(
        f"{row['method']} {row['tube']} {row['tilt_deg_mean_min']:.2f} to {row['tilt_deg_mean_max']:.2f} deg"
        for row in rows
    )
    return [f"Mean tilt error of single seeds, least to most: {told}."]


def _machine_note() -> str:
    from tubepose.provenance import machine

    found = machine()
    return f"{found['cpu']}, {found['cores']} cores, one thread used."
