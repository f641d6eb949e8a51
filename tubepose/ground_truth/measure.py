"""True poses of the declared tubes of one frame: rack, caps, their slots, and what is refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tubepose.capture.frame import RgbdFrame
from tubepose.capture.hints import SlotHint, pointed_at
from tubepose.capture.registration import known_intrinsics
from tubepose.ground_truth.caps import Cap, find_caps
from tubepose.ground_truth.model import GroundTruthConfig, GroundTruthResult, TubeTruth
from tubepose.ground_truth.rack_top import find_rack, turns_of
from tubepose.labware import CapModel, RackModel, TubeModel
from tubepose.transforms import FloatArray, axis_rotation, invert_transform, make_transform, tilt_rad, transform_points

_DEFAULT = GroundTruthConfig()


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What the session says stands there."""

    rack: RackModel
    tubes: Mapping[str, TubeModel]
    cap: CapModel
    config: GroundTruthConfig


@dataclass(frozen=True, slots=True, eq=False)
class _Placed:
    """A cap in the rack frame of one turn: its nearest slot and what of it fits there.

    Attributes:
        cap: The measured square.
        slot: Nearest slot.
        axis: The square's normal, rack frame, shape (3,).
        lateral_m: Distance of the axis' foot on the slot floor to the slot's centre, metres.
        above_floor_m: Height of the tube's bottom above the slot floor, metres; NaN for an undeclared slot.
    """

    cap: Cap
    slot: str
    axis: FloatArray
    lateral_m: float
    above_floor_m: float

    def refusal(self, scene: _Scene) -> str:
        """Why the tube's pose is no truth; empty when it is."""
        config, rack = scene.config, scene.rack
        problem = self.cap.refusal(config)
        if problem:
            return problem
        tilt = tilt_rad(self.axis, np.array([0.0, 0.0, 1.0]))
        if tilt > config.max_tilt_rad:
            return f"tilt {np.rad2deg(tilt):.1f} deg is above {np.rad2deg(config.max_tilt_rad):.1f} deg"
        allowed = config.slot_tolerance_m + rack.floor_play_mm * 1e-3
        if self.lateral_m > allowed:
            return (
                f"the bottom lies {self.lateral_m * 1e3:.1f} mm off the slot's centre, {allowed * 1e3:.1f} mm allowed"
            )
        if abs(self.above_floor_m) > config.height_tolerance_m:
            return (
                f"the bottom lies {self.above_floor_m * 1e3:+.1f} mm off the slot floor, "
                f"{config.height_tolerance_m * 1e3:.1f} mm allowed: another tube, or a cap that is not seated"
            )
        return ""


def measure_ground_truth(
    frame: RgbdFrame,
    rack: RackModel,
    tubes: Mapping[str, TubeModel],
    cap: CapModel,
    hint: SlotHint | None,
    config: GroundTruthConfig = _DEFAULT,
) -> GroundTruthResult:
    """Measure the true poses of the tubes in a frame with printed caps (paper, section V-A).

    Args:
        frame: Frame of the capture with printed caps.
        rack: The rack in it.
        tubes: Tube model per slot, as the session declares them.
        cap: The printed cap that every tube wears.
        hint: Where one slot is, which tells the turns of a rack apart when its caps do not; or None.
        config: Thresholds.

    Returns:
        One entry per declared slot. What the frame does not show well enough is refused with a reason, never guessed.

    Raises:
        KeyError: A declared slot is not in the rack.
    """
    scene = _Scene(rack, tubes, cap, config)
    T_camera_any = find_rack(frame.measured_m, rack, config)
    if T_camera_any is None:
        width, depth = rack.outline_mm
        return _refused(scene, f"no rack top of {width:g} x {depth:g} mm ({rack.name}) found")
    caps = find_caps(frame, T_camera_any, _height_band_m(scene), cap.square_m, config)
    turns = turns_of(T_camera_any, rack, config)
    placed = [[_place(found, T_camera_rack, scene) for found in caps] for T_camera_rack in turns]
    scores = [_score(in_turn, scene) for in_turn in placed]
    chosen, problem = _choose_turn(scores, _hinted_turn(frame, turns, scene, hint))
    if problem:
        return _refused(scene, problem, ambiguous=chosen is None)
    assert chosen is not None
    return _assign(turns[chosen], placed[chosen], scene)


def _refused(scene: _Scene, reason: str, ambiguous: bool = False) -> GroundTruthResult:
    tubes = tuple(TubeTruth(slot, tube.name, "refused", f"frame: {reason}") for slot, tube in scene.tubes.items())
    return GroundTruthResult("refused", reason, None, ambiguous, tubes)


def _height_band_m(scene: _Scene) -> tuple[float, float]:
    """Lowest and highest height above the rack's base where a square may be, metres; never down to the rack's top."""
    rack, margin = scene.rack, scene.config.search_margin_m
    heights = [rack.floor_m + scene.cap.offset_m(tube) for tube in scene.tubes.values()] or [rack.height_m]
    lowest = max(min(heights) - margin, rack.height_m + 2 * scene.config.top_band_m)
    return lowest, max(heights) + margin


def _place(cap: Cap, T_camera_rack: FloatArray, scene: _Scene) -> _Placed:
    """Nearest slot of a cap: by the foot of its axis, or straight below where the normal is not to be trusted."""
    T_rack_square = invert_transform(T_camera_rack) @ cap.T_camera_square
    axis, center = T_rack_square[:3, 2], T_rack_square[:3, 3]
    length = (center[2] - scene.rack.floor_m) / axis[2] if axis[2] > 0.5 else np.inf
    foot = center - axis * length if np.isfinite(length) else center
    where = center if cap.refusal(scene.config) else foot
    distances = np.linalg.norm(scene.rack.slot_centers_m - where[:2], axis=1)
    slot = scene.rack.all_slots[int(np.argmin(distances))]
    above = length - scene.cap.offset_m(scene.tubes[slot.name]) if slot.name in scene.tubes else float("nan")
    return _Placed(cap, slot.name, axis, float(np.linalg.norm(foot[:2] - slot.center_m)), float(above))


def _score(placed: list[_Placed], scene: _Scene) -> int:
    """Agreement of a turn with the session: declared slots that hold their cap, less caps where none is declared."""
    good = [p for p in placed if not p.cap.refusal(scene.config)]
    fitting = {p.slot for p in good if p.slot in scene.tubes and not p.refusal(scene)}
    return len(fitting) - sum(p.slot not in scene.tubes for p in good)


def _choose_turn(scores: list[int], hinted: int | None) -> tuple[int | None, str]:
    """The turn with the best agreement, by the hint among equals; a reason when they contradict or do not tell."""
    best = [turn for turn, score in enumerate(scores) if score == max(scores)]
    if len(best) == 1:
        if hinted is not None and hinted != best[0]:
            return best[0], "the hint contradicts the slots that hold caps: correct the hint or the list of tubes"
        return best[0], ""
    if hinted in best:
        return hinted, ""
    return None, "ambiguous turn: the caps fit several turns of the rack equally, and no hint tells them apart"


def _hinted_turn(frame: RgbdFrame, turns: Sequence[FloatArray], scene: _Scene, hint: SlotHint | None) -> int | None:
    """The turn that a hint means; None without one, and where it means none clearly."""
    if hint is None:
        return None
    opening = np.array([*scene.rack.slot(hint.slot).center_m, scene.rack.height_m])
    openings_m = np.stack([transform_points(T_camera_rack, opening) for T_camera_rack in turns])
    return pointed_at(hint, openings_m, turns[0][:3, 2], known_intrinsics(frame))


def _assign(T_camera_rack: FloatArray, placed: list[_Placed], scene: _Scene) -> GroundTruthResult:
    """Truth of every declared slot in the chosen turn."""
    enough = scene.config.second_cap_share
    caps = [p for p in placed if p.cap.coverage >= enough]
    undeclared = sorted({p.slot for p in caps if p.slot not in scene.tubes and not p.cap.refusal(scene.config)})
    tubes = []
    for slot, tube in scene.tubes.items():
        here = [p for p in caps if p.slot == slot]
        if len(here) == 1:
            tubes.append(_truth(T_camera_rack, here[0], tube, scene))
            continue
        reason = f"two caps on one slot ({len(here)} squares)" if here else "no cap found at the slot"
        if not here and undeclared:
            reason += f"; caps stand at undeclared {', '.join(undeclared)}"
        tubes.append(TubeTruth(slot, tube.name, "refused", reason))
    return GroundTruthResult("ok", "", T_camera_rack, False, tuple(tubes), tuple(undeclared))


def _truth(T_camera_rack: FloatArray, placed: _Placed, tube: TubeModel, scene: _Scene) -> TubeTruth:
    cap = placed.cap
    truth = TubeTruth(
        slot=placed.slot,
        tube=tube.name,
        status="refused",
        reason=placed.refusal(scene),
        plane_rms_m=cap.plane_rms_m,
        icp_rms_m=cap.icp_rms_m,
        coverage=cap.coverage,
        n_points=cap.n_points,
        tilt_std_rad=cap.tilt_std_rad,
    )
    if truth.reason:
        return truth
    bottom = cap.T_camera_square[:3, 3] - cap.T_camera_square[:3, 2] * scene.cap.offset_m(tube)
    rotation = T_camera_rack[:3, :3] @ axis_rotation(placed.axis)
    return replace(truth, status="ok", T_camera_tube=make_transform(rotation, bottom))
