"""The manifest of data sets: where each is from, its size and digest, sensor, licence and split."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictInt

from tubepose.errors import CaptureError
from tubepose.labware.reading import read_yaml, validate

Split = Literal["sample", "train", "validation", "test"]
_STRICT = ConfigDict(extra="forbid", frozen=True)
_BLOCK = 1 << 20


class DataSet(BaseModel):
    """One data set.

    Attributes:
        name: Unique in the manifest.
        path: File or folder, relative to the manifest's own folder.
        source: Where it is from: an address, or the command that made it.
        bytes: Size of all its files.
        files: How many files it has.
        sha256: Digest of the file; of a folder that of its listing (see `tree_sha256`).
        sensor: What recorded it.
        licence: SPDX name, or how it may be used.
        split: What it may be used for; parameters are never fitted to ``test``.
        simulated: True if no sensor recorded it.
    """

    model_config = _STRICT
    name: str = Field(min_length=1)
    path: str = Field(min_length=1)
    source: str = Field(min_length=1)
    bytes: StrictInt = Field(ge=0)
    files: StrictInt = Field(ge=0)
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$")
    sensor: str = Field(min_length=1)
    licence: str = Field(min_length=1)
    split: Split
    simulated: StrictBool


class Manifest(BaseModel):
    """All data sets that the project knows."""

    model_config = _STRICT
    format: Literal[1] = 1
    data_sets: tuple[DataSet, ...]


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


def write_manifest(path: Path, manifest: Manifest) -> None:
    """Write a manifest: aside first, then renamed."""
    text = yaml.safe_dump(manifest.model_dump(mode="json"), sort_keys=False, width=120, allow_unicode=True)
    aside = path.with_name(f".{path.name}.part")
    aside.write_text(text, encoding="utf-8")
    aside.replace(path)


def verify_manifest(manifest: Manifest, root: Path) -> list[str]:
    """Compare every data set with what lies under `root`; one line per difference, none if all is well."""
    problems = []
    for entry in manifest.data_sets:
        place = root / entry.path
        if not place.exists():
            problems.append(f"{entry.name}: {entry.path} is not there; it is from {entry.source}")
            continue
        size, count, digest = measure(place)
        if (size, count) != (entry.bytes, entry.files):
            problems.append(
                f"{entry.name}: {entry.path} has {size} bytes in {count} file(s), the manifest says {entry.bytes} in "
                f"{entry.files}"
            )
        elif digest != entry.sha256:
            problems.append(f"{entry.name}: {entry.path} has the sha256 {digest}, the manifest says {entry.sha256}")
    return problems


def manifest_entry_for(
    place: Path, root: Path, *, name: str, source: str, sensor: str, licence: str, split: Split, simulated: bool
) -> DataSet:
    """Measure a file or folder under `root` and describe it.

    Raises:
        CaptureError: It is not there, or not under `root`.
    """
    if not place.exists() or not place.resolve().is_relative_to(root.resolve()):
        raise CaptureError(f"{place}: expected an existing file or folder under {root}")
    size, count, digest = measure(place)
    return DataSet(
        name=name,
        path=place.resolve().relative_to(root.resolve()).as_posix(),
        source=source,
        bytes=size,
        files=count,
        sha256=digest,
        sensor=sensor,
        licence=licence,
        split=split,
        simulated=simulated,
    )


def measure(place: Path) -> tuple[int, int, str]:
    """Bytes, number of files, and sha256 of a file or folder."""
    files = _files(place)
    digest = file_sha256(place) if place.is_file() else tree_sha256(place)
    return sum(file.stat().st_size for file in files), len(files), digest


def file_sha256(path: Path) -> str:
    """Digest of one file."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def tree_sha256(folder: Path) -> str:
    """Digest of a folder: of the lines ``sha256  path`` of its files, sorted by path; as `sha256sum` prints them.

    Files and folders whose names start with a dot, and `__pycache__`, do not count.
    """
    lines = [f"{file_sha256(file)}  {file.relative_to(folder).as_posix()}\n" for file in _files(folder)]
    return hashlib.sha256("".join(lines).encode("utf-8")).hexdigest()


def _files(place: Path) -> list[Path]:
    if place.is_file():
        return [place]
    found = [file for file in place.rglob("*") if file.is_file() and _counts(file.relative_to(place))]
    return sorted(found, key=lambda file: file.relative_to(place).as_posix())


def _counts(relative: Path) -> bool:
    return not any(part.startswith(".") or part == "__pycache__" for part in relative.parts)
