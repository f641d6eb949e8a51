"""`tubepose bench`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tubepose_cli.paths import named

if TYPE_CHECKING:
    from collections.abc import Sequence

    from tubepose.benchmark import Bench
    from tubepose.evaluation import GateResult

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
    baseline: Annotated[
        Path | None, typer.Option(help="Run to be gated by: a baseline file, or the folder of a run.")
    ] = None,
    fail_if: Annotated[
        str | None, typer.Option("--fail-if", help="Gates with commas: kept,wrong,error,coverage,time:1.2.")
    ] = None,
    write_baseline_to: Annotated[
        Path | None, typer.Option("--write-baseline", help="Write this run as a baseline file.")
    ] = None,
    junit: Annotated[Path | None, typer.Option(help="Write the gates as JUnit XML.")] = None,
    summary_json: Annotated[Path | None, typer.Option("--summary-json", help="Write counts and gates as JSON.")] = None,
    other_data: Annotated[
        bool, typer.Option("--other-data", help="Gate though data, labware or versions differ from the baseline's.")
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Go on after the last finished frame in --out.")] = False,
    fresh: Annotated[bool, typer.Option("--fresh", help="Begin anew, whatever --out holds of a run.")] = False,
    fail_fast: Annotated[bool, typer.Option("--fail-fast", help="Stop at the first bad capture.")] = False,
) -> None:
    """Run every method on sessions, compare with the ground truth, and print the paper's two tables.

    Writes what estimate and gt write, and errors, summary, comparison, uncertainty, coverage, confusion, seeds and
    slot_accuracy.csv, table_accuracy.{csv,md,tex} and table_timing.{csv,md,tex} into --out.
    """
    from tubepose.batch import Asked
    from tubepose.benchmark import BenchOptions, judge_run, plan_bench
    from tubepose.capture.fusion import read_average
    from tubepose.config import load_config
    from tubepose.result_folder import held_folder
    from tubepose_cli.gating import GateOptions, finish_gates, gate_bench, read_asked
    from tubepose_cli.inputs import DetectorChoice, find_sessions, read_methods, sample_session
    from tubepose_cli.results import RunOptions, run_estimates
    from tubepose_cli.show import finish, progress, say

    gate_options = GateOptions(baseline, fail_if, write_baseline_to, junit, summary_json, other_data)
    asked = read_asked(gate_options)
    settings = load_config(config)
    options = BenchOptions(
        read_methods(methods), seeds, exact_truth, known_rack, all_tubes, published, fail_fast,
        read_average(average) if average is not None else 1,
    )  # fmt: skip
    source = DetectorChoice(detector, model, boxes, classes, layout, settings)
    source.factory()  # what is wrong with its files is told before any work
    folders, problems = find_sessions(sessions or [sample_session()], fail_fast=fail_fast)
    gates: Sequence[GateResult] = ()
    with held_folder(out):
        plan = plan_bench(folders, out, options, progress)
        measured = plan.measured
        problems = list(dict.fromkeys([*problems, *plan.problems]))
        if not measured.sessions:
            finish(problems)  # before anything of an earlier run is written over
        tables = run_estimates(
            plan.jobs, Asked(options.methods, settings, seeds, warm_up=True), source, out,
            RunOptions(resume=resume, fresh=fresh, fail_fast=fail_fast, overlays=overlays),
            inputs=[*([config] if config is not None else []), *(session.folder for session in measured.sessions)],
            labware=[] if exact_truth else [s.printed_cap for s in measured.sessions if s.printed_cap is not None],
            problems=problems, averaged=average is not None, ground_truth_config=measured.config,
        )  # fmt: skip
    if len(measured.truth):
        found = judge_run(plan, tables, options, settings)
        _show(found, out)
        gates = gate_bench(out, found, asked, gate_options)
    elif asked.gates:
        problems.append("no trial could be judged, so no gate is passed")
    elif not exact_truth:
        say("no trial has a capture with printed caps that could be measured: no errors, no tables")
    finish([*problems, *tables.problems])
    finish_gates(gates)


def _show(found: Bench, out: Path) -> None:
    """Write what judges the run, and show its two tables."""
    from tubepose_cli.show import say, show_table

    found.write(out)
    for table in found.tables.values():
        show_table(table.cells, table.caption, table.notes)
    say(f"all tables and rows: {out}")
