"""BOP results: rows ``scene_id,im_id,obj_id,score,R,t,time`` (BOP challenge, format of 6D localisation results)."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from tubepose.errors import ConfigError
from tubepose.foreign.mapping import ForeignMapping
from tubepose.labware import TubeModel
from tubepose.records import Row, pose_columns, transform_of
from tubepose.transforms import FloatArray

BOP_COLUMNS = ("scene_id", "im_id", "obj_id", "score", "R", "t", "time")
_NOT_ORTHONORMAL = 1e-2


def read_bop_results(path: Path, mapping: ForeignMapping, tubes: Mapping[str, TubeModel]) -> list[Row]:
    """Read a BOP results file.

    Args:
        path: The CSV file; R as nine numbers row by row, t as three numbers, mm.
        mapping: Trials of scenes, tubes of objects, origin and axis of the models.
        tubes: Models by name.

    Returns:
        One row per estimate: session, trial, method, tube, status, confidence and pose; no slot.

    Raises:
        ConfigError: A column is missing, a number is none, a rotation is none, or a scene or object is not mapped.
    """
    table = read_cells(path)
    missing = [name for name in BOP_COLUMNS[:6] if name not in table]
    if missing:
        raise ConfigError(f"{path}: column {', '.join(missing)} is missing; a BOP file has {','.join(BOP_COLUMNS)}")
    scale = 1.0 if mapping.unit == "m" else 1e-3
    rows: list[Row] = []
    for number, cells in enumerate(table.to_dict("records"), start=2):
        where = f"{path}: line {number}"
        trial = _trial(where, cells, mapping)
        tube = tubes.get(_tube_name(where, cells, mapping, tubes))
        T = np.eye(4)
        T[:3, :3] = rotation(where, numbers(where, "R", cells["R"], 9).reshape(3, 3))
        T[:3, 3] = numbers(where, "t", cells["t"], 3) * scale
        score = numbers(where, "score", cells["score"], 1)[0]
        session, _, name = trial.rpartition("/")
        rows.append({
            "session": session, "trial": name, "method": mapping.method or path.stem, "status": "ok",
            "tube": tube.name if tube is not None else None, "score": float(score),
            **pose_columns(T @ mapping.to_tube(tube)),
        })  # fmt: skip
    return rows


def _trial(where: str, cells: Mapping[Any, Any], mapping: ForeignMapping) -> str:
    scene, image = str(cells["scene_id"]).strip(), str(cells["im_id"]).strip()
    for key in (f"{scene}/{image}", scene):
        if key in mapping.scenes:
            return mapping.scenes[key]
    raise ConfigError(
        f"{where}: no trial is declared for scene_id {scene}, im_id {image}; add to the mapping file "
        f"'scenes: {{\"{scene}/{image}\": SESSION/TRIAL}}' (--mapping)"
    )


def _tube_name(where: str, cells: Mapping[Any, Any], mapping: ForeignMapping, tubes: Mapping[str, TubeModel]) -> str:
    number = int(numbers(where, "obj_id", cells["obj_id"], 1)[0])
    if number not in mapping.objects:
        raise ConfigError(
            f"{where}: no tube is declared for obj_id {number}; add to the mapping file "
            f"'objects: {{{number}: TUBE}}' (--mapping)"
        )
    name = mapping.objects[number]
    if name not in tubes:
        raise ConfigError(f"{where}: obj_id {number} is '{name}', which the truth does not name: {', '.join(tubes)}")
    return name


def numbers(where: str, name: str, text: Any, count: int) -> FloatArray:
    """`count` finite numbers of a cell, split at white space.

    Raises:
        ConfigError: There are others, or as many are not there.
    """
    try:
        values = np.array([float(word) for word in str(text).split()])
    except ValueError:
        values = np.empty(0)
    if len(values) != count or not np.isfinite(values).all():
        raise ConfigError(f"{where}: {name} '{text}'; expected {count} finite number{'s' if count > 1 else ''}")
    return values


def rotation(where: str, R: FloatArray) -> FloatArray:
    """The rotation nearest to a matrix (3, 3) that is one but for its rounding (polar decomposition).

    Raises:
        ConfigError: It is none: not orthonormal, or a reflection.
    """
    u, sizes, vt = np.linalg.svd(R)
    if np.abs(sizes - 1).max() > _NOT_ORTHONORMAL or np.linalg.det(R) < 0:
        raise ConfigError(f"{where}: R is no rotation (its determinant is {np.linalg.det(R):.3g}); expected row by row")
    return np.asarray(u @ vt)


def read_cells(path: Path) -> pd.DataFrame:
    """A CSV file with every cell as text.

    Raises:
        ConfigError: It is missing, or no CSV file.
    """
    try:
        return pd.read_csv(path, dtype="str", keep_default_na=False, skipinitialspace=True)
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file") from None
    except (OSError, ValueError) as problem:  # pandas' parser errors are ValueErrors
        raise ConfigError(f"{path}: cannot be read as a CSV file: {problem}") from None


def write_bop_results(
    estimates: pd.DataFrame, scenes: Mapping[tuple[str, str], tuple[int, int]], objects: Mapping[str, int]
) -> str:
    """Accepted estimates as the text of a BOP results file, one method of them; R row by row, t in mm, time -1.

    Args:
        estimates: Rows of estimates.csv; those that are ok, of a known type and of a trial in `scenes` are written.
        scenes: scene_id and im_id per session and trial.
        objects: obj_id per tube name.
    """
    lines = [",".join(BOP_COLUMNS)]
    for row in estimates[estimates["status"] == "ok"].to_dict("records"):
        key = (str(row["session"]), str(row["trial"]))
        if key not in scenes or row["tube"] not in objects:
            continue
        T = transform_of({str(name): value for name, value in row.items()})
        R = " ".join(repr(float(value)) for value in T[:3, :3].ravel())
        t = " ".join(repr(float(value)) for value in T[:3, 3] * 1e3)
        score = 1.0 if pd.isna(row["confidence"]) else float(row["confidence"])
        scene, image = scenes[key]
        lines.append(f"{scene},{image},{objects[row['tube']]},{score!r},{R},{t},-1")
    return "\n".join(lines) + "\n"
