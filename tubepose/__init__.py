"""tubepose: poses of in-rack test tubes from recorded RGB-D captures, with ground truth and honest tables."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tubepose.benchmark import bench, compare, evaluate

__version__ = "0.1.0"
__all__ = ["__version__", "bench", "compare", "evaluate"]


def __getattr__(name: str) -> Any:
    """The front door, imported when it is asked for (PEP 562)."""
    if name not in ("bench", "compare", "evaluate"):
        raise AttributeError(f"module 'tubepose' has no attribute '{name}'")
    from tubepose import benchmark

    return getattr(benchmark, name)
