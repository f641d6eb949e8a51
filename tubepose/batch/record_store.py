"""Where finished frames are kept: each in a file of its own that is there whole or not at all.

A record is found by what its rows depend on: the content of its capture, how it is read, labware, hints, what is asked
and the code. Other input has another key, so it is done again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from pydantic import BaseModel

from tubepose.batch.jobs import Job, UnnamedJob
from tubepose.batch.tasks import Ended, FrameRecord, KnownTurn, NamedRack, Outcome, Task
from tubepose.errors import OutputError
from tubepose.labware import Labware, labware_of
from tubepose.result_folder import write_aside
from tubepose.result_tables import TABLES, Tables

_FORMAT = 1


class Store(Protocol):
    """Records of frames by key."""

    def key(self, task: Task) -> str:
        """Of a frame's record: everything that its rows depend on."""
        ...

    def read(self, key: str) -> FrameRecord | None:
        """A record; None where there is none."""
        ...

    def write(self, key: str, record: FrameRecord) -> None:
        """Keep a record."""
        ...

    @property
    def writer(self) -> Callable[[str, FrameRecord], None]:
        """What keeps records, for another process."""
        ...

    def ended(self, number: int) -> int | None:
        """How many frames a job's capture has, where that was kept."""
        ...

    def end(self, number: int, count: int) -> None:
        """Keep that a capture has so many frames and that all are done."""
        ...


@dataclass(frozen=True, slots=True)
class MemoryStore:
    """Records of one run, kept in memory."""

    records: dict[str, FrameRecord] = field(default_factory=dict)

    def key(self, task: Task) -> str:
        """Number and position."""
        return f"{task.number}-{task.position}"

    def read(self, key: str) -> FrameRecord | None:
        """A record; None where there is none."""
        return self.records.get(key)

    def write(self, key: str, record: FrameRecord) -> None:
        """Keep a record."""
        self.records[key] = record

    @property
    def writer(self) -> Callable[[str, FrameRecord], None]:
        """What keeps records in this process."""
        return self.write

    def ended(self, number: int) -> int | None:  # noqa: ARG002
        """Never known before."""
        return None

    def end(self, number: int, count: int) -> None:
        """Nothing to keep."""


@dataclass(frozen=True, slots=True)
class RecordFolder:
    """Records as JSON files in a folder.

    Attributes:
        folder: `records/` in the folder of results.
    """

    folder: Path

    def read(self, key: str) -> FrameRecord | None:
        """A record; None where there is none, or one that this version does not read."""
        try:
            data = json.loads((self.folder / f"{key}.json").read_bytes())
            return _record(data)
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, key: str, record: FrameRecord) -> None:
        """Write a record aside and rename it.

        Raises:
            OutputError: It cannot be written, or the folder is gone.
        """
        with write_aside(self.folder / f"{key}.json", make=False) as aside:
            aside.write_text(json.dumps(_json(record), default=_plain, separators=(",", ":")), encoding="ascii")

    def count(self) -> int:
        """How many frames have a record."""
        return sum(len(path.stem) == _KEY_LENGTH for path in self.folder.glob("*.json"))

    def clear(self, patterns: Sequence[str] = ("*.json", ".*.part*")) -> None:
        """Remove all records and what was left beside them.

        Raises:
            OutputError: One of them cannot be removed.
        """
        try:
            for path in [path for pattern in patterns for path in self.folder.glob(pattern)]:
                path.unlink(missing_ok=True)
        except OSError as problem:
            raise OutputError(f"{self.folder}: cannot be emptied ({problem.strerror}); choose another folder") from None


_KEY_LENGTH = 40


@dataclass(frozen=True, slots=True)
class FolderStore:
    """A folder of records, with the keys of a batch.

    Attributes:
        folder: The records.
        jobs: All of the batch.
        asked: Digest of what is asked of every frame, and of the code.
        digest: Of the content of a capture; called once per capture.
        keys: Of the jobs, as they were needed.
        ends: Of the captures, as they were asked for.
    """

    folder: RecordFolder
    jobs: Sequence[Job | UnnamedJob]
    asked: str
    digest: Callable[[Path], str]
    keys: dict[int, str] = field(default_factory=dict)
    ends: dict[int, int | None] = field(default_factory=dict)

    def key(self, task: Task) -> str:
        """Digest of the job, the frame's position, the rack that was named and what earlier frames tell."""
        rest = [task.position, task.named, task.earlier if self.jobs[task.number].previous else None]
        return _sha256([self._job_key(task.number), rest])

    def read(self, key: str) -> FrameRecord | None:
        """A record; None where there is none."""
        return self.folder.read(key)

    def write(self, key: str, record: FrameRecord) -> None:
        """Write a record aside and rename it."""
        self.folder.write(key, record)

    @property
    def writer(self) -> Callable[[str, FrameRecord], None]:
        """What keeps records, for another process."""
        return self.folder.write

    def ended(self, number: int) -> int | None:
        """How many frames a capture has that was done to its end."""
        if number not in self.ends:
            record = self.folder.read(f"end-{self._job_key(number)}")
            self.ends[number] = None if record is None else int(record.outcome.reason)
        return self.ends[number]

    def end(self, number: int, count: int) -> None:
        """Write that a capture has so many frames and that all are done."""
        if self.ended(number) != count:
            self.folder.write(f"end-{self._job_key(number)}", FrameRecord(Outcome(Ended.NO_FRAME, reason=str(count))))
            self.ends[number] = count

    def _job_key(self, number: int) -> str:
        if number not in self.keys:
            job = self.jobs[number]
            outside = getattr(getattr(job.capture, "capture", job.capture), "outside", ())  # files that a folder names
            parts = {entry.name: getattr(job, entry.name) for entry in fields(job) if entry.name != "capture"}
            digests = [self.digest(path) for path in (job.capture.path, *outside)]
            self.keys[number] = _sha256([self.asked, digests, _words(job.capture), parts])
        return self.keys[number]


def digest_of(value: object) -> str:
    """SHA-256 of a value's words."""
    return hashlib.sha256(json.dumps(_words(value), sort_keys=True).encode()).hexdigest()


def _sha256(value: object) -> str:
    return digest_of(value)[:_KEY_LENGTH]


def _words(value: Any) -> Any:
    """A value as JSON that is the same in every process; places of files do not count, their content does."""
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if is_dataclass(value) and not isinstance(value, type):
        found = {entry.name: _words(getattr(value, entry.name)) for entry in fields(value) if entry.name != "path"}
        return {"": type(value).__name__, **found}
    if isinstance(value, Mapping):
        return {str(key): _words(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_words(item) for item in value]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return getattr(value, "__qualname__", None) or str(value)


def _json(record: FrameRecord) -> dict[str, Any]:
    outcome, named, turn = record.outcome, record.outcome.named, record.outcome.turn
    return {
        "format": _FORMAT,
        "ended": outcome.ended.value,
        "problem": outcome.problem,
        "reason": outcome.reason,
        "named": None if named is None else {"rack": named.rack.model_dump(mode="json"), "nats": named.nats},
        "turn": None if turn is None else asdict(turn),
        "labware": [item.model_dump(mode="json") for item in record.tables.labware.values()],
        "rows": {name: getattr(record.tables, name) for name in TABLES},
    }


def _record(data: Any) -> FrameRecord:
    if data["format"] != _FORMAT:
        raise ValueError("another format")
    named, turn = data["named"], data["turn"]
    rack: Any = labware_of(named["rack"]) if named is not None else None
    outcome = Outcome(
        Ended(data["ended"]),
        data["problem"],
        NamedRack(rack, named["nats"]) if named is not None else None,
        data["reason"],
        KnownTurn(turn["rack"], tuple(turn["pose"])) if turn is not None else None,
    )
    labware: list[Labware] = [labware_of(item) for item in data["labware"]]
    tables = Tables(labware={item.name: item for item in labware})
    for name in TABLES:
        getattr(tables, name).extend(data["rows"][name])
    return FrameRecord(outcome, tables)


def _plain(value: Any) -> Any:
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"a {type(value).__name__} has no place in a record")
