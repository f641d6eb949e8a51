"""Which way round a rack stands whose top looks the same, or nearly so, after half a turn or a quarter."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tubepose.capture.frame import CameraIntrinsics
from tubepose.capture.hints import EarlierRack, SlotHint, TurnHint, pointed_at, word_of
from tubepose.checks import Check
from tubepose.config import RackConfig
from tubepose.labware import RackModel
from tubepose.rack.agreement import Agreement, measure_agreement
from tubepose.rack.field import top_field
from tubepose.rack.pose import RackPose
from tubepose.rack.settling import Registration, register_at
from tubepose.rack.size import FaceSize
from tubepose.transforms import HALF_TURN, QUARTER_TURN, FloatArray, transform_points

_NONE: Mapping[str, tuple[str, FloatArray]] = {}


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """A registration seen from a rack's frame that is turned about its z.

    Attributes:
        T_camera_rack: Its pose, shape (4, 4), metres.
        covariance: Of that pose, shape (6, 6), about and along the turned frame's axes.
        agreement: What the points say of it.
        level_tops: How many tops of tubes hold it level.
        checks: What it had to pass.
        bow_m: Of its face, shape (3,), along the turned frame's axes, metres; see `Fit.bow_m`.
        bow_std_m: Standard deviations of that.
        size: Sizes of its face along the turned frame's axes; None where they were not measured.
        floor_m: Height of the slots' floor and its standard deviation, metres; None where it was not seen.
    """

    T_camera_rack: FloatArray
    covariance: FloatArray
    agreement: Agreement
    level_tops: int
    checks: tuple[Check, ...]
    bow_m: FloatArray
    bow_std_m: FloatArray
    size: FaceSize | None
    floor_m: tuple[float, float] | None


def turns_of(best: Registration, points_m: FloatArray, rack: RackModel, config: RackConfig) -> list[Turn]:
    """A registration and its other turns, the least rmse first; registered anew where half a turn changes the top.

    Args:
        best: The registration.
        points_m: What it is registered to, shape (N, 3), camera frame, metres.
        rack: The rack.
        config: Its section.
    """
    alike = top_field(rack).alike
    if alike > 1:
        return [_turn(best, np.linalg.matrix_power(QUARTER_TURN, 4 // alike * k)) for k in range(alike)]
    turned = register_at(points_m, best.fit.T_camera_rack @ HALF_TURN, rack, config)
    if (turned.fit.level is None) != (best.fit.level is None):  # compared by the same heights
        fit = replace(turned.fit, level=best.fit.level)
        turned = replace(turned, fit=fit, agreement=measure_agreement(fit.laid_flat(points_m, rack), fit, rack, config))
    return sorted((_turn(one, np.eye(4)) for one in (best, turned)), key=lambda turn: turn.agreement.rmse_m)


def _turn(registration: Registration, T_registered_turned: FloatArray) -> Turn:
    fit = registration.fit
    axes = np.kron(np.eye(2), T_registered_turned[:3, :3])
    quarter = abs(T_registered_turned[0, 0]) < 0.5
    return Turn(
        fit.T_camera_rack @ T_registered_turned,
        np.asarray(axes.T @ fit.covariance @ axes),
        registration.agreement,
        0 if fit.level is None else fit.level.count,
        registration.checks,
        _bow_turned(fit.bow_m, T_registered_turned),
        np.abs(_bow_turned(fit.bow_std_m, T_registered_turned)),
        registration.size if registration.size is None or not quarter else registration.size.quarter_turned(),
        registration.floor_m,
    )


def _bow_turned(bow_m: FloatArray, T: FloatArray) -> FloatArray:
    """A bow's three parts (3,) seen from a frame that is turned by a multiple of a quarter turn."""
    return bow_m if abs(T[0, 0]) > 0.5 else np.array([bow_m[1], bow_m[0], -bow_m[2]])


def choose_turn(
    T_camera_turns: Sequence[FloatArray],
    margin_m: float,
    rack: RackModel,
    config: RackConfig,
    hint: TurnHint | None,
    intrinsics: CameraIntrinsics | None,
) -> tuple[int, str]:
    """Which of two or four turns to report, and what decided.

    Args:
        T_camera_turns: The turn that agrees best, T_camera_rack of shape (4, 4), metres, and the others.
        margin_m: Rmse of the next best one minus that of the best one, metres.
        rack: The rack.
        config: What margin decides.
        hint: Where a slot is, or where the rack stood before.
        intrinsics: Of the image that a pixel of the hint speaks of.
    """
    if margin_m > config.ambiguous_margin_m:
        return 0, "geometry"
    if isinstance(hint, EarlierRack):
        unmoved = np.flatnonzero(_moved_m(hint.T_camera_rack, T_camera_turns, rack) <= hint.within_m)
        if len(unmoved) == 1:
            return int(unmoved[0]), "previous"
    elif hint is not None:
        told = pointed_at(hint, _openings_m(T_camera_turns, rack, hint.slot), T_camera_turns[0][:3, 2], intrinsics)
        if told is not None:
            return told, "hint"
    # Decided by the image's diagonal: racks stand along the image's sides more often than along its diagonal.
    return int(np.argmax([T[:2, 0].sum() for T in T_camera_turns])), "rule"


def unused_hint(
    T_camera_given: FloatArray,
    T_camera_others: Sequence[FloatArray],
    rack: RackModel,
    hint: TurnHint | None,
    intrinsics: CameraIntrinsics | None,
) -> str:
    """Why a hint has not decided between the turn that is given and the others, in words; empty without a hint."""
    if hint is None:
        return ""
    T_camera_turns = [T_camera_given, *T_camera_others]
    if isinstance(hint, EarlierRack):
        return _earlier_words(hint, T_camera_turns, rack)
    if hint.pixel is not None and intrinsics is None:
        return (
            f"the hint for {hint.slot} is a pixel, and this cloud has none: give an organised cloud or an image, or a "
            f"hint without pixels, as {hint.slot}@top-left"
        )
    return _place_words(hint, _openings_m(T_camera_turns, rack, hint.slot), intrinsics)


def _earlier_words(hint: EarlierRack, T_camera_turns: Sequence[FloatArray], rack: RackModel) -> str:
    do = "give a hint for this capture"
    if hint.T_camera_rack is None:
        return f"{hint.reason}: {do}"
    moved_m, limit_mm = _moved_m(hint.T_camera_rack, T_camera_turns, rack).min(), f"{hint.within_m * 1e3:g} mm"
    if moved_m <= hint.within_m:
        return f"a turn of this rack moves it by less than {limit_mm}: {do}"
    return (
        f"the rack has moved by {moved_m * 1e3:.1f} mm or more since its turn was last known, at most {limit_mm} "
        f"expected of one that was left alone: {do}"
    )


def _place_words(hint: SlotHint, openings_m: FloatArray, intrinsics: CameraIntrinsics | None) -> str:
    """What a hint says, and where its slot is in the pose given and the others."""
    if hint.toward is not None:
        words = [word_of(openings_m, k) for k in range(len(openings_m))]
        if None in words:
            return f"{hint.slot} is at nearly the same place however the rack is turned: name a slot at a corner"
        turned = " or ".join(str(word) for word in words[1:])
        return (
            f"the hint says that {hint.slot} is seen at the {hint.toward}, which does not tell its places apart: it is "
            f"at the {words[0]} in the pose given or, the rack turned, at the {turned}"
        )
    if hint.point_m is not None:
        said, (given, *others) = _numbers(hint.point_m, 3), [_numbers(place, 3) for place in openings_m]
        do = "give a point nearer to one of them, in metres, in the camera frame"
    else:
        assert hint.pixel is not None
        assert intrinsics is not None
        pixels = intrinsics.project(openings_m)
        said, (given, *others) = _numbers(hint.pixel, 0), [_numbers(place, 0) for place in pixels]
        do = "point nearer to one of them, in pixels of the capture's image (an overlay is cut and scaled)"
    return (
        f"the hint says that {hint.slot} is seen at {said}, but it is at {given} in the pose given or, the rack "
        f"turned, at {' or '.join(others)}: {do}"
    )


def _numbers(place: Sequence[float] | FloatArray, digits: int) -> str:
    return ",".join(f"{value:.{digits}f}" for value in place)


def example_hints(T_camera_rack: FloatArray, rack: RackModel) -> tuple[str, ...]:
    """Hints that tell the turns of a rack apart, that of the pose given first; none where no slot's place does.

    Args:
        T_camera_rack: The pose given, shape (4, 4), metres.
        rack: The rack.
    """
    alike = max(top_field(rack).alike, 2)
    T_camera_turns = [T_camera_rack @ np.linalg.matrix_power(QUARTER_TURN, 4 // alike * k) for k in range(alike)]
    for slot in rack.all_slots:
        openings_m = _openings_m(T_camera_turns, rack, slot.name)
        words = [word_of(openings_m, k) for k in range(alike)]
        if None not in words:
            return tuple(f"{slot.name}@{word}" for word in words)
    return ()


class EarlierTurns:
    """Where racks stood in earlier frames in which their turn was known: by geometry, a hint, or an earlier frame."""

    def __init__(self, last: Mapping[str, tuple[str, FloatArray]] = _NONE, used: Iterable[SlotHint] = ()) -> None:
        self._last = dict(last)
        self._used = list(used)

    def hint(self, group: str, rack: RackModel, place: SlotHint | None, config: RackConfig) -> TurnHint:
        """The hint for the next frame: a place, until a frame's turn was known with it; then where the rack stood.

        Args:
            group: What has frames in common: a session.
            rack: The rack in the frame.
            place: Where one of its slots is in the first frame; one object for all captures that it is said once for.
            config: How far a rack moves that is left alone.
        """
        if place is not None and not any(place is used for used in self._used):
            return place
        if group not in self._last:
            return EarlierRack(None, config.left_alone_m, "the turn of the rack was known in no earlier frame")
        name, T_camera_rack = self._last[group]
        if name != rack.name:
            return EarlierRack(None, config.left_alone_m, f"the last rack whose turn was known was another one, {name}")
        return EarlierRack(T_camera_rack, config.left_alone_m)

    def learn(self, group: str, rack: RackModel, place: SlotHint | None, pose: RackPose) -> None:
        """Keep a frame's pose, and that its place was of use, if the turn is known."""
        if pose.T_camera_rack is not None and not pose.ambiguous:
            self._last[group] = rack.name, pose.T_camera_rack
            if place is not None:
                self._used.append(place)


def _openings_m(T_camera_turns: Sequence[FloatArray], rack: RackModel, slot: str) -> FloatArray:
    """Where a slot's opening is in each turn, shape (K, 3), camera frame, metres."""
    opening = np.array([*rack.slot(slot).center_m, rack.height_m])
    return np.stack([transform_points(T, opening) for T in T_camera_turns])


def _moved_m(T_camera_before: FloatArray | None, T_camera_turns: Sequence[FloatArray], rack: RackModel) -> FloatArray:
    """How far the corner of the top that moved farthest has moved, if a turn is that of before, shape (K,), metres."""
    if T_camera_before is None:
        return np.full(len(T_camera_turns), np.inf)
    signs = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    corners = np.column_stack([signs * rack.outline_m / 2, np.full(4, rack.height_m)])
    before = transform_points(T_camera_before, corners)
    off = [np.linalg.norm(transform_points(T, corners) - before, axis=1).max() for T in T_camera_turns]
    return np.array(off)
