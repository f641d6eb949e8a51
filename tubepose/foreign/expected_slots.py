"""What is declared to stand in the slots of a rack: CSV, session, JSON by slot, PyLabRobot."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from tubepose.capture.session import SESSION_FILE, is_session, load_session
from tubepose.errors import ConfigError
from tubepose.foreign.bop_results import read_cells

ANY_TUBE = "*"
_EMPTY = ("", "empty", "-", "none", "null")


def read_expected(path: Path, known: Collection[str]) -> pd.DataFrame:
    """Read a declared map.

    Formats: a CSV file with the columns slot and tube (and session, trial or capture where several are declared); a
    session folder or its session.yaml, trial by trial; a JSON object of slot names (A1, as Opentrons has them) to
    tubes; a PyLabRobot rack saved as JSON, whose spots hold tubes. ``*`` is a tube of any type; an empty cell, null or
    ``empty`` is none. A PyLabRobot tube whose model is not known is one of any type.

    Args:
        path: File or folder.
        known: Names of tubes that can be declared.

    Returns:
        Columns slot, expected, and session, trial or capture where the file has them.

    Raises:
        ConfigError: The file cannot be read, names a tube that is not known, or a slot twice.
    """
    if path.name == SESSION_FILE or is_session(path):
        table = _of_session(path)
    elif path.suffix.lower() == ".json":
        table = _of_json(path, known)
    else:
        table = _of_csv(path)
    others = sorted(set(table["expected"]) - {*known, ANY_TUBE, ""})
    if others:
        raise ConfigError(
            f"{path}: tube '{others[0]}' is none of those that can be found: {', '.join(sorted(known))}; '*' is any"
        )
    twice = table[table.duplicated([name for name in table.columns if name != "expected"])]
    if len(twice):
        raise ConfigError(f"{path}: slot {twice['slot'].iloc[0]} is declared twice; expected once per rack")
    return table


def _of_session(path: Path) -> pd.DataFrame:
    session = load_session(path)
    rows = [
        {"session": session.name, "trial": trial.name, "slot": slot, "expected": session.tubes[tube].name}
        for trial in session.trials
        for slot, tube in trial.tubes.items()
    ]
    return pd.DataFrame(rows, columns=["session", "trial", "slot", "expected"])


def _of_csv(path: Path) -> pd.DataFrame:
    cells = read_cells(path)
    missing = [name for name in ("slot", "tube") if name not in cells]
    if missing:
        raise ConfigError(f"{path}: column {', '.join(missing)} is missing; expected slot,tube")
    keys = [name for name in ("session", "trial", "capture") if name in cells]
    return cells.assign(expected=cells["tube"].map(_tube))[[*keys, "slot", "expected"]]


def _tube(text: Any) -> str:
    word = "" if text is None else str(text).strip()
    return "" if word.lower() in _EMPTY else word


def _of_json(path: Path, known: Collection[str]) -> pd.DataFrame:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as problem:
        raise ConfigError(f"{path}: cannot be read as JSON: {problem}") from None
    if isinstance(data, Mapping) and isinstance(data.get("children"), list):
        named = _of_pylabrobot(path, data, known)
    elif isinstance(data, Mapping) and data and all(isinstance(v, str | None) for v in data.values()):
        named = {str(slot): _tube(tube) for slot, tube in data.items()}
    else:
        raise ConfigError(
            f'{path}: expected an object of slots to tubes, {{"A1": "TUBE", "A2": null}}, or a PyLabRobot rack with '
            "its tubes; an Opentrons labware definition says where wells are, not what stands in them"
        )
    return pd.DataFrame({"slot": list(named), "expected": list(named.values())}, dtype="str")


def _of_pylabrobot(path: Path, data: Mapping[str, Any], known: Collection[str]) -> dict[str, str]:
    """Tubes in the spots of a saved rack; a spot's slot is named by `ordering`, or by the end of its name."""
    ordering = data.get("ordering")
    slots = {str(child): str(slot) for slot, child in ordering.items()} if isinstance(ordering, Mapping) else {}
    named: dict[str, str] = {}
    for spot in data["children"]:
        if not isinstance(spot, Mapping) or not isinstance(spot.get("name"), str):
            raise ConfigError(f"{path}: a child of the rack has no name; expected a PyLabRobot rack as it is saved")
        held = [child for child in spot.get("children") or [] if isinstance(child, Mapping)]
        model = str(held[0].get("model")) if held else ""
        name = str(spot["name"])
        slot = slots.get(name, name.rsplit("_", 1)[-1].rsplit("-", 1)[-1])
        named[slot] = (model if model in known else ANY_TUBE) if held else ""
    return named
