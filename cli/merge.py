"""`tubepose merge`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from tubepose_cli.paths import named

KEPT = ("config", "detector", "inputs_sha256", "methods", "problems", "seeds", "threads")
"""Of run.json, what the parts have in common or add to one another."""


def merge(
    folders: Annotated[
        list[Path],
        typer.Argument(parser=named, metavar="FOLDERS", help="Results of the parts: --out of each estimate --shard."),
    ],
    out: Annotated[
        Path,
        typer.Option(parser=named, metavar="PATH", help="Folder for the results; nothing is written anywhere else."),
    ],
) -> None:
    """Join the parts of a batch that were run with --shard: the same tables as those of one run."""
    from tubepose.batch.record_store import RecordFolder
    from tubepose.batch.run_index import RECORDS, merged_jobs, missing_parts
    from tubepose.batch.running import add_records
    from tubepose.config import Config
    from tubepose.errors import ConfigError
    from tubepose.result_folder import held_folder
    from tubepose.result_tables import Tables
    from tubepose_cli.results import RunWords, copy_results, tell_results, write_results
    from tubepose_cli.show import finish

    if any(folder.resolve() == out.resolve() for folder in folders):
        raise ConfigError(f"{out}: is one of the parts; choose another folder for the results")
    jobs = list(merged_jobs(folders))
    missing = missing_parts(folders)
    tables, runs = Tables(), [read_run(folder) for folder in folders]
    with held_folder(out):
        for job, folder in jobs:
            add_records(tables, RecordFolder(folder / RECORDS).read, job.keys)
            tables.problems += job.problems
        copy_results(jobs, folders, out)
        before = list(dict.fromkeys(line for run in runs for line in run["problems"] if line not in tables.problems))
        more: dict[str, Any] = {name: runs[0][name] for name in ("detector", "methods", "seeds", "threads")}
        used = {path: digest for run in runs for path, digest in run["inputs_sha256"].items()}
        words = RunWords(sys.argv, Config.model_validate(runs[0]["config"]), tuple(tables.labware.values()), used)
        problems = [*before, *tables.problems, *missing]
        write_results(tables, out, words, {**more, "problems": problems, "merged": [str(f) for f in folders]})
        tell_results(tables)
    finish(problems)


def read_run(folder: Path) -> dict[str, Any]:
    """run.json of a folder of results."""
    import json

    from tubepose.errors import ConfigError

    try:
        found = json.loads((folder / "run.json").read_bytes())
        return {
            name: found[name]
            for name in ("config", "detector", "inputs_sha256", "methods", "problems", "seeds", "threads")
        }
    except (OSError, ValueError, KeyError, TypeError):
        raise ConfigError(f"{folder}: no run.json of a run there; expected a folder of results") from None
