"""What was seen of every slot of a rack, as shares of its opening: exact geometry of lines of sight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.labware import RackModel, TubeModel
from tubepose.preprocessing import fullest_level
from tubepose.slots.cells import core_cells, telling_cells
from tubepose.slots.lines_of_sight import follow_sight
from tubepose.slots.sight_kernels import AT_FACE, FILLED, KINDS, PASSED, SILENT, STANDING
from tubepose.slots.silhouette import contradicting_m2
from tubepose.transforms import FloatArray

DEPTH_STD_M = 5.0e-4
"""Prior standard deviation of a point's depth where none was measured, metres: between a structured light scanner
(0.1 mm) and a stereo or time-of-flight camera at half a metre (1 mm)."""
PATCH_M = 3.0e-3
"""Side of a patch of lines of sight that count as one, metres: neighbours share their error, an edge, a ghost. The
range over which real scanners' depth errors were measured to be shared."""

LEVEL_M = 4.0e-3
"""Heights of one top, metres: caps lean by 10 deg at most, a millimetre over a slot's middle; edges are rounded."""


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
        covered: Share of the slot's middle that is covered by points above the face at one height, seen along the
            rack's normal.
        seen_share: Share that was looked at: lines that went in or met the slot's own content, or `covered` if larger.
        patches_passed: Patches of 3 x 3 mm whose lines went on where a tube in the slot would have stopped them
            (`contradicting_m2`): lines into the opening, and those through the column above it that ended behind it.
        patches_stopped: Patches whose lines had to meet what stands in the slot and met something there.
        patches_covered: Patches of the slot's middle that is covered.
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
    patches_covered: float = 0.0

    def explained(self, share: float) -> SlotLook:
        """The same, less a share of the slot's middle that tubes of other slots reach over.

        Args:
            share: Of the slot's middle, as seen along the rack's normal, 0 to 1.
        """
        left = max(self.covered - share, 0.0)
        patches = self.patches_covered * left / self.covered if self.covered > 0 else 0.0
        return replace(self, covered=left, patches_covered=patches)


def look_at_slots(
    frame: RgbdFrame,
    intrinsics: CameraIntrinsics | None,
    T_camera_rack: FloatArray,
    rack: RackModel,
    tubes: Sequence[TubeModel] = (),
    depth_std_m: float = DEPTH_STD_M,
    bow_m: FloatArray | None = None,
) -> tuple[SlotLook, ...]:
    """Compute what was seen of every slot by following every line of sight to its end.

    Args:
        frame: The frame.
        intrinsics: Of its pixels; without them, and for clouds without pixels, what was not returned is not known.
        T_camera_rack: The rack's pose, shape (4, 4), metres.
        rack: The rack.
        tubes: Types that can stand in it: how wide they are tells which lines of sight must meet one.
        depth_std_m: Standard deviation of a point's depth, metres.
        bow_m: Bow of the rack's face (`RackPose.bow_m`), shape (3,), metres; None where it is not known.

    Returns:
        One for each of `rack.all_slots`, in their order. Of a camera below the rack's face: nothing seen.
    """
    lines = follow_sight(frame, intrinsics, T_camera_rack, rack, depth_std_m, bow_m)
    n_slots = len(rack.all_slots)
    if lines is None:
        return tuple(SlotLook(slot.name, *[0.0] * 12) for slot in rack.all_slots)
    cells, kinds = lines.cells, lines.kinds

    def per_slot(values: NDArray[Any]) -> FloatArray:
        return np.asarray(np.bincount(cells.slot, values, n_slots), float)

    area = np.maximum(per_slot(np.ones(len(cells.slot))), 1)
    shares = np.column_stack([per_slot(kinds[:, k]) for k in range(KINDS)]) / area[:, None]
    in_image = per_slot(lines.in_image) / area
    # Inside the image, a cell without a line of sight is silent, too.
    shares[:, SILENT] = np.maximum(in_image - shares[:, :SILENT].sum(axis=1), 0.0)
    core = core_cells(cells, rack, tubes)
    covered = covered_cells(lines.highest_m, core, cells.slot, n_slots)
    stops = kinds[:, STANDING] + kinds[:, FILLED]
    stopped = per_slot(telling_cells(cells, rack, tubes, lines.camera_m) * stops)
    passed_m2 = contradicting_m2(lines.passing, cells, rack, tubes, lines.camera_m)
    cell_patches = cells.cell_m**2 / PATCH_M**2
    patches = (passed_m2 / PATCH_M**2, stopped * cell_patches, covered * cell_patches)
    covered = covered / np.maximum(per_slot(core), 1)
    seen = np.maximum(shares[:, [PASSED, STANDING, FILLED, AT_FACE]].sum(axis=1), covered)
    table = np.column_stack([in_image, shares, covered, seen, *patches]).tolist()
    return tuple(SlotLook(slot.name, *row) for slot, row in zip(rack.all_slots, table, strict=True))


def covered_cells(
    highest_m: FloatArray, core: NDArray[np.bool_], slot: NDArray[np.intp], n_slots: int
) -> NDArray[np.float64]:
    """How many cells of every slot's middle are covered at one height, shape (S,): the fullest `LEVEL_M` counts.

    What stands in a slot has a top there. Light that clear walls bend leaves points at all heights.

    Args:
        highest_m: Height of the highest point over each opening cell, shape (C,), metres; NaN without one.
        core: Which cells are of a slot's middle, shape (C,).
        slot: Index of every cell's slot, shape (C,).
        n_slots: How many slots there are.
    """
    rows = np.flatnonzero(core & np.isfinite(highest_m))
    over_m = highest_m[rows]
    return np.asarray(fullest_level(slot[rows], over_m, n_slots, LEVEL_M, over_m.min(initial=np.inf)), float)
