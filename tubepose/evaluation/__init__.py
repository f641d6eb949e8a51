"""Estimates against truth: pure functions on pandas tables that change none in place (columns: docs/outputs.md)."""

from tubepose.evaluation.comparison import COMPARISON_COLUMNS, compare
from tubepose.evaluation.matching import AXES, ERROR_COLUMNS, ERROR_VALUES, OUTCOMES, evaluate
from tubepose.evaluation.summary import RECALL_LIMITS, seed_spread, slot_accuracy, summarise

__all__ = [
    "AXES",
    "COMPARISON_COLUMNS",
    "ERROR_COLUMNS",
    "ERROR_VALUES",
    "OUTCOMES",
    "RECALL_LIMITS",
    "compare",
    "evaluate",
    "seed_spread",
    "slot_accuracy",
    "summarise",
]
