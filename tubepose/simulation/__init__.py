"""Simulated captures with known poses, so that everything runs without hardware; see docs/simulation.md."""

from tubepose.simulation.sessions import simulate_session
from tubepose.simulation.shooting import SENSORS
from tubepose.simulation.truth import ExactTruth, read_exact_truth
from tubepose.simulation.variation import SceneVariation, load_scene_variation

__all__ = [
    "SENSORS",
    "ExactTruth",
    "SceneVariation",
    "load_scene_variation",
    "read_exact_truth",
    "simulate_session",
]
