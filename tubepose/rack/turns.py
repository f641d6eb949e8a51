"""Which way round a rack stands whose top looks the same, or nearly so, after half a turn or a quarter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tubepose.capture.frame import CameraIntrinsics
from tubepose.capture.session import SlotHint
from tubepose.checks import Check
from tubepose.config import RackConfig
from tubepose.labware import RackModel
from tubepose.rack.agreement import Agreement, measure_agreement
from tubepose.rack.field import top_field
from tubepose.rack.settling import Registration, register_at
from tubepose.rack.size import FaceSize
from tubepose.transforms import HALF_TURN, QUARTER_TURN, FloatArray, transform_points


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
    hint: SlotHint | None,
    intrinsics: CameraIntrinsics | None,
) -> tuple[int, str]:
    """Which of two or four turns to report, and what decided.

    Args:
        T_camera_turns: The turn that agrees best, T_camera_rack of shape (4, 4), metres, and the others.
        margin_m: Rmse of the next best one minus that of the best one, metres.
        rack: The rack.
        config: What margin decides.
        hint: Where a slot is seen.
        intrinsics: Of the image that the hint speaks of.
    """
    if margin_m > config.ambiguous_margin_m:
        return 0, "geometry"
    if hint is not None and intrinsics is not None:
        pixels = _hinted(T_camera_turns, rack, hint, intrinsics)
        distances = np.hypot(*(pixels - np.array(hint.pixel)).T)
        nearest = int(distances.argmin())
        others = np.arange(len(distances)) != nearest
        # A hint far from all places says nothing: swapped coordinates, or a pixel of another image.
        near = 0.25 * np.hypot(*(pixels[others] - pixels[nearest]).T)
        if (distances[nearest] < near).all() and (near < distances[others] - distances[nearest]).all():
            return nearest, "hint"
    # Decided by the image's diagonal: racks stand along the image's sides more often than along its diagonal.
    return int(np.argmax([T[:2, 0].sum() for T in T_camera_turns])), "rule"


def unused_hint(
    T_camera_given: FloatArray,
    T_camera_others: Sequence[FloatArray],
    rack: RackModel,
    hint: SlotHint | None,
    intrinsics: CameraIntrinsics | None,
) -> str:
    """Why a hint has not decided between the turn that is given and the others, in words; empty without a hint."""
    if hint is None:
        return ""
    if intrinsics is None:
        return f"the hint for {hint.slot} is a pixel, and this cloud has none: give an organised cloud or an image"
    (u, v), *others = _hinted([T_camera_given, *T_camera_others], rack, hint, intrinsics)
    turned = " or ".join(f"{other_u:.0f},{other_v:.0f}" for other_u, other_v in others)
    return (
        f"the hint says that {hint.slot} is seen at {hint.pixel[0]:.0f},{hint.pixel[1]:.0f}, but it is at "
        f"{u:.0f},{v:.0f} in the pose given or, the rack turned, at {turned}: point nearer to one of them, in pixels "
        "of the capture's image (an overlay is cut and scaled)"
    )


def _hinted(
    T_camera_turns: Sequence[FloatArray], rack: RackModel, hint: SlotHint, intrinsics: CameraIntrinsics
) -> FloatArray:
    """Pixels (K, 2) where the hint's slot is seen in each turn."""
    point = np.array([*rack.slot(hint.slot).center_m, rack.height_m])
    return np.stack([intrinsics.project(transform_points(T, point)) for T in T_camera_turns])
