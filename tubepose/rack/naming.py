"""Which rack of a catalogue stands there (`--rack auto`): every rack is registered, and the likelihoods compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from tubepose.capture.frame import CameraIntrinsics
from tubepose.capture.hints import SlotHint
from tubepose.config import Config
from tubepose.labware import RackModel, catalogue
from tubepose.preprocessing import unit_doubt
from tubepose.rack.edges import best_registration, coarse_sample, pose_of
from tubepose.rack.pose import MIN_POINTS, RackPose, RackStatus
from tubepose.rack.search import levels
from tubepose.rack.settling import Registration
from tubepose.transforms import FloatArray

# Racks in a reason: the first ones tell enough.
TOLD = 2
# Places that are looked at per rack and level direction.
PLACES = 5


@dataclass(frozen=True, slots=True, eq=False)
class RankedRack:
    """A rack and how well it fits.

    Attributes:
        rack: The rack.
        log_likelihood: Of the cells of its face, nats; minus infinity without a registration.
        reason: Why it is refused; empty if it fits.
    """

    rack: RackModel
    log_likelihood: float
    reason: str


def catalogue_racks() -> tuple[RackModel, ...]:
    """Every rack of the built-in catalogue."""
    return tuple(item for item in catalogue().values() if isinstance(item, RackModel))


def name_rack(
    points_m: FloatArray,
    config: Config,
    racks: Sequence[RackModel] | None = None,
    hint: SlotHint | None = None,
    intrinsics: CameraIntrinsics | None = None,
) -> tuple[RackPose, tuple[RankedRack, ...]]:
    """Find out which rack stands there, and its pose (always by method ``edges``).

    A rack is named if it passes every check of `register_rack`, and is likelier than the next rack that passes them too
    by `rack.max_gain` nats. `RackPose.rack` is the rack, `named_by_nats` by how much it is likelier: infinity where no
    other passes.

    Args:
        points_m: Array of shape (N, 3), camera frame, metres, without NaN: the rack's box or the whole frame.
        config: Sections rack_top and rack are used.
        racks: The racks that it can be; the whole catalogue if None.
        hint: As for `register_rack`; left out where the rack has no such slot.
        intrinsics: Of the hint's image.

    Returns:
        The pose, refused with the ranking in its reason where no rack can be named, and the ranking, best first.
    """
    racks = catalogue_racks() if racks is None else racks
    if len(points_m) < MIN_POINTS:
        reason = f"{len(points_m)} valid points on the rack, expected at least {MIN_POINTS}"
        return RackPose(RackStatus.INSUFFICIENT, reason, code="too_few_points"), ()
    order = sorted(_registrations(points_m, racks, config), key=lambda pair: _rank(pair[1]))
    ranking = tuple(RankedRack(rack, best.log_likelihood, best.reason) for rack, best in order)
    reason = _not_named(ranking, len(racks), config)
    if reason:
        doubt = unit_doubt(points_m)
        if doubt:
            return RackPose(RackStatus.UNIT, doubt, code="wrong_unit"), ranking
        fits = ranking and not ranking[0].reason
        return RackPose(RackStatus.REFUSED, reason, code="several_fit" if fits else "none_fits"), ranking
    rack, best = order[0]
    if hint is not None and not rack.has_slot(hint.slot):
        hint = None
    pose = pose_of(best, points_m, rack, config, hint, intrinsics)
    return replace(pose, rack=rack, named_by_nats=ranking[0].log_likelihood - _rival(ranking)), ranking


def _not_named(ranking: Sequence[RankedRack], known: int, config: Config) -> str:
    """Why no rack can be named, in words; empty if the first one is it."""
    if not ranking or ranking[0].reason:
        near = ", ".join(f"{entry.rack.name} ({entry.reason.split('; ')[0]})" for entry in ranking[:TOLD])
        return (
            f"no rack of the {known} known ones fits; "
            f"{f'the nearest are {near}' if near else 'no level top is among the points'}; "
            "give your own by --rack FILE, or --rack grid with --pitch and --slot"
        )
    ahead = ranking[0].log_likelihood - _rival(ranking)
    if ahead >= config.rack.max_gain:
        return ""
    told = ", ".join(entry.rack.name for entry in ranking[:TOLD])
    return (
        f"more than one rack fits: {told}, the first one likelier by {ahead:.0f} nats, at least "
        f"{config.rack.max_gain:g} expected: name it"
    )


def _rival(ranking: Sequence[RankedRack]) -> float:
    """Log likelihood of the next rack after the first that passes every check; minus infinity without any."""
    return max((entry.log_likelihood for entry in ranking[1:] if not entry.reason), default=float("-inf"))


def _registrations(
    points_m: FloatArray, racks: Sequence[RackModel], config: Config
) -> list[tuple[RackModel, Registration]]:
    """The best registration of every rack that has one, at the first level direction at which a rack is accepted."""
    best: dict[str, Registration] = {}
    few_m = coarse_sample(points_m, config.rack_top)
    for level in levels(few_m, config.rack_top):
        for rack in racks:
            found = best_registration(points_m, few_m, [level], rack, config, PLACES)
            before = best.get(rack.name)
            if found is not None and (before is None or _rank(found) < _rank(before)):
                best[rack.name] = found
        if any(not found.reason for found in best.values()):
            break
    return [(rack, best[rack.name]) for rack in racks if rack.name in best]


def _rank(registration: Registration) -> tuple[bool, float, float]:
    """Smaller is better: accepted before refused, then likelier, then more evidence."""
    return bool(registration.reason), -registration.log_likelihood, -registration.agreement.evidence
