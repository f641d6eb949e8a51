"""Estimates judged by truth, assembled: a benchmark of our methods, anybody's estimates, runs side by side, gates."""

from tubepose.benchmark.foreign_run import EvaluateOptions, Evaluation, evaluate
from tubepose.benchmark.judgement import Judgement, count_lines, judge, write_tables
from tubepose.benchmark.measured import MeasuredTruth, measure_sessions
from tubepose.benchmark.plan import (
    BENCH_METHODS,
    Bench,
    BenchOptions,
    BenchPlan,
    bench,
    judge_run,
    plan_bench,
)

__all__ = [
    "BENCH_METHODS",
    "Bench",
    "BenchOptions",
    "BenchPlan",
    "EvaluateOptions",
    "Evaluation",
    "Judgement",
    "MeasuredTruth",
    "bench",
    "count_lines",
    "evaluate",
    "judge",
    "judge_run",
    "measure_sessions",
    "plan_bench",
    "write_tables",
]
