"""What label tools write beside boxes: lists of class names, and names of pictures that they have changed.

Ultralytics and Roboflow: `data.yaml`. Darknet and CVAT: `obj.names`. Roboflow's darknet export: `_darknet.labels`.
Label Studio: `classes.txt` and `notes.json`. Roboflow calls `shot.png` `shot_png.rf.<hash>.jpg`, Label Studio
`<8 hex digits>-shot.png`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from tubepose.errors import DetectorError
from tubepose.labware.reading import read_json, read_yaml

CLASS_FILES = ("classes.txt", "obj.names", "data.yaml", "data.yml", "_darknet.labels", "notes.json")
"""Lists of class names, in the order in which they are looked for."""
_ROBOFLOW = re.compile(r"(.+)_(?:jpe?g|png|bmp|tiff?|webp)\.rf\.[0-9A-Za-z]{6,}", re.IGNORECASE)
_LABEL_STUDIO = re.compile(r"[0-9a-f]{8}-(.+)")
_T = TypeVar("_T")


def read_class_names(path: Path) -> tuple[str, ...]:
    """Class names in the order of their numbers, of a text file (one a line), a `data.yaml` or a `notes.json`.

    Raises:
        DetectorError: The file is missing or empty, or holds no names that are numbered from 0 without a gap.
    """
    if path.suffix.lower() in (".yaml", ".yml"):
        return _names_of_yaml(path)
    if path.suffix.lower() == ".json":
        return _names_of_notes(path)
    names = [line.strip() for line in read_text(path).splitlines()]
    while names and not names[-1]:
        names.pop()
    if not names:
        raise DetectorError(f"{path}: no class names; expected one name a line")
    if "" in names:
        raise DetectorError(
            f"{path}:{names.index('') + 1}: found an empty line, expected a class name; remove the line"
        )
    return tuple(names)


def find_class_file(folder: Path) -> Path | None:
    """The list of class names of a folder of labels: in it, or in one of the two folders above; None without one."""
    places = [folder, *folder.resolve().parents[:2]]
    found = (place / name for place in places for name in CLASS_FILES)
    return next((path for path in found if path.is_file()), None)


def picture_names(stem: str) -> tuple[str, ...]:
    """Names that a picture may have had before a label tool changed it, the name as it is first.

    Args:
        stem: Name of the picture or of its label file, without ending.
    """
    names = [stem]
    for pattern in (_ROBOFLOW, _LABEL_STUDIO, _ROBOFLOW):
        changed = pattern.fullmatch(names[-1])
        if changed is not None:
            names.append(changed[1])
    return tuple(names)


def by_picture_name(paths: Iterable[Path]) -> dict[str, list[Path]]:
    """Files by every name that their picture may have had."""
    found: dict[str, list[Path]] = {}
    for path in paths:
        for name in picture_names(path.stem):
            found.setdefault(name, []).append(path)
    return found


def read_text(path: Path) -> str:
    """Text of a file.

    Raises:
        DetectorError: It is missing or no text.
    """
    try:
        return path.read_text(encoding="utf-8-sig")  # label tools on Windows write a byte order mark
    except FileNotFoundError:
        raise DetectorError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as problem:
        raise DetectorError(f"{path}: cannot be read as text: {problem}") from None


def _names_of_yaml(path: Path) -> tuple[str, ...]:
    data = read_yaml(path, DetectorError)
    names, count = data.get("names"), data.get("nc")
    numbered: Mapping[Any, Any] = dict(enumerate(names)) if isinstance(names, list) else names or {}
    found = _in_order(path, numbered if isinstance(numbered, Mapping) else {}, "'names:', a list or 0: name, 1: name")
    if count is not None and count != len(found):
        raise DetectorError(f"{path}: 'nc: {str(count)[:20]}', but {len(found)} names; correct one of them")
    return found


def _names_of_notes(path: Path) -> tuple[str, ...]:
    entries = read_json(path, DetectorError).get("categories")
    known = [entry for entry in entries if isinstance(entry, Mapping)] if isinstance(entries, list) else []
    return _in_order(
        path, {str(entry.get("id")): entry.get("name") for entry in known}, "'categories' with id and name"
    )


def _in_order(path: Path, numbered: Mapping[Any, Any], expected: str) -> tuple[str, ...]:
    names = {str(number): name for number, name in numbered.items()}
    if not names or sorted(names, key=lambda n: (len(n), n)) != [str(i) for i in range(len(names))]:
        raise DetectorError(f"{path}: no class names; expected {expected}, numbered from 0")
    texts = [names[str(i)] for i in range(len(names))]
    if any(isinstance(name, dict | list | bool) or name is None or not str(name).strip() for name in texts):
        raise DetectorError(f"{path}: expected class names that are words, found {str(texts)[:120]}")
    return tuple(str(name).strip() for name in texts)
