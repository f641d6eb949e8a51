"""One method under several settings on the same sessions: how the settings of the tables were chosen.

    python -m benchmarks.compare_settings rivals SESSION...      # settings of global registration + ICP
    python -m benchmarks.compare_settings objectives SESSION...  # the costs that Eq. 3 can be read as

Prints, per tube and setting: estimates that are ok, failures, mean tilt error, mean distance error of the bottom.
Choose on sessions of your own; never on those that a table reports.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import get_args

import numpy as np
import pandas as pd

from tubepose.batch import run_jobs, session_jobs
from tubepose.capture.session import Session, load_session
from tubepose.config import Config, IcpConfig, Objective, TubeConfig
from tubepose.detection.geometric import GeometricDetector
from tubepose.evaluation import evaluate, summarise
from tubepose.ground_truth import GroundTruthConfig
from tubepose.provenance import pinned_threads
from tubepose.records import ESTIMATE_COLUMNS, to_table
from tubepose.truth_tables import TRUTH_COLUMNS, TruthTables, measure_session

SEEDS = 2


def rival_settings() -> Iterator[tuple[str, Config]]:
    """Settings of global registration + ICP, one thing changed at a time."""
    base = IcpConfig()
    changes: dict[str, dict[str, object]] = {
        "default": {},
        "mutual filter": {"mutual_filter": True},
        "voxel 0.7 mm": {"voxel_m": 0.7e-3},
        "voxel 1.5 mm": {"voxel_m": 1.5e-3},
        "features 4 mm": {"feature_radius_m": 4e-3, "normal_radius_m": 2e-3},
        "features 10 mm": {"feature_radius_m": 10e-3},
        "RANSAC 0.8 mm": {"ransac_distance_m": 0.8e-3},
        "RANSAC 2.5 mm": {"ransac_distance_m": 2.5e-3},
        "1 M iterations": {"ransac_iterations": 1_000_000, "ransac_confidence": 0.9999},
        "point to point": {"estimation": "point_to_point"},
    }
    for name, change in changes.items():
        yield name, Config(icp=base.model_copy(update=change))


def objective_settings() -> Iterator[tuple[str, Config]]:
    """The named objectives of the cylinder fit."""
    for name in get_args(Objective):
        yield name, Config(tube=TubeConfig(objective=name))


def compare(sessions: Sequence[Session], method: str, settings: Iterator[tuple[str, Config]]) -> pd.DataFrame:
    """Summary rows per tube and setting."""
    truth = TruthTables()
    for session in sessions:
        measure_session(session, truth, GroundTruthConfig())
    models = {tube.name: tube for session in sessions for tube in session.tubes.values()}
    jobs = [job for session in sessions for job in session_jobs(session)[0]]
    rows = []
    for name, config in settings:
        tables = run_jobs(
            jobs, [method], lambda rack, tubes, c=config: GeometricDetector(rack, tubes, c), config, seeds=SEEDS
        )
        estimates = to_table(tables.estimates, ESTIMATE_COLUMNS)
        errors = evaluate(estimates, to_table(truth.truth, TRUTH_COLUMNS), models, [method])
        milliseconds = np.mean([row["duration_ms"] for row in tables.timings if row["stage"] == "tube"])
        for row in summarise(errors, [method]).to_dict("records"):
            rows.append(
                {
                    "tube": row["tube"],
                    "setting": name,
                    "ok": f"{row['n_ok']}/{row['n_expected']}",
                    "failed": row["n_failed"],
                    "rejected": row["n_rejected"],
                    "tilt mean (deg)": f"{row['tilt_deg_mean']:.2f}",
                    "tilt p95 (deg)": f"{row['tilt_deg_p95']:.2f}",
                    "within 1 mm, 1 deg": f"{row.get('recall_1mm_1deg', float('nan')):.2f}",
                    "ms per tube": f"{milliseconds:.1f}",
                }
            )
        print(f"{name}: done", file=sys.stderr)
    return pd.DataFrame(rows).sort_values(["tube", "setting"], kind="stable")


def main() -> None:
    """Parse the two arguments and print a Markdown table."""
    which, *folders = sys.argv[1:] or ["help"]
    if which not in ("rivals", "objectives") or not folders:
        sys.exit(__doc__)
    sessions = [load_session(Path(folder)) for folder in folders]
    method, settings = ("global-icp", rival_settings()) if which == "rivals" else ("paper", objective_settings())
    with pinned_threads(1):
        table = compare(sessions, method, settings)
    print("| " + " | ".join(table.columns) + " |")
    print("|" + "---|" * len(table.columns))
    for row in table.itertuples(index=False):
        print("| " + " | ".join(str(value) for value in row) + " |")


if __name__ == "__main__":
    main()
