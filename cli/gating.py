"""Gates on the command line: what `bench` and `compare` share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

if TYPE_CHECKING:
    from tubepose.benchmark import Bench, Run
    from tubepose.evaluation import GateResult


@dataclass(frozen=True, slots=True)
class GateOptions:
    """What was typed: baseline, gates, files."""

    baseline: Path | None
    fail_if: str | None
    write_baseline: Path | None
    junit: Path | None
    summary_json: Path | None
    other_data: bool


@dataclass(frozen=True, slots=True)
class Asked:
    """The gates and the baseline, read before anything is run."""

    gates: dict[str, float | None] | None
    baseline: Run | None


def read_asked(options: GateOptions) -> Asked:
    """Read what was typed, so that a wrong word costs no run."""
    from tubepose.benchmark import read_run
    from tubepose.errors import ConfigError
    from tubepose.evaluation import read_gates

    gates = read_gates(options.fail_if) if options.fail_if is not None else None
    for name in ("error", "time"):
        if gates is not None and name in gates and options.baseline is None:
            raise ConfigError(f"--fail-if {name} needs --baseline FILE; make one with --write-baseline FILE")
    if options.baseline is not None and not options.baseline.exists():
        raise ConfigError(f"{options.baseline}: no such baseline; make one with --write-baseline {options.baseline}")
    return Asked(gates, read_run(options.baseline) if options.baseline is not None else None)


def gate_bench(out: Path, found: Bench, asked: Asked, options: GateOptions) -> Sequence[GateResult]:
    """Gate a run that lies in `out`, show what the gates say, and write what is asked for."""
    from tubepose.benchmark import compare, gate_alone, gate_table, read_run, write_baseline
    from tubepose_cli.show import say, show_table

    for method, n in found.judgement.counts().items():
        if n["expected"] and not n["ok"]:
            say(f"warning: {method} answered none of {n['expected']} tubes; --fail-if kept makes that an exit of 1")
    run = read_run(out)
    summary: dict[str, Any] = {"counts": found.judgement.counts()}
    gates: Sequence[GateResult] = ()
    if asked.baseline is not None:
        pair = compare([asked.baseline, run], asked.gates, other_data=options.other_data)
        gates, summary = pair.gates, summary | pair.summary()
        for table in pair.tables():
            show_table(table.cells, table.caption, table.notes)
    elif asked.gates:
        gates = gate_alone(run, asked.gates)
        table = gate_table(gates)
        show_table(table.cells, table.caption)
        summary |= {"passed": all(gate.passed for gate in gates), "gates": list(gates)}
    write_reports(gates, summary, options.junit, options.summary_json)
    if options.write_baseline is not None:
        write_baseline(options.write_baseline, run)
        say(f"baseline: {options.write_baseline}")
    return gates


def write_reports(
    gates: Sequence[GateResult], summary: dict[str, Any], junit: Path | None, summary_json: Path | None
) -> None:
    """JUnit XML and the summary, where they are asked for."""
    from tubepose.benchmark.run_comparison import junit_xml
    from tubepose.report.writing import write_bytes, write_json

    if junit is not None:
        write_bytes(junit, junit_xml(gates))
    if summary_json is not None:
        write_json(summary_json, summary)


def finish_gates(gates: Sequence[GateResult]) -> None:
    """End with 1 where a gate is failed, with a line that says which."""
    from tubepose_cli.show import say

    failed = [f"{gate.gate} ({gate.method})" for gate in gates if not gate.passed]
    if failed:
        say(f"error: {len(failed)} of {len(gates)} gates failed: {', '.join(failed)}")
        raise typer.Exit(1)
