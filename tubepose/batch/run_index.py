"""What the records in a folder are of: settings, labware, captures in order, and whether the run came to its end."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tubepose.batch.jobs import Job, UnnamedJob
from tubepose.batch.record_store import RecordFolder, digest_of
from tubepose.batch.schedule import Schedule
from tubepose.errors import ConfigError
from tubepose.labware import Labware, labware_sha256
from tubepose.result_folder import make_folder, write_aside

RECORDS = "records"
INDEX = "index.json"


@dataclass(frozen=True, slots=True)
class Shard:
    """One of several parts of a batch, from 1."""

    part: int
    parts: int

    def numbers(self, jobs: Sequence[Job | UnnamedJob]) -> list[int]:
        """Of the jobs in this part: every so many; sessions in which frames follow one another stay together."""
        following = {job.session for job in jobs if job.previous}
        groups: dict[object, int] = {}
        found = []
        for number, job in enumerate(jobs):
            key: object = job.session if job.session in following else number
            if groups.setdefault(key, len(groups)) % self.parts == self.part - 1:
                found.append(number)
        return found


def read_shard(text: str) -> Shard:
    """A part as it is typed, ``i/n`` with i from 1 to n.

    Raises:
        ConfigError: It is none.
    """
    match = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    if match is None or not 1 <= int(match[1]) <= int(match[2]):
        raise ConfigError(
            f"--shard {text}: expected i/n with i from 1 to n, for example 3/8 (the third of eight parts)"
        )
    return Shard(int(match[1]), int(match[2]))


@dataclass(frozen=True, slots=True)
class JobIndex:
    """A job's place in the batch, the keys of its records in order, and its problems."""

    number: int
    keys: tuple[str, ...] = ()
    problems: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class RunIndex:
    """What the records in a folder are of.

    Attributes:
        settings: Digests of what is asked of every frame and of the code, by what a person calls them.
        labware: Digests of the definitions that jobs name, by name.
        count: Jobs of the whole batch.
        shard: Which part of it this is.
        finished: Whether the run came to its end.
        jobs: Those that were done.
    """

    settings: dict[str, str]
    labware: dict[str, str]
    count: int
    shard: Shard = Shard(1, 1)
    finished: bool = False
    jobs: tuple[JobIndex, ...] = ()

    @property
    def digest(self) -> str:
        """Of the settings: a part of every record's key."""
        return digest_of(self.settings)

    def differences(self, other: RunIndex) -> list[str]:
        """What differs in a way that makes rows of both no rows of one run."""
        names = [name for name in self.settings | other.settings if self.settings.get(name) != other.settings.get(name)]
        both = self.labware.keys() & other.labware.keys()
        return names + [f"labware {name}" for name in sorted(both) if self.labware[name] != other.labware[name]]


def run_index(jobs: Sequence[Job | UnnamedJob], settings: Mapping[str, object], shard: Shard | None = None) -> RunIndex:
    """The index of a run that begins."""
    found: dict[str, Labware] = {tube.name: tube for job in jobs for tube in job.tubes}
    found |= {job.rack.name: job.rack for job in jobs if isinstance(job, Job)}
    labware = {name: labware_sha256(item) for name, item in found.items()}
    return RunIndex(
        {name: digest_of(value) for name, value in settings.items()}, labware, len(jobs), shard or Shard(1, 1)
    )


def indexed_jobs(schedule: Schedule) -> tuple[JobIndex, ...]:
    """What a schedule has done."""
    return tuple(JobIndex(number, tuple(keys), tuple(lines)) for number, keys, lines in schedule.results())


def open_records(out: Path, index: RunIndex, *, resume: bool, fresh: bool) -> tuple[RecordFolder, int]:
    """The records of a folder of results, emptied unless the run goes on; and how many it goes on with.

    Raises:
        ConfigError: There are records of an unfinished run, or of one with other settings, and it is not said what is
            to become of them.
        OutputError: The folder cannot be written.
    """
    make_folder(out / RECORDS)
    folder = RecordFolder(out / RECORDS)
    before, count = read_index(out), folder.count()
    if before is not None and count and not fresh:
        if resume and (differing := before.differences(index)):
            raise ConfigError(
                f"{out}: its {count} records are of a run that differs in {', '.join(differing)}; --fresh begins anew "
                "and removes them, or choose another folder"
            )
        if not resume and not before.finished:
            raise ConfigError(
                f"{out}: a run that came to no end has {count} finished frames there; --resume goes on with it, "
                "--fresh begins anew"
            )
    folder.clear((".*.part*",) if resume else ("*.json", ".*.part*"))
    write_index(out, index)
    return folder, count if resume else 0


def read_index(out: Path) -> RunIndex | None:
    """The index in a folder of results; None where there is none that this version reads."""
    try:
        data = json.loads((out / RECORDS / INDEX).read_bytes())
        jobs = tuple(JobIndex(int(one["number"]), tuple(one["keys"]), tuple(one["problems"])) for one in data["jobs"])
        if not all(re.fullmatch("[0-9a-f]{40}", key) for one in jobs for key in one.keys):
            return None
        shard = Shard(*map(int, data["shard"]))
        return RunIndex(
            dict(data["settings"]), dict(data["labware"]), int(data["count"]), shard, bool(data["finished"]), jobs
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None


def write_index(out: Path, index: RunIndex) -> None:
    """Write the index of a folder of results.

    Raises:
        OutputError: It cannot be written.
    """
    data: dict[str, Any] = {
        "settings": index.settings,
        "labware": index.labware,
        "count": index.count,
        "shard": [index.shard.part, index.shard.parts],
        "finished": index.finished,
        "jobs": [{"number": one.number, "keys": one.keys, "problems": one.problems} for one in index.jobs],
    }
    with write_aside(out / RECORDS / INDEX, make=False) as aside:
        aside.write_text(json.dumps(data, separators=(",", ":")), encoding="ascii")


def remove_empty(out: Path) -> None:
    """Take away the index and the folder of records that have none."""
    with suppress(OSError):
        (out / RECORDS / INDEX).unlink(missing_ok=True)
        (out / RECORDS).rmdir()


def merged_jobs(outs: Sequence[Path]) -> Iterator[tuple[JobIndex, Path]]:
    """The jobs of several folders of results in the order of the batch, each with the folder of its records.

    Raises:
        ConfigError: A folder has no finished run, or one of another batch; or two of them have done the same capture
            and differ.
    """
    indexes = [_finished(out) for out in outs]
    found: dict[int, tuple[JobIndex, Path]] = {}
    for out, index in zip(outs, indexes, strict=True):
        differing = indexes[0].differences(index) + (["captures"] if index.count != indexes[0].count else [])
        if differing:
            raise ConfigError(f"{out}: differs from {outs[0]} in {', '.join(differing)}; expected parts of one batch")
        for job in index.jobs:
            known = found.setdefault(job.number, (job, out))
            if known[0] != job:
                raise ConfigError(f"{out}: has done the same capture as {known[1]}, and differs; give one of them")
    yield from (found[number] for number in sorted(found))


def missing_parts(outs: Sequence[Path]) -> list[str]:
    """One line per part of a batch that is in none of the folders."""
    shards = [_finished(out).shard for out in outs]
    there = {shard.part for shard in shards if shard.parts == shards[0].parts}
    parts = shards[0].parts
    return [f"part {part}/{parts} is in none of the folders" for part in range(1, parts + 1) if part not in there]


def _finished(out: Path) -> RunIndex:
    index = read_index(out)
    if index is None:
        raise ConfigError(f"{out}: no records of a run there; expected a folder that 'tubepose estimate --out' wrote")
    if not index.finished:
        raise ConfigError(f"{out}: its run came to no end; run it again with --resume first")
    return index
