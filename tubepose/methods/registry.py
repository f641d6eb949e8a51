"""All methods by name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType

from tubepose.methods.gicp import GICP
from tubepose.methods.global_icp import GLOBAL_ICP
from tubepose.methods.kiss_matcher import KISS_MATCHER
from tubepose.methods.method import Method, require_packages
from tubepose.methods.paper import PAPER
from tubepose.methods.profile import PROFILE
from tubepose.methods.slot_icp import SLOT_ICP
from tubepose.methods.upright import UPRIGHT

_ALL: tuple[Method, ...] = (PROFILE, PAPER, UPRIGHT, SLOT_ICP, GLOBAL_ICP, KISS_MATCHER, GICP)
METHODS: Mapping[str, Method] = MappingProxyType({method.name: method for method in _ALL})
"""Methods by name, the default first, then the paper's; the others are baselines."""
DEFAULT_METHOD = PROFILE.name


def seeds_of(name: str, count: int) -> Sequence[int | None]:
    """The seeds that a method runs with where `count` are asked for: 0, 1, ...; None once for a deterministic one."""
    return range(count) if METHODS[name].is_stochastic else (None,)


def foremost(names: Sequence[str]) -> str:
    """The one of the named methods that is shown, and that others are compared with: ours, the paper's, the first."""
    return next((method.name for method in (PROFILE, PAPER) if method.name in names), names[0])


def require_methods(names: Iterable[str]) -> None:
    """Import the packages that the named methods need.

    Raises:
        TubePoseError: One is not installed.
    """
    for name in names:
        require_packages(name, METHODS[name].packages)
