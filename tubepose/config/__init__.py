"""Every tunable number of the estimators: one frozen section per stage, defaults beside the reason for them.

A user's YAML file (``--config``) may set any of them; an unknown key fails and names the known ones.
No default was fitted to a capture that a table of ours is computed on; docs/method.md says where each is from.
Sections are a package of their own: stages take all of them, so a section inside of its stage would be imported by
what imports it.
"""

from tubepose.config.composed import Config, load_config
from tubepose.config.method_sections import IcpConfig, Objective, RivalsConfig, TubeConfig
from tubepose.config.preprocess_sections import PreprocessConfig, RackTopConfig
from tubepose.config.profile_section import ProfileConfig
from tubepose.config.rack_section import RackConfig, RackMethod
from tubepose.config.sensor_section import SensorConfig
from tubepose.config.slot_section import SlotConfig

__all__ = [
    "Config",
    "IcpConfig",
    "Objective",
    "PreprocessConfig",
    "ProfileConfig",
    "RackConfig",
    "RackMethod",
    "RackTopConfig",
    "RivalsConfig",
    "SensorConfig",
    "SlotConfig",
    "TubeConfig",
    "load_config",
]
