"""From a frame with a registered rack to the poses of its tubes: one file and one signature for every method."""

from tubepose.methods.method import EachTube, Method, MethodResult
from tubepose.methods.registry import DEFAULT_METHOD, METHODS, foremost, require_methods, seeds_of

__all__ = [
    "DEFAULT_METHOD",
    "METHODS",
    "EachTube",
    "Method",
    "MethodResult",
    "foremost",
    "require_methods",
    "seeds_of",
]
