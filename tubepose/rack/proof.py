"""What a registration has to pass: quick looks first, then named alternatives and sizes on the cells of the face."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tubepose.checks import Check
from tubepose.config import RackConfig
from tubepose.labware import RackModel
from tubepose.preprocessing import thin
from tubepose.rack.agreement import Agreement
from tubepose.rack.alternatives import SIDES, edge_slots, gains, line_steps_m, own_distance_m
from tubepose.rack.face import Face, face_grid, look_at_face
from tubepose.rack.field import openings_field
from tubepose.rack.fit import Fit, bow_slopes, to_frame, top_frame
from tubepose.rack.size import FaceSize, measure_size
from tubepose.rack.tops_in_slots import LEAST_TOPS, TopsInSlots, tops_in_slots
from tubepose.transforms import FloatArray

# Half thickness of what counts as the face: so many standard deviations of its heights, between these.
FACE_SIGMAS, FACE_M = 2.5, (0.4e-3, 1.0e-3)
# Cells beside the outline that are looked at: a line of slots more.
BESIDE_M = 30e-3
# Degrees and millimetres, with their part of a covariance.
_UNITS = (("uncertain_turn", np.rad2deg(1.0), slice(0, 3)), ("uncertain_shift", 1e3, slice(3, 6)))
# A pose that is known no better than this is not known at all.
LOST_DEG = 45.0
# The middle of a place for a tube, half its side as a share of the distance of slots, and what a tube fills of it.
CORE, FULL = 0.25, 0.6
# Tops in so many of the slots tell that they are there: a few are ghosts of clear walls.
TOPS_SHARE = 0.2
# Tubes stand so far out of a rack, about.
OVER_M = 50e-3
# A floor is seen in slots with so many points, this near to each other in height, away from walls and from the face.
FLOOR_POINTS = 12
FLOOR_SAMPLE = 60_000
FLAT_M = 0.8e-3
WALL_M = 2.5e-3
DEEP_M = 6e-3
# A size that differs by so many standard deviations is marked: one right file of twenty may have it.
MARKS_SIGMAS = 2.0
# Slots that have to agree on it, and how well the level of one is known.
FLOOR_SLOTS = 3
FLOOR_STD_M = 0.3e-3


@dataclass(frozen=True, slots=True, eq=False)
class Proof:
    """What became of a registration.

    Attributes:
        checks: What it had to pass besides the quick looks.
        size: Sizes of its face.
        floor_m: Height of the slots' floor above the rack's base and its standard deviation, metres; None where it was
            not seen.
        log_likelihood: Of the cells of its face and beside it, nats.
    """

    checks: tuple[Check, ...]
    size: FaceSize
    floor_m: tuple[float, float] | None
    log_likelihood: float


def quick_checks(seen: Agreement, fit: Fit, config: RackConfig) -> tuple[Check, ...]:
    """What a registration has to pass before its face is looked at cell by cell."""
    return tuple(_quick(seen, fit, config))


def face_of(points_m: FloatArray, fit: Fit, spacing_m: float, rack: RackModel) -> Face:
    """The face of a registration; arguments as of `prove`."""
    window_m = float(np.clip(FACE_SIGMAS * fit.scatter_m, *FACE_M))
    grid = face_grid(rack, spacing_m, BESIDE_M)
    return look_at_face(points_m, fit.T_camera_rack, rack, window_m, grid, spacing_m)


def prove(points_m: FloatArray, fit: Fit, seen: Agreement, rack: RackModel, config: RackConfig) -> Proof:
    """Every check of a registration that has passed the quick ones, and what its face was measured to be.

    Args:
        points_m: Points near the rack, camera frame, shape (N, 3), metres; of a bowed rack those that were laid flat.
        fit: The registration.
        seen: What a quick look has counted.
        rack: The rack.
        config: Limits.
    """
    face, T_camera_top = face_of(points_m, fit, seen.spacing_m, rack), top_frame(fit.T_camera_rack, rack)
    tops = tops_in_slots(points_m, T_camera_top, fit.bow_m, rack)
    size, floor_m = measure_size(face, rack).with_tops(tops), measure_floor(points_m, fit, rack)
    checks = (
        *_alternatives(face, rack, config),
        *_beside(face, fit.bow_m, rack),
        *_tops(tops, rack, config),
        *_sizes(size, rack, config),
        *_scale(size, rack, float(np.linalg.norm(T_camera_top[:3, 3])), config),
        *_floor(floor_m, rack, config),
    )
    return Proof(checks, size, floor_m, face.log_likelihood(own_distance_m(rack, face.grid)))


def _quick(seen: Agreement, fit: Fit, config: RackConfig) -> Iterator[Check]:
    rmse_mm, limit_mm = 1e3 * seen.rmse_m, 1e3 * config.max_inlier_rmse_m
    yield Check("inlier_rmse", rmse_mm, limit_mm, not rmse_mm > limit_mm)
    for code, value, limit in (
        ("in_openings", seen.in_slot, config.max_stray_share),
        ("beside_outline", seen.outside, config.max_outside_share),
    ):
        yield Check(code, 100 * value, 100 * limit, value <= limit)
    bow_mm = 1e3 * float(np.abs(fit.bow_m).max())
    yield Check("bow", bow_mm, config.max_bow_mm, bow_mm <= config.max_bow_mm)
    least = config.min_seen if fit.level is None else config.min_seen_held
    yield Check("little_seen", 100 * seen.coverage, 100 * least, seen.coverage >= least)
    yield Check("not_in_view", 100 * seen.unseen, 100 * config.max_unseen_share, seen.unseen <= config.max_unseen_share)
    yield Check("slot_step", seen.slot_margin, config.min_slot_margin, seen.slot_margin >= config.min_slot_margin)
    most_mm = config.max_shift_std_mm if fit.level is None else config.max_shift_std_held_mm
    for (code, scale, part), limit in zip(_UNITS, (config.max_turn_std_deg, most_mm), strict=True):
        std = float(scale * np.sqrt(np.diag(fit.covariance)[part].max()))
        if code == "uncertain_turn" and std > LOST_DEG:
            yield Check("lost", std, limit, False)
            return
        yield Check(code, std, limit, std <= limit)


def _alternatives(face: Face, rack: RackModel, config: RackConfig) -> Iterator[Check]:
    for gain in gains(face, rack):
        yield Check(gain.code, gain.nats, config.max_gain, gain.nats <= config.max_gain, detail=gain.words)


def _beside(face: Face, bow_m: FloatArray, rack: RackModel) -> Iterator[Check]:
    """Tubes that stand where another line of slots would be: full places in more than one slot of it.

    Those of a bowed rack stand along its face's normal, and lean over the places beside it.
    """
    steps = line_steps_m(rack)
    for where, sign in SIDES.items():
        axis = 0 if sign[0] else 1
        step = steps[axis]
        if step is None:
            continue
        full = 0
        for slot in edge_slots(rack.all_slots, np.array(sign) * step):
            place = slot.center_m + np.array(sign) * step
            place = place - OVER_M * bow_slopes(bow_m, place, rack)
            low, high = (
                np.floor((place + side * CORE * step - face.grid.low_m) / face.grid.cell_m + 0.5).astype(int)
                for side in (-1, 1)
            )
            core = face.standing[max(low[0], 0) : max(high[0], 0), max(low[1], 0) : max(high[1], 0)]
            full += core.size > 0 and float(core.mean()) > FULL
        what = "column" if axis == 0 else "row"
        yield Check("tubes_beside", full, 1, full <= 1, detail=f"a {what} more at {where}")


def _tops(tops: TopsInSlots, rack: RackModel, config: RackConfig) -> Iterator[Check]:
    if tops.count >= max(LEAST_TOPS, TOPS_SHARE * len(rack.all_slots)):
        yield Check("tops_off_slots", tops.median_share, config.max_tops_off, tops.median_share <= config.max_tops_off)


def _sizes(size: FaceSize, rack: RackModel, config: RackConfig) -> Iterator[Check]:
    std, reach_m = size.std, np.abs(rack.slot_centers_m).max(axis=0)
    for axis, name in enumerate("xy"):
        value_mm, std_mm = (1e3 * float(share * reach_m[axis]) for share in (size.stretch[axis], std[axis]))
        yield from pitch_checks(f"pitch_{name}", value_mm, std_mm, config)
    wider_m, wider_std_m = size.wider_openings_m()
    yield from _measured("openings", 2e3 * wider_m, 2e3 * wider_std_m, config.max_openings_mm, ("wider", "narrower"))
    for axis in range(2):
        value_mm, std_mm = (2e3 * float(value) for value in (size.outline_m[axis], std[3 + axis]))
        yield from _measured("outline", value_mm, std_mm, config.max_outline_mm, ("larger", "smaller"))


def pitch_checks(code: str, value_mm: float, std_mm: float, config: RackConfig) -> Iterator[Check]:
    """What another distance of slots refuses, beyond three standard deviations, and what it marks, beyond two.

    Args:
        code: Of the axis.
        value_mm: How much farther out the outermost slots lie than the rack's file has them.
        std_mm: Its standard deviation.
        config: Limits.
    """
    words = "farther apart" if value_mm > 0 else "nearer"
    most_mm = config.max_pitch_marked_mm
    marked = abs(value_mm) > max(MARKS_SIGMAS * std_mm, most_mm)
    yield Check(code, abs(value_mm), most_mm, not marked, decides=False, detail=words)
    yield from _measured(code, value_mm, std_mm, config.max_pitch_mm, ("farther apart", "nearer"))


def _measured(code: str, value: float, std: float, limit: float, words: tuple[str, str]) -> Iterator[Check]:
    """A check that refuses what is beyond a limit by more than three standard deviations."""
    beyond = abs(value) - 3 * std
    yield Check(code, abs(value), limit, beyond <= limit, detail=words[0] if value > 0 else words[1])


def _scale(size: FaceSize, rack: RackModel, distance_m: float, config: RackConfig) -> Iterator[Check]:
    """One scale of pitch and outline, by least squares: a cloud that is too large, or too small.

    An outline's edge is moved by blur as well: its part is as sure as that. Where neither what is seen nor the sensor's
    calibration excludes a scale that moves the rack by what a wrong answer is, that is marked too.
    """
    scale, std = size.scale(rack, config.edge_std_mm * 1e-3)
    words = "larger" if scale > 0 else "smaller"
    moved_mm = 1e3 * abs(scale) * distance_m
    significant = abs(scale) > MARKS_SIGMAS * std and moved_mm > config.max_scale_shift_mm
    yield Check("scale", 100 * abs(scale), 0.1 * config.max_scale_shift_mm / distance_m, not significant, False, words)
    unknown_mm, most_mm = 3e3 * distance_m / float(np.hypot(1 / std, 1 / config.scale_std)), config.max_scale_unknown_mm
    yield Check("scale_unknown", unknown_mm, most_mm, unknown_mm <= most_mm, decides=False)
    limit = config.max_scale
    yield Check("scale", 100 * abs(scale), 100 * limit, abs(scale) - 3 * std <= limit, detail=words)


def _floor(measured: tuple[float, float] | None, rack: RackModel, config: RackConfig) -> Iterator[Check]:
    if measured is None:
        return
    off_mm, std_mm = 1e3 * (measured[0] - rack.floor_m), 1e3 * measured[1]
    limit = config.max_floor_mm + 3 * (std_mm + rack.floor_tolerance_mm)
    yield Check("floor", abs(off_mm), limit, abs(off_mm) <= limit, detail="higher" if off_mm > 0 else "deeper")


def measure_floor(points_m: FloatArray, fit: Fit, rack: RackModel) -> tuple[float, float] | None:
    """Height of the slots' floor above the rack's base and its standard deviation, metres; None where it is not seen.

    In every slot the points away from its walls whose heights are alike are a floor; the median of the slots that have
    one is taken, if they agree.
    """
    local = to_frame(thin(points_m, FLOOR_SAMPLE), top_frame(fit.T_camera_rack, rack))
    distance, _, known = openings_field(rack).look_up(local)
    deep = local[known & (local[:, 2] < -DEEP_M) & (distance > WALL_M)]
    if len(deep) < FLOOR_POINTS:
        return None
    apart = deep[:, None, :2] - rack.slot_centers_m[None]
    slot = np.argmin((apart**2).sum(axis=2), axis=1)
    levels = []
    for k in np.unique(slot):
        z = deep[slot == k, 2]
        middle = float(np.median(z))
        if len(z) >= FLOOR_POINTS and np.mean(np.abs(z - middle) < FLAT_M) > 0.75:
            levels.append(middle)
    if len(levels) < min(FLOOR_SLOTS, len(rack.all_slots) // 3 + 1):
        return None
    level = float(np.median(levels))
    spread = 1.4826 * float(np.median(np.abs(np.array(levels) - level)))
    if spread > FLAT_M:
        return None
    return rack.height_m + level, float(np.hypot(FLOOR_STD_M, spread) / np.sqrt(len(levels)))
