"""Printed caps with a square top -> true poses of tubes (paper, section V-A).

Truth shares no code with the estimators that it judges: this package imports none of their modules.
The steps: `rack_top` finds the rack's top and outline, `caps` cuts out the squares and fits their planes,
`square` registers the square template, `measure` puts caps and slots together and refuses what cannot be trusted.
"""

from tubepose.ground_truth.measure import measure_ground_truth
from tubepose.ground_truth.model import GroundTruthConfig, GroundTruthResult, TubeTruth

__all__ = ["GroundTruthConfig", "GroundTruthResult", "TubeTruth", "measure_ground_truth"]
