"""The option --rack: a rack by name or file, or how to find one out for each capture."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tubepose.batch import Job
    from tubepose.capture.source import Capture
    from tubepose.config import Config
    from tubepose.labware import RackModel
    from tubepose.rack.lattice import SlotLattice

# Stands in a job until its rack is found.
UNKNOWN = "chen2023-soft-5x10"


@dataclass(frozen=True)
class RackChoice:
    """What `--rack` says: a rack, or how to find one out for each capture.

    Attributes:
        rack: The rack, where it is named.
        lattice: Pitch and opening of ``--rack grid``; None otherwise.
        auto: True for ``--rack auto``.
    """

    rack: RackModel | None = None
    lattice: SlotLattice | None = None
    auto: bool = False

    @property
    def open(self) -> bool:
        """Whether the rack is only known once a capture was looked at."""
        return self.auto or self.lattice is not None


def read_rack(name: str | None, pitch: str | None, slot: str | None) -> RackChoice:
    """The options ``--rack NAME|FILE|auto|grid``, ``--pitch X[xY]``, ``--slot square:SIDE[xSIDE]|round:DIAMETER``."""
    from tubepose.errors import ConfigError
    from tubepose.labware import load_rack

    if name != "grid" and (pitch is not None or slot is not None):
        raise ConfigError("--pitch and --slot go with --rack grid")
    if name is None:
        return RackChoice()
    if name == "auto":
        return RackChoice(auto=True)
    if name == "grid":
        if pitch is None or slot is None:
            raise ConfigError("--rack grid needs --pitch and --slot, for example --pitch 18.5x17.7 --slot square:16.5")
        return RackChoice(lattice=_lattice(pitch, slot))
    return RackChoice(rack=load_rack(name))


def _lattice(pitch: str, slot: str) -> SlotLattice:
    from tubepose.errors import ConfigError
    from tubepose.labware import SlotShape
    from tubepose.rack.lattice import SlotLattice

    shape, _, size = slot.partition(":")
    if shape not in ("square", "round"):
        raise ConfigError(f"--slot {slot}: expected square:SIDE, square:SIDExSIDE or round:DIAMETER, millimetres")
    pitch_mm, size_mm = _sides("--pitch", pitch), _sides("--slot", size)
    if shape == "round" and size_mm[0] != size_mm[1]:
        raise ConfigError(f"--slot {slot}: a round slot has one diameter")
    if size_mm[0] >= pitch_mm[0] or size_mm[1] >= pitch_mm[1]:
        raise ConfigError(f"--pitch {pitch}, --slot {slot}: the openings must be smaller than their pitch")
    return SlotLattice(pitch_mm, SlotShape(shape="square" if shape == "square" else "round", size_mm=size_mm))


def _sides(option: str, text: str) -> tuple[float, float]:
    from tubepose.errors import ConfigError

    try:
        sides = [float(side) for side in text.split("x")]
    except ValueError:
        sides = []
    if len(sides) not in (1, 2) or min(sides) <= 0:
        raise ConfigError(f"{option} {text}: expected millimetres as X or XxY, for example 18.5x17.7")
    return sides[0], sides[-1]


def find_rack(capture: Capture, choice: RackChoice, config: Config) -> tuple[RackModel, float]:
    """The rack of a capture whose rack is not named, from its first frame; and the margin by which it was named.

    Raises:
        CaptureError: No rack can be named, or no slots are found; the reason holds the ranking.
    """
    from tubepose.errors import CaptureError
    from tubepose.provenance import pinned_threads
    from tubepose.rack.grid import register_grid
    from tubepose.rack.naming import name_rack

    frame = next(iter(capture.frames()), None)
    if frame is None:
        raise CaptureError(f"{capture.path}: no frame to find the rack in")
    points_m = frame.points_m[frame.valid]
    with pinned_threads(1):
        if choice.lattice is not None:
            pose = register_grid(points_m, choice.lattice, config, frame.intrinsics)
        else:
            pose, _ = name_rack(points_m, config, intrinsics=frame.intrinsics)
    if pose.rack is None or pose.T_camera_rack is None:
        raise CaptureError(f"{capture.path}: {pose.reason}")
    return pose.rack, pose.named_by_margin


def find_racks(
    jobs: Iterable[Job], choice: RackChoice, config: Config, *, fail_fast: bool, say: Callable[[str], None]
) -> tuple[list[Job], list[str]]:
    """The jobs with the racks that are found in their captures, and one line per capture that has none."""
    from tubepose.errors import TubePoseError

    found, problems = [], []
    for job in jobs:
        try:
            rack, margin = find_rack(job.capture, choice, config)
        except TubePoseError as problem:
            if fail_fast:
                raise
            problems.append(str(problem))
            continue
        by = f", by a margin of {margin:.0%}" if choice.auto else ""
        say(f"{job.capture.name}: rack {rack.name} found{by}")
        found.append(replace(job, rack=rack, named_by_margin=margin))
    return found, problems
