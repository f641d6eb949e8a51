"""The slot map: what stands in every slot of a rack, and how that differs from what was declared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from tubepose.evaluation.repeatability import FRAME_KEYS, transforms
from tubepose.labware import RackModel

ANY_TUBE = "*"
"""Declared where a tube of whatever type stands."""
FINDINGS = ("ok", "missing", "extra", "wrong_type", "tilted", "not_seated", "not_seen", "unclear")
MAP_COLUMNS = (*FRAME_KEYS, "method", "rack", "slot", "state", "p_occupied", "tube", "status", "tilt_deg", "seat_mm",
               "ambiguous")  # fmt: skip
_POSE = ["tx_m", "ty_m", "tz_m", "qw", "qx", "qy", "qz"]


@dataclass(frozen=True, slots=True)
class MapLimits:
    """When a tube does not stand as it should.

    Attributes:
        tilt_deg: Largest angle between a tube and the rack's normal.
        seat_mm: Largest height of a tube's bottom over the slot floor, or depth under it.
    """

    tilt_deg: float = 10.0
    seat_mm: float = 3.0


def slot_map(
    slots: pd.DataFrame, estimates: pd.DataFrame, racks: pd.DataFrame, rack_models: Mapping[str, RackModel]
) -> pd.DataFrame:
    """What stands in every slot of every frame.

    Args:
        slots: Rows of slots.csv of one method.
        estimates: Rows of estimates.csv of that method.
        racks: Rows of racks.csv of that method.
        rack_models: Racks by name, for the height over the slot floor; of others it is NaN.

    Returns:
        One row per frame and slot, columns MAP_COLUMNS; `seat_mm` is how far the tube's bottom is above the slot floor.
    """
    keys = [*FRAME_KEYS, "method"]
    rows = slots[[*keys, "slot", "state", "p_occupied", "tube", "status", "ambiguous"]]
    rows = rows.merge(racks[[*keys, "rack"]].drop_duplicates(keys), how="left", on=keys)
    posed = estimates[(estimates["status"] == "ok") & estimates["slot"].notna() & estimates[_POSE].notna().all(axis=1)]
    posed = posed.drop_duplicates([*keys, "slot"])[[*keys, "slot", "tilt_deg", *_POSE]]
    posed = posed.merge(racks[[*keys, "rack", *_POSE]].drop_duplicates(keys), on=keys, suffixes=("", "_rack"))
    T_rack_tube = np.linalg.inv(transforms(posed, "_rack")) @ transforms(posed)
    floors = [
        rack_models[rack].bottom_center_m(rack_models[rack].slot(slot))[2]
        if rack in rack_models and rack_models[rack].has_slot(slot)
        else np.nan
        for rack, slot in zip(posed["rack"], posed["slot"], strict=True)
    ]
    posed = posed.assign(seat_mm=1e3 * (T_rack_tube[:, 2, 3] - np.array(floors, dtype=float)))
    rows = rows.merge(posed[[*keys, "slot", "tilt_deg", "seat_mm"]], how="left", on=[*keys, "slot"])
    return rows[list(MAP_COLUMNS)]


def compare_map(found: pd.DataFrame, declared: pd.DataFrame, limits: MapLimits | None = None) -> pd.DataFrame:
    """The map beside the declared one.

    Args:
        found: Result of `slot_map`.
        declared: Columns slot, expected (a tube's name, `ANY_TUBE`, or empty), and session, trial or capture where the
            declaration differs between them; slots that are not listed are declared empty.
        limits: When a tube does not stand as it should.

    Returns:
        The map with the columns ``expected`` and ``finding``, one of FINDINGS; what stands wrong in the slot of a tube
        of the wrong type is ``wrong_type``. Rows of captures that are not declared are left out.
    """
    asked = limits or MapLimits()
    on = [name for name in ("session", "trial", "capture") if name in declared]
    rows = found.merge(declared[on].drop_duplicates(), on=on) if on else found
    rows = rows.merge(declared[[*on, "slot", "expected"]], how="left", on=[*on, "slot"])
    rows = rows.assign(expected=rows["expected"].fillna(""))
    return rows.assign(finding=[_finding(row, asked) for row in rows.to_dict("records")])


def _finding(row: Mapping[Any, Any], limits: MapLimits) -> str:
    if row["state"] in ("not_seen", "unclear"):
        return str(row["state"])
    if row["state"] == "empty":
        return "missing" if row["expected"] else "ok"
    if not row["expected"]:
        return "extra"
    accepted = row["status"] == "ok"
    if accepted and row["expected"] not in (ANY_TUBE, row["tube"]):
        return "wrong_type"
    if accepted and row["tilt_deg"] > limits.tilt_deg:
        return "tilted"
    if accepted and abs(row["seat_mm"]) > limits.seat_mm:
        return "not_seated"
    return "ok" if accepted or row["expected"] == ANY_TUBE else "unclear"


def grid(rows: pd.DataFrame, column: str) -> pd.DataFrame:
    """One frame's map as rows and columns of the rack, row A first; slots that have no such name come after it.

    Args:
        rows: Rows of one frame.
        column: What stands in the cells.
    """
    cells: dict[str, dict[int, str]] = {}
    numbers: set[int] = set()
    for row in rows.to_dict("records"):
        letter, number = str(row["slot"])[:1], str(row["slot"])[1:]
        line, place = (letter, int(number)) if letter.isalpha() and number.isdigit() else (str(row["slot"]), 1)
        cells.setdefault(line, {})[place] = str(row[column])
        numbers.add(place)
    names = sorted(numbers)
    table = [[line, *(cells[line].get(number, "") for number in names)] for line in sorted(cells)]
    return pd.DataFrame(table, columns=["", *map(str, names)], dtype="str")
