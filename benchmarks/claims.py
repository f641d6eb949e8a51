"""What is claimed of method `profile`, claim by claim, from one run of `tubepose bench` on a simulated session.

    tubepose bench data/test --out RUN --seeds 1 --methods upright,profile,paper,slot-icp,global-icp,gicp,kiss-matcher
    python -m benchmarks.claims data/test RUN [--out CLAIMS]

The run's estimates are judged twice: by the truth that printed caps gave (ground_truth.csv of the run), and by the
exact poses of the simulation. Nothing is estimated again.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from tubepose.capture.session import Session, load_session
from tubepose.errors import ConfigError, TubePoseError
from tubepose.evaluation import compare, evaluate
from tubepose.records import to_table
from tubepose.report.writing import write_csv
from tubepose.truth_tables import TRUTH_COLUMNS, exact_truth_rows
from tubepose.uncertainty import ALL_TUBES, coverage, uncertainty

OURS = "profile"
TRIVIAL = "upright"
ROTATION_DEG = {True: 0.15, False: 0.12}
"""Target of the mean of R_x and of R_y, for open and for closed tubes."""
TRANSLATION_MM = 0.2
TILT_P95_DEG = 0.4
WRONG = 2.0
"""An accepted answer farther off than this many degrees or millimetres is wrong."""
AXES = ("rx_deg", "ry_deg", "tilt_deg", "tx_mm", "ty_mm", "tz_mm")


def judge(session: Session, run: Path) -> dict[str, pd.DataFrame]:
    """Rows of errors.csv by the measured and by the exact truth."""
    texts = dict.fromkeys(("session", "trial", "capture", "method", "slot", "tube", "reason"), "str")
    whole = {"seed": "Int64", "timestamp_ns": "Int64"}
    estimates, racks, measured = (
        pd.read_csv(run / f"{name}.csv", dtype=texts | whole) for name in ("estimates", "racks", "ground_truth")
    )
    if (measured["reason"] == "exact").any():
        raise ConfigError(f"{run}: judged by exact poses; expected a run of 'tubepose bench' without --exact-truth")
    estimates["reason"] = estimates["reason"].fillna("")
    methods = list(racks["method"].unique())
    seeds = {name: sorted(of["seed"].dropna().astype(int).unique()) for name, of in estimates.groupby("method")}
    truths = {"measured": measured, "exact": to_table(exact_truth_rows(session), TRUTH_COLUMNS)}
    return {
        name: evaluate(estimates, truth, session.types, methods, racks=racks, seeds=seeds)
        for name, truth in truths.items()
    }


def accuracy_rows(errors: pd.DataFrame, session: Session, truth: str) -> list[dict[str, object]]:
    """Claim 1: accuracy per tube type, with its targets."""
    rows = []
    models = session.types
    for tube in sorted(models):
        named = errors[(errors["method"] == OURS) & (errors["tube"] == tube)]
        of = named[named["outcome"] != "false"]
        ok = of[of["outcome"] == "ok"]
        size = ok[list(AXES)].abs()
        false = len(named) - len(of)
        wrong = int(is_wrong(of).sum())
        limit = ROTATION_DEG[models[tube].is_open]
        means = size.mean()
        met = [
            means[["rx_deg", "ry_deg"]].max() <= limit,
            size["tilt_deg"].quantile(0.95) <= TILT_P95_DEG,
            means[["tx_mm", "ty_mm", "tz_mm"]].max() <= TRANSLATION_MM,
            len(of) > 0 and len(ok) >= 0.98 * len(of) and wrong == false == 0,
        ]
        rows.append(
            {
                "truth": truth,
                "tube": tube,
                "R_x": means["rx_deg"],
                "R_y": means["ry_deg"],
                "limit R": limit,
                "tilt p95": size["tilt_deg"].quantile(0.95),
                "T_x": means["tx_mm"],
                "T_y": means["ty_mm"],
                "T_z": means["tz_mm"],
                "ok/expected": f"{len(ok)}/{len(of)}",
                "wrong": wrong,
                "false": false,
                "R met": met[0],
                "p95 met": met[1],
                "T met": met[2],
                "kept, none wrong": met[3],
            }
        )
    return rows


def is_wrong(rows: pd.DataFrame) -> pd.Series[bool]:
    """Which accepted answers mislead: too far off, of another type than the tube's, or upside down."""
    offset_mm = np.sqrt((rows[["tx_mm", "ty_mm", "tz_mm"]] ** 2).sum(axis=1))
    other_type = ~rows["type_correct"].astype("boolean").fillna(True).astype(bool)
    misleads = (rows["tilt_deg"] > WRONG) | (offset_mm > WRONG) | other_type
    turned = (rows["outcome"] == "failed") & (rows["reason"] == "upside down")
    return ((rows["outcome"] == "ok") & misleads) | turned


def rival_rows(errors: pd.DataFrame, truth: str) -> list[dict[str, object]]:
    """Claim 2: paired differences of absolute errors to every rival; positive is a rival's larger error."""
    table = compare(errors, OURS)
    table = table[table["error"].isin(AXES)]
    rows = []
    for (method, tube), group in table.groupby(["method", "tube"], sort=False):
        row: dict[str, object] = {"truth": truth, "tube": tube, "rival": method}
        for entry in group.to_dict("records"):
            low, high = entry["ci95_low"], entry["ci95_high"]
            verdict = "ahead" if low > 0 else "behind" if high < 0 else "level"
            verdict = verdict if np.isfinite([low, high]).all() else "too few captures"
            row[str(entry["error"])] = f"{entry['mean_difference']:+.2f} ({low:+.2f} to {high:+.2f}) {verdict}"
        row["pairs"] = int(group["n_pairs"].iloc[0])
        rows.append(row)
    return rows


def gain_rows(errors: pd.DataFrame, truth: str) -> list[dict[str, object]]:
    """Claim 2: mean tilt error of `upright` over that of ours, on the tubes that both answered."""
    keys = ["session", "trial", "slot", "tube"]
    ok = errors[errors["outcome"] == "ok"]
    ours, trivial = (ok.loc[ok["method"] == name, [*keys, "tilt_deg"]] for name in (OURS, TRIVIAL))
    both = ours.merge(trivial, on=keys, suffixes=("", "_upright"))
    return [
        {
            "truth": truth,
            "tube": tube,
            "upright (deg)": group["tilt_deg_upright"].mean(),
            "profile (deg)": group["tilt_deg"].mean(),
            "ratio": group["tilt_deg_upright"].mean() / group["tilt_deg"].mean(),
        }
        for tube, group in both.groupby("tube")
    ]


def floor_rows(run: Path) -> list[dict[str, object]]:
    """The measured truth's own error, per tube type."""
    floor = pd.read_csv(run / "ground_truth_floor.csv")
    return [
        {"tube": tube, **{axis: group[axis].abs().mean() for axis in AXES}, "caps": len(group)}
        for tube, group in floor.groupby("tube")
    ]


def show(title: str, rows: Sequence[dict[str, object]]) -> None:
    """Print rows as a Markdown table."""
    print(f"\n{title}\n")
    if not rows:
        print("none")
        return
    print("| " + " | ".join(rows[0]) + " |")
    print("|" + "---|" * len(rows[0]))
    for row in rows:
        print("| " + " | ".join(_cell(value) for value in row.values()) + " |")


def _cell(value: object) -> str:
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def main(arguments: list[str] | None = None) -> int:
    """Print every claim, and write the rows where asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("session", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, help="Folder for the rows as CSV.")
    options = parser.parse_args(arguments)
    try:
        session = load_session(options.session)
        judged = judge(session, options.run)
    except TubePoseError as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 1
    tables = {
        "accuracy": [row for name, errors in judged.items() for row in accuracy_rows(errors, session, name)],
        "rivals": [row for name, errors in judged.items() for row in rival_rows(errors, name)],
        "gain": [row for name, errors in judged.items() for row in gain_rows(errors, name)],
        "truth's own error": floor_rows(options.run),
    }
    for name, errors in judged.items():
        honest = uncertainty(errors)
        tables[f"uncertainty, {name} truth"] = honest[honest["method"] == OURS].to_dict("records")
        kept = coverage(errors)
        kept = kept[(kept["method"] == OURS) & (kept["tube"] == ALL_TUBES)]
        tables[f"coverage, {name} truth"] = kept.to_dict("records")
    for title, rows in tables.items():
        show(title, rows)
        if options.out is not None:
            write_csv(options.out / f"{title.replace(', ', '_').replace(' ', '_')}.csv", pd.DataFrame(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
