"""Configuration: defaults, changes from a file, refusals."""

import pytest
from pydantic import ValidationError

from tubepose.config import Config, TubeConfig, load_config
from tubepose.errors import ConfigError


def written(tmp_path, text):
    path = tmp_path / "config.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_no_file_gives_the_defaults():
    assert load_config(None) == Config()


def test_a_file_changes_what_it_names_and_nothing_else(tmp_path):
    config = load_config(written(tmp_path, "tube:\n  objective: l2\nrack:\n  icp_distances_m: [0.004, 0.001]\n"))
    assert config.tube == TubeConfig(objective="l2")
    assert config.rack.icp_distances_m == (0.004, 0.001)
    assert config.rack.min_fitness == Config().rack.min_fitness
    assert config.slots == Config().slots


def test_unknown_section_names_the_known_ones(tmp_path):
    with pytest.raises(ConfigError, match=r"unknown key 'tubes'; known keys: .*rack, sensor, slots, tube, .*rivals"):
        load_config(written(tmp_path, "tubes: {}\n"))


def test_unknown_key_inside_a_section_names_the_keys_of_that_section(tmp_path):
    path = written(tmp_path, "slots:\n  min_shares: 0.3\n")
    with pytest.raises(ConfigError, match=r"unknown key 'slots\.min_shares'; known keys: .*min_share, height") as error:
        load_config(path)
    assert "objective" not in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tube:\n  min_points: many\n", r"tube\.min_points: .*integer.*'many'"),
        ("tube:\n  objective: median\n", r"tube\.objective: .*'hinge', 'signed', 'l1', 'l2' or 'count'.*'median'"),
        ("rack: 3\n", r"rack: .*found 3"),
        ("- a\n", "expected a mapping"),
        ("tube: [\n", "not valid YAML"),
    ],
)
def test_wrong_values_are_named_in_one_line(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message) as error:
        load_config(written(tmp_path, text))
    assert "\n" not in str(error.value)


def test_missing_file(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.yaml: no such file"):
        load_config(tmp_path / "none.yaml")


def test_a_section_cannot_be_changed_in_place():
    with pytest.raises(ValidationError, match="frozen"):
        Config().tube.min_points = 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("profile: {slope_std: 0}", "slope_std: Input should be greater than 0"),
        ("rack: {min_seen: .nan}", "min_seen: .*finite"),
        ("rack: {max_inlier_rmse_m: -1}", "max_inlier_rmse_m: expected 0 or more, found -1"),
        ("rack: {icp_distances_m: []}", "icp_distances_m: expected one or more numbers, all more than 0"),
        ("rack_top: {seed: -1}", "seed: expected 0 or more, found -1"),
        ("profile: {plane_points: 0}", "plane_points: expected 1 or more, found 0"),
        ("icp: {max_distance_m: [0]}", r"max_distance_m: expected one or more numbers, all more than 0, found \[0.0\]"),
        ("rack: {max_stray_share: yes}", "max_stray_share: expected no yes or no"),
    ],
)
def test_numbers_that_would_open_a_gate_or_break_a_fit_are_refused(tmp_path, text, words):
    (tmp_path / "a.yaml").write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=words):
        load_config(tmp_path / "a.yaml")


@pytest.mark.parametrize("text", ["rack: {min_seen: 0}", "slots: {open_depth_m: 0}", "sensor: {shared_m: 0}"])
def test_nothing_is_a_number_too(tmp_path, text):
    (tmp_path / "a.yaml").write_text(text, encoding="utf-8")
    (tmp_path / "b.yaml").write_text(text.replace("0", "0.5"), encoding="utf-8")
    assert load_config(tmp_path / "a.yaml") != load_config(tmp_path / "b.yaml")


@pytest.mark.parametrize("section", [name for name, _ in Config()])
def test_no_setting_is_negative(section):
    for name, value in getattr(Config(), section):
        if not isinstance(value, bool | str):
            with pytest.raises(ValidationError, match=name):
                type(getattr(Config(), section))(**{name: (-1,) if isinstance(value, tuple) else -1})
