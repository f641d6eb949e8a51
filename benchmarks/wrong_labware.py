"""Wrong answers without a mark: frames are asked with right and with wrong labware files, and judged by exact truth.

    python -m benchmarks.wrong_labware [--frames N] [--seed S] [--set choose|report] [--sensor raycast|structured-light]
        [--cases NAME,...] [--per-kind N] [--frame-folder DIR] [--out DIR] [--workers 1|2] [--render-only]

All of it is SIMULATED: racks of the catalogue in turn, fill 0 to 100 %, bow -2.5 to 2.5 mm, 700 to 1032 px, any tubes
that fit. Frames are kept under --frame-folder (default: --out/frames), so that a second run only estimates. Of every
kind of case each frame gets --per-kind cases, drawn by its name (0: all of them, some hundred a frame).

WRONG is: a rack `ok` under another name, or more than 2 mm or 2 deg off at the centre of its face (a turn that is
marked ambiguous counts as right either way); a slot called empty that holds a tube, or occupied that holds none; a tube
`ok` of another type, under another slot's name, or more than 2 mm or 2 deg off across its axis, or more than 2 mm along
it where it wears a closed cap. Open tubes off along their axes are counted apart: no capture shows their floor.
A rack whose scale is marked as off or unknown is not wrong along the line of sight, nor are its tubes; where its pitch
is marked, tubes are not wrong across their axes.
--out gets answers.csv, one row per frame and case, and table.md.
"""

from __future__ import annotations

import argparse
import csv
import dataclasses
import multiprocessing
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.wrong_labware_cases import KINDS, Case, cases
from benchmarks.wrong_labware_judging import Answer, StatedTube, Verdict, judge
from benchmarks.wrong_labware_scenes import SETS, View, view
from tubepose.config import Config
from tubepose.detection.geometric import GeometricDetector
from tubepose.errors import TubePoseError
from tubepose.methods import DEFAULT_METHOD
from tubepose.pipeline import estimate_tubes, prepare_scene
from tubepose.provenance import pinned_threads
from tubepose.records import estimate_row, rack_row, slot_rows
from tubepose.scene import Scene
from tubepose.simulation import SENSORS

FULL_FRAMES = 500
MOST_WORKERS = 2
SEPARATOR = " | "
KEYS = ("frame", "kind", "case", "true_rack", "asked_rack", "n_tubes_true", "bow_x_mm", "bow_y_mm")
COUNTS = tuple(field.name for field in dataclasses.fields(Verdict))
COLUMNS = (*KEYS, "wrong", *COUNTS, "resolved_by", "duration_ms", "reason", "tubes_not_ok", "stated_slots")

Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class Plan:
    """What every worker does with a frame; see the options of `main`."""

    chosen: str
    seed: int
    sensor: str
    kinds: tuple[str, ...]
    per_kind: int
    folder: Path
    render_only: bool


def ask(case: Case, config: Config) -> tuple[Answer, Row]:
    """Ask the estimator one question by the library's public names; details that nobody judges come beside."""
    detector = GeometricDetector(case.rack, case.tubes, config)
    try:
        scene = prepare_scene(case.frame, case.rack, case.tubes, detector, config, methods=(DEFAULT_METHOD,))
        result = estimate_tubes(scene, DEFAULT_METHOD, config)
    except TubePoseError as refusal:
        return Answer(case.rack, None, False, str(refusal)), {"resolved_by": "error"}
    scene, estimates = result.scene, result.estimates
    rack = rack_row(scene)
    slots = slot_rows({}, DEFAULT_METHOD, scene, estimates)
    tubes = [
        StatedTube(e.target.slot, e.target.tube.name, e.target.tube, e.T_camera_tube, e.pose.covariance)
        for e in estimates
        if e.pose.status.value == "ok" and e.T_camera_tube is not None and e.target.tube is not None
    ]
    reason = str(rack.get("reason_code") or rack["reason"])
    answer = Answer(
        case.rack,
        scene.rack_pose.T_camera_rack,
        bool(rack["ambiguous"]),
        reason,
        tuple(tubes),
        {row["slot"]: stated(row) for row in slots},
        frozenset(filter(None, str(rack["marks"]).split(";"))),
    )
    return answer, {"resolved_by": rack["resolved_by"], "tubes_not_ok": _not_ok(scene, estimates)}


def stated(row: Row) -> str:
    """State of a slot: column `state`, or `occupied` of tables that have no such column."""
    state = row.get("state")
    if state is not None:
        return str(getattr(state, "value", state))
    return "occupied" if row["occupied"] else "empty"


def _not_ok(scene: Scene, estimates: Sequence[Any]) -> str:
    """Slot and reason of every tube that is not stated: `A1: reason | B2: ...`, as reasons have semicolons."""
    rows = [estimate_row({}, scene, estimate) for estimate in estimates]
    words = [f"{row['slot']}: {row.get('reason_code') or row['reason']}" for row in rows if row["status"] != "ok"]
    return SEPARATOR.join(words)


def frame_rows(plan: Plan, number: int) -> list[Row]:
    """All answers about one frame, as rows of answers.csv."""
    with pinned_threads(1):
        seen = view(plan.chosen, plan.seed, number, plan.sensor, plan.folder)
        if plan.render_only:
            return []
        return [_row(seen, case) for case in cases(seen, plan.kinds, plan.per_kind, plan.seed)]


def _row(seen: View, case: Case) -> Row:
    start = time.perf_counter_ns()
    answer, details = ask(case, Config())
    duration_ms = round((time.perf_counter_ns() - start) / 1e6)
    verdict = judge(case.truth, answer, case.same_rack, case.face_truth)
    slots = answer.slots or {}
    return {
        "frame": seen.name,
        "kind": case.kind,
        "case": case.name,
        "true_rack": case.truth.rack.name if case.truth.rack is not None else "none",
        "asked_rack": case.rack.name,
        "n_tubes_true": len(case.truth.tubes),
        "bow_x_mm": round(1e3 * seen.truth.bow.along_x_m, 2),
        "bow_y_mm": round(1e3 * seen.truth.bow.along_y_m, 2),
        "wrong": verdict.wrong,
        **dataclasses.asdict(verdict),
        "duration_ms": duration_ms,
        "reason": answer.reason,
        "stated_slots": " ".join(name for name, state in slots.items() if state == "occupied"),
        **details,
    }


def answers(plan: Plan, frames: int, workers: int) -> Iterator[list[Row]]:
    """Rows of every frame as they are done."""
    if workers == 1:
        yield from (frame_rows(plan, number) for number in range(frames))
        return
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        waiting = [pool.submit(frame_rows, plan, number) for number in range(frames)]
        for done in as_completed(waiting):
            yield done.result()


HEADINGS = (
    "kind", "questions", "frames", "racks ok", "racks wrong", "tubes ok", "tubes wrong", "type", "slot", "lateral",
    "tilt", "axial", "axial, open", "false empty", "false occupied", "not stated",
)  # fmt: skip


def table(rows: Sequence[Row]) -> str:
    """One line per kind of case, then a sentence about the right files."""
    lines = ["| " + " | ".join(HEADINGS) + " |", "|---" + "|--:" * (len(HEADINGS) - 1) + "|"]
    kinds = list(dict.fromkeys(row["kind"] for row in rows))
    for kind in (*kinds, "all"):
        some = [row for row in rows if kind in (row["kind"], "all")]
        total = {name: sum(int(row[name]) for row in some) for name in COUNTS}
        names = (
            "racks", "wrong_racks", "tubes", "wrong_tubes", "wrong_type", "wrong_slot", "lateral", "tilt", "axial",
            "axial_unseen", "false_empty", "false_occupied", "not_stated",
        )  # fmt: skip
        cells = [kind, len(some), len({row["frame"] for row in some}), *(total[name] for name in names)]
        lines.append("| " + " | ".join(map(str, cells)) + " |")
    wrong = sum(int(row["wrong"]) for row in rows)
    asked = sum(int(row["wrong"]) > 0 for row in rows)
    lines.append(f"\n**Wrong without a mark: {wrong} statements, in {asked} of {len(rows)} questions.**")
    right = [row for row in rows if row["kind"] == "right"]
    if right:
        lines.append(_right_words(right))
    return "\n".join(lines)


def _right_words(right: Sequence[Row]) -> str:
    def count(name: str, among: Sequence[Row] = right) -> int:
        return sum(int(row[name]) for row in among)

    accepted = [row for row in right if int(row["racks"])]
    return (
        f"With the right file: {count('racks')} of {len(right)} racks accepted; {count('kept')} of "
        f"{count('n_tubes_true')} tubes kept, {count('n_tubes_true', accepted)} of them in accepted racks; "
        f"{count('ambiguous')} racks ambiguous, {count('needless')} of them though the scene is not; of "
        f"{count('scale_marks')} the cloud's scale is marked as off or unknown."
    )


def main() -> None:
    """Parse the command line, ask, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=FULL_FRAMES)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", choices=tuple(SETS), default="choose", dest="chosen")
    parser.add_argument("--sensor", choices=tuple(SENSORS), default="raycast")
    parser.add_argument("--cases", default=",".join(KINDS), help="Known: " + ", ".join(KINDS))
    parser.add_argument("--per-kind", type=int, default=2)
    parser.add_argument("--frame-folder", type=Path)
    parser.add_argument("--out", type=Path, default=Path("out/wrong_labware"))
    parser.add_argument("--workers", type=int, choices=range(1, MOST_WORKERS + 1), default=1)
    parser.add_argument("--render-only", action="store_true", help="Simulate and keep the frames, ask nothing.")
    options = parser.parse_args()
    kinds = tuple(options.cases.split(","))
    if unknown := sorted(set(kinds) - set(KINDS)):
        parser.error(f"--cases: unknown {', '.join(unknown)}; known: {', '.join(KINDS)}")
    folder = options.frame_folder or options.out / "frames"
    plan = Plan(
        options.chosen, options.seed, options.sensor, kinds, options.per_kind, folder, options.render_only
    )  # fmt: skip
    rows = _written(plan, options.frames, options.workers, options.out)
    if rows:
        words = table(sorted(rows, key=lambda row: list(KINDS_ORDER).index(row["kind"])))
        (options.out / "table.md").write_text(words + "\n", encoding="utf-8")
        print(words)


KINDS_ORDER = (
    "right", "other rack", "rows, columns", "pitch", "openings", "floor", "height", "type missing", "type replaced",
    "cap height", "cloud scale", "robot's frame", "clutter", "no rack",
)  # fmt: skip
"""Rows of the table."""


def _written(plan: Plan, frames: int, workers: int, out: Path) -> list[Row]:
    """Ask, and write every frame's rows when they are there: an interrupted run has them up to then."""
    out.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    with (out / "answers.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, restval="")
        writer.writeheader()
        for done, found in enumerate(answers(plan, frames, workers), 1):
            writer.writerows(found)
            file.flush()
            rows += found
            print(f"\r{done}/{frames} frames", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    return rows


if __name__ == "__main__":
    main()
