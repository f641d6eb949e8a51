from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tubepose.config import Config
from tubepose.errors import ConfigError
from tubepose.report import (
    accuracy_table,
    timing_table,
    write_aside,
    write_csv,
    write_json,
    write_table,
    write_text,
)
from tubepose.report.tables import escape_tex
from tubepose.report.writing import csv_text
from tubepose.statistics import BootstrapInterval


def summary_row(tube, method, n_ok=18, **means):
    row = {
        "method": method,
        "tube": tube,
        "n_expected": 20,
        "n_ok": n_ok,
        "n_rejected": 1,
        "n_missed": 0,
        "n_failed": 19 - n_ok,
    }
    for axis in ("rx_deg", "ry_deg", "tx_mm", "ty_mm", "tz_mm"):
        row[f"{axis}_mean"] = means.get(axis, 1.23456789)
    return {**row, "n_false": 2}


SUMMARY = pd.DataFrame(
    [
        summary_row("chen2023-tube-1", "paper"),
        summary_row("my_tube", "paper", n_ok=0, rx_deg=np.nan),
        summary_row("chen2023-tube-1", "global-icp", n_ok=3),
    ]
)


def test_accuracy_rows_are_rounded_strings_tube_by_tube_with_counts():
    rows = accuracy_table(SUMMARY).cells
    assert rows["Tube"].tolist() == ["chen2023-tube-1", "chen2023-tube-1", "my_tube"]
    assert rows["Method"].tolist() == ["paper", "global-icp", "paper"]
    assert rows["R_x (deg)"].tolist() == ["1.23", "1.23", "-"]
    assert rows["ok/expected"].tolist() == ["18/20", "3/20", "0/20"]
    assert rows["rejected/missed/failed"].tolist() == ["1/0/1", "1/0/16", "1/0/19"]
    assert rows["false"].tolist() == ["2", "2", "2"]


def test_published_figures_come_only_when_asked_for_and_say_so():
    assert "published" not in accuracy_table(SUMMARY).markdown()
    table = accuracy_table(SUMMARY, published=True)
    rows = table.cells[table.cells["Method"].str.contains("published")]
    assert rows["Method"].tolist() == ["Our, published", "ICP, published"]
    assert rows.iloc[0].tolist()[2:7] == ["1.26", "1.15", "1.18", "2.80", "0.35"]
    assert rows["ok/expected"].tolist() == ["-", "-"]
    assert table.values["source"].tolist() == ["measured"] * 2 + ["published"] * 2 + ["measured"]
    assert "H. Chen" in table.notes[-1]


def test_the_values_keep_full_precision():
    assert accuracy_table(SUMMARY).values["rx_deg"].iloc[0] == 1.23456789
    assert "1.23456789" in csv_text(accuracy_table(SUMMARY).values)


def test_latex_has_the_papers_shape_and_escapes_what_latex_would_read():
    text = accuracy_table(SUMMARY, ["truth to 0.1 deg & 50% of_it"]).latex()
    assert r"\multirow{2}{*}{chen2023-tube-1} & paper & 1.23" in text
    assert r"\multirow{1}{*}{my\_tube}" in text
    assert r"truth to 0.1 deg \& 50\% of\_it" in text
    assert text.count(r"\midrule") == 2
    for name in ("table", "threeparttable", "tabular", "tablenotes"):
        assert text.count(rf"\begin{{{name}}}") == text.count(rf"\end{{{name}}}") == 1
    body = [line for line in text.splitlines() if "1.23" in line]
    assert {line.count(" & ") for line in body} == {9}


def test_escape_tex_leaves_no_command():
    assert escape_tex(r"a_b{c}\d^e~f#g$") == (r"a\_b\{c\}\textbackslash{}d\textasciicircum{}e\textasciitilde{}f\#g\$")


def test_markdown_has_one_line_per_row_and_the_notes_below():
    lines = accuracy_table(SUMMARY, ["simulated"]).markdown().splitlines()
    cells = [line for line in lines if line.startswith("|")]
    assert len(cells) == 2 + len(SUMMARY)
    assert len({line.count("|") for line in cells}) == 1
    assert lines[-1] == "- simulated"


def timing(stage, duration_ms, method="all", warmup=False, instance=""):
    return {
        "session": "s", "trial": "t", "capture": "c", "frame": 0, "method": method, "seed": pd.NA, "stage": stage,
        "instance": instance, "duration_ms": duration_ms, "warmup": warmup,
    }  # fmt: skip


TIMINGS = pd.DataFrame(
    [
        timing("load", 500.0),
        timing("detect", 900.0, warmup=True),
        timing("detect", 90.0),
        timing("detect", 110.0),
        timing("rack", 200.0),
        timing("slots", 5.0),
        timing("tube", 800.0, "paper", warmup=True),
        *(timing("tube", ms, "paper", instance="A1") for ms in (10.0, 11.0, 15.0)),
        *(timing("tube", ms, "global-icp", instance="A1") for ms in (36.0, 36.0)),
    ]
)


def test_timing_rows_leave_out_warm_up_and_loading():
    table = timing_table(TIMINGS)
    assert table.cells["Component"].tolist() == [
        "Object Detection",
        "Rack Pose Estimation",
        "Slots",
        "Tube Pose Estimation (paper)",
        "Tube Pose Estimation (global-icp)",
    ]
    assert table.cells["per"].tolist() == ["image", "rack", "image", "tube", "tube"]
    assert table.values["mean_ms"].tolist() == pytest.approx([100.0, 200.0, 5.0, 12.0, 36.0])
    assert table.values["median_ms"].tolist()[3] == 11.0
    assert table.values["p95_ms"].tolist()[3] == pytest.approx(14.6)
    assert table.values["n"].tolist() == [2, 1, 1, 3, 2]
    assert timing_table(TIMINGS).cells["Ratio to paper"].tolist() == ["-", "-", "-", "1.00", "3.00"]
    assert any("load 500.00 ms" in note for note in table.notes)


def test_published_times_come_only_when_asked_for():
    assert "published" not in timing_table(TIMINGS).latex()
    published = timing_table(TIMINGS, published=True).values.query("source == 'published'")
    assert published["mean_ms"].tolist() == [96.0, 191.0, 12.0, 36.0]


def test_timing_without_the_papers_method_has_no_ratio():
    rows = timing_table(TIMINGS[TIMINGS["method"] != "paper"]).cells
    assert rows["Ratio to paper"].unique().tolist() == ["-"]


ROWS = pd.DataFrame(
    {
        "timestamp_ns": pd.array([1_700_000_000_123_456_789, None], dtype="Int64"),
        "tx_m": [0.1 + 0.2, np.nan],
        "tube": ["a,b", None],
    }
)


def test_csv_keeps_every_digit_and_reads_back_the_same(tmp_path):
    path = tmp_path / "out" / "estimates.csv"
    write_csv(path, ROWS)
    assert path.read_bytes() == b'timestamp_ns,tx_m,tube\n1700000000123456789,0.30000000000000004,"a,b"\n,,\n'
    back = pd.read_csv(path, dtype={"timestamp_ns": "Int64"})
    assert back["timestamp_ns"].iloc[0] == 1_700_000_000_123_456_789
    assert back["tx_m"].iloc[0] == 0.1 + 0.2


def test_stamps_that_went_through_floats_are_refused(tmp_path):
    with pytest.raises(ValueError, match="column timestamp_ns has type float64; expected whole nanoseconds"):
        write_csv(tmp_path / "a.csv", ROWS.astype({"timestamp_ns": "float64"}))
    assert list(tmp_path.iterdir()) == []


def test_the_same_rows_give_the_same_bytes(tmp_path):
    for folder in ("one", "two"):
        write_table(tmp_path / folder, "table_accuracy", accuracy_table(SUMMARY, ["note"], published=True))
        write_table(tmp_path / folder, "table_timing", timing_table(TIMINGS))
    names = sorted(path.name for path in (tmp_path / "one").iterdir())
    assert names == [f"table_{kind}.{suffix}" for kind in ("accuracy", "timing") for suffix in ("csv", "md", "tex")]
    for name in names:
        assert (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes()


def test_a_failed_write_leaves_the_old_file_and_nothing_aside(tmp_path):
    path = tmp_path / "overlay.png"
    write_text(path, "old")

    def half_done() -> None:
        with write_aside(path) as aside:
            assert aside.suffix == ".png"
            aside.write_text("half")
            raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        half_done()
    assert path.read_text() == "old"
    assert [entry.name for entry in tmp_path.iterdir()] == ["overlay.png"]


def test_a_place_that_cannot_be_written_is_said_in_one_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"file/a\.txt: cannot be written .*choose another one") as caught:
        write_text(tmp_path / "file" / "a.txt", "text")
    assert "\n" not in str(caught.value)


def test_json_keeps_order_and_makes_values_plain(tmp_path):
    record = {
        "seed": np.int64(3),
        "share": np.float64("nan"),
        "path": Path("a/b"),
        "list": (np.array([1, 2]),),
        "a": pd.NA,
    }
    record |= {"config": Config().tube, "interval": BootstrapInterval(1.0, 0.5, float("inf"), 3, 2)}
    write_json(tmp_path / "run.json", record)
    text = (tmp_path / "run.json").read_text()
    back = json.loads(text)
    assert back.pop("config")["objective"] == "hinge"
    assert back.pop("interval") == {"mean": 1.0, "low": 0.5, "high": None, "n": 3, "n_groups": 2}
    assert back == {"seed": 3, "share": None, "path": "a/b", "list": [[1, 2]], "a": None}
    assert list(json.loads(text)) == list(record)
    with pytest.raises(TypeError, match="not JSON serializable"):
        write_json(tmp_path / "other.json", {"a": object()})
