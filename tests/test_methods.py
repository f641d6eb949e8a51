"""All methods by name, and the one signature that they have."""

import ast
from pathlib import Path

import pytest

import tubepose
from tubepose.errors import ConfigError
from tubepose.methods import DEFAULT_METHOD, METHODS, foremost, seeds_of
from tubepose_cli.inputs import read_methods

LIBRARY = Path(tubepose.__file__).parent
NAMES = ("profile", "paper", "upright", "slot-icp", "global-icp", "kiss-matcher", "gicp")


def test_ours_and_the_baselines_have_their_names_and_one_file_each():
    assert tuple(METHODS) == NAMES
    assert DEFAULT_METHOD == "profile"
    assert all(METHODS[name].name == name for name in NAMES)
    assert all((LIBRARY / "methods" / f"{name.replace('-', '_')}.py").is_file() for name in NAMES)


def test_only_profile_finds_its_tubes_itself():
    assert [name for name, method in METHODS.items() if not method.needs_targets] == ["profile"]


def test_seeds_are_for_what_is_drawn():
    assert {name for name in METHODS if METHODS[name].is_stochastic} == {"global-icp", "kiss-matcher"}
    assert list(seeds_of("global-icp", 3)) == [0, 1, 2]
    assert list(seeds_of("paper", 3)) == [None]


@pytest.mark.parametrize(
    ("names", "first"),
    [(("upright", "paper", "profile"), "profile"), (("upright", "paper"), "paper"), (("gicp", "upright"), "gicp")],
)
def test_ours_is_shown_first_then_the_papers_then_what_was_asked_first(names, first):
    assert foremost(names) == first


def test_an_unknown_method_is_named_with_the_known_ones():
    with pytest.raises(ConfigError, match="unknown method 'papr'; did you mean 'paper'\\?; known: profile, paper"):
        read_methods("papr")


@pytest.mark.parametrize("path", ["pipeline.py", "batch*", "scene.py", "records.py", "targets.py", "detection"])
def test_nothing_around_the_methods_knows_one_of_them_by_name(path):
    """A method says itself what it needs: nothing branches on its name, nor the pipeline on a detector's type."""
    files = [one for found in LIBRARY.glob(path) for one in ([found] if found.is_file() else found.rglob("*.py"))]
    assert files
    for file in files:
        tree = ast.parse(file.read_text())
        texts = {node.value for node in ast.walk(tree) if isinstance(node, ast.Constant)}
        assert not texts & set(NAMES), file
        if file.name == "pipeline.py":
            called = {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
            assert "isinstance" not in called
