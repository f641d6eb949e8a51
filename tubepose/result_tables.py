"""The rows of a run, table by table, while it goes on."""

from __future__ import annotations

from dataclasses import dataclass, field

from tubepose.labware import Labware
from tubepose.records import Row


@dataclass(slots=True)
class Tables:
    """Rows of the result files, in the order in which they came.

    Attributes:
        racks: One per frame and method.
        sensor: One per frame.
        slots: One per frame, method and slot.
        estimates: One per frame, method, seed and detected tube.
        timings: One per timed stage instance.
        checks: One per check of a rack or of a tube, frame and method.
        labware_check: One per frame and size that it shows of a rack or of a type of tube.
        labware: Every rack and tube that was looked for, by name.
        problems: One line per capture that could not be finished.
        done: How many captures were finished or failed: all of them, but where the user stops the batch.
    """

    racks: list[Row] = field(default_factory=list)
    sensor: list[Row] = field(default_factory=list)
    slots: list[Row] = field(default_factory=list)
    estimates: list[Row] = field(default_factory=list)
    timings: list[Row] = field(default_factory=list)
    checks: list[Row] = field(default_factory=list)
    labware_check: list[Row] = field(default_factory=list)
    labware: dict[str, Labware] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    done: int = 0

    def lengths(self) -> tuple[int, ...]:
        """How many rows there are, table by table."""
        return tuple(len(rows) for rows in self._rows())

    def cut(self, lengths: tuple[int, ...]) -> None:
        """Leave out the rows that came after there were so many."""
        for rows, length in zip(self._rows(), lengths, strict=True):
            del rows[length:]

    def _rows(self) -> tuple[list[Row], ...]:
        return self.racks, self.sensor, self.slots, self.estimates, self.timings, self.checks, self.labware_check
