"""Tables for readers, and the one place that writes result files."""

from tubepose.report.tables import Table, accuracy_table, timing_table
from tubepose.report.writing import write_aside, write_bytes, write_csv, write_json, write_table, write_text

__all__ = [
    "Table",
    "accuracy_table",
    "timing_table",
    "write_aside",
    "write_bytes",
    "write_csv",
    "write_json",
    "write_table",
    "write_text",
]
