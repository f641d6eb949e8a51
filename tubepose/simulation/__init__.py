"""Simulated captures with known poses, so that everything runs without hardware; see docs/simulation.md."""

from tubepose.simulation.sessions import SENSORS, simulate_session
from tubepose.simulation.truth import ExactTruth, read_exact_truth

__all__ = ["SENSORS", "ExactTruth", "read_exact_truth", "simulate_session"]
