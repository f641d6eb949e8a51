"""The directions of imports, stated as a table: an edge that is not in it fails."""

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
LIBRARY = ROOT / "tubepose"
CLI = ROOT / "cli"

# Everyone may use these; they use nothing of ours but one another.
BASE = {"errors", "transforms"}
STAGES = {"rack", "slots", "tube", "profile", "methods", "pipeline", "detection"}

# Part of the library -> the other parts that it may import (BASE goes without saying).
ALLOWED: dict[str, set[str]] = {
    "errors": set(),
    "transforms": set(),
    "labware": set(),
    "capture": {"compiled", "labware"},
    "config": {"labware"},
    "preprocessing": {"config", "labware"},
    "rack_band": {"config", "labware", "preprocessing"},
    "detection": {"capture", "config", "labware", "preprocessing", "rack", "rack_band"},
    "compiled": set(),
    "sensor": {"capture", "compiled", "config", "labware"},
    "checks": set(),
    "confidence": set(),
    "rack": {"capture", "checks", "compiled", "config", "labware", "preprocessing", "rack_band"},
    "slots": {"capture", "checks", "compiled", "config", "labware", "preprocessing", "detection", "rack"},
    "tube": {"checks"},
    "profile": {"capture", "checks", "compiled", "confidence", "config", "labware", "preprocessing", "sensor", "tube"},
    "scene": {"capture", "checks", "detection", "labware", "rack", "sensor", "slots", "stage_times", "tube"},
    "occupancy": {"scene", "slots", "tube"},
    "targets": {"capture", "checks", "config", "detection", "labware", "scene", "slots"},
    "methods": {
        "checks",
        "config",
        "detection",
        "labware",
        "preprocessing",
        "profile",
        "rack",
        "scene",
        "stage_times",
        "targets",
        "tube",
        "tubes_pitch",
    },
    "pipeline": {
        "capture",
        "config",
        "detection",
        "labware",
        "methods",
        "rack",
        "scene",
        "sensor",
        "slots",
        "stage_times",
        "targets",
    },
    "stage_times": set(),
    "tubes_pitch": {"checks", "config", "labware", "rack", "scene", "statistics", "tube"},
    "labware_check": {"config", "labware", "rack", "scene", "statistics", "tubes_pitch"},
    "standing_tops": {"labware"},
    "labware_measure": {"capture", "config", "labware", "rack", "sensor", "standing_tops"},
    "result_tables": {"labware", "records"},
    "records": {
        "capture",
        "checks",
        "detection",
        "occupancy",
        "pose_errors",
        "rack",
        "scene",
        "sensor",
        "stage_times",
    },
    "result_folder": set(),
    "batch": {
        "provenance",
        "result_folder",
        "capture",
        "compiled",
        "config",
        "labware",
        "detection",
        "labware_check",
        "methods",
        "rack",
        "pipeline",
        "records",
        "result_tables",
        "scene",
        "stage_times",
    },
    "camera_report": {"capture", "config", "expectation", "labware", "sensor"},
    "expectation": {"capture", "config", "labware", "profile", "sensor"},
    "ground_truth": {"capture", "labware"},
    "simulation": {"capture", "compiled", "labware"},
    "statistics": set(),
    "pose_errors": set(),
    "evaluation": {"confidence", "labware", "pose_errors", "statistics"},
    "uncertainty": {"pose_errors", "statistics"},
    "confusion": set(),
    "training": {"capture", "detection", "labware", "report", "simulation", "version"},
    "truth_tables": {
        "batch",
        "records",
        "capture",
        "evaluation",
        "ground_truth",
        "labware",
        "pose_errors",
        "simulation",
    },
    "foreign": {"capture", "labware", "pose_errors", "records", "simulation", "truth_tables"},
    "benchmark": {
        "batch",
        "capture",
        "config",
        "confusion",
        "detection",
        "evaluation",
        "foreign",
        "ground_truth",
        "labware",
        "methods",
        "pose_errors",
        "provenance",
        "records",
        "report",
        "result_tables",
        "simulation",
        "statistics",
        "truth_tables",
        "uncertainty",
        "version",
    },
    "provenance": {"capture", "config", "labware", "version"},
    "report": {
        "result_folder",
        "batch",
        "capture",
        "config",
        "evaluation",
        "labware",
        "detection",
        "occupancy",
        "rack",
        "scene",
        "slots",
        "statistics",
        "tube",
    },
}


def parts() -> list[str]:
    entries = [path for path in LIBRARY.iterdir() if path.suffix == ".py" or (path / "__init__.py").is_file()]
    return sorted(path.stem for path in entries if path.name not in ("__init__.py",))


def sources(part: str) -> list[Path]:
    single = LIBRARY / f"{part}.py"
    return [single] if single.is_file() else sorted((LIBRARY / part).rglob("*.py"))


def imported(source: str, package: str = "") -> set[str]:
    """Dotted names that a module imports anywhere in it, `from a import b` as a.b; relative ones made absolute."""
    names = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                kept = package.split(".")[: len(package.split(".")) - node.level + 1]
                base = ".".join([*kept, base]).rstrip(".")
            names |= {f"{base}.{alias.name}" for alias in node.names}
    return names


def parts_used(source: str, package: str = "tubepose") -> set[str]:
    """Parts of the library that a module imports; `version` stands for the package's own `__version__`."""
    used = set()
    for name in imported(source, package):
        first, _, rest = name.partition(".")
        if first == "tubepose_cli":
            used.add("cli")
        elif first == "tubepose":
            used.add("version" if rest == "__version__" else rest.split(".")[0])
    return used


def package_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts[:-1])


def test_every_part_has_a_row_and_every_row_a_part() -> None:
    assert set(parts()) == set(ALLOWED), "add the new part to ALLOWED, below what it imports"


@pytest.mark.parametrize("part", sorted(ALLOWED))
def test_imports_follow_the_table(part: str) -> None:
    for path in sources(part):
        extra = parts_used(path.read_text(), package_of(path)) - ALLOWED[part] - BASE - {part}
        assert not extra, f"{path.relative_to(ROOT)} imports {sorted(extra)}"


def test_the_table_itself_has_no_cycle() -> None:
    done: set[str] = set(BASE) | {"version"}
    left = {part: needs - BASE for part, needs in ALLOWED.items() if part not in BASE}
    while left:
        ready = [part for part, needs in left.items() if needs <= done]
        assert ready, f"cycle among {sorted(left)}"
        done |= set(ready)
        left = {part: needs for part, needs in left.items() if part not in done}


def test_no_circle_of_modules() -> None:
    """Within a part as well; a package's `__init__` is for those outside of it."""
    paths = {
        ".".join(p.relative_to(ROOT).with_suffix("").parts): p for p in LIBRARY.rglob("*.py") if p.stem != "__init__"
    }
    left = {}
    for name, path in paths.items():
        used = imported(path.read_text(), package_of(path))
        left[name] = {other for other in paths if other in used or any(u.startswith(f"{other}.") for u in used)}
    while left:
        ready = [name for name, needs in left.items() if not needs & left.keys()]
        assert ready, f"cycle among {sorted(left)}"
        for name in ready:
            del left[name]


def test_ground_truth_shares_nothing_with_the_estimators() -> None:
    reached, todo = set(), {"ground_truth"}
    while todo:
        part = todo.pop()
        reached.add(part)
        for path in sources(part):
            todo |= parts_used(path.read_text(), package_of(path)) - reached - {"version"}
    assert not reached & (STAGES | {"preprocessing", "config"}), sorted(reached)


def test_package_root_imports_nothing() -> None:
    """The front door is loaded when it is asked for."""
    code = "import sys, tubepose; print(sorted(name for name in sys.modules if name.startswith('tubepose.')))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "[]\n"
    assert parts_used((LIBRARY / "__init__.py").read_text()) == {"benchmark"}


def test_a_forbidden_edge_would_be_seen() -> None:
    assert parts_used("def f():\n    from tubepose.rack import RackPose\n") == {"rack"}
    assert parts_used("from . import rack", "tubepose.ground_truth") == {"ground_truth"}
    assert parts_used("from ..rack import RackPose", "tubepose.ground_truth") == {"rack"}
    assert parts_used("import tubepose.pipeline as p\nfrom tubepose import tube, __version__") == {
        "pipeline",
        "tube",
        "version",
    }
    assert parts_used("from tubepose_cli.show import say") == {"cli"}


@pytest.mark.parametrize("path", sorted(LIBRARY.rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT)))
def test_library_does_not_print_exit_or_parse_arguments(path: Path) -> None:
    source = path.read_text()
    used = {name.split(".")[0] for name in imported(source)}
    assert not used & {"typer", "click", "argparse", "rich"}, used
    called = {ast.unparse(node.func) for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Call)}
    assert not called & {"print", "input", "exit", "quit", "sys.exit", "os._exit"}, called


def test_no_drawer_for_odds_and_ends() -> None:
    drawers = {"utils", "util", "misc", "common", "tools", "helpers"}
    found = [p for folder in (LIBRARY, CLI) for p in folder.rglob("*") if drawers & set(p.stem.split("_"))]
    assert not found


def test_click_is_not_imported() -> None:
    for path in CLI.rglob("*.py"):
        assert "click" not in {name.split(".")[0] for name in imported(path.read_text())}, path


def test_commands_import_nothing_heavy_at_the_top() -> None:
    light = {"typer", "tubepose_cli", *sys.stdlib_module_names}
    allowed = {
        "tubepose.__version__",
        *(f"tubepose.errors.{name}" for name in ("TubePoseError", "StoppedError", "is_interrupt", "interrupt_number")),
    }
    for path in sorted(CLI.glob("*.py")):
        body = [node for node in ast.parse(path.read_text()).body if isinstance(node, ast.Import | ast.ImportFrom)]
        names = imported("\n".join(ast.unparse(node) for node in body), "tubepose_cli")
        heavy = {name for name in names if name.split(".")[0] not in light} - allowed
        assert not heavy, f"{path.name} imports {sorted(heavy)} at module level"


def test_help_loads_no_heavy_library() -> None:
    """What makes `--help` quick, and counts the same on a slow machine as on a fast one."""
    code = (
        "import sys; from tubepose_cli import main; sys.argv = ['tubepose', '--help']\n"
        "try: main.run()\n"
        "finally: print(' '.join(sorted({m.split('.')[0] for m in sys.modules})), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "estimate" in done.stdout
    loaded = set(done.stderr.split())
    assert "typer" in loaded
    assert not loaded & {
        *("numpy", "scipy", "pandas", "open3d", "cv2", "numba", "mcap"),
        *("onnxruntime", "matplotlib", "pydantic", "yaml", "plotly", "dash"),
    }


def test_every_package_is_in_the_wheel() -> None:
    listed = set(tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"])
    found = {".".join(path.parent.relative_to(ROOT).parts) for path in LIBRARY.rglob("__init__.py")} | {"tubepose_cli"}
    assert listed == found


def test_every_folder_of_code_is_a_package() -> None:
    folders = {path.parent for path in LIBRARY.rglob("*.py") if "sample" not in path.parts}
    assert not [str(folder) for folder in folders if not (folder / "__init__.py").is_file()]
