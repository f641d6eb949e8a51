"""`tubepose data`: the project's data sets and their manifest."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(help="Data sets: checked against the manifest.", no_args_is_help=True)


@app.callback()
def data() -> None:
    """Data sets: checked against the manifest."""


@app.command()
def verify(
    names: Annotated[
        list[str] | None, typer.Argument(help="Data sets that must be here; default: those that are.")
    ] = None,
    manifest: Annotated[Path, typer.Option(help="The manifest.")] = Path("data_manifest.yaml"),
    root: Annotated[Path | None, typer.Option(help="Folder of the data; default: the manifest's own.")] = None,
) -> None:
    """Compare every file of the data sets with its size and sha256 in the manifest."""
    import pandas as pd

    from tubepose.capture.manifest import check_data_set, read_manifest
    from tubepose.errors import CaptureError, ConfigError
    from tubepose_cli.inputs import unknown_name
    from tubepose_cli.show import finish, show_table

    if not manifest.is_file():
        raise CaptureError(f"{manifest}: no such file; name the manifest with --manifest FILE")
    sets = read_manifest(manifest).data_sets
    known = [entry.name for entry in sets]
    for name in names or ():
        if name not in known:
            raise ConfigError(unknown_name("data set", name, known))
    asked = [entry for entry in sets if not names or entry.name in names]
    checks = [check_data_set(entry, manifest.parent if root is None else root) for entry in asked]
    rows = [
        {
            "name": check.data_set.name,
            "split": check.data_set.split,
            "files": len(check.data_set.files),
            "bytes": check.data_set.bytes,
            "state": check.state,
        }
        for check in checks
    ]
    absent = [check.data_set for check in checks if check.state == "absent"]
    notes = [f"{entry.name} is not here; it comes from: {entry.source}" for entry in absent]
    show_table(pd.DataFrame(rows), f"Data sets of {manifest}", [] if names else notes)
    finish([*(line for check in checks for line in check.differences), *(notes if names else ())])
