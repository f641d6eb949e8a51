"""Labware definitions from YAML files and from the built-in catalogue."""

from __future__ import annotations

import difflib
import hashlib
import json
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ValidationError

from tubepose.errors import LabwareError, TubePoseError
from tubepose.labware.other_standards import SIDE_SUFFIX, SideFile, complete_rack, read_foreign_rack, side_words
from tubepose.labware.racks import RackModel
from tubepose.labware.tubes import CapModel, TubeModel

Labware = RackModel | TubeModel | CapModel
_KINDS: dict[str, type[Labware]] = {"rack": RackModel, "tube": TubeModel, "cap": CapModel}
_M = TypeVar("_M", bound=BaseModel)
_L = TypeVar("_L", RackModel, TubeModel, CapModel)


LABWARE_SUFFIXES = (".yaml", ".yml", ".json")
"""Ends of the names of definition files: our own, and JSON of other standards."""
_LONGEST_QUOTE = 200
"""Characters of a wrong value that are told."""
_MOST_VALUES = 200_000
"""In a file: thousands of times what a rack of a thousand slots has."""
# What PyYAML raises for values that are not what their tag says, and for depths that are none.
_NO_YAML = (
    *(yaml.YAMLError, ValueError, OverflowError, RecursionError),
    *(AttributeError, TypeError, KeyError, IndexError),
)


class _Loader(yaml.SafeLoader):
    """Of two values for one key YAML keeps the last one, and so loses what was meant: refused instead."""

    def compose_mapping_node(self, anchor: Any) -> yaml.MappingNode:
        """As written, before merge keys (`<<`) bring in what a mapping may override."""
        node = super().compose_mapping_node(anchor)
        seen: set[tuple[str, str]] = set()
        for key, _ in node.value:
            if not isinstance(key, yaml.ScalarNode):
                continue
            if (key.tag, key.value) in seen:
                told = f"the key '{key.value}' is there twice"
                raise yaml.composer.ComposerError(None, None, told, key.start_mark)
            seen.add((key.tag, key.value))
        return node

    def get_single_node(self) -> yaml.Node | None:
        """The whole document, unless its aliases stand for more than anybody writes (a "billion laughs" file)."""
        node = super().get_single_node()
        most = max(_MOST_VALUES, self.index)  # characters: there is no value without one
        if node is not None and _expanded(node, {}) > most:
            told = f"its aliases stand for more than {most} values"
            raise yaml.composer.ComposerError(None, None, told, node.start_mark)
        return node


def _expanded(node: yaml.Node, known: dict[int, int]) -> int:
    """Values that a node stands for, what its aliases repeat counted each time; of a circle more than are allowed."""
    if isinstance(node, yaml.ScalarNode):
        return 1
    if id(node) not in known:
        known[id(node)] = sys.maxsize  # until it is counted: it holds itself
        parts = [part for pair in node.value for part in pair] if isinstance(node, yaml.MappingNode) else node.value
        known[id(node)] = 1 + sum(_expanded(part, known) for part in parts)
    return known[id(node)]


def labware_sha256(item: Labware) -> str:
    """SHA-256 of a definition's content, wherever it was read from."""
    return hashlib.sha256(item.model_dump_json().encode()).hexdigest()


def read_yaml(path: Path, error: type[TubePoseError]) -> dict[str, Any]:
    """Read one YAML mapping; raises `error` in one line if the file is missing, broken or no mapping."""
    try:
        data = yaml.load(path.read_text(encoding="utf-8"), _Loader)  # a SafeLoader
    except FileNotFoundError:
        raise error(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as problem:
        raise error(f"{path}: cannot be read: {problem}") from None
    except _NO_YAML as problem:
        told = problem if isinstance(problem, yaml.YAMLError | ValueError) else "a value is not what its tag says"
        raise error(f"{path}: not valid YAML: {told}") from None
    if not isinstance(data, dict):
        found = "nothing: the file is empty" if data is None else f"a {type(data).__name__}"
        raise error(f"{path}: expected a mapping of keys to values, found {found}")
    return data


def validate(model: type[_M], data: dict[str, Any], where: str, error: type[TubePoseError]) -> _M:
    """Check data against a strict model; raises `error` in one line that names the key and the known ones."""
    try:
        return model.model_validate(data)
    except ValidationError as problem:
        found = "; ".join(_explain(model, entry) for entry in problem.errors())
        raise error(f"{where}: {found}") from None


def _explain(model: type[BaseModel], entry: Any) -> str:
    place = ".".join(str(part) for part in entry["loc"])
    if entry["type"] == "extra_forbidden":
        known = _known_keys(model, entry["loc"][:-1])
        return f"unknown key '{place}'" + (f"; known keys: {', '.join(known)}" if known else "")
    if entry["type"] == "missing":
        return f"the key '{place}' is missing"
    if entry["type"] == "tuple_type":
        return f"{place}: expected a list in brackets, [..., ...] (found {repr(entry['input'])[:_LONGEST_QUOTE]})"
    message = entry["msg"].removeprefix("Value error, ")
    message = f"{place}: {message}" if place else message
    given = entry["input"]
    return (
        message
        if isinstance(given, dict | list) or entry["type"] == "value_error"
        else f"{message} (found {repr(given)[:_LONGEST_QUOTE]})"
    )


def _known_keys(model: type[BaseModel], place: Sequence[str | int]) -> list[str]:
    """Field names of the (nested) model that a place in the data belongs to."""
    for part in place:
        if isinstance(part, int) or part not in model.model_fields:
            continue
        inner = [
            t
            for t in _types_in(model.model_fields[part].annotation)
            if isinstance(t, type) and issubclass(t, BaseModel)
        ]
        if not inner:
            return []
        model = inner[0]
    return list(model.model_fields)


def _types_in(annotation: Any) -> list[Any]:
    arguments = getattr(annotation, "__args__", ())
    return [annotation] if not arguments else [t for argument in arguments for t in _types_in(argument)]


def read_json(path: Path, error: type[TubePoseError]) -> dict[str, Any]:
    """Read one JSON object; raises `error` in one line if the file is missing, broken or no object."""
    try:
        data = json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise error(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as problem:
        raise error(f"{path}: cannot be read: {problem}") from None
    except (ValueError, RecursionError) as problem:
        raise error(f"{path}: not valid JSON: {problem}") from None
    if not isinstance(data, dict):
        raise error(f"{path}: expected a JSON object, found a {type(data).__name__}")
    return data


def read_rack_json(path: Path) -> RackModel:
    """A rack of another standard, completed by its side file: `my_rack.json` by `my_rack.side.yaml`.

    Raises:
        LabwareError: No standard that is read, a side file that is missing or wrong, or a rack that cannot be.
    """
    rack = read_foreign_rack(read_json(path, LabwareError), str(path))
    side = path.with_name(path.stem + SIDE_SUFFIX)
    if not side.is_file():
        raise LabwareError(f"{path}: {side_words(rack, str(side))}")
    added = validate(SideFile, read_yaml(side, LabwareError), str(side), LabwareError)
    return validate(RackModel, complete_rack(rack, added, str(side)), f"{path} with {side.name}", LabwareError)


def labware_of(data: Mapping[str, Any]) -> Labware:
    """A definition from what `model_dump(mode="json")` made of it.

    Raises:
        ValueError: It is none.
    """
    model = _KINDS.get(str(data.get("kind")))
    if model is None:
        raise ValueError("no definition of labware")
    return model.model_validate(data)


def read_labware(path: Path) -> Labware:
    """Read one definition file: our own YAML, or JSON of another standard with its side file.

    Raises:
        LabwareError: The file is missing, is no YAML mapping, or breaks its model; one line that names the key.
    """
    if path.suffix.lower() == ".json":
        return read_rack_json(path)
    data = read_yaml(path, LabwareError)
    kind = data.get("kind")
    if not isinstance(kind, str) or kind not in _KINDS:
        raise LabwareError(f"{path}: expected 'kind: rack', 'kind: tube' or 'kind: cap', found {kind!r}")
    return validate(_KINDS[kind], data, str(path), LabwareError)


@cache
def catalogue() -> dict[str, Labware]:
    """All built-in definitions by name, sorted."""
    folder = files("tubepose.labware") / "catalogue"
    found = [read_labware(Path(str(entry))) for entry in folder.iterdir() if entry.name.endswith(".yaml")]
    return {item.name: item for item in sorted(found, key=lambda item: item.name)}


def _load(name_or_file: str, model: type[_L], kind: str, folder: Path | None) -> _L:
    known = {name: item for name, item in catalogue().items() if isinstance(item, model)}
    if name_or_file in known:
        return known[name_or_file]
    path = Path(name_or_file)
    if path.suffix in LABWARE_SUFFIXES:
        item = read_labware(folder / path if folder is not None else path)
        if not isinstance(item, model):
            raise LabwareError(f"{path}: expected a {kind}, found a {item.kind}")
        return item
    close = difflib.get_close_matches(name_or_file, known, n=1)
    guess = f"; did you mean '{close[0]}'?" if close else ""
    raise LabwareError(
        f"unknown {kind} '{name_or_file}'{guess}; known: {', '.join(known)}; or give a .yaml or .json file"
    )


def load_rack(name_or_file: str, folder: Path | None = None) -> RackModel:
    """A rack by catalogue name or by YAML file (relative to `folder` if given)."""
    return _load(name_or_file, RackModel, "rack", folder)


def load_tube(name_or_file: str, folder: Path | None = None) -> TubeModel:
    """A tube by catalogue name or by YAML file (relative to `folder` if given)."""
    return _load(name_or_file, TubeModel, "tube", folder)


def unique_tubes(tubes: Iterable[TubeModel], where: str) -> tuple[TubeModel, ...]:
    """The tubes, each once: two names or files can mean the same one.

    Raises:
        LabwareError: Two of them differ and have the same name, which no table could tell apart.
    """
    found: dict[str, TubeModel] = {}
    for tube in tubes:
        if found.setdefault(tube.name, tube) != tube:
            raise LabwareError(f"{where}: two different tubes are named '{tube.name}'; give one of them another name")
    return tuple(found.values())


def load_cap(name_or_file: str, folder: Path | None = None) -> CapModel:
    """A printed cap by catalogue name or by YAML file (relative to `folder` if given)."""
    return _load(name_or_file, CapModel, "cap", folder)
