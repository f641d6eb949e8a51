"""All sections together, and the file that changes them."""

from __future__ import annotations

from pathlib import Path

from tubepose.config.method_sections import IcpConfig, RivalsConfig, TubeConfig
from tubepose.config.preprocess_sections import PreprocessConfig, RackTopConfig
from tubepose.config.profile_section import ProfileConfig
from tubepose.config.rack_section import RackConfig
from tubepose.config.section import Section
from tubepose.config.sensor_section import SensorConfig
from tubepose.config.slot_section import SlotConfig
from tubepose.errors import ConfigError
from tubepose.labware.reading import read_yaml, validate


class Config(Section):
    """All sections."""

    preprocess: PreprocessConfig = PreprocessConfig()
    rack_top: RackTopConfig = RackTopConfig()
    rack: RackConfig = RackConfig()
    sensor: SensorConfig = SensorConfig()
    slots: SlotConfig = SlotConfig()
    tube: TubeConfig = TubeConfig()
    profile: ProfileConfig = ProfileConfig()
    icp: IcpConfig = IcpConfig()
    rivals: RivalsConfig = RivalsConfig()


def load_config(path: Path | None) -> Config:
    """Defaults, changed by the YAML file if one is given.

    Raises:
        ConfigError: The file is missing, or has an unknown key or a wrong value.
    """
    if path is None:
        return Config()
    return validate(Config, read_yaml(path, ConfigError), str(path), ConfigError)
