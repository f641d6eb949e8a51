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
from tubepose.benchmark.run_comparison import Comparison, compare, gate_alone, gate_table, junit_xml
from tubepose.benchmark.runs import Run, fingerprint, read_run, tube_times_ms, write_baseline

__all__ = [
    "BENCH_METHODS",
    "Bench",
    "BenchOptions",
    "BenchPlan",
    "Comparison",
    "EvaluateOptions",
    "Evaluation",
    "Judgement",
    "MeasuredTruth",
    "Run",
    "bench",
    "compare",
    "count_lines",
    "evaluate",
    "fingerprint",
    "gate_alone",
    "gate_table",
    "judge",
    "judge_run",
    "junit_xml",
    "measure_sessions",
    "plan_bench",
    "read_run",
    "tube_times_ms",
    "write_baseline",
    "write_tables",
]
