"""Runs against runs: counts, paired differences, gates; as text, Markdown, JSON and JUnit XML."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pandas as pd

from tubepose.benchmark.runs import Run, differences, read_run
from tubepose.errors import ConfigError
from tubepose.evaluation import inside_95
from tubepose.evaluation.gate import GateResult, gate_counts_alone, gate_pair
from tubepose.evaluation.paired_tubes import PAIRED_ERRORS, captures_of, expected_tubes, pair_tubes, tube_changes
from tubepose.report.tables import Table
from tubepose.statistics import paired_bootstrap

WORST_SHOWN = 10


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Two or more runs, paired by tube with the first of them.

    Attributes:
        counts: Per run and method: expected, kept, wrong, rejected, missed, failed, false, and means of the kept.
        paired: Per run, method and error: mean paired difference of absolute errors with its 95 % interval.
        changes: Per run, method and tube what became of it, worst first.
        gates: What the gates say, in the order in which they were asked.
        notes: What makes the runs differ besides.
    """

    counts: pd.DataFrame
    paired: pd.DataFrame
    changes: pd.DataFrame
    gates: tuple[GateResult, ...]
    notes: tuple[str, ...]

    @property
    def passed(self) -> bool:
        """Whether every gate that was asked is passed."""
        return all(gate.passed for gate in self.gates)

    def tables(self) -> list[Table]:
        """For a reader: counts, paired differences, the worst changes, gates."""
        found = [
            _table("Counts, then means of the answered", self.counts, self.notes),
            _table("Paired by tube: after minus before, 95 % interval over captures", self.paired),
            _table("Worst changes", self.changes.head(WORST_SHOWN)[list(_SHOWN)]),
        ]
        return [*found, *([gate_table(self.gates)] if self.gates else [])]

    def markdown(self) -> str:
        """All tables as GitHub-flavoured Markdown."""
        return "\n".join(table.markdown() for table in self.tables())

    def summary(self) -> dict[str, Any]:
        """All of it as plain values, for JSON."""
        return {
            "passed": self.passed,
            "counts": self.counts.to_dict("records"),
            "paired": self.paired.to_dict("records"),
            "gates": [asdict(gate) for gate in self.gates],
            "changes": self.changes.to_dict("records"),
            "notes": list(self.notes),
        }


_SHOWN = ("run", "method", "trial", "slot", "tube", "before", "after", "cap_mm_before", "cap_mm_after", "cap_mm_change")


def compare(
    runs: Sequence[Path | str | Run],
    gates: Mapping[str, float | None] | None = None,
    *,
    other_data: bool = False,
) -> Comparison:
    """Compare runs with the first of them, as ``tubepose compare`` does.

    Args:
        runs: Folders that bench or evaluate wrote, baseline files, or runs; two or more.
        gates: Result of `tubepose.evaluation.gate.read_gates`; None for no gate.
        other_data: Compare though data, labware or versions differ.

    Raises:
        ConfigError: A run cannot be read, the runs share no method or tube, or were made of other data.
    """
    read = _named([run if isinstance(run, Run) else read_run(run) for run in runs])
    if len(read) < 2:
        raise ConfigError("one run is given; expected two or more to compare")
    counts = [count_row(run, method) for run in read for method in run.methods]
    first, paired, changes, found, notes = read[0], [], [], [], []
    for run in read[1:]:
        unlike = differences(first.fingerprint, run.fingerprint)
        if unlike and gates and not other_data:
            raise ConfigError(
                f"{run.name}: {' and '.join(unlike)} differ from those of {first.name}; say --other-data to compare "
                "all the same, or write the baseline again"
            )
        gone = [name for name in first.methods if name not in run.methods]
        notes += (
            [f"{run.name} lacks methods of {first.name}: {', '.join(gone)}."] if gone and len(first.methods) > 1 else []
        )
        notes += [f"{run.name}: {' and '.join(unlike)} differ from those of {first.name}."] if unlike else []
        for pair in _methods(first, run):
            pairs = pair_tubes(first.errors, run.errors, pair)
            paired += _paired_rows(pairs, run.name, pair[1])
            changes.append(tube_changes(pairs, run.name, pair[1]))
            found += (
                [*gate_pair(first.errors, run.errors, pair, gates), *_time_gate(first, run, pair, gates)]
                if gates
                else []
            )
    return Comparison(
        pd.DataFrame(counts), pd.DataFrame(paired), pd.concat(changes, ignore_index=True), tuple(found), tuple(notes)
    )


def gate_alone(run: Run, gates: Mapping[str, float | None]) -> tuple[GateResult, ...]:
    """Gates of one run without a baseline.

    Raises:
        ConfigError: A gate needs a baseline.
    """
    for name in ("error", "time"):
        if name in gates:
            raise ConfigError(f"--fail-if {name} needs --baseline FILE; make one with --write-baseline FILE")
    return tuple(gate for method in run.methods for gate in gate_counts_alone(run.errors, method, gates))


def count_row(run: Run, method: str) -> dict[str, Any]:
    """Counts of a method in a run, and means of what was answered."""
    rows = expected_tubes(run.errors, method)
    of = run.errors[run.errors["method"] == method]
    kept = rows[rows["kept"]]
    row: dict[str, Any] = {"run": run.name, "method": method, "expected": len(rows), "kept": len(kept)}
    row |= {"wrong": int(rows["wrong"].sum())}
    row |= {name: int((of["outcome"] == name).sum()) for name in ("rejected", "missed", "failed", "false")}
    row |= {f"{name}_mean": float(kept[name].abs().mean()) for name in ("tilt_deg", "cap_mm")}
    return row | {"inside_95": inside_95(run.errors, method).mean, "tube_ms": run.times_ms.get(method, float("nan"))}


def _named(runs: Sequence[Run]) -> list[Run]:
    """Runs whose names differ."""
    seen: dict[str, int] = {}
    named = []
    for run in runs:
        seen[run.name] = seen.get(run.name, 0) + 1
        name = run.name if seen[run.name] == 1 else f"{run.name} ({seen[run.name]})"
        named.append(Run(name, run.errors, run.times_ms, run.fingerprint))
    return named


def _methods(first: Run, run: Run) -> list[tuple[str, str]]:
    """Methods of both; two runs of one method each are paired whatever these are called."""
    both = [(name, name) for name in first.methods if name in run.methods]
    if not both and len(first.methods) == len(run.methods) == 1:
        both = [(first.methods[0], run.methods[0])]
    if not both:
        raise ConfigError(
            f"{run.name} and {first.name} share no method: {', '.join(run.methods)}; {', '.join(first.methods)}"
        )
    return both


def _paired_rows(pairs: pd.DataFrame, run: str, method: str) -> list[dict[str, Any]]:
    rows = []
    for name in PAIRED_ERRORS:
        both = pairs[pairs["kept_before"] & pairs["kept_after"]].dropna(subset=[f"{name}_before", f"{name}_after"])
        change = (both[f"{name}_after"].abs() - both[f"{name}_before"].abs()).to_numpy(float)
        found = paired_bootstrap(change, captures_of(both))
        interval = {"mean_difference": found.mean, "ci95_low": found.low, "ci95_high": found.high}
        rows.append({"run": run, "method": method, "error": name, **interval, "n_pairs": found.n,
                     "n_captures": found.n_groups})  # fmt: skip
    return rows


def _time_gate(first: Run, run: Run, pair: tuple[str, str], gates: Mapping[str, float | None]) -> list[GateResult]:
    """Ratio of times per tube; where both runs have another method, ratios to it, so that machines do not count."""
    if "time" not in gates:
        return []
    limit, before, after = gates["time"] or 1.2, first.times_ms.get(pair[0]), run.times_ms.get(pair[1])
    if not before or not after:
        return [GateResult("time", pair[1], True, "-", "-", "no times of both runs")]
    others = [name for name in first.times_ms if name in run.times_ms and name not in pair and name != "upright"]
    same = first.fingerprint.get("cpu") == run.fingerprint.get("cpu")
    if others:
        before, after = before / first.times_ms[others[0]], after / run.times_ms[others[0]]
        words, unit = f"in units of {others[0]}, same run", "x"
    elif same:
        words, unit = "same processor", " ms"
    else:
        return [GateResult("time", pair[1], True, "-", "-", "other processors, and no other method to be measured by")]
    ratio = after / before
    told = f"ratio {ratio:.2f}, limit {limit:g} ({words})"
    return [GateResult("time", pair[1], ratio <= limit, f"{before:.3g}{unit}", f"{after:.3g}{unit}", told)]


def _table(caption: str, values: pd.DataFrame, notes: Sequence[str] = ()) -> Table:
    cells = values.map(_cell) if len(values) else values
    return Table(caption, "tab:compare", values, cells.astype("str"), tuple(notes), "l" * values.shape[1], ())


def _cell(value: Any) -> str:
    if value is None or value is pd.NA or (isinstance(value, float) and pd.isna(value)):
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def gate_table(gates: Sequence[GateResult]) -> Table:
    """The reasons in one table, failed gates first."""
    ordered = sorted(gates, key=lambda gate: gate.passed)
    rows = [{"gate": g.gate, "method": g.method, "result": "pass" if g.passed else "FAIL", "before": g.before,
             "after": g.after, "reason": g.reason} for g in ordered]  # fmt: skip
    return _table("Gates", pd.DataFrame(rows))


def junit_xml(gates: Sequence[GateResult]) -> bytes:
    """Gates as JUnit XML: a test case per gate and method."""
    failed = str(sum(not gate.passed for gate in gates))
    suite = ElementTree.Element("testsuite", name="tubepose", tests=str(len(gates)), failures=failed)
    for gate in gates:
        case = ElementTree.SubElement(suite, "testcase", classname=f"tubepose.{gate.method}", name=gate.gate)
        if not gate.passed:
            told = f"{gate.before} -> {gate.after}: {gate.reason}"
            ElementTree.SubElement(case, "failure", message=told).text = told
    return bytes(ElementTree.tostring(suite, encoding="utf-8", xml_declaration=True)) + b"\n"
