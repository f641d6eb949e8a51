"""Slots without a rack's definition (`--rack grid`): only the pitch and the opening are known.

The lattice's angle is found as a rack's is, by its waves. Folded into one cell of the pitch, the points show where the
ribs run; then every cell says whether there is a slot, and the rows and columns are counted. The rack that they make is
registered like any other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from tubepose.capture.frame import CameraIntrinsics
from tubepose.checks import Check
from tubepose.config import Config
from tubepose.labware import RackModel
from tubepose.preprocessing import unit_doubt
from tubepose.rack.edges import coarse_sample, pose_of
from tubepose.rack.fit import to_frame, top_frame
from tubepose.rack.lattice import SlotLattice, countable, other_pitch
from tubepose.rack.pose import MIN_POINTS, RackPose, RackStatus
from tubepose.rack.search import TURN_TRIES, Band, levels, turns
from tubepose.rack.settling import Registration, register_at
from tubepose.transforms import FloatArray, make_transform, translation

# Slots that the angle is looked for with, and how far and how finely it is turned about what was found.
PROBE = 4
FINE_TURNS_RAD = np.deg2rad(np.arange(-1.0, 1.01, 0.2))
FOLD_M = 5e-4
# How far an edge may seem to be off.
SLACK_M = 1.5e-3
RASTER_M = 2e-3
OUTLINE_SHARE = 0.03
MEASURE = "are --pitch and --slot right? Measure the pitch over as many slots as there are"
# What stands beside a rack as tubes stand in it: heights above its top, and the share that leaning tubes may have.
STANDING_POINTS = 20_000
STANDING_M = (5e-3, 0.15)
MOST_BESIDE = 0.05
# Lines of slots that may be hidden, and the sides that they are looked for on.
MOST_GROWTH = 3
# A line that is there is seen this well at least, as a share of how well the others are, and brings this share of the
# evidence that they bring on average: edges of the top look like a third of a line, and bring a little.
SEEN_SHARE = 1 / 3
GROWTH_SHARE = 0.25
SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1))
MOST_CELLS = 1_000_000


def register_grid(
    points_m: FloatArray, lattice: SlotLattice, config: Config, intrinsics: CameraIntrinsics | None = None
) -> RackPose:
    """Find slots of a known pitch and opening, and the pose of the rack that they make.

    `RackPose.rack` is that rack: as many rows and columns as were seen, named from the corner that the rule takes for
    the first; it always counts as ambiguous.

    Args:
        points_m: Array of shape (N, 3), camera frame, metres, without NaN.
        lattice: What is known.
        config: Sections rack_top and rack are used.
        intrinsics: As for `register_rack`.
    """
    if len(points_m) < MIN_POINTS:
        reason = f"{len(points_m)} valid points on the rack, expected at least {MIN_POINTS}"
        return RackPose(RackStatus.INSUFFICIENT, reason, code="too_few_points")
    # The outline is not defined but measured, to a cell.
    share = max(config.rack.max_outside_share, OUTLINE_SHARE)
    config = config.model_copy(update={"rack": config.rack.model_copy(update={"max_outside_share": share})})
    found: list[tuple[RackModel, Registration]] = []
    for T_camera_rack, rack in coarse_racks(points_m, lattice, config):
        found.append(_grown(points_m, T_camera_rack, rack, lattice, config))
        if not found[-1][1].reason:
            break
    if not found:
        told = " x ".join(f"{side:g}" for side in lattice.pitch_mm)
        doubt = unit_doubt(points_m)
        none = f"no slots {told} mm apart among the points; {MEASURE}"
        status, code = (RackStatus.UNIT, "wrong_unit") if doubt else (RackStatus.NOT_FOUND, "no_slots")
        return RackPose(status, doubt or none, code=code)
    rack, best = max(found, key=lambda pair: (not pair[1].reason, pair[1].agreement.evidence))
    if best.reason:
        pose = pose_of(best, points_m, rack, config, None, intrinsics)
        return replace(pose, rack=rack, reason=f"{pose.reason}; {MEASURE}")
    words = _miscounted(points_m, best, rack, lattice, config)
    if words:
        best = replace(best, checks=(*best.checks, Check("grid", float("nan"), float("nan"), False, detail=words)))
    return replace(pose_of(best, points_m, rack, config, None, intrinsics), rack=rack)


def _miscounted(points_m: FloatArray, best: Registration, rack: RackModel, lattice: SlotLattice, config: Config) -> str:
    """Why slots that fit are not all there are, or not as far apart as said, in words; empty if they are."""
    beside = _tubes_beside(points_m, best, rack, lattice)
    if beside > MOST_BESIDE:
        return (
            f"{rack.name} was counted, and {beside:.0%} of what stands up stands beside it, at most {MOST_BESIDE:.0%} "
            "expected: rows or columns are hidden, or the pitch is another one; name the rack"
        )
    return other_pitch(points_m, best, rack, lattice, config)


def _tubes_beside(points_m: FloatArray, best: Registration, rack: RackModel, lattice: SlotLattice) -> float:
    """Share of the points above a top's height, over it or up to a slot beside it, that are beside it."""
    local = to_frame(points_m[:: len(points_m) // STANDING_POINTS + 1], top_frame(best.fit.T_camera_rack, rack))
    local = local[(local[:, 2] > STANDING_M[0]) & (local[:, 2] < STANDING_M[1])]
    off = np.abs(local[:, :2]) - rack.outline_m / 2
    near = np.all(off < np.array(lattice.pitch_mm) * 1e-3, axis=1)
    return float(np.mean(np.any(off[near] > 0, axis=1))) if near.any() else 0.0


def _grown(
    points_m: FloatArray, T_camera_rack: FloatArray, rack: RackModel, lattice: SlotLattice, config: Config
) -> tuple[RackModel, Registration]:
    """The registration, with a row or column more on any side as long as that explains more: tubes hide whole rows."""
    best = rack, register_at(points_m, T_camera_rack, rack, config.rack)
    for _ in range(MOST_GROWTH):
        before, seen = best, best[1].agreement
        for side in SIDES:
            grown, T_more = _with_line(before[0], before[1].fit.T_camera_rack, np.array(side), lattice)
            more = register_at(points_m, T_more, grown, config.rack)
            # What is not seen adds evidence, too.
            lines = max(abs(side[0]) * grown.grid.columns, abs(side[1]) * grown.grid.rows) if grown.grid else 1
            if more.agreement.coverage <= seen.coverage * (1 - (1 - SEEN_SHARE) / lines):
                continue
            evidence = more.agreement.evidence_at(seen.spacing_m)
            least = seen.evidence * (1 + GROWTH_SHARE / max(lines - 1, 1))
            if evidence > max(least, best[1].agreement.evidence_at(seen.spacing_m)):
                best = grown, more
        if best is before:
            break
    return best


def _with_line(
    rack: RackModel, T_camera_rack: FloatArray, side: NDArray[np.intp], lattice: SlotLattice
) -> tuple[RackModel, FloatArray]:
    """A rack with one row or column more on a side, (x, y) of -1, 0 or 1, and its T_camera_rack."""
    assert rack.grid is not None
    counts = np.array([rack.grid.columns, rack.grid.rows])
    walls_mm = lattice.walls_mm(np.array(rack.outline_mm), counts)
    counts = counts + np.abs(side)
    grown = lattice.rack(int(counts[1]), int(counts[0]), walls_mm)
    half_step_m = side * np.array(lattice.pitch_mm) * 5e-4
    return grown, T_camera_rack @ translation([*half_step_m, 0.0])


def coarse_racks(points_m: FloatArray, lattice: SlotLattice, config: Config) -> Iterator[tuple[FloatArray, RackModel]]:
    """Racks that could stand there and their coarse poses (T_camera_rack), the clearest lattice of a level first."""
    probe = lattice.rack(PROBE, PROBE)
    for level in levels(coarse_sample(points_m, config.rack_top), config.rack_top):
        folded = [
            _fold(turn.band, angle, lattice)
            for band in level
            for turn in turns(band, probe, TURN_TRIES)
            for angle in (turn.angle_rad, turn.angle_rad + np.pi / 2)
        ]
        for lines in sorted(folded, key=lambda lines: -lines.score)[:3]:
            made = _count(lines, lattice)
            if made is not None:
                yield made


@dataclass(frozen=True, slots=True, eq=False)
class _Lines:
    """A lattice in a band: its angle, where a slot's centre is in its frame, and how clear it is."""

    band: Band
    angle_rad: float
    center_m: FloatArray
    score: float


def _fold(band: Band, angle_rad: float, lattice: SlotLattice) -> _Lines:
    """The clearest lattice within a degree of an angle: points folded into one cell, compared with the cell's ribs."""
    pitch_m = np.array(lattice.pitch_mm) * 1e-3
    shape = np.rint(pitch_m / FOLD_M).astype(int)
    ribs = _cell(lattice, shape)
    spectrum = np.conj(np.fft.rfft2(ribs - ribs.mean()))
    best: _Lines | None = None
    for angle in angle_rad + FINE_TURNS_RAD:
        xy = band.solid_m @ _turned(angle)
        cells = np.floor(np.mod(xy / pitch_m, 1) * shape).astype(np.intp) % shape
        counts = np.bincount(cells[:, 0] * shape[1] + cells[:, 1], minlength=int(shape.prod())).reshape(shape)
        match = np.fft.irfft2(np.fft.rfft2(counts) * spectrum, tuple(shape))
        place = np.unravel_index(int(match.argmax()), match.shape)
        score = float(match[place]) / np.sqrt(len(xy))
        if best is None or score > best.score:
            best = _Lines(band, float(angle), (np.array(place) + 0.5) / shape * pitch_m, score)
    assert best is not None
    return best


def _cell(lattice: SlotLattice, shape: NDArray[np.intp]) -> FloatArray:
    """Which parts of one cell of the pitch are rib, its slot's centre at cell (0, 0); shape `shape`."""
    one = lattice.rack(1, 1).all_slots[0]
    pitch_m = np.array(lattice.pitch_mm) * 1e-3
    axes = [(np.mod(np.arange(n) / n + 0.5, 1) - 0.5) * side for n, side in zip(shape, pitch_m, strict=True)]
    return np.asarray(one.signed_distance_m(np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)) > 0, float)


def _turned(angle_rad: float) -> FloatArray:
    """Columns: the lattice's x and y in the band's frame."""
    cos, sin = np.cos(angle_rad), np.sin(angle_rad)
    return np.array([[cos, -sin], [sin, cos]])


def _count(lines: _Lines, lattice: SlotLattice) -> tuple[FloatArray, RackModel] | None:
    """Rows and columns between the outer edges of a lattice's top, as a rack with its coarse pose; None without any."""
    pitch_m, size_m = np.array(lattice.pitch_mm) * 1e-3, np.array(lattice.slot.size_mm) * 1e-3
    xy = lines.band.solid_m @ _turned(lines.angle_rad) - lines.center_m
    extent = _extent(xy, pitch_m, lattice)
    if extent is None:
        return None
    low, high = extent
    first, last = (np.ceil((low + size_m / 2 - SLACK_M) / pitch_m), np.floor((high - size_m / 2 + SLACK_M) / pitch_m))
    counts = (last - first + 1).astype(int)
    if not countable(counts) or counts.max() < 2:
        return None
    walls_m = ((first * pitch_m - size_m / 2 - low) + (high - last * pitch_m - size_m / 2)) / 2
    rack = lattice.rack(int(counts[1]), int(counts[0]), (float(1e3 * walls_m[0]), float(1e3 * walls_m[1])))
    R = np.eye(3)
    R[:2, :2] = _turned(lines.angle_rad)
    at = R[:2, :2] @ (lines.center_m + (first + last) / 2 * pitch_m)
    return lines.band.T_camera_band @ make_transform(R, np.array([*at, -rack.height_m])), rack


def _extent(xy_m: FloatArray, pitch_m: FloatArray, lattice: SlotLattice) -> tuple[FloatArray, FloatArray] | None:
    """Least and largest x and y of the largest patch of points on a lattice's ribs, frame of the lattice; None if none.

    The patch hangs together where openings are bridged. Its edges are where its lines of points end: a line counts if
    it has a tenth of the points of a wall.
    """
    one = lattice.rack(1, 1).all_slots[0]
    off = np.mod(xy_m / pitch_m + 0.5, 1) - 0.5
    ribs = xy_m[one.signed_distance_m(off * pitch_m) > -SLACK_M / 2]
    if len(ribs) < MIN_POINTS:
        return None
    low = ribs.min(axis=0)
    cells = np.floor((ribs - low) / RASTER_M).astype(np.intp)
    reach = int(np.ceil(pitch_m.max() / 2 / RASTER_M)) + 1
    raster = np.zeros(cells.max(axis=0) + 1 + 2 * reach, bool)
    if raster.size > MOST_CELLS:
        return None
    raster[cells[:, 0] + reach, cells[:, 1] + reach] = True
    closed = ndimage.binary_closing(raster, np.ones((3, 3), bool), iterations=reach)
    labels, _ = ndimage.label(closed)
    label = labels[cells[:, 0] + reach, cells[:, 1] + reach]
    ribs = ribs[label == np.argmax(np.bincount(label)[1:]) + 1]
    edges = np.array([_ends(ribs[:, axis]) for axis in range(2)])
    return edges[:, 0], edges[:, 1]


def _ends(values_m: FloatArray) -> tuple[float, float]:
    bins = np.arange(values_m.min() - FOLD_M, values_m.max() + 2 * FOLD_M, FOLD_M)
    counts = np.histogram(values_m, bins)[0]
    full = np.flatnonzero(counts > 0.1 * np.percentile(counts, 98))
    return float(bins[full[0]]), float(bins[full[-1] + 1])
