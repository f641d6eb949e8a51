"""The options --hint and --hints: which way round racks stand that look the same when they are turned."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tubepose.batch import Job, UnnamedJob
    from tubepose.capture.hints import Hint, SlotHint
    from tubepose.labware import RackModel

COLUMNS = ("capture", "hint")


@dataclass(frozen=True)
class HintChoice:
    """What `--hint` and `--hints` say.

    Attributes:
        everywhere: The hint of every capture that has none of its own; None without `--hint`.
        of_capture: Hints by the name of their capture.
        file: Where they stand; None without `--hints`.
    """

    everywhere: Hint | None = None
    of_capture: Mapping[str, Hint] = field(default_factory=dict)
    file: Path | None = None

    def of(self, capture: str) -> tuple[SlotHint | None, bool]:
        """Where a slot is in a capture, and whether its rack stands as before."""
        hint = self.of_capture.get(capture, self.everywhere)
        return (hint.place, hint.previous) if hint is not None else (None, False)

    @property
    def options(self) -> list[str]:
        """The options that were given."""
        given = {"--hint": self.everywhere, "--hints": self.file}
        return [option for option, value in given.items() if value is not None]


def read_hints(texts: Sequence[str], file: Path | None, rack: RackModel | None) -> HintChoice:
    """The options ``--hint SLOT@PLACE``, ``--hint previous`` and ``--hints FILE.csv``.

    Whether a rack that is still to be named has the slots, the batch tells.
    """
    everywhere = _read(",".join(texts), "--hint", rack) if texts else None
    return HintChoice(everywhere, _read_file(file, rack) if file is not None else {}, file)


def refuse_unknown_captures(jobs: Iterable[Job | UnnamedJob], choice: HintChoice) -> None:
    """Every line of a file of hints is of a capture that is there.

    Raises:
        ConfigError: One is not: a wrong name would leave its capture without a hint.
    """
    from tubepose.errors import ConfigError

    names = list(dict.fromkeys(job.capture.name for job in jobs))
    unknown = [name for name in choice.of_capture if name not in names]
    if unknown:
        raise ConfigError(
            f"{choice.file}: no capture is named {unknown[0]}; the captures are {', '.join(names[:10])}"
            f"{', ...' if len(names) > 10 else ''}"
        )


def _read_file(file: Path, rack: RackModel | None) -> dict[str, Hint]:
    """Hints by capture, of a table with the columns capture and hint, by commas or semicolons."""
    from tubepose.errors import ConfigError

    try:
        lines = file.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as problem:
        raise ConfigError(f"{file}: cannot be read: {problem}") from None
    header = lines[0] if lines else ""
    rows = csv.DictReader(lines, delimiter=";" if ";" in header else ",", skipinitialspace=True)
    if sorted(rows.fieldnames or ()) != sorted(COLUMNS):
        raise ConfigError(f"{file}: expected a first line 'capture,hint', found '{header}'")
    hints: dict[str, Hint] = {}
    for row in rows:
        where = f"{file}, line {rows.line_num}"
        capture, text = row["capture"], row["hint"]
        if None in row:
            raise ConfigError(f'{where}: more than two columns; put a hint with commas into quotes: "A1@412,300"')
        if not text:
            raise ConfigError(f"{where}: capture {capture} has no hint; leave the line out")
        if capture in hints:
            raise ConfigError(f"{where}: capture {capture} is there twice")
        hints[capture] = _read(text, where, rack)
    return hints


def _read(text: str, where: str, rack: RackModel | None) -> Hint:
    from tubepose.capture.hints import read_hint
    from tubepose.errors import ConfigError

    said = f"{where} {text}" if where.startswith("--") else f"{where}: hint {text}"
    try:
        hint = read_hint(text)
    except ValueError as problem:
        raise ConfigError(f"{said}: {problem}") from None
    if hint.place is not None and rack is not None and not rack.has_slot(hint.place.slot):
        raise ConfigError(f"{said}: no slot {hint.place.slot} in rack {rack.name}; {rack.slot_words}")
    return hint
