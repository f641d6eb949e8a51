"""What each check of a rack decides: values with the right file and with wrong ones, and what it refuses alone.

    python -m benchmarks.rack_checks [--frames N] [--seed S] [--set choose|report] [--per-kind N] [--frame-folder DIR]

The SIMULATED frames and the files are those of `benchmarks.wrong_labware`. Per check: the value nearest to refusal (the
largest share of its limit) with right files, how many right files it refused, how many wrong files it refused, how many
of those no other check refused, and how many of these are accepted once the check is removed: quick checks spare the
others, which would have refused most of them. A check without which nothing wrong is accepted could go.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

from benchmarks.wrong_labware_cases import KINDS, cases
from benchmarks.wrong_labware_scenes import SETS, view
from tubepose import checks
from tubepose.checks import Check
from tubepose.config import Config
from tubepose.provenance import pinned_threads
from tubepose.rack import RackPose, RackStatus, register_rack

NO_CHECK = "(no check: no registration)"
LEAST_CODES = frozenset(("little_seen", "slot_step"))
"""Checks that want more than their limit."""


@dataclass(slots=True)
class Decided:
    """What one check has decided.

    Attributes:
        worst: Of right files the value nearest to refusal, and its limit.
        right: Right files that it refused.
        wrong: Wrong files that it refused.
        alone: Of these, those that no other check refused.
        needed: Of these, those that are accepted without it.
    """

    worst: tuple[float, float] | None = None
    right: int = 0
    wrong: int = 0
    alone: int = 0
    needed: int = 0


@dataclass(slots=True)
class Decisions:
    """What all checks have decided, and how many files were asked."""

    by_code: dict[str, Decided] = field(default_factory=lambda: defaultdict(Decided))
    n_right: int = 0
    n_wrong: int = 0

    def add(self, pose: RackPose, right: bool, again: Callable[[], RackPose]) -> None:
        """Count one answer; `again` asks the same once more."""
        self.n_right += right
        self.n_wrong += not right
        codes = {check.code for check in checks.failed(pose.checks)}
        if pose.status is not RackStatus.OK and not codes:
            codes = {NO_CHECK}
        for code in codes:
            decided = self.by_code[code]
            decided.right += right
            decided.wrong += not right
            if not right and len(codes) == 1:
                decided.alone += 1
                with removed(code):
                    decided.needed += again().status is RackStatus.OK
        if right:
            for check in pose.checks:
                decided = self.by_code[check.code]
                if check.decides and (decided.worst is None or nearness(check) > nearness_of(check, decided.worst)):
                    decided.worst = (check.value, check.limit)


@contextmanager
def removed(code: str) -> Iterator[None]:
    """Answers as they would be without one check."""
    refusing = checks.failed
    checks.failed = lambda some: refusing(check for check in some if check.code != code)
    try:
        yield
    finally:
        checks.failed = refusing


def nearness(check: Check) -> float:
    """How near a value is to refusal: 1 at its limit."""
    return nearness_of(check, (check.value, check.limit))


def nearness_of(check: Check, value_and_limit: tuple[float, float]) -> float:
    """The same of another value of that check."""
    value, limit = value_and_limit
    if limit == 0:
        return float(value > 0)
    return limit / max(value, 1e-12) if check.code in LEAST_CODES else value / limit


def table(found: Decisions) -> str:
    """Markdown, one row a check."""
    lines = [
        f"{found.n_right} right files, {found.n_wrong} wrong ones. SIMULATED.",
        "",
        "| check | right files: nearest value, limit | refused right | refused wrong | of these alone | accepted "
        "without it |",
        "|---|---|--:|--:|--:|--:|",
    ]
    for code, decided in sorted(found.by_code.items(), key=lambda item: -item[1].wrong):
        worst = "-" if decided.worst is None else f"{decided.worst[0]:.3g}, {decided.worst[1]:.3g}"
        lines.append(f"| {code} | {worst} | {decided.right} | {decided.wrong} | {decided.alone} | {decided.needed} |")
    return "\n".join(lines)


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", dest="chosen", choices=tuple(SETS), default="choose")
    parser.add_argument("--per-kind", type=int, default=2, help="cases of every kind per frame; 0: all")
    parser.add_argument("--frame-folder", type=Path)
    options = parser.parse_args()
    kinds = tuple(kind for kind in KINDS if kind not in ("types", "caps"))
    found = Decisions()
    with pinned_threads(1):
        for number in range(options.frames):
            seen = view(options.chosen, options.seed, number, "raycast", options.frame_folder)
            for case in cases(seen, kinds, options.per_kind, options.seed):
                ask = partial(register_rack, case.frame.measured_m, case.rack, Config())
                found.add(ask(), case.kind == "right", ask)
    print(table(found))


if __name__ == "__main__":
    main()
