"""Hints: which of the ways that look alike a rack stands in, by a slot whose place is known or by an earlier frame.

docs/capture-format.md says how they are written.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from pydantic import BaseModel, ConfigDict, model_validator

from tubepose.capture.frame import CameraIntrinsics
from tubepose.transforms import FloatArray

Toward = Literal["top-left", "top", "top-right", "left", "right", "bottom-left", "bottom", "bottom-right"]
"""Corners and edges of the image: x of the camera frame points right, y down."""

PREVIOUS = "previous"
FORMS = (
    f"expected SLOT@U,V (a pixel), SLOT@WHERE ({', '.join(get_args(Toward))}), SLOT@X,Y,Z (metres, camera frame) or "
    f"{PREVIOUS}, for example A1@412,300 or A1@top-left"
)
CLEAR_SHARE = 0.25
"""A place that a hint means is nearer to it than this share of its distance to each other one; no unit."""
CLEAR_ANGLE_RAD = math.radians(30)
"""A place that a word of `Toward` means lies this much nearer to its direction, from the middle of all places.

Of a rack that stands at 90 deg to the word that leaves 15 deg to either side of it open, and the nearest of the eight
words, 22.5 deg off at most, still tells the four corners of a square rack apart: 22.5 from 67.5 deg.
"""
CORNER_ANGLE_RAD = math.radians(60)
"""Farther from the direction of a corner no place is at it.

Beyond 45 deg it is on the other side of the rack's middle in one of the two ways that the corner names; the rest is for
a rack that stands askew.
"""
SAME_PLACE_M = 1e-3
"""Places of a slot that are nearer than this are one: the middle slot's, which tells no turns apart.

Metres: more than the poses of two turns of one rack differ by, less than any rack's slots are apart.
"""
HEIGHT_M = 0.2
"""A point may lie this far over or under its slot's opening, metres: more than any tube is high or any slot deep."""
FARTHEST_M = 10.0
"""A point farther from the camera is in millimetres, not metres: no camera that resolves a slot looks so far."""


def _unit(x: float, y: float) -> FloatArray:
    length = math.hypot(x, y)
    return np.array([x / length, y / length])


_SIGNS = {"left": -1.0, "right": 1.0, "top": -1.0, "bottom": 1.0}
_DIRECTIONS: Mapping[Toward, FloatArray] = {
    word: _unit(
        sum(_SIGNS[part] for part in word.split("-") if part in ("left", "right")),
        sum(_SIGNS[part] for part in word.split("-") if part in ("top", "bottom")),
    )
    for word in get_args(Toward)
}


class SlotHint(BaseModel):
    """Where one slot is: tells the turns of a rack apart that looks the same when it is turned.

    Exactly one of `pixel`, `toward` and `point_m` is given.

    Attributes:
        slot: Name of the slot.
        pixel: Its place (u, v) in the image; a click is exact enough.
        toward: The corner or edge of the image that it is nearest to, of the places that it can be at.
        point_m: A point (x, y, z) on it, over it or in it, camera frame, metres.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    slot: str
    pixel: tuple[float, float] | None = None
    toward: Toward | None = None
    point_m: tuple[float, float, float] | None = None

    @model_validator(mode="after")
    def _check(self) -> SlotHint:
        given = [name for name in ("pixel", "toward", "point_m") if getattr(self, name) is not None]
        if len(given) != 1:
            found = " and ".join(given) or "none of them"
            raise ValueError(f"a hint gives one of pixel, toward and point_m for its slot, found {found}")
        if self.point_m is not None and math.hypot(*self.point_m) > FARTHEST_M:
            raise ValueError(f"the point of a hint is in metres, camera frame; {self.point_m} is too far away")
        return self


@dataclass(frozen=True, slots=True, eq=False)
class EarlierRack:
    """The hint that a rack stands as it did in an earlier frame in which its turn was known.

    Attributes:
        T_camera_rack: Its pose there, shape (4, 4), metres; None where no earlier frame knew its turn.
        within_m: A corner of the rack's top that has moved farther is not one of a rack that was left alone, metres.
        reason: Why there is no pose, in words; empty if there is one.
    """

    T_camera_rack: FloatArray | None
    within_m: float
    reason: str = ""


TurnHint = SlotHint | EarlierRack
"""What may tell the turns of a rack in one frame apart."""


@dataclass(frozen=True, slots=True)
class Hint:
    """What a person says of a capture: a slot's place, or that its rack stands as before, or first one, then the other.

    Attributes:
        place: Where a slot is; with `previous`, only until a frame's turn is known.
        previous: Whether a rack that stands still since an earlier frame stands as it did there.
    """

    place: SlotHint | None = None
    previous: bool = False


def read_hint(text: str) -> Hint:
    """A hint as it is written: `A1@412,300`, `A1@top-left`, `A1@0.10,-0.05,0.62`, `previous`, `A1@top-left,previous`.

    Raises:
        ValueError: It is none of these; the text says what was expected.
    """
    words = [word.strip() for word in text.split(",")]
    parts = [word for word in words if word != PREVIOUS]
    previous = len(words) - len(parts)
    if previous > 1 or not words or (not parts and not previous):
        raise ValueError(FORMS)
    return Hint(_place(",".join(parts)) if parts else None, bool(previous))


def _place(text: str) -> SlotHint:
    slot, _, where = text.partition("@")
    word = next((word for word in get_args(Toward) if word == where), None)
    if slot and word is not None:
        return SlotHint(slot=slot, toward=word)
    try:
        numbers = tuple(float(value) for value in where.split(","))
    except ValueError:
        numbers = ()
    if not slot or len(numbers) not in (2, 3) or not all(math.isfinite(number) for number in numbers):
        raise ValueError(FORMS)
    if len(numbers) == 2:
        return SlotHint(slot=slot, pixel=numbers)
    if math.hypot(*numbers) > FARTHEST_M:
        raise ValueError(f"the point is {math.hypot(*numbers):g} m away; expected metres, in the camera frame")
    return SlotHint(slot=slot, point_m=(numbers[0], numbers[1], numbers[2]))


def pointed_at(
    hint: SlotHint, openings_m: FloatArray, normal: FloatArray, intrinsics: CameraIntrinsics | None
) -> int | None:
    """Which of the places that a slot can be at a hint means; None where it means none of them clearly.

    Args:
        hint: The hint.
        openings_m: Where the slot's opening is in each turn, shape (K, 3), camera frame, metres.
        normal: Of the rack's top, camera frame, shape (3,): a point over the slot or in it is one at its opening.
        intrinsics: Of the image that a pixel is of; without them a pixel means none.
    """
    if hint.toward is not None:
        return _towards(hint.toward, openings_m)
    if hint.point_m is not None:
        off = np.array(hint.point_m) - openings_m
        over = off @ normal
        if np.abs(over).min() > HEIGHT_M:
            return None
        across = np.linalg.norm(off - over[:, None] * normal, axis=1)
        return _near(across, openings_m, openings_m)
    if intrinsics is None:
        return None
    pixels = intrinsics.project(openings_m)
    return _near(np.hypot(*(pixels - np.array(hint.pixel)).T), pixels, openings_m)


def _near(distances: FloatArray, places: FloatArray, openings_m: FloatArray) -> int | None:
    """The place that is near, if it is clearly the nearest.

    A hint far from all places is of something else: swapped coordinates, or a pixel of another image.
    """
    best = int(distances.argmin())
    others = np.arange(len(distances)) != best
    near = CLEAR_SHARE * np.linalg.norm(places[others] - places[best], axis=1)
    clear = (distances[best] < near).all() and (near < distances[others] - distances[best]).all()
    return best if clear and _apart(best, openings_m) else None


def _towards(word: Toward, openings_m: FloatArray) -> int | None:
    """The place that lies in a direction of the image, if it is clearly the one that does."""
    angles = _angles_rad(word, openings_m)
    best = int(angles.argmin())
    clear = (np.delete(angles, best) - angles[best] > CLEAR_ANGLE_RAD).all()
    if "-" in word and angles[best] > CORNER_ANGLE_RAD:
        return None
    return best if clear and _apart(best, openings_m) else None


def _angles_rad(word: Toward, openings_m: FloatArray) -> FloatArray:
    """Angles between a direction of the image and places (K, 3) as seen from the middle of them, shape (K,).

    NaN for what is behind the camera, or at the middle.
    """
    seen = CameraIntrinsics(1, 1, 1.0, 1.0, 0.0, 0.0).project(openings_m)
    off = seen - seen.mean(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.arccos(np.clip(off @ _DIRECTIONS[word] / np.linalg.norm(off, axis=1), -1.0, 1.0)))


def _apart(index: int, openings_m: FloatArray) -> bool:
    """Whether a place is none of the others."""
    others = np.delete(openings_m, index, axis=0)
    return bool((np.linalg.norm(others - openings_m[index], axis=1) > SAME_PLACE_M).all())


def word_of(openings_m: FloatArray, index: int) -> Toward | None:
    """The corner or edge of the image that tells one place of a slot from its others best; None if none does.

    Args:
        openings_m: The places, shape (K, 3), camera frame, metres.
        index: Which of them.
    """

    def lead_rad(word: Toward) -> float:
        angles = _angles_rad(word, openings_m)
        return float((np.delete(angles, index) - angles[index]).min())

    best = max(_DIRECTIONS, key=lead_rad)
    return best if _towards(best, openings_m) == index else None
