"""Labware against the scan: sizes that a frame shows of a rack and its tubes, beside what their files say.

Every size has a value and a standard deviation. Those of several frames are pooled by inverse variances; where they
scatter more than they state, the standard deviation grows with it (Birge ratio).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from tubepose.config import Config, RackConfig
from tubepose.labware import RackModel, TubeModel
from tubepose.rack import RackPose, RackStatus
from tubepose.rack.alternatives import line_steps_m
from tubepose.scene import Scene, TubeEstimate
from tubepose.statistics import weighted_mean
from tubepose.transforms import FloatArray
from tubepose.tubes_pitch import MEASURED_CODES, SIGMAS, joined, ribs_stretch, tops_stretch

TOLERANCE_MM = 0.5
"""A file that is off by less cannot make an answer wrong: a quarter of the 2 mm that count as wrong."""
SIZE_CODES = frozenset(("pitch_x", "pitch_y", "openings", "outline", "scale", "floor"))
"""A rack that is refused for these alone is the right one with a wrong file: its sizes are worth telling."""
LEAST_STRANGERS = 3
"""So many tops of one height that no type has are tubes, and not something that lies there."""
MAX_OFF_MM = 5.0
"""A top farther off a type's height is of another type: caps are pressed on or not by less than this."""


@dataclass(frozen=True, slots=True)
class SizeCheck:
    """One size of a definition, as measured; millimetres, but for the scale, which is a ratio.

    Attributes:
        quantity: What it is: ``pitch_x_mm``, ``opening_mm``, ``top_height_mm``, ...
        labware: Name of the rack or tube.
        key: Key of its file that is to be corrected.
        defined: What the file says of the quantity.
        measured: What the scan says.
        std: Standard deviation of that.
        n: How many tubes it was measured on; of a rack's sizes how many frames.
        tolerance: A smaller difference is none.
        write: The right number to write to the key.
        other_key: Another key that would explain the difference as well; empty if there is none.
    """

    quantity: str
    labware: str
    key: str
    defined: float
    measured: float
    std: float
    n: int
    tolerance: float
    write: float
    other_key: str = ""

    @property
    def contradicts(self) -> bool:
        """Whether the scan contradicts the file: beyond the tolerance by more than the measurement's error explains."""
        off = abs(self.measured - self.defined)
        return bool(off > SIGMAS * self.std and off > self.tolerance)


def compare_sizes(scene: Scene, estimates: Sequence[TubeEstimate], config: Config) -> tuple[SizeCheck, ...]:
    """What a frame says of the sizes of its rack and of its tubes.

    Args:
        scene: The frame and its rack's pose.
        estimates: Answers of one method; only measured tops say something of the tubes.
        config: Sections rack and profile are used.

    Returns:
        Nothing for a rack that is not there or is another one.
    """
    pose, rack = scene.rack_pose, scene.rack
    failed_codes = {check.code for check in pose.checks if check.decides and not check.passed}
    known = pose.status is RackStatus.OK or (pose.status is RackStatus.REFUSED and failed_codes <= SIZE_CODES)
    if not known or (pose.status is not RackStatus.OK and not failed_codes):
        return ()
    return (*_rack_sizes(pose, rack, estimates, config.rack), *_tube_sizes(scene, estimates, config))


def pooled(sizes: Sequence[SizeCheck]) -> tuple[SizeCheck, ...]:
    """The same over all frames, one for each quantity of each definition, in the order in which they came first."""
    groups: dict[tuple[str, str, str], list[SizeCheck]] = {}
    for size in sizes:
        groups.setdefault((size.quantity, size.labware, size.key), []).append(size)
    return tuple(_pool(group) for group in groups.values())


def pooled_rows(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of labware_check.csv over the whole run, without keys of a frame, from those of its frames."""
    names = SizeCheck.__dataclass_fields__
    return [size_row(size) for size in pooled([SizeCheck(**{name: row[name] for name in names}) for row in rows])]


def size_row(size: SizeCheck) -> dict[str, Any]:
    """Row of labware_check.csv, without its keys."""
    return {**asdict(size), "contradicts": size.contradicts}


def _rack_sizes(
    pose: RackPose, rack: RackModel, estimates: Sequence[TubeEstimate], config: RackConfig
) -> Iterator[SizeCheck]:
    reach_m = np.abs(rack.slot_centers_m).max(axis=0)
    for axis, (name, step_m) in enumerate(zip("xy", line_steps_m(rack), strict=True)):
        ribs, tops = ribs_stretch(pose, axis), tops_stretch(rack, estimates, axis)
        if step_m is None or (ribs is None and tops is None):
            continue
        share, std = joined(ribs, tops)
        tolerance = TOLERANCE_MM * step_m / float(reach_m[axis])
        step_mm = 1e3 * step_m
        measured = step_mm * (1 + share)
        key = "pitch_mm" if rack.grid is not None else "center_mm"
        yield SizeCheck(f"pitch_{name}_mm", rack.name, key, step_mm, measured, step_mm * std, 1, tolerance, measured)
    if pose.size is not None:
        wider_m, std_m = pose.size.wider_openings_m()
        defined = float(rack.all_slots[0].size_mm[0])
        found = defined + 2e3 * wider_m
        yield SizeCheck(
            "opening_mm", rack.name, "size_mm", defined, found, 2e3 * std_m, 1, config.max_openings_mm, found
        )
        for axis, name in enumerate("xy"):
            defined = float(rack.outline_mm[axis])
            found = defined + 2e3 * float(pose.size.outline_m[axis])
            std = 2 * float(np.hypot(1e3 * pose.size.std[3 + axis], config.edge_std_mm))
            yield SizeCheck(
                f"outline_{name}_mm", rack.name, "outline_mm", defined, found, std, 1, config.max_outline_mm, found
            )
        yield from _scale(pose, rack, config)
    if pose.floor_m is not None:
        found, std = 1e3 * pose.floor_m[0], 1e3 * pose.floor_m[1]
        yield SizeCheck("floor_mm", rack.name, "floor_mm", rack.floor_mm, found, std, 1, TOLERANCE_MM, found)


def _scale(pose: RackPose, rack: RackModel, config: RackConfig) -> Iterator[SizeCheck]:
    """One scale of pitch and outline, as `rack.proof` weighs them; `write` is the factor for the capture's depth."""
    assert pose.size is not None
    share, std = pose.size.scale(rack, config.edge_std_mm * 1e-3)
    tolerance = config.max_scale
    if pose.T_camera_rack is not None:
        face_m = pose.T_camera_rack @ np.array([0.0, 0.0, rack.height_m, 1.0])
        tolerance = config.max_scale_shift_mm * 1e-3 / float(np.linalg.norm(face_m[:3]))
    scale = 1 + share
    yield SizeCheck("scale", rack.name, "depth_scale_m", 1.0, scale, std, 1, tolerance, 1 / scale, "outline_mm")


def _tube_sizes(scene: Scene, estimates: Sequence[TubeEstimate], config: Config) -> Iterator[SizeCheck]:
    """Heights and diameters of closed tops, type by type."""
    if scene.rack.floor_tolerance_mm > TOLERANCE_MM:
        return  # its floor was set by these very tops
    shift_mm, shared_mm = _floor_shift_mm(scene.rack_pose, scene.rack)
    floor_key = "floor_mm" if scene.rack_pose.floor_m is None else ""
    cap_mm = 1e3 * config.profile.cap_height_m
    for tube in (tube for tube in scene.tubes if not tube.is_open):
        tops = [
            e.pose.top
            for e in estimates
            if e.target.tube == tube and e.pose.top is not None and e.pose.reason_code in MEASURED_CODES
        ]
        heights = 1e3 * np.array([top.height_m for top in tops]) - shift_mm
        heights = heights[np.isfinite(heights)]
        strange = len(heights) == 0
        heights = _with_strangers(heights, tube, scene.tubes, estimates, shift_mm)
        if len(heights):
            std = float(np.hypot(max(_scatter(heights), cap_mm) / np.sqrt(len(heights)), shared_mm))
            yield _height(tube, float(np.median(heights)), std, len(heights), floor_key, strange)
        wide = 1e3 * np.array([top.diameter_m for top in tops])
        wide = wide[np.isfinite(wide)]
        if len(wide) and tube.cap is not None:
            # Blur moves the ends of all caps alike: more caps do not take that away.
            ends_m = scene.noise.edge_blur_px * scene.noise.spacing_m / float(np.sqrt(12))
            blur_mm = 2e3 * float(np.hypot(config.profile.widening_m, ends_m))
            std = float(np.hypot(_scatter(wide) / np.sqrt(len(wide)), blur_mm))
            found, defined = float(np.median(wide)), tube.cap.diameter_mm
            yield SizeCheck(
                "cap_diameter_mm", tube.name, "diameter_mm", defined, found, std, len(wide), TOLERANCE_MM, found
            )


def _height(tube: TubeModel, found_mm: float, std_mm: float, n: int, floor_key: str, strange: bool) -> SizeCheck:
    """A type's height; the key is that of its cap's seat where the cap then still sits on the rim."""
    off = found_mm - tube.height_mm
    key, write = "body.height_mm", tube.body.height_mm + off
    if tube.cap is not None and 0 <= tube.cap.top_mm + off <= tube.cap.height_mm:
        key, write = "top_mm", tube.cap.top_mm + off
    other = "another type" if strange else floor_key
    return SizeCheck("top_height_mm", tube.name, key, tube.height_mm, found_mm, std_mm, n, TOLERANCE_MM, write, other)


def _with_strangers(
    heights_mm: FloatArray,
    tube: TubeModel,
    tubes: Sequence[TubeModel],
    estimates: Sequence[TubeEstimate],
    shift_mm: float,
) -> FloatArray:
    """Heights of a type's tops, with those of no given type that are nearer to its height than to another's.

    Only tops near a type's defined height are taken for it: where that is wrong, the others are among the unknown ones.
    Without any of the type, they count if they are several and alike.
    """
    found = [
        1e3 * e.pose.top.height_m - shift_mm
        for e in estimates
        if e.target.tube is None and e.pose.top is not None and e.pose.reason_code == "unknown_type"
    ]
    nearest = [min(tubes, key=lambda one: abs(one.height_mm - height)) for height in found]
    mine = np.array([height for height, one in zip(found, nearest, strict=True) if one == tube])
    mine = mine[np.abs(mine - tube.height_mm) < MAX_OFF_MM]
    if len(heights_mm):
        return np.concatenate([heights_mm, mine[np.abs(mine - np.median(heights_mm)) < 2 * TOLERANCE_MM]])
    alike = len(mine) >= LEAST_STRANGERS and float(np.ptp(mine)) < 2 * TOLERANCE_MM
    return mine if alike else np.empty(0)


def _floor_shift_mm(pose: RackPose, rack: RackModel) -> tuple[float, float]:
    """How much higher the slots' floor is than defined, as seen, and the error that a frame's heights over it share."""
    face_mm = 0.0 if pose.covariance is None else 1e3 * float(np.sqrt(pose.covariance[5, 5]))
    if pose.floor_m is None:
        return 0.0, face_mm
    return 1e3 * (pose.floor_m[0] - rack.floor_m), float(np.hypot(1e3 * pose.floor_m[1], face_mm))


def _scatter(values: FloatArray) -> float:
    """Robust standard deviation: of the median of absolute deviations."""
    return 1.4826 * float(np.median(np.abs(values - np.median(values))))


def _pool(group: Sequence[SizeCheck]) -> SizeCheck:
    measured, std = weighted_mean(np.array([size.measured for size in group]), np.array([size.std for size in group]))
    n, first = sum(size.n for size in group), group[0]
    others = "; ".join(sorted({size.other_key for size in group if size.other_key}))
    write = 1 / measured if first.quantity == "scale" else first.write + measured - first.measured
    tolerance = float(np.mean([size.tolerance for size in group]))
    return replace(first, measured=measured, std=std, n=n, tolerance=tolerance, write=write, other_key=others)
