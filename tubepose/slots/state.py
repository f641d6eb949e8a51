"""State of every slot: empty, occupied, not seen or unclear, with a probability (naive Bayes over patches)."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from tubepose.slots.look import SlotLook

PRIOR_OCCUPIED = 0.5
"""Nothing is known of a slot before it is looked at."""
PASSES_EMPTY = 0.95
"""Probability that a patch of an empty slot lets lines of sight in: the rest are ghosts (stray light, mixed edges)."""
PASSES_OCCUPIED = 0.05
"""The same where an opaque thing stands in the slot: points behind an edge, or light through a wall."""
MISSED = 0.01
"""Probability that what the patches say is wrong altogether: a clear tube that returned nothing and was not found, or
a ghost that fills a slot. It bounds `p_occupied` of what no method found or believed."""
ACCEPTED = 0.99
"""Least probability that a slot with an accepted tube is occupied."""
PRIOR_DOUBTFUL = 0.9
"""The same of a slot in which a method found something that it did not accept: most of that stands there. A stated
prior, not a measured one."""
LEAST_PATCHES = 1.0
"""Less than one patch is not evidence: a rack's pose that is off by 0.5 mm gives a third of one where a cap stands
(simulated racks)."""
MOST_DISSENT = 0.25
"""Patches that say the opposite, as a share of those for a state, above which it is not stated: five times what ghosts
are expected to be, so that something else is there, a clear tube say."""
LEAST_COVERED = 0.5
"""Least share of a slot that is covered (of its middle) or filled below the face for what no method found to be a thing
that stands there: a top returns from most of its area (0.64 and more in simulated racks), the edge of a neighbour's cap
that reaches over the slot and the ghosts behind a clear wall from little of it (up to 0.16)."""
SURE = 0.95
"""A state is stated from this probability on: with the model's patches, from one more for it than against it."""


class SlotState(StrEnum):
    """What is known of a slot.

    Attributes:
        EMPTY: Lines of sight went in where anything that stands there would have stopped them.
        OCCUPIED: A tube was accepted there, or lines of sight were stopped there.
        NOT_SEEN: Too little was seen to say anything.
        UNCLEAR: It was seen, and what was seen does not decide.
    """

    EMPTY = "empty"
    OCCUPIED = "occupied"
    NOT_SEEN = "not_seen"
    UNCLEAR = "unclear"


class Finding(StrEnum):
    """What a method answered for a slot.

    Attributes:
        NONE: Nothing.
        TUBE: A tube that it accepted.
        DOUBTFUL: Something it did not accept: a rejected tube, an unknown thing, something across the slot.
    """

    NONE = "none"
    TUBE = "tube"
    DOUBTFUL = "doubtful"


@dataclass(frozen=True, slots=True)
class StatedSlot:
    """State of one slot.

    Attributes:
        state: The state.
        p_occupied: Probability that something stands in the slot, 0 to 1.
        seen_share: Share of its opening that was looked at, 0 to 1; NaN where the frame was not looked at.
    """

    state: SlotState
    p_occupied: float
    seen_share: float


def patches_stopped(look: SlotLook) -> float:
    """Patches that say that something stands in a slot: its lines of sight or its covered middle, whichever is more."""
    return max(look.patches_stopped, look.patches_covered)


def p_occupied(look: SlotLook, prior: float = PRIOR_OCCUPIED) -> float:
    """Probability that something opaque stands in a slot, from its patches: naive Bayes, a Bernoulli law per patch.

    A patch that nothing came back from says nothing, P(no return | empty) = P(no return | occupied): black caps and
    dark wells are alike.

    Args:
        look: What was seen of the slot.
        prior: Probability before it was looked at.
    """
    stopped = np.log((1 - PASSES_OCCUPIED) / (1 - PASSES_EMPTY))
    passed = np.log(PASSES_OCCUPIED / PASSES_EMPTY)
    log_odds = np.log(prior / (1 - prior))
    log_odds += patches_stopped(look) * stopped + look.patches_passed * passed
    p = 1 / (1 + np.exp(-np.clip(log_odds, -50, 50)))
    return float(MISSED * prior + (1 - MISSED) * p)


def state_slot(look: SlotLook | None, finding: Finding) -> StatedSlot:
    """State of a slot from what was seen of it and what a method found in it.

    Args:
        look: What was seen; None where the frame was not looked at.
        finding: What the method answered. An accepted tube is believed; what was not accepted is never called empty.
    """
    share = look.seen_share if look is not None else float("nan")
    prior = PRIOR_OCCUPIED if finding is Finding.NONE else PRIOR_DOUBTFUL
    seen = look is not None and look.patches_passed + patches_stopped(look) >= LEAST_PATCHES
    p = p_occupied(look, prior) if look is not None and seen else prior
    if finding is Finding.TUBE:
        return StatedSlot(SlotState.OCCUPIED, max(p, ACCEPTED), share)
    if look is None or not seen:
        return StatedSlot(SlotState.NOT_SEEN if finding is Finding.NONE else SlotState.UNCLEAR, p, share)
    passed, stopped = look.patches_passed, patches_stopped(look)
    state = SlotState.UNCLEAR
    solid = finding is not Finding.NONE or look.covered + look.filled >= LEAST_COVERED
    if p >= SURE and passed <= MOST_DISSENT * stopped and solid:
        state = SlotState.OCCUPIED
    elif p <= 1 - SURE and stopped <= MOST_DISSENT * passed and finding is Finding.NONE:
        state = SlotState.EMPTY
    if state is SlotState.UNCLEAR:
        # Patches that contradict each other make the model's own probability too sure.
        p = float(np.clip(p, 1 - SURE, SURE))
    return StatedSlot(state, p, share)
