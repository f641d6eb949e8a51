import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
import pytest

from tubepose.config import Config
from tubepose.labware import labware_sha256, load_rack, load_tube
from tubepose.labware.reading import read_labware
from tubepose.provenance import inputs_sha256, pinned_threads, run_record
from tubepose.report.writing import write_json


def make_folder(place: Path, files: dict[str, str]) -> Path:
    for name, text in files.items():
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        (place / name).write_text(text)
    return place


def sha256_of(path: Path) -> str:
    return inputs_sha256([path], path.parent / "results")[str(path)]


def test_a_files_hash_is_that_of_its_bytes(tmp_path: Path) -> None:
    (tmp_path / "f").write_bytes(b"tube")
    assert sha256_of(tmp_path / "f") == hashlib.sha256(b"tube").hexdigest()


def test_a_folders_hash_depends_on_names_and_contents_and_not_on_the_place(tmp_path: Path) -> None:
    files = {"a/x": "1", "b": "2"}
    first = sha256_of(make_folder(tmp_path / "one", files))
    assert sha256_of(make_folder(tmp_path / "two", dict(reversed(files.items())))) == first
    others = [{"a/x": "1", "b": "3"}, {"a/y": "1", "b": "2"}, {"a/x": "1"}, {"a/x": "2", "b": "1"}]
    found = {sha256_of(make_folder(tmp_path / f"other{i}", other)) for i, other in enumerate(others)}
    assert len(found) == 4
    assert first not in found


def test_labware_is_hashed_by_what_it_says_and_not_by_its_file(tmp_path: Path) -> None:
    text = (
        "kind: rack\nname: r\noutline_mm: [100, 60]\nheight_mm: 50\nfloor_mm: 3\n"
        "grid: {rows: 2, columns: 4, pitch_mm: [22, 24], slot: {shape: round, size_mm: [17, 17]}}\n"
    )
    (tmp_path / "a.yaml").write_text(text)
    (tmp_path / "b.yaml").write_text("# the same\n" + text.replace("60]", "60.0]"))
    (tmp_path / "c.yaml").write_text(text.replace("60]", "61]"))
    a, b, c = (labware_sha256(read_labware(tmp_path / f"{name}.yaml")) for name in "abc")
    assert a == b
    assert a != c


def test_the_record_is_json_and_holds_what_a_second_run_needs(tmp_path: Path) -> None:
    (tmp_path / "boxes.txt").write_text("0 0.5 0.5 1 1\n")
    labware = [load_rack("chen2023-soft-5x10"), load_tube("chen2023-tube-2")]
    used = inputs_sha256([tmp_path / "boxes.txt"], tmp_path / "out")
    record = run_record(["tubepose", "x"], Config(), labware, used, seeds=[0], odd=float("nan"))
    write_json(tmp_path / "run.json", record)
    read = json.loads((tmp_path / "run.json").read_text())
    assert read["command"] == ["tubepose", "x"]
    assert Config.model_validate(read["config"]) == Config()
    assert set(read["labware_sha256"]) == {"chen2023-soft-5x10", "chen2023-tube-2"}
    assert list(read["inputs_sha256"]) == [(tmp_path / "boxes.txt").as_posix()]
    assert read["versions"]["numpy"] == np.__version__
    assert any(name.startswith("open3d") for name in read["versions"])
    assert read["machine"]["cores"] >= 1
    assert (read["seeds"], read["odd"]) == ([0], None)


def test_results_in_a_session_are_no_part_of_it_and_its_captures_count_with_it(tmp_path: Path) -> None:
    session, out = tmp_path / "s", tmp_path / "s" / "results"
    (session / "one").mkdir(parents=True)
    (session / "one" / "cloud.ply").write_text("ply")
    (tmp_path / "model.onnx").write_text("m")
    paths = [session, session / "one", tmp_path / "model.onnx", tmp_path / "model.onnx"]
    before = inputs_sha256(paths, out)
    assert list(before) == [str(session), str(tmp_path / "model.onnx")]
    out.mkdir()
    (out / "racks.csv").write_text("rack\n")
    assert inputs_sha256(paths, out) == before
    assert inputs_sha256(paths, tmp_path / "elsewhere") != before
    assert inputs_sha256(paths, session) == inputs_sha256(paths, tmp_path / "elsewhere")
    (session / "one" / "cloud.ply").write_text("other")
    assert inputs_sha256(paths, out)[str(session)] != before[str(session)]


def test_what_cannot_be_read_is_recorded_as_such(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.ply").write_text("ply")

    def refuse(_: Path) -> str:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tubepose.provenance.file_sha256", refuse)
    assert inputs_sha256([tmp_path / "a.ply"], tmp_path / "out") == {
        str(tmp_path / "a.ply"): "cannot be read: Permission denied"
    }


def test_threads_are_bounded_inside_and_as_before_after() -> None:
    before = cv2.getNumThreads(), o3d.utility.get_max_threads()
    inside = []

    def failing() -> None:
        with pinned_threads(1):
            inside.append((cv2.getNumThreads(), o3d.utility.get_max_threads()))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        failing()
    assert inside == [(1, 1)]
    assert (cv2.getNumThreads(), o3d.utility.get_max_threads()) == before


def test_open3d_says_nothing_inside(capfd: pytest.CaptureFixture[str]) -> None:
    def warn() -> str:
        o3d.io.read_point_cloud("no-such-file.ply")
        return capfd.readouterr().out

    assert "Open3D WARNING" in warn()
    with pinned_threads(1):
        assert warn() == ""
    assert "Open3D WARNING" in warn()
