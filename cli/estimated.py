"""Tables of a run: read from its folder, or made by estimating captures first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tubepose.batch import Job, UnnamedJob


@dataclass(frozen=True, slots=True)
class Asked:
    """What was typed of an estimate."""

    rack: str | None
    tubes: str | None
    method: str
    detector: str


def run_folder(paths: Sequence[Path], asked: Asked, out: Path) -> tuple[Path, list[str]]:
    """Folder with the tables, and one line per capture that could not be done.

    One path that is the folder of a run is taken as it is; captures are estimated into `out`.
    """
    from tubepose.batch import Asked as Question
    from tubepose.config import load_config
    from tubepose.errors import kept
    from tubepose.result_folder import held_folder
    from tubepose_cli.inputs import (
        DetectorChoice,
        capture_jobs,
        read_methods,
        read_tubes,
        refuse_twins,
        sessions_below,
    )
    from tubepose_cli.racks import read_rack
    from tubepose_cli.results import RunOptions, run_estimates
    from tubepose_cli.show import finish

    if len(paths) == 1 and (paths[0] / "estimates.csv").is_file() and (paths[0] / "racks.csv").is_file():
        return paths[0], []
    settings = load_config(None)
    choice, tubes = read_rack(asked.rack, None, None), read_tubes(asked.tubes) if asked.tubes is not None else ()
    jobs: list[Job | UnnamedJob] = []
    problems: list[str] = []
    for path in [found for one in paths for found in (sessions_below(one) or [one])]:
        with kept(problems):
            found, unread = capture_jobs(path, choice, tubes, settings)
            distinct, twins = refuse_twins(found, jobs)
            jobs += distinct
            problems += [*unread, *twins]
    if not jobs:
        finish(problems)
    source = DetectorChoice(asked.detector, None, None, None, None, settings)
    with held_folder(out):
        tables = run_estimates(
            jobs, Question(tuple(read_methods(asked.method)), settings, 1), source, out,
            RunOptions(fresh=True, overlays=False), problems=problems,
        )  # fmt: skip
    return out, [*problems, *tables.problems]


def read_tables(folder: Path, *names: str) -> list[object]:
    """Tables of a run by name."""
    import pandas as pd

    from tubepose.errors import ConfigError

    texts = dict.fromkeys(("session", "trial", "capture", "slot", "tube", "method", "status", "state", "reason"), "str")
    tables: list[object] = []
    for name in names:
        try:
            table = pd.read_csv(folder / f"{name}.csv", dtype=texts)
        except (OSError, ValueError) as problem:
            raise ConfigError(
                f"{folder / name}.csv: cannot be read: {problem}; expected a folder of estimate"
            ) from None
        tables.append(
            table.assign(**{key: table[key].fillna("") for key in ("session", "trial", "capture") if key in table})
        )
    return tables
