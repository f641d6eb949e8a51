"""A lattice of slots that belongs to no rack's definition, and whether another pitch explains the points better."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from tubepose.config import Config
from tubepose.labware import RackModel, SlotGrid, SlotShape
from tubepose.rack.settling import Registration, register_at
from tubepose.transforms import FloatArray

# Nothing is known of the height of a top above its slots' floor: this much is assumed, and it may be off by as much.
ASSUMED_DEPTH_MM = 50.0
# Rows and columns that a lattice may have.
MOST_SLOTS = (26, 60)
# Other pitches that are tried, as shares of the one given, and how much more evidence tells that it is one of them.
PITCH_SHARES = (
    0.5, 2 / 3, 0.75, 0.8, 0.85, 0.89, 0.92, 0.94, 0.96, 0.975, 1.025, 1.04, 1.06, 1.08, 1.12, 1.17, 1.25, 1.5
)  # fmt: skip
OTHER_PITCH = 1.05
# No top ends with its outer openings: an outline that is measured a little too large has no row more.
LEAST_WALL_MM = 1.0


@dataclass(frozen=True, slots=True)
class SlotLattice:
    """What is known of a rack that has no definition.

    Attributes:
        pitch_mm: Distance of neighbouring slots, (x, y).
        slot: Their opening.
    """

    pitch_mm: tuple[float, float]
    slot: SlotShape

    def rack(self, rows: int, columns: int, walls_mm: tuple[float, float] | None = None) -> RackModel:
        """A rack of so many slots; `walls_mm` is the width of its top outside the outer openings along x and y."""
        pitch, size = np.array(self.pitch_mm), np.array(self.slot.size_mm)
        walls = np.maximum((pitch - size) if walls_mm is None else np.array(walls_mm), 0.5)
        outline = pitch * (np.array([columns, rows]) - 1) + size + 2 * walls
        return RackModel(
            kind="rack",
            name=f"grid-{rows}x{columns}",
            source="Slots seen in the capture; nothing is known of its height and its floor.",
            outline_mm=(float(outline[0]), float(outline[1])),
            height_mm=ASSUMED_DEPTH_MM + 1,
            floor_mm=1.0,
            floor_tolerance_mm=ASSUMED_DEPTH_MM,
            grid=SlotGrid(rows=rows, columns=columns, pitch_mm=self.pitch_mm, slot=self.slot),
        )

    def walls_mm(self, outline_mm: FloatArray, counts: NDArray[np.intp]) -> tuple[float, float]:
        """What so many columns and rows leave of a top (x, y) beside their outer openings, on each side."""
        across, along = (outline_mm - np.array(self.pitch_mm) * (counts - 1) - np.array(self.slot.size_mm)) / 2
        return float(across), float(along)


def countable(counts: NDArray[np.intp]) -> bool:
    """Whether a lattice can have so many columns and rows."""
    return bool(counts.min() >= 1 and counts[1] <= MOST_SLOTS[0] and counts[0] <= MOST_SLOTS[1])


def other_pitch(points_m: FloatArray, best: Registration, rack: RackModel, lattice: SlotLattice, config: Config) -> str:
    """A sentence where slots of another pitch explain the same top better; empty if none do."""
    size, outline = np.array(lattice.slot.size_mm), np.array(rack.outline_mm)
    likeliest, most = np.array(lattice.pitch_mm), OTHER_PITCH * best.agreement.evidence
    for axis, share in product(range(2), PITCH_SHARES):
        pitch = np.array(lattice.pitch_mm)
        pitch[axis] *= share
        counts = np.floor((outline - size - 2 * LEAST_WALL_MM) / pitch).astype(np.intp) + 1
        if np.any(pitch <= size) or not countable(counts):
            continue
        other = SlotLattice((float(pitch[0]), float(pitch[1])), lattice.slot)
        packed = other.rack(int(counts[1]), int(counts[0]), other.walls_mm(outline, counts))
        seen = register_at(points_m, best.fit.T_camera_rack, packed, config.rack).agreement
        evidence = seen.evidence_at(best.agreement.spacing_m)
        if evidence > most:
            likeliest, most = pitch, evidence
    if np.allclose(likeliest, lattice.pitch_mm):
        return ""
    given, found = (" x ".join(f"{side:.3g}" for side in sides) for sides in (lattice.pitch_mm, likeliest))
    return (
        f"slots {found} mm apart explain the points better than the pitch that is given, {given} mm: measure it again"
    )
