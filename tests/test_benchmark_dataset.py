"""The benchmark set: its recipe, its place in the manifest, its twin, and the sample cut from it."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest
import yaml
from commands import tubepose

from tubepose.capture.manifest import Manifest, check_data_set, read_manifest, write_manifest
from tubepose.capture.session import load_session
from tubepose.simulation import read_exact_truth

REPOSITORY = Path(__file__).resolve().parent.parent
# Of the design, not of the materials: the same in both splits.
DESIGN = {
    "distance_m",
    "rack_bow_mm",
    "fill",
    "scanner_tilt_deg",
    "scattering_per_mm",
    "liquid_share",
    "label_share",
    "tolerances",
}
SMALL = {
    "rack": "round-10ml-3x4",
    "tubes": ["blood-16x100", "chen2023-tube-3"],
    "cap": "printed-square-16.7",
    "trials": 2,
    "resolution": 64,
    "sensor": "raycast",
    "capture_format": "mcap",
    "licence": "Apache-2.0",
    "scenes": {"fill": [0.2, 0.3]},
    "sets": {"dev": {"seed": 5}, "test": {"seed": 6, "scenes": {"table_albedo": [0.3, 0.4]}}},
}


@pytest.fixture(scope="module")
def dataset() -> ModuleType:
    """The script is no part of an installed package: it is loaded from its file."""
    spec = importlib.util.spec_from_file_location("dataset_command", REPOSITORY / "benchmarks" / "dataset.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def run(dataset: ModuleType, tmp_path: Path):
    """The command with a small recipe and an empty manifest."""
    recipe, manifest = tmp_path / "recipe.yaml", tmp_path / "data_manifest.yaml"
    recipe.write_text(yaml.safe_dump(SMALL))
    write_manifest(manifest, Manifest(data_sets=()))
    places = ["--recipe", str(recipe), "--manifest", str(manifest)]
    return lambda *arguments: dataset.main([*places, *arguments])


def sets(root: Path) -> dict[str, object]:
    return {entry.name: entry for entry in read_manifest(root / "data_manifest.yaml").data_sets}


def truths(session: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in (session / "simulation_truth").iterdir()}


def test_the_recipe_has_the_papers_design(dataset: ModuleType) -> None:
    recipe = dataset.read_recipe()
    assert (recipe.rack, len(recipe.tubes), recipe.trials, recipe.resolution) == ("chen2023-soft-5x10", 3, 20, 1376)
    assert (recipe.sensor, recipe.capture_format) == ("structured-light", "mcap")
    for name in ("dev", "test"):
        variation = recipe.variation(name)
        assert (variation.fill, variation.scattering_per_mm, variation.scanner_tilt_deg) == ((0.1, 1), (0, 1), (0, 20))
        assert (variation.liquid_share, variation.label_share) == (0.3, 0.3)


def test_dev_and_test_share_no_seed_and_no_material(dataset: ModuleType) -> None:
    recipe = dataset.read_recipe()
    assert set(recipe.sets) == {"dev", "test"}
    assert recipe.sets["dev"].seed != recipe.sets["test"].seed
    dev, test = recipe.variation("dev"), recipe.variation("test")
    materials = set(type(dev).model_fields) - DESIGN
    assert len(materials) == 10
    for name in materials:
        (low, high), (other_low, other_high) = getattr(dev, name), getattr(test, name)
        assert high < other_low or other_high < low, name
    for name in DESIGN:
        assert getattr(dev, name) == getattr(test, name)


def test_a_set_is_made_recorded_and_verified(run, tmp_path: Path) -> None:
    assert run("make", "dev", "--threads", "1") == 0
    entry = sets(tmp_path)["dev"]
    assert (entry.split, entry.simulated, entry.path) == ("dev", True, "data/dev")
    assert entry.source == "python -m benchmarks.dataset make dev"
    assert len(entry.files) == 8 + 4 + 1
    assert check_data_set(entry, tmp_path).state == "ok"
    assert tubepose("data", "verify", "dev", "--manifest", tmp_path / "data_manifest.yaml").code == 0
    assert run("make", "dev") == 1
    (tmp_path / "data" / "dev" / "session.yaml").write_text("changed")
    assert check_data_set(entry, tmp_path).state == "differs"
    assert run("record", "dev") == 0
    assert check_data_set(sets(tmp_path)["dev"], tmp_path).state == "ok"


def test_another_size_is_not_the_recipes_set(run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("make", "dev", "--trials", "1") == 1
    assert "--trials 1: " in capsys.readouterr().err
    assert not (tmp_path / "data").exists()
    out = tmp_path / "try"
    assert run("make", "test", "--trials", "1", "--resolution", "96", "--threads", "1", "--out", str(out)) == 0
    assert len(load_session(out / "test").trials) == 2
    assert sets(tmp_path) == {}


def test_the_twin_has_the_same_scenes(run, tmp_path: Path) -> None:
    small = ("--trials", "1", "--threads", "1", "--out")
    assert run("make", "test", *small, str(tmp_path / "a")) == 0
    assert run("twin", "test", "--sensor", "raycast", *small, str(tmp_path / "b")) == 0
    assert truths(tmp_path / "a" / "test") == truths(tmp_path / "b")
    assert len(truths(tmp_path / "b")) == 2


def test_the_sample_is_the_first_trials_of_every_tube(run, tmp_path: Path) -> None:
    (tmp_path / "tubepose" / "sample").mkdir(parents=True)
    (tmp_path / "tubepose" / "sample" / "old.txt").write_text("gone afterwards")
    assert run("make", "dev", "--threads", "1") == 0
    assert run("sample") == 0
    whole, sample = load_session(tmp_path / "data" / "dev"), load_session(tmp_path / "tubepose" / "sample")
    assert [trial.name for trial in sample.trials] == ["blood-16x100-001", "chen2023-tube-3-001"]
    assert list(sample.trials) == [trial for trial in whole.trials if trial.name.endswith("001")]
    assert sample.name == f"{whole.name}-sample"
    for trial in sample.trials:
        for place in (trial.printed, trial.original):
            assert (sample.folder / place).read_bytes() == (whole.folder / place).read_bytes()
        assert read_exact_truth(sample.folder, trial.name).tubes.keys() == trial.tubes.keys()
    entry = sets(tmp_path)["sample"]
    assert (entry.split, entry.source) == ("dev", "python -m benchmarks.dataset sample --trials 1 --most-tubes 99")
    assert check_data_set(entry, tmp_path).state == "ok"
    assert len(entry.files) == 4 + 2 + 1
    assert [path.name for path in (tmp_path / "tubepose").iterdir()] == ["sample"]
    most = min(len(trial.tubes) for trial in whole.trials)
    assert run("sample", "--most-tubes", str(most), "--out", str(tmp_path / "few")) == 0
    assert {len(trial.tubes) for trial in load_session(tmp_path / "few").trials} == {most}


def test_what_cannot_be_done_is_said(run, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("make", "train") == 1
    assert "no set 'train' in" in capsys.readouterr().err
    assert run("sample") == 1
    assert "error: " in capsys.readouterr().err
    assert run("record", "dev") == 1
    assert "expected an existing file or folder" in capsys.readouterr().err
    (tmp_path / "recipe.yaml").write_text(yaml.safe_dump(SMALL | {"scenes": {"fil": [0, 1]}}))
    assert run("make", "dev") == 1
    assert "unknown key 'fil'; known keys: fill" in capsys.readouterr().err
