"""The paper's Table I (accuracy) and Table II (time), for a reader: the only place where numbers are rounded."""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
import pandas as pd

PAPER = "H. Chen, W. Wan, M. Matsushita, T. Kotaka, K. Harada: In-Rack Test Tube Pose Estimation Using RGB-D Data"
AXES = ("rx_deg", "ry_deg", "tx_mm", "ty_mm", "tz_mm")
PUBLISHED_ACCURACY: dict[tuple[str, str], tuple[float, float, float, float, float]] = {
    ("chen2023-tube-1", "Our"): (1.26, 1.15, 1.18, 2.80, 0.35),
    ("chen2023-tube-1", "ICP"): (43.4, 28.2, 21.1, 56.7, 49.7),
    ("chen2023-tube-2", "Our"): (0.97, 0.88, 0.69, 2.20, 0.37),
    ("chen2023-tube-2", "ICP"): (2.24, 1.77, 1.38, 4.44, 0.25),
    ("chen2023-tube-3", "Our"): (1.06, 0.93, 0.88, 3.26, 0.74),
    ("chen2023-tube-3", "ICP"): (1.06, 0.95, 1.44, 1.31, 0.75),
}
PUBLISHED_TIMES_MS = (
    ("Object Detection", "image", "", 96.0),
    ("Rack Pose Estimation", "rack", "", 191.0),
    ("Tube Pose Estimation", "tube", "Our", 12.0),
    ("Tube Pose Estimation", "tube", "ICP", 36.0),
)
_COMPONENTS = (
    ("detect", "Object Detection", "image"),
    ("rack", "Rack Pose Estimation", "rack"),
    ("slots", "Slots", "image"),
)
_COUNTS = ("n_expected", "n_ok", "n_rejected", "n_missed", "n_failed", "n_false")
_TEX = {
    "\\": r"\textbackslash{}", "&": r"\&", "%": r"\%", "$": r"\$", "#": r"\#", "_": r"\_", "{": r"\{", "}": r"\}",
    "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": r"\textless{}", ">": r"\textgreater{}",
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Table:
    """A table to print and to write.

    Attributes:
        caption: What it shows.
        label: LaTeX label.
        values: Full precision, for the CSV.
        cells: The same rows as rounded strings, for a reader.
        notes: Lines under the table.
        column_spec: Columns of the LaTeX tabular.
        head: LaTeX lines between the top rule and the body's rule.
        grouped: Whether equal neighbours in the first column become one cell.
    """

    caption: str
    label: str
    values: pd.DataFrame
    cells: pd.DataFrame
    notes: tuple[str, ...]
    column_spec: str
    head: tuple[str, ...]
    grouped: bool = False

    def markdown(self) -> str:
        """The table as Markdown, with caption and notes."""
        names = [str(name) for name in self.cells.columns]
        rows = [[cell.replace("|", r"\|") for cell in row] for row in self.cells.to_numpy().tolist()]
        widths = [max(3, len(name), *(len(row[i]) for row in rows)) for i, name in enumerate(names)]
        texts = [i < _text_columns(self.cells) for i in range(len(names))]
        rule = ["-" * width if text else "-" * (width - 1) + ":" for width, text in zip(widths, texts, strict=True)]
        lines = [
            "| "
            + " | ".join(c.ljust(w) if t else c.rjust(w) for c, w, t in zip(row, widths, texts, strict=True))
            + " |"
            for row in (names, rule, *rows)
        ]
        notes = ["", *(f"- {note}" for note in self.notes)] if self.notes else []
        return "\n".join([f"**{self.caption}**", "", *lines, *notes]) + "\n"

    def latex(self) -> str:
        """The table as LaTeX, in the paper's shape; needs the packages booktabs, multirow and threeparttable."""
        notes = [rf"  \item[Note {i}] {escape_tex(note)}" for i, note in enumerate(self.notes, start=1)]
        notes = [r"\begin{tablenotes}", *notes, r"\end{tablenotes}"] if notes else []
        lines = [
            r"\begin{table}[!htbp]",
            rf"\caption{{{escape_tex(self.caption)}}}",
            rf"\label{{{self.label}}}",
            r"\centering",
            r"\begin{threeparttable}",
            rf"\begin{{tabular}}{{{self.column_spec}}}",
            r"\toprule",
            *self.head,
            r"\midrule",
            *self._body(),
            r"\bottomrule",
            r"\end{tabular}",
            *notes,
            r"\end{threeparttable}",
            r"\end{table}",
        ]
        return "\n".join(lines) + "\n"

    def _body(self) -> list[str]:
        rows = [[escape_tex(cell) for cell in row] for row in self.cells.to_numpy().tolist()]
        if not self.grouped:
            return [" & ".join(row) + r" \\" for row in rows]
        lines: list[str] = []
        for name, group in groupby(rows, key=lambda row: row[0]):
            members = list(group)
            first = rf"\multirow{{{len(members)}}}{{*}}{{{name}}}"
            lines += [r"\midrule"] if lines else []
            lines += [" & ".join([first if i == 0 else "", *row[1:]]) + r" \\" for i, row in enumerate(members)]
        return lines


def escape_tex(text: str) -> str:
    """Text with every character that LaTeX would read as a command made plain."""
    return re.sub(r"[\\&%$#_{}~^<>]", lambda found: _TEX[found.group()], text)


def accuracy_table(summary: pd.DataFrame, notes: Sequence[str] = (), published: bool = False) -> Table:
    """Table I: mean absolute error per axis, tube by tube, with the counts that the means stand on.

    Args:
        summary: Result of `evaluation.summarise`.
        notes: Lines under the table: the truth's uncertainty, the rivals' settings, simulated or recorded.
        published: Add the paper's own figures as rows of their own, for the tubes that are in the summary.
    """
    values = _accuracy_values(summary, published)
    lines = [
        "Means of absolute errors over the ok rows, all seeds of a method together; rotation by swing.",
        *notes,
    ]
    if published:
        lines.append(
            f"Rows marked published: Table I of {PAPER}; real scans, 20 trials per tube, Euler angles, failures not "
            "counted apart: other data and another error, not a comparison."
        )
    return Table(
        caption="Rotational and translational errors",
        label="tab:accuracy",
        values=values,
        cells=_accuracy_cells(values),
        notes=tuple(lines),
        column_spec="ll|cc|ccc|ccc",
        head=(
            r"& & \multicolumn{2}{c|}{R.E. (deg)} & \multicolumn{3}{c|}{Translational Error (mm)}"
            r" & \multicolumn{3}{c}{Counts} \\",
            r"\cmidrule{3-10}",
            r"& Method & $R_x$ & $R_y$ & $T_x$ & $T_y$ & $T_z$ & ok/expected & rej./missed/failed & false \\",
        ),
        grouped=True,
    )


def _accuracy_values(summary: pd.DataFrame, published: bool) -> pd.DataFrame:
    rows: list[dict[str, Any]] = []
    for tube in sorted(summary["tube"].unique()):
        for row in summary[summary["tube"] == tube].to_dict("records"):
            means = {axis: row[f"{axis}_mean"] for axis in AXES}
            counts = {name: row[name] for name in _COUNTS}
            rows.append({"tube": tube, "method": row["method"], **means, **counts, "source": "measured"})
        for (name, method), figures in PUBLISHED_ACCURACY.items() if published else ():
            if name == tube:
                row = {"tube": tube, "method": method, **dict(zip(AXES, figures, strict=True)), "source": "published"}
                rows.append(row)
    table = pd.DataFrame(rows, columns=["tube", "method", *AXES, *_COUNTS, "source"])
    return table.astype({**dict.fromkeys(AXES, "float64"), **dict.fromkeys(_COUNTS, "Int64")})


def _accuracy_cells(values: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for row in values.to_dict("records"):
        means = [_number(row[axis]) for axis in AXES]
        if row["source"] == "published":
            counts = ["-", "-", "-"]
        else:
            ends = "/".join(str(row[name]) for name in ("n_rejected", "n_missed", "n_failed"))
            counts = [f"{row['n_ok']}/{row['n_expected']}", ends, str(row["n_false"])]
        rows.append([row["tube"], _method(row), *means, *counts])
    names = ["Tube", "Method", "R_x (deg)", "R_y (deg)", "T_x (mm)", "T_y (mm)", "T_z (mm)"]
    return pd.DataFrame(rows, columns=[*names, "ok/expected", "rejected/missed/failed", "false"], dtype="str")


def timing_table(timings: pd.DataFrame, notes: Sequence[str] = (), published: bool = False) -> Table:
    """Table II: time per component, without warm-up; the tube's stage once per method.

    Loading has no row; its mean stands in a note.

    Args:
        timings: Rows of timings.csv.
        notes: Lines under the table: machine, threads.
        published: Add the paper's own figures (another machine) as rows of their own.
    """
    values = _timing_values(timings, published)
    lines = [
        "Warm-up left out; outlier removal and down-sampling count in. Ratio: mean over the mean of the paper's method."
    ]
    lines += [*_apart(timings), *notes]
    if published:
        lines.append(f"Rows marked published: Table II of {PAPER}; Intel i9-13900K and NVIDIA RTX 4090.")
    return Table(
        caption="Time costs",
        label="tab:timing",
        values=values,
        cells=_timing_cells(values),
        notes=tuple(lines),
        column_spec="ll|ccccc",
        head=(r"Component & per & Mean (ms) & Median (ms) & p95 (ms) & n & Ratio \\",),
    )


def _timing_values(timings: pd.DataFrame, published: bool) -> pd.DataFrame:
    measured = timings[~timings["warmup"].astype(bool)]
    stages = [(name, unit, "", measured[measured["stage"] == stage]) for stage, name, unit in _COMPONENTS]
    tubes = measured[measured["stage"] == "tube"]
    stages += [("Tube Pose Estimation", "tube", m, tubes[tubes["method"] == m]) for m in tubes["method"].unique()]
    paper_ms = tubes.loc[tubes["method"] == "paper", "duration_ms"].mean()
    rows: list[dict[str, Any]] = []
    for name, unit, method, of in stages:
        ms = of["duration_ms"].astype(float)
        if ms.empty:
            continue
        row = {"component": name, "per": unit, "method": method, "mean_ms": ms.mean(), "median_ms": ms.median()}
        ratio = ms.mean() / paper_ms if unit == "tube" else np.nan
        rows.append({**row, "p95_ms": ms.quantile(0.95), "n": len(ms), "ratio_to_paper": ratio, "source": "measured"})
    for name, unit, method, mean_ms in PUBLISHED_TIMES_MS if published else ():
        ratio = mean_ms / PUBLISHED_TIMES_MS[2][3] if unit == "tube" else np.nan
        row = {"component": name, "per": unit, "method": method, "mean_ms": mean_ms, "ratio_to_paper": ratio}
        rows.append({**row, "source": "published"})
    names = ["component", "per", "method", "mean_ms", "median_ms", "p95_ms", "n", "ratio_to_paper", "source"]
    floats = dict.fromkeys(("mean_ms", "median_ms", "p95_ms", "ratio_to_paper"), "float64")
    return pd.DataFrame(rows, columns=names).astype({**floats, "n": "Int64"})


def _timing_cells(values: pd.DataFrame) -> pd.DataFrame:
    rows = []
    for row in values.to_dict("records"):
        method = _method(row)
        name = f"{row['component']} ({method})" if method else row["component"]
        times = [_number(row[column]) for column in ("mean_ms", "median_ms", "p95_ms")]
        count = "-" if pd.isna(row["n"]) else str(row["n"])
        rows.append([name, row["per"], *times, count, _number(row["ratio_to_paper"])])
    names = ["Component", "per", "Mean (ms)", "Median (ms)", "p95 (ms)", "n", "Ratio to paper"]
    return pd.DataFrame(rows, columns=names, dtype="str")


def _apart(timings: pd.DataFrame) -> list[str]:
    measured = timings[~timings["warmup"].astype(bool)]
    found = [(stage, measured.loc[measured["stage"] == stage, "duration_ms"]) for stage in ("load",)]
    parts = [f"{stage} {_number(ms.mean())} ms (mean of {len(ms)})" for stage, ms in found if len(ms)]
    return [f"Not in the rows: {', '.join(parts)}."] if parts else []


def _method(row: Mapping[Hashable, Any]) -> str:
    if row["source"] == "measured":
        return str(row["method"])
    return f"{row['method']}, published" if row["method"] else "published"


def _number(value: float) -> str:
    return "-" if pd.isna(value) else f"{value:.2f}"


def _text_columns(cells: pd.DataFrame) -> int:
    """How many leading columns are words: the rest is aligned to the right."""
    return min(2, len(cells.columns))
