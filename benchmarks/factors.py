"""Each factor alone: small simulated sessions that differ from a base in one thing, and what it does to the errors.

    python -m benchmarks.factors make [--threads N]           # data/factors/NAME; a run that was stopped goes on
    python -m benchmarks.factors report [--methods ...] [--out FOLDER]    # Markdown on stdout, rows as CSV

benchmarks/factors.yaml says which; the truth is exact. Nothing is chosen with these sessions. With --known-rack the
rack's pose is the exact one, which tells its error, and racks that are not found, from the tubes'.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import BaseModel, ConfigDict, Field

from benchmarks.dataset import RECIPE, ROOT, read_recipe
from tubepose.batch import run_jobs, session_jobs
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.manifest import Split
from tubepose.capture.session import Session, is_session, load_session
from tubepose.config import Config
from tubepose.detection import Detection, Detector
from tubepose.detection.assisted import AssistedDetector
from tubepose.detection.bundled import bundled_model
from tubepose.detection.geometric import GeometricDetector
from tubepose.detection.yolo import YoloDetector
from tubepose.errors import ConfigError, TubePoseError
from tubepose.evaluation import evaluate, summarise
from tubepose.labware import load_cap, load_rack, load_tube
from tubepose.labware.reading import read_yaml, validate
from tubepose.methods import METHODS
from tubepose.provenance import pinned_threads
from tubepose.records import ESTIMATE_COLUMNS, to_table
from tubepose.simulation import simulate_session
from tubepose.simulation.variation import SceneVariation, scene_variation
from tubepose.truth_tables import TRUTH_COLUMNS, exact_truth_rows, with_exact_rack
from tubepose.uncertainty import uncertainty
from tubepose_cli.show import counted_progress

FACTORS = ROOT / "benchmarks" / "factors.yaml"
PLACE = ROOT / "data" / "factors"
SHOWN = ("profile", "upright")
WRONG_TILT_DEG, WRONG_POSITION_MM = 2.0, 2.0
"""An accepted pose that is farther off than either is wrong."""
TARGET_R_DEG = {False: 0.12, True: 0.15}
"""Mean |R_x| and |R_y| that is aimed at, by whether the tube's own cap is open (semi-transparent tubes)."""
TARGET_T_MM, TARGET_P95_DEG = 0.2, 0.4
SLACK = 2.0
"""A factor alone may double the targets."""
_SHIFTS = ("tx_mm_mean", "ty_mm_mean", "tz_mm_mean")


class Factor(BaseModel):
    """What one session has of its own."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    sensor: str | None = None
    scenes: dict[str, Any] = {}


class Plan(BaseModel):
    """Contents of factors.yaml; names and numbers are those of `simulate_session`."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    materials: Split
    seed: int = Field(ge=0)
    tubes: tuple[str, ...]
    trials: int = Field(ge=1)
    resolution: int = Field(ge=32)
    sensor: str
    scenes: dict[str, Any] = {}
    factors: dict[str, Factor] = Field(min_length=1)


def read_plan(path: Path = FACTORS) -> Plan:
    """Read the factors.

    Raises:
        ConfigError: Missing, or it breaks the format.
    """
    return validate(Plan, read_yaml(path, ConfigError), str(path), ConfigError)


def variation_of(plan: Plan, name: str, recipe: Path = RECIPE) -> SceneVariation:
    """Ranges that the scenes of a factor are drawn from: materials of the recipe's set, the base, the factor."""
    read = read_recipe(recipe)
    if plan.materials not in read.sets:
        raise ConfigError(f"no set '{plan.materials}' in {recipe}; its sets: {', '.join(read.sets)}")
    ranges = read.scenes | read.sets[plan.materials].scenes | plan.scenes | plan.factors[name].scenes
    return scene_variation(ranges, f"scenes of {name}")


def make(plan: Plan, place: Path, threads: int, recipe: Path = RECIPE) -> None:
    """Simulate the sessions that are not there yet; what a stopped run has finished is kept."""
    read = read_recipe(recipe)
    for name, factor in plan.factors.items():
        if is_session(place / name):
            continue
        with counted_progress(f"captures of {name}") as show:
            simulate_session(
                place / name,
                load_rack(read.rack),
                [load_tube(tube) for tube in plan.tubes],
                trials=plan.trials,
                seed=plan.seed,
                cap=load_cap(read.cap),
                sensor=factor.sensor or plan.sensor,
                resolution=plan.resolution,
                variation=variation_of(plan, name, recipe),
                printed=False,
                capture_format=read.capture_format,
                threads=threads,
                resume=True,
                progress=show,
            )
        print(f"{name}: done", file=sys.stderr, flush=True)


class NoBoxes(Detector):
    """A detector for methods that need none, where the rack's pose is known as well."""

    name = "recorded"

    def detect(self, frame: RgbdFrame) -> tuple[Detection, ...]:  # noqa: ARG002
        """No boxes."""
        return ()


def judge(
    session: Session, methods: Sequence[str], config: Config, *, known_rack: bool = False
) -> tuple[pd.DataFrame, str]:
    """Rows of errors.csv of a session by its exact truth, and how many racks of how many were accepted."""
    jobs, problems = session_jobs(session)
    jobs = with_exact_rack(jobs, session) if known_rack else jobs
    boxes = not known_rack or any(METHODS[name].needs_targets for name in methods)
    yolo = YoloDetector(bundled_model(), threads=1) if boxes else None
    tables = run_jobs(
        jobs,
        methods,
        lambda rack, tubes: AssistedDetector(yolo, GeometricDetector(rack, tubes, config)) if yolo else NoBoxes(),
        config,
    )
    for problem in (*problems, *tables.problems):
        print(f"error: {problem}", file=sys.stderr)
    models = session.types
    truth = to_table(exact_truth_rows(session), TRUTH_COLUMNS)
    errors = evaluate(to_table(tables.estimates, ESTIMATE_COLUMNS), truth, models, methods)
    racks = pd.DataFrame(tables.racks, columns=["trial", "method", "status"]).drop_duplicates("trial")
    return errors, f"{(racks['status'] == 'ok').sum()}/{len(session.trials)}"


def table_rows(errors: pd.DataFrame, is_open: dict[str, bool]) -> Iterator[dict[str, Any]]:
    """Rows of the table per method and tube, from rows of errors.csv."""
    stated = uncertainty(errors).set_index(["method", "tube"])["inside_95"]
    for row in summarise(errors).to_dict("records"):
        method, tube = row["method"], row["tube"]
        if tube not in is_open:
            continue
        ok = errors[(errors["method"] == method) & (errors["tube"] == tube) & (errors["outcome"] == "ok")]
        position_mm = np.sqrt((ok[["tx_mm", "ty_mm", "tz_mm"]] ** 2).sum(axis=1))
        found = {name: row[name] for name in ("rx_deg_mean", "ry_deg_mean", "tilt_deg_mean", "tilt_deg_p95")}
        found |= {name: row[name] for name in _SHIFTS}
        yield {
            "tube": tube,
            "method": method,
            **found,
            **{name: row[f"n_{name}"] for name in ("ok", "expected", "rejected", "missed", "failed")},
            "wrong": int(((ok["tilt_deg"] > WRONG_TILT_DEG) | (position_mm > WRONG_POSITION_MM)).sum()),
            "false": row["n_false"],
            "inside_95": stated.get((method, tube), float("nan")),
            "over": ", ".join(over_targets(found, is_open[tube])),
        }


def over_targets(row: dict[str, float], is_open: bool) -> list[str]:
    """Errors of a row that are not within `SLACK` times their targets; one that is not known is not within."""
    limits = {f"R_{axis}": (f"r{axis}_deg_mean", TARGET_R_DEG[is_open]) for axis in "xy"}
    limits |= {"tilt p95": ("tilt_deg_p95", TARGET_P95_DEG)}
    limits |= {f"T_{axis}": (f"t{axis}_mm_mean", TARGET_T_MM) for axis in "xyz"}
    return [word for word, (name, limit) in limits.items() if not row[name] <= SLACK * limit]


def report(plan: Plan, place: Path, methods: Sequence[str], out: Path, *, known_rack: bool = False) -> str:
    """Judge all sessions; write factors.csv and errors.csv into a folder.

    Returns:
        The table as Markdown.

    Raises:
        ConfigError: A session is not there, or a method is unknown.
    """
    absent = [name for name in plan.factors if not is_session(place / name)]
    if absent:
        raise ConfigError(f"{place}: no session {', '.join(absent)}; make them: python -m benchmarks.factors make")
    if unknown := [name for name in methods if name not in METHODS]:
        raise ConfigError(f"unknown method '{unknown[0]}'; known methods: {', '.join(METHODS)}")
    rows, all_errors = [], []
    for name in plan.factors:
        session = load_session(place / name)
        with pinned_threads(1):
            errors, racks = judge(session, methods, Config(), known_rack=known_rack)
        is_open = {name: tube.is_open for name, tube in session.types.items()}
        rows += [{"factor": name, "racks": racks, **row} for row in table_rows(errors, is_open)]
        all_errors.append(errors.assign(factor=name))
        print(f"{name}: judged", file=sys.stderr, flush=True)
    table = pd.DataFrame(rows).sort_values("tube", kind="stable", ignore_index=True)
    out.mkdir(parents=True, exist_ok=True)
    table.to_csv(out / "factors.csv", index=False)
    pd.concat(all_errors).to_csv(out / "errors.csv", index=False)
    return "\n".join(markdown(table))


def markdown(table: pd.DataFrame) -> Iterator[str]:
    """Lines of the table, one per tube, factor and method."""
    yield (
        "| tube | factor | method | R_x, R_y (deg) | tilt mean, p95 (deg) | T_x, T_y, T_z (mm) | ok/expected | "
        "rejected/missed/failed | wrong | false | inside 95 % | answers within twice the targets |"
    )
    yield "|---|---|---|--:|--:|--:|--:|--:|--:|--:|--:|---|"
    for row in table.to_dict("records"):
        cells = [row["tube"], row["factor"], row["method"]]
        for names in (("rx_deg_mean", "ry_deg_mean"), ("tilt_deg_mean", "tilt_deg_p95"), _SHIFTS):
            cells.append(", ".join(f"{row[name]:.2f}" for name in names) if row["ok"] else "-")
        cells += [f"{row['ok']}/{row['expected']}", f"{row['rejected']}/{row['missed']}/{row['failed']}"]
        cells += [str(row["wrong"]), str(row["false"])]
        cells.append("-" if np.isnan(row["inside_95"]) else f"{row['inside_95']:.3f}")
        within = f"no: {row['over']}" if row["over"] else "yes"
        cells.append(within if row["ok"] else "no answer")
        yield "| " + " | ".join(cells) + " |"


def parser() -> argparse.ArgumentParser:
    """Parser of the command line."""
    whole = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    whole.add_argument("--plan", type=Path, default=FACTORS)
    whole.add_argument("--recipe", type=Path, default=RECIPE)
    whole.add_argument("--place", type=Path, default=PLACE, help="folder of the sessions")
    commands = whole.add_subparsers(dest="command", required=True)
    commands.add_parser("make").add_argument("--threads", type=int, default=1)
    judged = commands.add_parser("report")
    judged.add_argument("--methods", default=",".join(SHOWN), help="with commas")
    judged.add_argument("--known-rack", action="store_true", help="take the rack's pose from the exact truth")
    judged.add_argument("--out", type=Path, default=Path("out/factors"), help="folder of factors.csv and errors.csv")
    return whole


def main(arguments: list[str] | None = None) -> int:
    """Run the command; 1 if it could not be done."""
    options = parser().parse_args(arguments)
    try:
        plan = read_plan(options.plan)
        if options.command == "make":
            make(plan, options.place, options.threads, options.recipe)
        else:
            methods = options.methods.split(",")
            print(report(plan, options.place, methods, options.out, known_rack=options.known_rack))
    except (TubePoseError, OSError) as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
