"""The tables of `python -m benchmarks.speed`: times summed up, claims held against them, Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.speed_stages import REST, STAGES

Row = dict[str, Any]
OURS = "profile"
RACKS = ("edges", "obb-icp")
CLAIMS = {("tube", "global-icp"): 300.0, ("tube", "paper"): 10.0, ("rack", "obb-icp"): 5.0}
"""How many times faster than this `profile` (`edges`) is claimed to be."""
FULL_RACK_MS = 60.0
"""A full rack without detection, rack and tubes, is claimed to take less."""


def summary(samples: pd.DataFrame) -> pd.DataFrame:
    """Mean and median per part, frame (and all together) and name, with ratios to the first name of the part."""
    rows = []
    for frame in ("all", *samples["frame"].unique()):
        of = samples if frame == "all" else samples[samples["frame"] == frame]
        for part in of["part"].unique():
            groups = {name: of[(of["part"] == part) & (of["name"] == name)] for name in of["name"].unique()}
            groups = {name: group for name, group in groups.items() if len(group)}
            ours = groups[{"tube": OURS, "rack": RACKS[0]}.get(part, next(iter(groups)))]["ms"]
            for name, group in groups.items():
                row: Row = {"part": part, "frame": frame, "name": name, "n": len(group)}
                row |= {"mean_ms": group["ms"].mean(), "median_ms": group["ms"].median()}
                row |= {
                    "ratio_of_means": row["mean_ms"] / ours.mean(),
                    "ratio_of_medians": row["median_ms"] / ours.median(),
                }
                rows.append(row | {"ok": (group["outcome"] == "ok").mean() if part == "rack" else np.nan})
    return pd.DataFrame(rows)


def claim_lines(table: pd.DataFrame, tubes: dict[str, int]) -> Iterator[str]:
    """Each claim, what was found, and whether it holds by mean and by median."""
    total = table[table["frame"] == "all"].set_index(["part", "name"])
    for (part, name), least in CLAIMS.items():
        if (part, name) in total.index:
            row = total.loc[(part, name)]
            found = [row["ratio_of_means"], row["ratio_of_medians"]]
            ours = OURS if part == "tube" else RACKS[0]
            yield (
                f"- `{ours}` {least:g} times faster than `{name}`: {'holds' if min(found) >= least else 'FAILS'} "
                f"({found[0]:.1f} by means, {found[1]:.1f} by medians)."
            )
    fullest = max(tubes, key=lambda frame: tubes[frame])
    row = table[(table["frame"] == fullest) & (table["name"] == "rack + profile")].iloc[0]
    found = [row["mean_ms"], row["median_ms"]]
    yield (
        f"- Rack and {tubes[fullest]} tubes ({fullest}) under {FULL_RACK_MS:g} ms without detection: "
        f"{'holds' if max(found) < FULL_RACK_MS else 'FAILS'} ({found[0]:.1f} ms mean, {found[1]:.1f} ms median)."
    )


def markdown(table: pd.DataFrame, frames: Sequence[str]) -> Iterator[str]:
    """The tables: tubes and racks of all frames together, then every frame stage by stage."""
    known = table.set_index(["part", "name", "frame"])
    for part, what, ours in (("tube", "ms per tube", OURS), ("rack", "ms per rack", RACKS[0])):
        medians = " | ".join(f"median of {frame}" for frame in frames)
        yield f"| {part} ({what}) | n | mean | median | mean / {ours} | median / {ours} | accepted | {medians} |"
        yield "|---|" + "--:|" * (6 + len(frames))
        for row in table[(table["part"] == part) & (table["frame"] == "all")].to_dict("records"):
            cells = [row["name"], str(row["n"])]
            cells += [f"{row[key]:.2f}" for key in ("mean_ms", "median_ms", "ratio_of_means", "ratio_of_medians")]
            cells.append("-" if np.isnan(row["ok"]) else f"{row['ok']:.2f}")
            cells += [f"{known.loc[(part, row['name'], frame), 'median_ms']:.2f}" for frame in frames]
            yield "| " + " | ".join(cells) + " |"
        yield ""
    yield "| ms per frame: mean, median | " + " | ".join(frames) + " |"
    yield "|---|" + "--:|" * len(frames)
    for part, names in (("frame", ("rack + profile", "rack", "profile")), ("stage", (*STAGES, REST))):
        for name in names:
            found = [known.loc[(part, name, frame)] for frame in frames]
            cells = [f"{row['mean_ms']:.2f}, {row['median_ms']:.2f}" for row in found]
            yield f"| {'. ' if part == 'stage' else ''}{name} | {' | '.join(cells)} |"
    yield ""


def bound_line(trial: str, tubes: int, least: dict[str, float], profile_ms: float, all_ms: float) -> str:
    """One sentence on how far a frame is from its bound."""
    return (
        f"- Bound of {trial} ({tubes} tubes): {least['bytes'] / 1e6:.1f} MB of cloud over the rack, read once at "
        f"{least['bytes_per_s'] / 1e9:.1f} GB/s, take {least['read_ms']:.2f} ms; normal equations of "
        f"{least['points']:.0f} points, {least['operations'] / 1e6:.1f} Mflop at "
        f"{least['operations_per_s'] / 1e9:.1f} Gflop/s, {least['fit_ms']:.2f} ms. `profile` takes "
        f"{profile_ms / least['bound_ms']:.0f} times that, rack and `profile` {all_ms / least['bound_ms']:.0f} times "
        "(medians)."
    )
