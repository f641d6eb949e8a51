"""A rack whose sizes are not known: found by its lattice or like another one, then registered and resized in turns.

A registration measures how a face differs from its definition (`rack.size`); the definition takes that over, and so on
until nothing changes: what is found does not depend on where it began.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tubepose.config import Config
from tubepose.labware import RackModel, SlotGrid, SlotShape
from tubepose.rack.edges import best_registration, coarse_sample
from tubepose.rack.grid import coarse_racks
from tubepose.rack.lattice import SlotLattice
from tubepose.rack.periods import propose_lattices
from tubepose.rack.search import levels
from tubepose.rack.settling import Registration, register_at
from tubepose.transforms import QUARTER_TURN, FloatArray

ROUNDS = 6
SETTLED_MM = 0.01
ODD_MM = 1.5
"""Openings that are longer than wide by less are taken for squares: one edge is told no better."""
LEAST_RIB_MM = 0.8
"""Openings do not grow until ribs are narrower: a sensor that loses their edges must not lose them."""


def register_unsized(
    points_m: FloatArray, config: Config, like: RackModel | None = None
) -> tuple[RackModel, Registration] | None:
    """The likeliest rack with the sizes that fit, and its registration; None where none is found.

    Args:
        points_m: Array of shape (N, 3), camera frame, metres, without NaN.
        config: Sections rack_top and rack are used.
        like: A definition to begin with; without it slots in rows and columns are looked for.
    """
    if like is not None:
        few_m = coarse_sample(points_m, config.rack_top)
        found = best_registration(points_m, few_m, levels(few_m, config.rack_top), like, config)
        starts = [] if found is None or found.size is None else [(like, found)]
    else:
        starts = [_upright(points_m, *one, config) for one in _unknown(points_m, config)]
    settled = [_settled(points_m, *start, config) for start in starts]
    return max(settled, key=lambda pair: pair[1].log_likelihood, default=None)


def _unknown(points_m: FloatArray, config: Config) -> Iterator[tuple[RackModel, Registration]]:
    """Racks that slots of unknown pitch could make, each with its registration; openings square and round."""
    for lattice in propose_lattices(points_m, config):
        found = False
        for shape in _shapes(lattice):
            for T_camera_rack, rack in coarse_racks(points_m, shape, config):
                registration = register_at(points_m, T_camera_rack, rack, config.rack)
                if registration.size is not None:
                    yield rack, registration
                    found = True
                    break
        if found:
            return


def _shapes(lattice: SlotLattice) -> Iterator[SlotLattice]:
    size = lattice.slot.size_mm
    if lattice.slot.shape == "square" and abs(size[0] - size[1]) < ODD_MM:
        size = (sum(size) / 2, sum(size) / 2)
        lattice = replace(lattice, slot=SlotShape(shape="square", size_mm=size))
    yield lattice
    if lattice.slot.shape == "round":
        side = size[0] * float(np.sqrt(np.pi) / 2)
        yield replace(lattice, slot=SlotShape(shape="square", size_mm=(side, side)))
    elif abs(size[0] - size[1]) < 0.3 * max(size):
        wide = float(min(np.sqrt(size[0] * size[1] * 4 / np.pi), 0.97 * min(lattice.pitch_mm)))
        yield replace(lattice, slot=SlotShape(shape="round", size_mm=(wide, wide)))


def _settled(
    points_m: FloatArray, rack: RackModel, found: Registration, config: Config
) -> tuple[RackModel, Registration]:
    """Measure, take the sizes over, register again, until nothing changes."""
    for _ in range(ROUNDS):
        assert found.size is not None
        better = _resized(rack, found)
        if better is None:
            break
        again = register_at(points_m, found.fit.T_camera_rack, better, config.rack)
        if again.size is None:
            break
        moved = max(
            float(np.abs(np.array(better.outline_mm) - rack.outline_mm).max()),
            float(np.abs(np.array(better.all_slots[0].size_mm) - rack.all_slots[0].size_mm).max()),
            1e3 * float(np.abs(better.slot_centers_m - rack.slot_centers_m).max()),
        )
        rack, found = better, again
        if moved < SETTLED_MM:
            break
    return rack, found


def _resized(rack: RackModel, found: Registration) -> RackModel | None:
    """The rack with the sizes that its registration measured; None where that is no rack."""
    size = found.size
    assert size is not None
    stretch = 1 + size.stretch
    # A sensor that loses the edges of ribs must not lose the ribs.
    narrowest_mm = 1e3 * rack.min_rib_m
    wider_mm = min(2e3 * size.openings_m, max(0.0, narrowest_mm - LEAST_RIB_MM))
    outline = tuple(float(side) for side in np.array(rack.outline_mm) + 2e3 * size.outline_m)
    try:
        if rack.grid is not None:
            slot = rack.grid.slot
            grid = SlotGrid(
                rows=rack.grid.rows, columns=rack.grid.columns,
                pitch_mm=_pair(np.array(rack.grid.pitch_mm) * stretch),
                slot=SlotShape(
                    shape=slot.shape, size_mm=_pair(np.array(slot.size_mm) + wider_mm),
                    corner_radius_mm=slot.corner_radius_mm,
                ),
                offset_mm=_pair(np.array(rack.grid.offset_mm) * stretch),
            )  # fmt: skip
            return RackModel(**{**rack.model_dump(), "outline_mm": outline, "grid": grid.model_dump()})
        slots = [
            {
                **slot.model_dump(),
                "center_mm": _pair(np.array(slot.center_mm) * stretch),
                "size_mm": _pair(np.array(slot.size_mm) + wider_mm),
            }
            for slot in rack.slots
        ]
        return RackModel(**{**rack.model_dump(), "outline_mm": outline, "slots": slots})
    except ValueError:
        return None


def _pair(values: FloatArray) -> tuple[float, float]:
    return float(values[0]), float(values[1])


def _upright(
    points_m: FloatArray, rack: RackModel, found: Registration, config: Config
) -> tuple[RackModel, Registration]:
    """The same with the longer side along x, as racks are named: rows A, B, ... of many columns."""
    if rack.grid is None or rack.outline_mm[0] >= rack.outline_mm[1]:
        return rack, found
    grid = rack.grid
    slot = SlotShape(shape=grid.slot.shape, size_mm=grid.slot.size_mm[::-1])
    turned = SlotGrid(rows=grid.columns, columns=grid.rows, pitch_mm=grid.pitch_mm[::-1], slot=slot)
    name = f"grid-{turned.rows}x{turned.columns}"
    keys = {**rack.model_dump(), "name": name, "outline_mm": rack.outline_mm[::-1], "grid": turned.model_dump()}
    other = RackModel(**keys)
    again = register_at(points_m, found.fit.T_camera_rack @ QUARTER_TURN, other, config.rack)
    return (other, again) if again.size is not None else (rack, found)
