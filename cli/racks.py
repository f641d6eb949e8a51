"""The option --rack: a rack by name or file, or how to find one out for each capture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tubepose.batch import RackFinder
    from tubepose.capture.frame import RgbdFrame
    from tubepose.config import Config
    from tubepose.labware import RackModel
    from tubepose.rack import RackPose
    from tubepose.rack.lattice import SlotLattice


SIDES_MM = (2.0, 200.0)
"""Least and largest pitch or opening that ``--rack grid`` takes: another number is of another unit."""


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
    low, high = SIDES_MM
    if len(sides) not in (1, 2) or not all(low <= side <= high for side in sides):
        raise ConfigError(
            f"{option} {text}: expected millimetres from {low:g} to {high:g} as X or XxY, for example 18.5x17.7"
        )
    return sides[0], sides[-1]


@dataclass(frozen=True)
class FindRack:
    """What finds the rack of a frame where ``--rack`` is ``auto`` or ``grid``; other processes can have it."""

    lattice: SlotLattice | None
    config: Config

    def __call__(self, frame: RgbdFrame) -> RackPose:
        from tubepose.rack.grid import register_grid
        from tubepose.rack.naming import name_rack

        points_m = frame.measured_m
        if self.lattice is not None:
            return register_grid(points_m, self.lattice, self.config, frame.intrinsics)
        pose, _ = name_rack(points_m, self.config, intrinsics=frame.intrinsics)
        return pose


def rack_finder(choice: RackChoice, config: Config) -> RackFinder:
    """What finds the rack of a frame where ``--rack`` is ``auto`` or ``grid``."""
    return FindRack(choice.lattice, config)
