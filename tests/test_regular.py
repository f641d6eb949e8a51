from __future__ import annotations

import os
from pathlib import Path

import pytest

from tubepose.capture.regular import irregular_words, leaves, require_inside, require_regular
from tubepose.capture.source import open_captures
from tubepose.errors import CaptureError


@pytest.mark.parametrize("inside", ["a", "a/../b", "./a", "..a", "a/b/../../c"])
def test_paths_that_stay(inside: str, tmp_path: Path) -> None:
    assert not leaves(inside)
    require_inside(tmp_path, inside, "cloud")


@pytest.mark.parametrize("outside", ["..", "../a", "a/../../b", "/etc/passwd", "./../a"])
def test_paths_that_leave_are_refused(outside: str, tmp_path: Path) -> None:
    with pytest.raises(CaptureError, match="leads out of the folder; move the file into it, or give --allow-outside"):
        require_inside(tmp_path, outside, "cloud")


def test_what_is_no_file_is_told(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "gone").symlink_to(tmp_path / "nothing")
    (tmp_path / "file").write_text("")
    found = {name: irregular_words(tmp_path / name) for name in ("pipe", "gone", "file", "absent")}
    assert found == {"pipe": "a pipe", "gone": "a link that leads nowhere", "file": "", "absent": ""}
    assert irregular_words(Path("/dev/zero")) == "a device"
    with pytest.raises(CaptureError, match="pipe: a pipe; expected a file"):
        require_regular(tmp_path / "pipe", CaptureError)


def test_a_capture_that_names_a_pipe_or_a_file_elsewhere_is_refused_at_once(tmp_path: Path) -> None:
    folder = tmp_path / "scan"
    folder.mkdir()
    os.mkfifo(folder / "pipe.ply")
    (tmp_path / "secret.ply").write_text("secret")
    for cloud, words in (("pipe.ply", "a pipe"), ("../secret.ply", "leads out of the folder")):
        (folder / "capture.yaml").write_text(f"unit: m\ncloud: {cloud}\n")
        (capture,) = open_captures(folder)
        with pytest.raises(CaptureError, match=words) as told:
            next(capture.frames())
        assert "secret\n" not in str(told.value)
    (capture,) = open_captures(folder, allow_outside=True)
    with pytest.raises(CaptureError, match="PLY"):
        next(capture.frames())
    assert capture.outside == (folder / "../secret.ply",)  # type: ignore[attr-defined]
