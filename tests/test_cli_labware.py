"""The command line: `tubepose labware`, help, version, and how errors leave."""

import subprocess
import sys
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from commands import tubepose
from typer.testing import CliRunner

from tubepose import __version__
from tubepose.errors import CaptureError, LabwareError
from tubepose.labware import catalogue
from tubepose_cli import main

RACK = """\
kind: rack
name: my-rack
outline_mm: [100, 60]
height_mm: 50
floor_mm: 3
grid:
  rows: 2
  columns: 4
  pitch_mm: [22, 24]
  slot: {shape: round, size_mm: [17, 17]}
"""
runner = CliRunner()


def command(*arguments: str, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    code = "from tubepose_cli.main import run; run()"
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, cwd=cwd, check=False
    )


def test_list_names_the_whole_catalogue() -> None:
    result = runner.invoke(main.app, ["labware", "list"])
    assert result.exit_code == 0
    listed = [line.split()[:2] for line in result.stdout.splitlines()[1:]]
    assert {item.name: item.kind for item in catalogue().values()} == {line[1]: line[0] for line in listed}


def test_show_says_the_measures_of_a_rack() -> None:
    out = runner.invoke(main.app, ["labware", "show", "chen2023-soft-5x10"]).stdout
    for words in (
        "192.5 x 95.5 mm",
        "53 mm high",
        "5 rows, 10 columns",
        "pitch 18.5 x 17.7 mm",
        "square 16.5 x 16.5 mm",
        "1.20 mm",
    ):
        assert words in out
    assert "E1 E2 E3 E4 E5 E6 E7 E8 E9 E10" in out


def test_show_says_the_measures_of_tubes_and_caps() -> None:
    out = runner.invoke(main.app, ["labware", "show", "chen2023-tube-3"]).stdout
    assert "105.5 mm with cap" in out
    assert "18.55 mm wide, 13 mm high" in out
    out = runner.invoke(main.app, ["labware", "show", "chen2023-tube-1"]).stdout
    assert "14.3 mm at the bottom, 17.5 mm at the rim" in out
    assert "flange" in out
    assert "16.7 mm, 3 mm thick" in runner.invoke(main.app, ["labware", "show", "printed-square-16.7"]).stdout


def test_show_draws_a_users_file_where_told_and_nowhere_else(tmp_path: Path) -> None:
    (tmp_path / "rack.yaml").write_text(RACK)
    out = tmp_path / "rack.png"
    result = runner.invoke(main.app, ["labware", "show", str(tmp_path / "rack.yaml"), "--out", str(out)])
    assert result.exit_code == 0
    assert out.read_bytes().startswith(b"\x89PNG")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["rack.png", "rack.yaml"]


def test_show_without_out_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert runner.invoke(main.app, ["labware", "show", "chen2023-tube-2"]).exit_code == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["show", "chen2023-tube2"], "unknown labware 'chen2023-tube2'; did you mean 'chen2023-tube-2'"),
        (["show", "missing.yaml"], "missing.yaml: no such file"),
        (["show", "chen2023-tube-2", "--out", "picture.jpg"], "expected a file name that ends in .png"),
        (["show", "chen2023-tube-2", "--out", "no/such/folder/x.png"], "folder no/such/folder does not exist"),
    ],
)
def test_show_refuses(arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    result = runner.invoke(main.app, ["labware", *arguments])
    assert isinstance(result.exception, LabwareError)
    assert message in str(result.exception)
    assert list(tmp_path.iterdir()) == []


def test_check_reads_every_file_and_fails_if_one_is_wrong(tmp_path: Path) -> None:
    good, bad = tmp_path / "good.yaml", tmp_path / "bad.yaml"
    good.write_text(RACK)
    bad.write_text(RACK.replace("floor_mm", "flor_mm"))
    result = runner.invoke(main.app, ["labware", "check", str(bad), str(good)])
    assert result.exit_code == 1
    assert result.stdout.splitlines() == [f"{good}: ok (rack my-rack)"]
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"error: {bad}: ")
    assert "unknown key 'flor_mm'; known keys: " in line
    assert runner.invoke(main.app, ["labware", "check", str(good)]).exit_code == 0


# The whole command


def test_an_error_is_one_line_and_exit_1(tmp_path: Path) -> None:
    done = command("labware", "show", "nothing.yaml", cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == "error: nothing.yaml: no such file\n"


def test_wrong_usage_is_exit_2() -> None:
    done = command("labware", "show", "--no-such-option")
    assert done.returncode == 2
    assert "no-such-option" in done.stderr


def test_our_own_bugs_keep_their_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(main, "app", broken)
    with pytest.raises(ZeroDivisionError):
        main.run()


def test_an_error_of_several_lines_becomes_one(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def refusing() -> None:
        raise CaptureError("cut\nshort")

    monkeypatch.setattr(main, "app", refusing)
    with pytest.raises(SystemExit, match="1"):
        main.run()
    assert capsys.readouterr().err == "error: cut short\n"


def test_version() -> None:
    assert runner.invoke(main.app, ["--version"]).stdout == f"tubepose {__version__}\n"


def test_help_names_every_command() -> None:
    out = runner.invoke(main.app, ["--help"]).stdout
    for name in ("estimate", "gt", "bench", "simulate", "labware", "data"):
        assert name in out


def test_the_command_is_installed() -> None:
    (script,) = entry_points(group="console_scripts", name="tubepose")
    assert script.load() is main.run


def test_a_place_that_cannot_be_written_is_one_line(tmp_path):
    (tmp_path / "file").write_text("mine")
    for command in (
        ("labware", "show", "chen2023-tube-1", "--out", tmp_path / "file" / "x.png"),
        ("detector", "render", "--count", "1", "--side", "96", "--out", tmp_path / "file"),
    ):
        ended = tubepose(*command)
        assert ended.code == 1
        assert len(ended.errors) == 1
        assert str(tmp_path / "file") in ended.err
    assert (tmp_path / "file").read_text() == "mine"
