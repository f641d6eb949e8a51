"""State of a slot: probability, and what a method found in it."""

import dataclasses

import pandas as pd
import pytest

from tubepose.evaluation import slot_accuracy
from tubepose.slots import Finding, SlotLook, SlotState, state_slot
from tubepose.slots.state import ACCEPTED, PRIOR_DOUBTFUL

NOTHING = SlotLook("A1", *[0.0] * 12)


def seen(passed=0.0, stopped=0.0, covered=0.6):
    return dataclasses.replace(
        NOTHING, patches_passed=passed, patches_stopped=stopped, seen_share=0.4, covered=covered if stopped else 0.0
    )


@pytest.mark.parametrize(
    ("look", "state"),
    [
        (NOTHING, SlotState.NOT_SEEN),
        (None, SlotState.NOT_SEEN),
        (seen(passed=0.9), SlotState.NOT_SEEN),
        (seen(passed=3.0), SlotState.EMPTY),
        (seen(stopped=3.0), SlotState.OCCUPIED),
        (seen(stopped=3.0, covered=0.2), SlotState.UNCLEAR),  # the edge of a neighbour's cap
        (seen(passed=3.0, stopped=3.0), SlotState.UNCLEAR),
        (seen(passed=5.0, stopped=2.0), SlotState.UNCLEAR),
        (seen(passed=9.0, stopped=1.0), SlotState.EMPTY),
    ],
)
def test_the_state_follows_the_evidence(look, state):
    stated = state_slot(look, Finding.NONE)
    assert stated.state is state
    if state is SlotState.EMPTY:
        assert stated.p_occupied <= 0.05
    elif state is SlotState.OCCUPIED:
        assert stated.p_occupied >= 0.95
    else:
        assert 0.05 <= stated.p_occupied <= 0.95


def test_one_patch_by_hand():
    # Prior odds 1, likelihood ratio 0.95 / 0.05, and 1 % of the answer is the prior's.
    assert state_slot(seen(stopped=1.0), Finding.NONE).p_occupied == pytest.approx(0.01 * 0.5 + 0.99 * 0.95)
    assert state_slot(seen(passed=1.5), Finding.NONE).p_occupied == pytest.approx(
        0.01 * 0.5 + 0.99 / (1 + 19**1.5)
    )  # fmt: skip


def test_more_patches_of_one_kind_are_never_less_sure():
    passed = [state_slot(seen(passed=n), Finding.NONE).p_occupied for n in (1.0, 2.0, 4.0, 30.0)]
    assert passed == sorted(passed, reverse=True)
    assert passed[-1] == pytest.approx(0.005)


def test_an_accepted_tube_is_believed_whatever_was_seen():
    for look in (None, NOTHING, seen(passed=20.0), seen(stopped=20.0)):
        stated = state_slot(look, Finding.TUBE)
        assert (stated.state, stated.p_occupied >= ACCEPTED) == (SlotState.OCCUPIED, True)


@pytest.mark.parametrize(
    ("look", "state"),
    [(None, SlotState.UNCLEAR), (seen(passed=20.0), SlotState.UNCLEAR), (seen(stopped=2.0), SlotState.OCCUPIED)],
)
def test_what_was_not_accepted_is_occupied_or_unclear_and_never_empty(look, state):
    stated = state_slot(look, Finding.DOUBTFUL)
    assert stated.state is state
    assert 0.05 <= stated.p_occupied <= 1.0
    if look is None:
        assert stated.p_occupied == PRIOR_DOUBTFUL


def test_not_seen_is_counted_apart_from_right_and_wrong():
    states = {"A1": "occupied", "A2": "empty", "A3": "not_seen", "B1": "empty", "B2": "occupied", "B3": "unclear"}
    keys = {"session": "s", "trial": "t"}
    slots = pd.DataFrame([{**keys, "method": "m", "slot": name, "state": state} for name, state in states.items()])
    declared = pd.DataFrame([{**keys, "slot": name} for name in ("A1", "A2", "A3")])
    assert slot_accuracy(slots, declared).to_dict("records") == [
        {
            "method": "m",
            "n_occupied": 3, "n_found": 1, "n_called_empty": 1,
            "n_empty": 3, "n_left_empty": 1, "n_called_occupied": 1,
            "n_not_seen": 1, "n_unclear": 1,
        }
    ]  # fmt: skip


def test_what_the_cap_of_a_neighbour_covers_says_nothing_of_a_slot():
    look = dataclasses.replace(NOTHING, patches_passed=16.0, patches_covered=5.0, covered=0.3, seen_share=0.3)
    assert state_slot(look, Finding.NONE).state is SlotState.UNCLEAR
    assert state_slot(look.explained(0.28), Finding.NONE).state is SlotState.EMPTY
    assert dataclasses.asdict(look.explained(0.0)) == dataclasses.asdict(look)
    assert look.explained(1.0).patches_covered == 0.0
