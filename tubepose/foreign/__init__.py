"""Results of other estimators as rows of estimates.csv: our own columns, BOP results, trajectories, JSON."""

from tubepose.foreign.bop_results import read_bop_results, write_bop_results
from tubepose.foreign.foreign_rows import read_estimates, read_truth
from tubepose.foreign.mapping import ForeignMapping, read_mapping
from tubepose.foreign.slot_matching import with_slots

__all__ = [
    "ForeignMapping",
    "read_bop_results",
    "read_estimates",
    "read_mapping",
    "read_truth",
    "with_slots",
    "write_bop_results",
]
