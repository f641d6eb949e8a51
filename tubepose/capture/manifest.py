"""The manifest of data sets: where each is from, the size and digest of every file, sensor, licence and split."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictInt, model_validator

from tubepose.errors import CaptureError
from tubepose.labware.reading import read_yaml, validate

Split = Literal["dev", "test"]
State = Literal["ok", "differs", "absent"]
_STRICT = ConfigDict(extra="forbid", frozen=True)
_SHA256 = Field(pattern=r"^[0-9a-f]{64}$")
_BLOCK = 1 << 20


class DataFile(BaseModel):
    """One file of a data set.

    Attributes:
        path: Relative to the data set's folder; the file's own name if the data set is one file.
        bytes: Its size.
        sha256: Its digest.
    """

    model_config = _STRICT
    path: str = Field(min_length=1)
    bytes: StrictInt = Field(ge=0)
    sha256: str = _SHA256


class DataSet(BaseModel):
    """One data set.

    Attributes:
        name: Unique in the manifest.
        path: File or folder, relative to the manifest's own folder.
        source: Where it is from: an address, or the command that made it.
        bytes: Size of all its files.
        sha256: Digest of the file; of a folder that of its listing (see `tree_sha256`).
        sensor: What recorded it.
        licence: SPDX name, or how it may be used.
        split: What it may be used for: ``dev`` to build and choose with, ``test`` to report only.
        simulated: True if no sensor recorded it.
        files: Every file, sorted by path.
    """

    model_config = _STRICT
    name: str = Field(min_length=1)
    path: str = Field(min_length=1)
    source: str = Field(min_length=1)
    bytes: StrictInt = Field(ge=0)
    sha256: str = _SHA256
    sensor: str = Field(min_length=1)
    licence: str = Field(min_length=1)
    split: Split
    simulated: StrictBool
    files: tuple[DataFile, ...]

    @model_validator(mode="after")
    def _check(self) -> DataSet:
        if self.bytes != sum(file.bytes for file in self.files):
            raise ValueError(f"{self.name}: bytes is {self.bytes}; expected the sum of its files")
        alone = len(self.files) == 1 and self.sha256 == self.files[0].sha256
        if not alone and self.sha256 != _listing_sha256((file.sha256, file.path) for file in self.files):
            raise ValueError(f"{self.name}: sha256 is not that of the listing of its files")
        return self


class Manifest(BaseModel):
    """All data sets that the project knows."""

    model_config = _STRICT
    format: Literal[2] = 2
    data_sets: tuple[DataSet, ...]


@dataclass(frozen=True, slots=True)
class Check:
    """A data set compared with its files.

    Attributes:
        data_set: Its entry in the manifest.
        state: ``ok``, ``differs``, or ``absent`` where nothing of it is there.
        differences: One line per file that differs, is missing or is not in the manifest.
    """

    data_set: DataSet
    state: State
    differences: tuple[str, ...] = ()


def read_manifest(path: Path) -> Manifest:
    """Read a manifest.

    Raises:
        CaptureError: Missing, or it breaks the format; one line that names the key.
    """
    manifest = validate(Manifest, read_yaml(path, CaptureError), str(path), CaptureError)
    names = [entry.name for entry in manifest.data_sets]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise CaptureError(f"{path}: names of data sets must be unique, found twice: {', '.join(doubled)}")
    return manifest


class _Line(dict[str, Any]):
    """A mapping that is written on one line."""


class _Dumper(yaml.SafeDumper):
    """YAML with a line per file."""


_Dumper.add_representer(
    _Line, lambda dumper, line: dumper.represent_mapping("tag:yaml.org,2002:map", line, flow_style=True)
)


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Write a manifest, one line per file: aside first, then renamed."""
    data = manifest.model_dump(mode="json")
    for entry in data["data_sets"]:
        entry["files"] = [_Line(file) for file in entry["files"]]
    text = yaml.dump(data, Dumper=_Dumper, sort_keys=False, width=10_000, allow_unicode=True)
    aside = path.with_name(f".{path.name}.part")
    aside.write_text(text, encoding="utf-8")
    aside.replace(path)


def with_entry(manifest: Manifest, entry: DataSet) -> Manifest:
    """The manifest with an entry in the place of the one of the same name, or at its end."""
    if entry.name in {known.name for known in manifest.data_sets}:
        kept = tuple(entry if known.name == entry.name else known for known in manifest.data_sets)
        return manifest.model_copy(update={"data_sets": kept})
    return manifest.model_copy(update={"data_sets": (*manifest.data_sets, entry)})


def check_data_set(entry: DataSet, root: Path) -> Check:
    """Compare a data set with what lies under `root`, file by file."""
    place = root / entry.path
    found = {file.path: file for file in _measured(place)} if place.exists() else {}
    if not found:
        return Check(entry, "absent")
    known = {file.path: file for file in entry.files}
    lines = []
    for path in sorted(found.keys() | known.keys()):
        where = f"{entry.name}: {entry.path if place.is_file() else f'{entry.path}/{path}'}"
        if path not in found:
            lines.append(f"{where}: missing; expected {known[path].bytes} bytes")
        elif path not in known:
            lines.append(f"{where}: not in the manifest")
        elif found[path].bytes != known[path].bytes:
            lines.append(f"{where}: {found[path].bytes} bytes; expected {known[path].bytes}")
        elif found[path].sha256 != known[path].sha256:
            lines.append(f"{where}: sha256 {found[path].sha256}; expected {known[path].sha256}")
    return Check(entry, "differs" if lines else "ok", tuple(lines))


def manifest_entry_for(
    place: Path, root: Path, *, name: str, source: str, sensor: str, licence: str, split: Split, simulated: bool
) -> DataSet:
    """Measure a file or folder under `root` and describe it.

    Raises:
        CaptureError: It is not there, or not under `root`.
    """
    # Not resolved: a folder of data may be a link to another disk.
    where, base = Path(os.path.abspath(place)), Path(os.path.abspath(root))
    if not place.exists() or not where.is_relative_to(base):
        raise CaptureError(f"{place}: expected an existing file or folder under {root}")
    files = _measured(place)
    return DataSet(
        name=name,
        path=where.relative_to(base).as_posix(),
        source=source,
        bytes=sum(file.bytes for file in files),
        sha256=files[0].sha256 if place.is_file() else _listing_sha256((file.sha256, file.path) for file in files),
        sensor=sensor,
        licence=licence,
        split=split,
        simulated=simulated,
        files=files,
    )


def file_sha256(path: Path) -> str:
    """Digest of one file; taken once per process for as long as its size and time stay."""
    found = path.stat()
    return _read_sha256(path, found.st_ino, found.st_size, found.st_mtime_ns)


@lru_cache(maxsize=100_000)
def _read_sha256(path: Path, *_state: int) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def tree_sha256(folder: Path, without: Path | None = None) -> str:
    """Digest of a folder: of the lines ``sha256  path`` of its files, sorted by path; as `sha256sum` prints them.

    Files and folders whose names start with a dot, and `__pycache__`, do not count, nor does a folder `without` in it.
    """
    left_out = None if without is None or without.resolve() == folder.resolve() else without.resolve()
    files = [
        (path, file) for path, file in _files(folder) if left_out is None or left_out not in file.resolve().parents
    ]
    return _listing_sha256((file_sha256(file), path) for path, file in files)


def _listing_sha256(files: Iterable[tuple[str, str]]) -> str:
    return hashlib.sha256(
        "".join(f"{digest}  {path}\n" for digest, path in files).encode("utf-8", "surrogateescape")
    ).hexdigest()


def _measured(place: Path) -> tuple[DataFile, ...]:
    return tuple(
        DataFile(path=path, bytes=file.stat().st_size, sha256=file_sha256(file)) for path, file in _files(place)
    )


def _files(place: Path) -> list[tuple[str, Path]]:
    """Files with their paths in the data set, sorted by those."""
    if place.is_file():
        return [(place.name, place)]
    found = [file for file in place.rglob("*") if file.is_file() and _counts(file.relative_to(place))]
    return sorted((file.relative_to(place).as_posix(), file) for file in found)


def _counts(relative: Path) -> bool:
    return not any(part.startswith(".") or part == "__pycache__" for part in relative.parts)
