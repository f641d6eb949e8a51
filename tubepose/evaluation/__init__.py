"""Estimates against truth: pure functions on pandas tables that change none in place (columns: docs/outputs.md)."""

from tubepose.evaluation.comparison import COMPARISON_COLUMNS, compare
from tubepose.evaluation.gate import GATES, GateResult, gate_counts_alone, gate_pair, inside_95, read_gates
from tubepose.evaluation.matching import AXES, ERROR_COLUMNS, ERROR_VALUES, OUTCOMES, evaluate
from tubepose.evaluation.paired_tubes import expected_tubes, pair_tubes, sign_flip_p, tube_changes
from tubepose.evaluation.summary import RECALL_LIMITS, seed_spread, slot_accuracy, summarise

__all__ = [
    "AXES",
    "COMPARISON_COLUMNS",
    "ERROR_COLUMNS",
    "ERROR_VALUES",
    "GATES",
    "OUTCOMES",
    "RECALL_LIMITS",
    "GateResult",
    "compare",
    "evaluate",
    "expected_tubes",
    "gate_counts_alone",
    "gate_pair",
    "inside_95",
    "pair_tubes",
    "read_gates",
    "seed_spread",
    "sign_flip_p",
    "slot_accuracy",
    "summarise",
    "tube_changes",
]
