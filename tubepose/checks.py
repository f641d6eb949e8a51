"""Checks as data: what was measured, what was allowed, and whether it passed. Words are made here alone."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

MOST_TOLD = 2
"""So many failed checks are told of: the others follow from them as a rule."""


@dataclass(frozen=True, slots=True)
class Check:
    """One test of an answer.

    Attributes:
        code: What was tested, a key of `SENTENCES`.
        value: What was found, in the unit that the sentence names.
        limit: What was allowed.
        passed: Whether it was within that.
        decides: Whether an answer that fails it is refused; else it is marked.
        detail: What a number cannot say: a side, the name of a rack.
    """

    code: str
    value: float
    limit: float
    passed: bool
    decides: bool = True
    detail: str = ""


SENTENCES = {
    "inlier_rmse": "inlier rmse {value:.2f} mm, at most {limit:.2f} mm expected",
    "in_openings": (
        "{value:.1f}% of the top's points lie inside the openings of {name}, at most {limit:.0f}% expected: another "
        "rack?"
    ),
    "beside_outline": (
        "{value:.1f}% of the top's points lie just outside the outline of {name}, at most {limit:.1f}% expected: "
        "another rack?"
    ),
    "bow": "its face would be bowed by {value:.1f} mm, at most {limit:g} mm expected: another surface than its top",
    "little_seen": "{value:.1f}% of the top seen, at least {limit:.0f}% expected",
    "not_in_view": (
        "no points at all on {value:.0f}% of the top, at most {limit:.0f}% expected: is the rack in the image as a "
        "whole?"
    ),
    "slot_step": (
        "the rack could as well stand a slot farther: too little of its edge is seen (margin {value:.0f} nats, at "
        "least {limit:.0f} expected)"
    ),
    "uncertain_turn": (
        "its pose is uncertain by {value:.2f} deg (standard deviation), at most {limit:g} deg expected: too little "
        "is seen"
    ),
    "uncertain_shift": (
        "its pose is uncertain by {value:.2f} mm (standard deviation), at most {limit:g} mm expected: too little is "
        "seen"
    ),
    "lost": "its pose cannot be told at all: too little is seen",
    "row_more": (
        "the scan shows {detail}, which {name} has not (likelier by {value:.0f} nats): another rack, or its file"
    ),
    "row_fewer": "the scan shows {detail} than {name} has (likelier by {value:.0f} nats): another rack, or its file",
    "no_openings": "the scan shows {detail} rather than {name} (likelier by {value:.0f} nats)",
    "other_rack": "the scan shows {detail} rather than {name} (likelier by {value:.0f} nats): ask for that one",
    "tubes_beside": (
        "{value:.0f} of the places beside the slots of {name}, where {detail} would be, are full: another rack, or "
        "its file"
    ),
    "tops_off_slots": (
        "what stands up lies {value:.2f} of the distance of slots off the slots of {name}, at most {limit:g} expected: "
        "its slots are elsewhere; another rack?"
    ),
    "pitch_x": (
        "the slots lie {detail} along x than those of {name}: {value:.2f} mm at the outermost one, at most "
        "{limit:g} mm expected: another rack, correct pitch_mm, or the cloud's scale"
    ),
    "pitch_y": (
        "the slots lie {detail} along y than those of {name}: {value:.2f} mm at the outermost one, at most "
        "{limit:g} mm expected: another rack, correct pitch_mm, or the cloud's scale"
    ),
    "openings": (
        "the openings are {detail} than those of {name} by {value:.1f} mm, at most {limit:g} mm expected: another "
        "rack, or correct size_mm"
    ),
    "outline": (
        "the outline is {detail} than that of {name} by {value:.1f} mm, at most {limit:g} mm expected: another "
        "rack, or correct outline_mm"
    ),
    "scale": (
        "everything is {detail} than {name} by {value:.2f}%, at most {limit:g}% expected: the cloud's scale "
        "(depth_scale_m, calibration) or the rack's file is off"
    ),
    "scale_unknown": (
        "its distance hangs on the cloud's scale, which is known to {value:.1f} mm there (three standard deviations, "
        "by what is seen of {name} and rack.scale_std), {limit:g} mm expected: state the calibration of your sensor"
    ),
    "floor": (
        "the floor of the slots is seen {value:.1f} mm {detail} than {name} says, at most {limit:.1f} mm expected: "
        "another rack, or correct floor_mm"
    ),
    "faces_away": (
        "the origin sees the face of {name} at {value:.0f} deg off its normal, at most {limit:g} deg expected: the "
        "origin has to be the camera; is the cloud in a robot's frame?"
    ),
    "seen_through": (
        "lines from the origin to points behind the face of {name} cross its solid part {value:.0f}% as often as "
        "without a face, at most {limit:g}% expected: the origin has to be the camera; is the cloud in a robot's frame?"
    ),
    "table_above": (
        "{value:.0f}% of what lies around {name} is as far above its face as its table is below it, at most {limit:g}% "
        "expected: the face is seen from behind; the origin has to be the camera; is the cloud in a robot's frame?"
    ),
    "grid": "{detail}",
    "two_places": (
        "two places look like {name} (the better one by a ratio of {value:.2f} in evidence, {limit:g} expected): "
        "too little of its top is seen"
    ),
    # Frames of a recording that are averaged.
    "scene_moved": (
        "{value:.0f} of {limit:.0f} frames of {name} are left out of the average, as something in the scene moved: "
        "{detail}"
    ),
    "camera_moved": (
        "{value:.0f} of {limit:.0f} frames of {name} are left out of the average, as the camera moved: {detail}"
    ),
    # Tubes: what stands in a slot.
    "no_points_above": "no points above the rack's top",
    "few_points": "{value:.0f} points above the rack's top, at least {limit:.0f} expected",
    "slot_taken": "slot {detail} holds another tube",
    "in_no_slot": "at most {value:.0f}% of it is above one slot, at least {limit:.0f}% expected: lies across the rack?",
    "no_types_given": "no tube model given (--tubes)",
    "unknown_class": "class {detail}",
    "types_alike": "{value:.1f} mm high: {detail} are not told apart by height",
    "tube_in_box_only": "a tube is detected here, but {detail}",
    "unknown_type": "{detail}",
    "type_not_told": "{detail}",
    "lies_across": "{detail}",
    "second_top": "{detail}",
    "part_of_top": "{detail}",
    # Tubes: whether a pose is to be believed.
    "type_unclear": (
        "another of the given types fits its top as well as {name} ({value:.0f}% of its support, at most {limit:.0f}% "
        "expected)"
    ),
    "not_looked_at": "an open rim is measured in the image, and this cloud has no pixels",
    "points_apart": (
        "the points on its top lie {value:.1f} mm apart: too coarse to tell where its circle ends, {limit:.1f} mm "
        "or less expected"
    ),
    "circle_little_seen": "{value:.0f}% of the top's circle seen, at least {limit:.0f}% expected",
    "height_off": (
        "the top is {value:+.1f} mm off the height of {name} in {detail}, at most {limit:.1f} mm expected: another "
        "type, or it stands on something"
    ),
    "something_higher": (
        "{value:.0f}% of the points over its top lie above it, at most {limit:.0f}% expected: something taller stands "
        "there"
    ),
    "mouth_filled": (
        "{value:.0f}% of the points in its mouth lie at one height near its rim, at most {limit:.0f}% expected: a "
        "closed top, of another type"
    ),
    "not_in_slot": "stands or leans as slot {detail} does not let it: jammed, on something, or not in the slot",
    "tilt_uncertain": (
        "its tilt is known to {value:.2f} deg only (standard deviation), at most {limit:.2f} deg expected"
    ),
    "two_in_slot": "two tubes in one slot: {detail}",
    "in_wall": "{detail}: the body would be {value:.2f} mm inside the slot's wall (Eq. 5)",
    "no_pose": "{detail}",
    "labware": "{detail}",
}
"""What each check says. Limits that can be set stand in the configuration, sections rack, profile, tube and slots."""


def sentence(check: Check, name: str) -> str:
    """What a check says of a rack or tube of that name."""
    words = SENTENCES[check.code.replace("column", "row")]
    return words.format(value=check.value, limit=check.limit, detail=check.detail, name=name)


def failed(checks: Iterable[Check]) -> tuple[Check, ...]:
    """The checks for which an answer is refused."""
    return tuple(check for check in checks if check.decides and not check.passed)


def reason(checks: Iterable[Check], name: str) -> str:
    """Why an answer is refused, in words; empty if it is not."""
    found = [sentence(check, name) for check in failed(checks)]
    more = len(found) - MOST_TOLD
    return "; ".join(found[:MOST_TOLD]) + (f"; and {more} more like it" if more > 0 else "")


def first_reason(checks: Iterable[Check], name: str) -> str:
    """The first reason why an answer is refused, in words, where the others follow from it; empty if it is not."""
    return next((sentence(check, name) for check in failed(checks)), "")


def said(code: str, detail: str, value: float = float("nan"), limit: float = float("nan")) -> Check:
    """A failed check of what no single number tells."""
    return Check(code, value, limit, False, detail=detail)


def reason_code(checks: Iterable[Check]) -> str:
    """Code of the first check for which an answer is refused; empty if it is not."""
    return next((check.code for check in failed(checks)), "")


def mark_codes(checks: Iterable[Check]) -> str:
    """Codes of the checks that mark an answer without refusing it, with semicolons."""
    return ";".join(dict.fromkeys(check.code for check in checks if not check.decides and not check.passed))
