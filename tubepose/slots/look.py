"""What was seen of every slot of a rack, as shares of its opening: exact geometry of lines of sight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.labware import RackModel, TubeModel
from tubepose.slots.cells import OpeningCells, core_radius_m, empty_height_m, opening_cells, telling_cells
from tubepose.slots.lines_of_sight import LinesOfSight, lines_of_sight
from tubepose.slots.silhouette import contradicting_m2
from tubepose.transforms import FloatArray

DEPTH_STD_M = 5.0e-4
"""Prior standard deviation of a point's depth where none was measured, metres: between a structured light scanner
(0.1 mm) and a stereo or time-of-flight camera at half a metre (1 mm)."""
BOW_M = 2.5e-3
"""How far a rack's face may bow off its plane, metres: real plastic racks."""
PATCH_M = 3.0e-3
"""Side of a patch of lines of sight that count as one, metres: neighbours share their error, an edge, a ghost. The
range over which real scanners' depth errors were measured to be shared."""
PASSED, STANDING, FILLED, AT_FACE, HIDDEN, SILENT = range(6)


@dataclass(frozen=True, slots=True, eq=False)
class SlotLook:
    """What was seen of one slot. Shares are of the opening's area at the rack's face, and sum to 1 with outside.

    Attributes:
        slot: Name of the slot.
        in_image: Share that lies inside the image.
        passed: Share whose lines of sight returned a point below the face, as an empty slot does.
        standing: Share whose lines were met above the face, in the slot's own column.
        filled: Share whose lines went in and ended well above the empty slot's wall or floor: a short thing.
        at_face: Share whose lines ended near the face: a lid, or the upper end of a wall; neither for nor against.
        hidden: Share whose lines were stopped above the face elsewhere: by what stands in another slot.
        silent: Share inside the image from which nothing came back: a black cap or a dark well. Of a cloud without
            pixels, all that no line of sight is known of.
        covered: Share of the slot's middle that is covered by points above the face, seen along the rack's normal.
        seen_share: Share that was looked at: lines that went in or met the slot's own content, or `covered` if larger.
        patches_passed: Patches of 3 x 3 mm whose lines went on where a tube in the slot would have stopped them
            (`contradicting_m2`): lines into the opening, and those through the column above it that ended behind it.
        patches_stopped: Patches whose lines had to meet what stands in the slot and met something there, or of its
            middle that is covered, if more.
    """

    slot: str
    in_image: float
    passed: float
    standing: float
    filled: float
    at_face: float
    hidden: float
    silent: float
    covered: float
    seen_share: float
    patches_passed: float
    patches_stopped: float


def look_at_slots(
    frame: RgbdFrame,
    intrinsics: CameraIntrinsics | None,
    T_camera_rack: FloatArray,
    rack: RackModel,
    tubes: Sequence[TubeModel] = (),
    depth_std_m: float = DEPTH_STD_M,
) -> tuple[SlotLook, ...]:
    """Compute what was seen of every slot by following every line of sight to its end.

    Args:
        frame: The frame.
        intrinsics: Of its pixels; without them, and for clouds without pixels, what was not returned is not known.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
        rack: The rack.
        tubes: Types that can stand in it: how wide they are tells which lines of sight must meet one.
        depth_std_m: Standard deviation of a point's depth, metres.

    Returns:
        One for each of `rack.all_slots`, in their order. Of a camera below the rack's face: nothing seen.
    """
    lines = lines_of_sight(frame, intrinsics, T_camera_rack, rack)
    cells = opening_cells(rack, lines.cell_m)
    n_slots = len(rack.all_slots)
    if lines.camera_m[2] <= rack.height_m:
        return _looks(rack, np.zeros((n_slots, 6)), np.zeros(n_slots), np.zeros(n_slots), np.zeros((n_slots, 2)))
    area = np.maximum(np.bincount(cells.slot, minlength=n_slots), 1)
    kinds, passing = _followed(lines, cells, rack, depth_std_m)
    shares = np.column_stack([np.bincount(cells.slot, kinds[:, k], n_slots) for k in range(6)]) / area[:, None]
    telling = telling_cells(cells, rack, tubes, lines.camera_m)
    covered, core = _covered(lines, cells, rack, tubes, depth_std_m)
    stopped = np.bincount(cells.slot, telling * (kinds[:, STANDING] + kinds[:, FILLED]), n_slots)
    patches_m2 = np.column_stack(
        [
            contradicting_m2(passing, cells, rack, tubes, lines.camera_m),
            np.maximum(stopped, covered * core) * cells.cell_m**2,
        ]
    )
    in_image = np.ones(len(cells.slot))
    if intrinsics is not None and frame.organised:
        in_image = _inside_image(cells, rack, intrinsics, T_camera_rack)
    framed = np.bincount(cells.slot, in_image, n_slots) / area
    return _looks(rack, shares, framed, covered, patches_m2 / PATCH_M**2)


def _looks(
    rack: RackModel, shares: FloatArray, in_image: FloatArray, covered: FloatArray, patches: FloatArray
) -> tuple[SlotLook, ...]:
    seen = np.maximum(shares[:, [PASSED, STANDING, FILLED, AT_FACE]].sum(axis=1), covered)
    # Cells without a line of sight inside the image are silent, too.
    silent = np.maximum(in_image - shares[:, :SILENT].sum(axis=1), 0.0)
    found = []
    for i, slot in enumerate(rack.all_slots):
        passed, standing, filled, at_face, hidden, _ = shares[i].tolist()
        values = (float(in_image[i]), passed, standing, filled, at_face, hidden, float(silent[i]), float(covered[i]))
        found.append(SlotLook(slot.name, *values, float(seen[i]), float(patches[i, 0]), float(patches[i, 1])))
    return tuple(found)


def _followed(
    lines: LinesOfSight, cells: OpeningCells, rack: RackModel, depth_std_m: float
) -> tuple[FloatArray, FloatArray]:
    """Share of every opening's cell's lines per kind, (C, 6); of every grid place's lines that went on, (X, Y).

    A line goes on where it ends at the face or below it: on a rib, in a slot as an empty one returns it, on the table.
    """
    crosses = np.flatnonzero(np.isfinite(lines.crossing_m[:, 0]))
    place, inside = cells.place_at(lines.crossing_m[crosses])
    place, ends = place[inside], lines.end_m[crosses[inside]]
    cell = cells.cell.ravel()[place]
    in_slot = cell >= 0
    kind = _kinds(ends[in_slot], cell[in_slot], cells, rack, lines.camera_m, depth_std_m)
    count = np.bincount(cell[in_slot] * 6 + kind, minlength=6 * len(cells.slot)).reshape(-1, 6)
    with np.errstate(invalid="ignore"):
        went_on = ends[:, 2] < rack.height_m + BOW_M + 3 * depth_std_m
    went_on[in_slot] = kind == PASSED
    size = cells.cell.size
    passing = np.bincount(place, went_on, size) / np.maximum(np.bincount(place, minlength=size), 1)
    return count / np.maximum(count.sum(axis=1, keepdims=True), 1), passing.reshape(cells.cell.shape)


def _kinds(
    end_m: FloatArray,
    cell: NDArray[np.intp],
    cells: OpeningCells,
    rack: RackModel,
    camera_m: FloatArray,
    depth_std_m: float,
) -> NDArray[np.intp]:
    """What became of lines of sight through cells, shape (N,)."""
    band = BOW_M + 3 * depth_std_m
    slack = band + 2 * rack.floor_tolerance_mm * 1e-3
    empty = empty_height_m(cells, rack, camera_m)[cell]
    z = end_m[:, 2]
    with np.errstate(invalid="ignore"):
        above, below = z > rack.height_m + band, z < rack.height_m - band
        own = above & (cells.owner_at(np.nan_to_num(end_m[:, :2])) == cells.slot[cell])
        filled = ~above & (z > empty + slack)
    kinds = [own, above, filled, below, np.isnan(z)]
    return np.select(kinds, [STANDING, HIDDEN, FILLED, PASSED, SILENT], AT_FACE).astype(np.intp)


def _covered(
    lines: LinesOfSight, cells: OpeningCells, rack: RackModel, tubes: Sequence[TubeModel], depth_std_m: float
) -> tuple[FloatArray, FloatArray]:
    """Share of every slot's core, at the face, with points above it, shape (S,), and the core's cells, shape (S,)."""
    n_slots = len(rack.all_slots)
    with np.errstate(invalid="ignore"):
        above = lines.end_m[lines.end_m[:, 2] > rack.height_m + BOW_M + 3 * depth_std_m]
    filled = np.zeros(len(cells.slot), bool)
    at = cells.cell_at(above[:, :2])
    filled[at[at >= 0]] = True
    radius, _ = core_radius_m(rack, tubes)
    core = np.hypot(*(cells.center_m - rack.slot_centers_m[cells.slot]).T) < radius[cells.slot]
    count = np.bincount(cells.slot, core, n_slots)
    return np.bincount(cells.slot, core & filled, n_slots) / np.maximum(count, 1), count


def _inside_image(
    cells: OpeningCells, rack: RackModel, intrinsics: CameraIntrinsics, T_camera_rack: FloatArray
) -> FloatArray:
    """1 for every cell that lies inside the image, else 0, shape (C,)."""
    points = np.column_stack([cells.center_m, np.full(len(cells.slot), rack.height_m)])
    uv = intrinsics.project(points @ T_camera_rack[:3, :3].T + T_camera_rack[:3, 3])
    with np.errstate(invalid="ignore"):
        inside = (uv > -0.5).all(axis=1) & (uv < np.array([intrinsics.width, intrinsics.height]) - 0.5).all(axis=1)
    return np.asarray(inside, float)
