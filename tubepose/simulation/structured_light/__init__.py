"""Light transport of a structured-light scanner over see-through tubes; see docs/simulation.md."""

from tubepose.simulation.structured_light.sensor import render

__all__ = ["render"]
