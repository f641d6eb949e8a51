"""One method under several settings on the same sessions: how the settings of the tables were chosen.

    python -m benchmarks.compare_settings rivals SESSION...        # settings of global registration + ICP
    python -m benchmarks.compare_settings kiss-matcher SESSION...  # settings of KISS-Matcher
    python -m benchmarks.compare_settings gicp SESSION...          # settings of small_gicp
    python -m benchmarks.compare_settings objectives SESSION...    # the costs that Eq. 3 can be read as

With --known-rack the rack's pose is the exact one (simulated sessions only), so that its errors hide nothing.
Prints, per tube and setting: how many estimates are ok and how many failed, and mean errors.
Choose on sessions of your own; never on those that a table reports.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import get_args

import numpy as np
import pandas as pd

from tubepose.batch import Job, run_jobs, session_jobs
from tubepose.capture.session import Session, load_session
from tubepose.config import Config, IcpConfig, Objective, RivalsConfig, TubeConfig
from tubepose.detection.geometric import GeometricDetector
from tubepose.evaluation import evaluate, summarise
from tubepose.ground_truth import GroundTruthConfig
from tubepose.methods import require_methods
from tubepose.provenance import pinned_threads
from tubepose.records import ESTIMATE_COLUMNS, to_table
from tubepose.truth_tables import TRUTH_COLUMNS, TruthTables, measure_session, with_exact_rack

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


def kiss_settings() -> Iterator[tuple[str, Config]]:
    """Settings of KISS-Matcher, one thing changed at a time."""
    changes: dict[str, dict[str, object]] = {
        "default": {},
        "one attempt of 1000 pairs": {"kiss_attempts": 1, "kiss_pairs": 1000},
        "10 attempts": {"kiss_attempts": 10},
        "80 attempts": {"kiss_attempts": 80},
        "1 partner": {"kiss_neighbors": 1},
        "5 partners": {"kiss_neighbors": 5},
        "100 pairs": {"kiss_pairs": 100},
        "400 pairs": {"kiss_pairs": 400},
        "noise 1 mm": {"kiss_noise_bound_m": 1e-3},
        "noise 3 mm": {"kiss_noise_bound_m": 3e-3},
        "no pruning": {"kiss_pruning": False},
        "features 6 mm, voxel 1 mm": {
            "kiss_voxel_m": 1e-3,
            "kiss_feature_radius_m": 6e-3,
            "kiss_normal_radius_m": 3e-3,
        },
        "refined by ICP": {"kiss_refinement": "icp"},
    }
    for name, change in changes.items():
        yield name, Config(rivals=RivalsConfig.model_validate(change))


def gicp_settings() -> Iterator[tuple[str, Config]]:
    """Settings of small_gicp, one thing changed at a time."""
    changes: dict[str, dict[str, object]] = {
        "default": {},
        "template onto scan": {"gicp_target": "scan"},
        "PLANE_ICP": {"gicp_kind": "PLANE_ICP"},
        "PLANE_ICP, template onto scan": {"gicp_kind": "PLANE_ICP", "gicp_target": "scan"},
        "ICP": {"gicp_kind": "ICP"},
        "1 mm": {"gicp_max_distance_m": (1e-3,)},
        "2, 1 mm": {"gicp_max_distance_m": (2e-3, 1e-3)},
        "4, 1.5 mm": {"gicp_max_distance_m": (4e-3, 1.5e-3)},
        "10 neighbours": {"gicp_neighbors": 10},
        "20 neighbours": {"gicp_neighbors": 20},
    }
    for name, change in changes.items():
        yield name, Config(rivals=RivalsConfig.model_validate(change))


def objective_settings() -> Iterator[tuple[str, Config]]:
    """The named objectives of the cylinder fit."""
    for name in get_args(Objective):
        yield name, Config(tube=TubeConfig(objective=name))


GROUPS: dict[str, tuple[str, Callable[[], Iterator[tuple[str, Config]]]]] = {
    "rivals": ("global-icp", rival_settings),
    "kiss-matcher": ("kiss-matcher", kiss_settings),
    "gicp": ("gicp", gicp_settings),
    "objectives": ("paper", objective_settings),
}


def session_jobs_of(session: Session, known_rack: bool) -> list[Job]:
    """One job per trial, with the rack's exact pose if that is asked for."""
    jobs = session_jobs(session)[0]
    return with_exact_rack(jobs, session) if known_rack else jobs


def compare(
    sessions: Sequence[Session], method: str, settings: Iterator[tuple[str, Config]], *, known_rack: bool = False
) -> pd.DataFrame:
    """Summary rows per tube and setting."""
    truth = TruthTables()
    for session in sessions:
        measure_session(session, truth, GroundTruthConfig())
    models = {name: tube for session in sessions for name, tube in session.types.items()}
    jobs = [job for session in sessions for job in session_jobs_of(session, known_rack)]
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
    """Parse the arguments and print a Markdown table."""
    known_rack = "--known-rack" in sys.argv
    which, *folders = [text for text in sys.argv[1:] if text != "--known-rack"] or ["help"]
    if which not in GROUPS or not folders:
        sys.exit(__doc__)
    method, settings = GROUPS[which]
    require_methods([method])
    sessions = [load_session(Path(folder)) for folder in folders]
    with pinned_threads(1):
        table = compare(sessions, method, settings(), known_rack=known_rack)
    print("| " + " | ".join(table.columns) + " |")
    print("|" + "---|" * len(table.columns))
    for row in table.itertuples(index=False):
        print("| " + " | ".join(str(value) for value in row) + " |")


if __name__ == "__main__":
    main()
