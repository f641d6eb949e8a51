"""Lines under the tables of a benchmark: what was seen, how the rack and its slots went, how honest errors are."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from tubepose.batch import Job
from tubepose.benchmark.measured import MeasuredTruth
from tubepose.confusion import confusion
from tubepose.provenance import machine
from tubepose.result_tables import Tables
from tubepose.uncertainty import ALL_TUBES, uncertainty


def data_note(measured: MeasuredTruth, jobs: Sequence[Job]) -> str:
    """What the run saw: simulated or recorded, sensor, rack."""
    kinds = sorted({session.origin for session in measured.sessions})
    sensors = sorted({session.sensor for session in measured.sessions})
    racks = sorted({job.rack.name for job in jobs})
    kind = "SIMULATED data, no real scan" if kinds == ["simulated"] else " and ".join(kinds) + " data"
    given = "its pose given" if any(job.T_camera_rack is not None for job in jobs) else "its pose estimated, not given"
    seen = f"sensor {', '.join(sensors)}; rack {', '.join(racks)}, {given}"
    return f"{kind}: {len(jobs)} captures; {seen}."


def rack_notes(tables: Tables) -> list[str]:
    """How many frames have an accepted rack."""
    frames = {(row["session"], row["trial"], row["capture"], row["frame"]): row["status"] for row in tables.racks}
    ok = sum(status == "ok" for status in frames.values())
    return [f"Racks: {ok} of {len(frames)} frames with an accepted pose."]


def slot_notes(slots: pd.DataFrame) -> list[str]:
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


def confusion_notes(errors: pd.DataFrame) -> list[str]:
    """Types that were taken for others, where more than one could stand in a trial."""
    rows = confusion(errors).to_dict("records")
    wrong = [row for row in rows if row["tube_estimated"] not in (row["tube"], "none")]
    told = "; ".join(f"{r['method']}: {r['n']} {r['tube']} taken for {r['tube_estimated']}" for r in wrong)
    return [f"Types taken for others: {told}."] if told else []


def uncertainty_notes(errors: pd.DataFrame, exact: bool) -> list[str]:
    """How honest stated errors are; a measured truth has an error of its own, which no estimator can state."""
    rows = [row for row in uncertainty(errors).to_dict("records") if row["tube"] == ALL_TUBES]
    own = "" if exact else " (the truth's own error is not in that)"
    return [
        f"{row['method']}: {row['inside_95']:.1%} of {row['n']} truths inside the stated 95 % region{own}; "
        f"mean tilt error {row['tilt_deg_all']:.2f} deg of all, {row['tilt_deg_best_half']:.2f} of the better half."
        for row in rows
    ]


def spread_notes(spread: pd.DataFrame) -> list[str]:
    """How far single seeds of a stochastic method are apart."""
    rows = [row for row in spread.to_dict("records") if row["n_seeds"] > 1]
    if not rows:
        return []
    told = "; ".join(
        f"{row['method']} {row['tube']} {row['tilt_deg_mean_min']:.2f} to {row['tilt_deg_mean_max']:.2f} deg"
        for row in rows
    )
    return [f"Mean tilt error of single seeds, least to most: {told}."]


def machine_note() -> str:
    """The machine that times are of."""
    found = machine()
    return f"{found['cpu']}, {found['cores']} cores, one thread used."
