"""The example of docs/python.md runs as it stands, on a capture of the sample."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]


def test_the_example_finds_the_tubes_of_a_capture(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "python.md").read_text(), re.DOTALL)
    captures = tmp_path / "CAPTURES"
    captures.mkdir()
    shutil.copy(ROOT / "tubepose/sample/captures/chen2023-tube-1-004-original.mcap", captures)
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    exec(compile(code, "docs/python.md", "exec"), names)
    out = capsys.readouterr().out
    assert "chen2023-tube-1-004-original ok" in out
    assert len(re.findall(r"^[A-E]\d+ \[\[", out, re.MULTILINE)) == 18
    last = names["result"].estimates[-1].T_camera_tube  # type: ignore[index]
    assert np.linalg.det(last[:3, :3]) == pytest.approx(1.0)
