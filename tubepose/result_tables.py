"""The rows of a run, table by table, while it goes on."""

from __future__ import annotations

from dataclasses import dataclass, field

from tubepose.labware import Labware
from tubepose.records import Row

TABLES = ("racks", "sensor", "slots", "estimates", "timings", "checks", "labware_check")
"""Names of those that have rows."""


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
        problems: One line per frame or capture that could not be done.
        done: How many frames there are rows of.
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

    def add(self, other: Tables) -> None:
        """Add the rows and the labware of others."""
        for name in TABLES:
            getattr(self, name).extend(getattr(other, name))
        self.labware |= other.labware
