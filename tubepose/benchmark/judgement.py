"""All tables that estimates and truth give together, as one object: computed once, written or shown by others."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import pandas as pd

from tubepose.confusion import confusion
from tubepose.evaluation import compare, evaluate, seed_spread, summarise
from tubepose.labware import TubeModel
from tubepose.methods import foremost
from tubepose.report.tables import Table
from tubepose.report.writing import write_csv, write_table
from tubepose.uncertainty import coverage, uncertainty


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """Estimates against truth; columns as in docs/outputs.md.

    Attributes:
        errors: One row per expected tube, method and seed; then one per false estimate.
        summary: Counts and errors per method and tube.
        comparison: Methods against the foremost one.
        uncertainty: Stated covariances against errors.
        coverage: Error against the share of answers kept.
        confusion: True type against estimated type.
        seeds: Spread over the seeds of stochastic methods.
    """

    errors: pd.DataFrame
    summary: pd.DataFrame
    comparison: pd.DataFrame
    uncertainty: pd.DataFrame
    coverage: pd.DataFrame
    confusion: pd.DataFrame
    seeds: pd.DataFrame

    def counts(self) -> dict[str, dict[str, int]]:
        """Per method: tubes expected, ok, rejected, missed, failed, false and of a wrong type, all types together."""
        names = [name for name in self.summary.columns if name.startswith("n_") and name != "n_seeds"]
        totals = self.summary.groupby("method", sort=False)[names].sum()
        return {
            str(method): {name.removeprefix("n_"): int(row[name]) for name in names}
            for method, row in totals.iterrows()
        }

    def write(self, out: Path) -> None:
        """Write every table as CSV.

        Raises:
            ConfigError: The folder cannot be written.
        """
        for field in fields(self):
            write_csv(out / f"{field.name}.csv", getattr(self, field.name))


def judge(
    estimates: pd.DataFrame, truth: pd.DataFrame, tube_models: Mapping[str, TubeModel], methods: Sequence[str],
    *, racks: pd.DataFrame | None = None, seeds: Mapping[str, Sequence[int]] | None = None,
) -> Judgement:  # fmt: skip
    """Judge estimates by truth.

    Args:
        estimates: Rows of estimates.csv.
        truth: Rows of ground_truth.csv.
        tube_models: The model of every tube that the truth names.
        methods: Methods to judge, in the order of the result.
        racks: As in `tubepose.evaluation.evaluate`.
        seeds: As in `tubepose.evaluation.evaluate`.
    """
    errors = evaluate(estimates, truth, tube_models, methods, racks=racks, seeds=seeds)
    return Judgement(
        errors=errors,
        summary=summarise(errors, methods),
        comparison=compare(errors, foremost(methods)),
        uncertainty=uncertainty(errors),
        coverage=coverage(errors),
        confusion=confusion(errors),
        seeds=seed_spread(errors),
    )


def count_lines(judgement: Judgement) -> list[str]:
    """A line per method: the counts, which stand before all means."""
    lines = []
    for method, n in judgement.counts().items():
        ends = ", ".join(f"{n[name]} {name}" for name in ("rejected", "missed", "failed", "false", "wrong_type"))
        lines.append(
            f"{method}: {n['ok']} of {n['expected']} tubes answered; {ends}".replace("wrong_type", "wrong type")
        )
    return lines


def write_tables(out: Path, tables: Mapping[str, Table]) -> None:
    """Write tables for readers, ``table_<name>`` as CSV, Markdown and LaTeX.

    Raises:
        ConfigError: The folder cannot be written.
    """
    for name, table in tables.items():
        write_table(out, f"table_{name}", table)
