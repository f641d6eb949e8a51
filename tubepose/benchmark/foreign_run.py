"""Anybody's estimates judged as ours are: same tables, same counting of failures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from tubepose.benchmark.judgement import Judgement, count_lines, judge, write_tables
from tubepose.benchmark.measured import Progress, measure_sessions, silent
from tubepose.benchmark.notes import confusion_notes, uncertainty_notes
from tubepose.capture.session import is_session
from tubepose.errors import CaptureError, ConfigError
from tubepose.foreign import ForeignMapping, read_estimates, read_truth, with_slots
from tubepose.foreign.slot_matching import MATCH_MM
from tubepose.labware import TubeModel, load_tube
from tubepose.report.tables import Table, accuracy_table
from tubepose.report.writing import make_folder, write_csv

_MOST_NAMED = 5


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Result of judging estimates from files.

    Attributes:
        judgement: Tables of estimates against truth.
        estimates: Rows of estimates.csv, with the slots that they were given.
        truth: Rows of ground_truth.csv.
        accuracy: The table for a reader.
        problems: One line per thing that could not be judged.
    """

    judgement: Judgement
    estimates: pd.DataFrame
    truth: pd.DataFrame
    accuracy: Table
    problems: tuple[str, ...]

    def write(self, out: Path) -> None:
        """Write all tables.

        Raises:
            ConfigError: The folder cannot be written.
        """
        make_folder(out)
        write_csv(out / "estimates.csv", self.estimates)
        write_csv(out / "ground_truth.csv", self.truth)
        self.judgement.write(out)
        write_tables(out, {"accuracy": self.accuracy})


@dataclass(frozen=True, slots=True)
class EvaluateOptions:
    """How estimates are read and matched.

    Attributes:
        mapping: Names and conventions of the files.
        tubes: Tube models by name where the truth is a table; the catalogue's are known.
        match_mm: Estimates without a slot claim a true tube no farther than this.
        exact_truth: Judge by the exact poses of simulated sessions.
    """

    mapping: ForeignMapping = field(default_factory=ForeignMapping)
    tubes: tuple[TubeModel, ...] = ()
    match_mm: float = MATCH_MM
    exact_truth: bool = False


def evaluate(
    estimates: Sequence[Path | str],
    truth: Sequence[Path | str],
    out: Path | str | None = None,
    *,
    options: EvaluateOptions | None = None,
    progress: Progress = silent,
) -> Evaluation:
    """Judge estimates of any origin, as ``tubepose evaluate`` does.

    Args:
        estimates: Files (our columns as CSV or JSON, BOP results, TUM rows) or folders of runs that hold estimates.csv.
        truth: Session folders, or one ground_truth.csv.
        out: Folder for the tables; None to write nothing.
        options: How they are read and matched.
        progress: Shows how far the measuring of the truth is.

    Returns:
        The tables, as `bench` gives them.

    Raises:
        ConfigError: A file is not as expected, or nothing in it is of a trial with truth.
        CaptureError: A session cannot be read or has no truth.
    """
    asked = options or EvaluateOptions()
    true, tubes, problems = _truth([Path(path) for path in truth], asked, progress)
    tables = [_of_sessions(path, _read(path, asked.mapping, tubes), true, problems) for path in map(Path, estimates)]
    _refuse_twins(tables, estimates)
    rows = with_slots(pd.concat(tables, ignore_index=True), true, asked.match_mm)
    methods = [str(name) for name in rows["method"].unique()]
    judgement = judge(rows, true, tubes, methods)
    notes = [f"Counts, {line}." for line in count_lines(judgement)]
    notes += [*uncertainty_notes(judgement.errors, asked.exact_truth), *confusion_notes(judgement.errors)]
    found = Evaluation(judgement, rows, true, accuracy_table(judgement.summary, notes), tuple(problems))
    if out is not None:
        found.write(Path(out))
    return found


def _truth(
    paths: Sequence[Path], options: EvaluateOptions, progress: Progress
) -> tuple[pd.DataFrame, dict[str, TubeModel], list[str]]:
    """The truth, the models of its tubes, and what could not be measured."""
    if len(paths) == 1 and paths[0].suffix.lower() == ".csv":
        table, known = read_truth(paths[0]), {tube.name: tube for tube in options.tubes}
        names = dict.fromkeys(table["tube"])
        return table, known | {name: known.get(name) or load_tube(name, paths[0].parent) for name in names}, []
    for path in paths:
        if not is_session(path.parent if path.is_file() else path):
            raise CaptureError(f"{path}: no session there; --truth takes session folders or one ground_truth.csv")
    folders = [path.parent if path.is_file() else path for path in paths]
    measured = measure_sessions(folders, None, exact=options.exact_truth, progress=progress)
    if not len(measured.truth):
        why = "; ".join(measured.problems) or "no trial has a capture with printed caps"
        raise CaptureError(f"{', '.join(map(str, paths))}: no truth: {why}")
    tubes = {name: tube for session in measured.sessions for name, tube in session.types.items()}
    return measured.truth, tubes, list(measured.problems)


def _read(path: Path, mapping: ForeignMapping, tubes: Mapping[str, TubeModel]) -> pd.DataFrame:
    """Estimates of a file, or of a run's folder, whose own rows need no mapping."""
    if path.is_dir():
        return read_estimates(path / "estimates.csv", ForeignMapping(), tubes)
    return read_estimates(path, mapping, tubes)


def _of_sessions(path: Path, rows: pd.DataFrame, truth: pd.DataFrame, problems: list[str]) -> pd.DataFrame:
    """Rows of trials with truth; a session that is not named is the one that has such a trial, if only one has."""
    if rows.empty:
        raise ConfigError(f"{path}: no row in it; expected one per estimate")
    trials = truth[["session", "trial"]].drop_duplicates()
    alone = trials[~trials.duplicated("trial", keep=False)].set_index("trial")["session"]
    unnamed = rows["session"].fillna("") == ""
    rows = rows.assign(session=rows["session"].mask(unnamed, rows["trial"].map(alone)).fillna(""))
    known = pd.MultiIndex.from_frame(rows[["session", "trial"]]).isin(pd.MultiIndex.from_frame(trials))
    others = list(dict.fromkeys(rows.loc[~known, "trial"]))
    if others:
        named = f"{', '.join(map(str, others[:_MOST_NAMED]))}{', ...' if len(others) > _MOST_NAMED else ''}"
        have = f"{', '.join(map(str, trials['trial'][:_MOST_NAMED]))}{', ...' if len(trials) > _MOST_NAMED else ''}"
        count = f"{(~known).sum()} of {len(rows)} rows"
        words = f"{path}: {count} are of trials without truth: {named}; the truth has {have}"
        if not known.any():
            raise ConfigError(words)
        problems.append(words)
    return rows[known]


def _refuse_twins(tables: Sequence[pd.DataFrame], paths: Sequence[Path | str]) -> None:
    """One name has to mean one estimator.

    Raises:
        ConfigError: Two files hold rows of the same method.
    """
    seen: dict[str, Path | str] = {}
    for table, path in zip(tables, paths, strict=True):
        for method in map(str, table["method"].unique()):
            if method in seen:
                raise ConfigError(
                    f"{path}: method '{method}' is that of {seen[method]}, too; name it in a column 'method', or in "
                    "a mapping file, 'method: NAME'"
                )
            seen[method] = path
