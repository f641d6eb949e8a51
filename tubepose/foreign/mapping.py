"""What a file of foreign results leaves unsaid: which trial a scene is, which tube an object, where its origin lies."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from tubepose.errors import ConfigError
from tubepose.labware import TubeModel
from tubepose.labware.reading import read_yaml, validate
from tubepose.transforms import FloatArray


class ForeignMapping(BaseModel):
    """Names and conventions of foreign results, as a YAML file states them.

    Attributes:
        method: What the tables call the estimator.
        objects: Tube name per object number of a BOP file.
        scenes: Trial per ``scene_id`` or ``scene_id/im_id`` of a BOP file, as ``trial`` or ``session/trial``.
        origin: Where the model's origin lies on the tube's axis: at its bottom, or half way up.
        axis: Which axis of the model runs along the tube, upwards.
        unit: Of the translations; BOP files are in mm.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    method: str = Field(default="", max_length=100)
    objects: dict[int, str] = {}
    scenes: dict[str, str] = {}
    origin: Literal["bottom", "center"] = "bottom"
    axis: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"
    unit: Literal["m", "mm"] | None = None

    def to_tube(self, tube: TubeModel | None) -> FloatArray:
        """Transform (4, 4) that maps points of our tube frame (bottom, z upwards) to the foreign model's, metres.

        Raises:
            ConfigError: The origin is half way up, and the tube's height is not known.
        """
        T = np.eye(4)
        axis = "xyz".index(self.axis[-1])
        up = np.zeros(3)
        up[axis] = -1.0 if self.axis.startswith("-") else 1.0
        side = np.roll(np.abs(up), 1)
        T[:3, :3] = np.column_stack([side, np.cross(up, side), up])
        if self.origin == "center":
            if tube is None:
                raise ConfigError("origin: center needs the tube of every row, found a row without one; name it")
            T[:3, 3] = -up * tube.height_m / 2
        return T


def read_mapping(path: Path | None) -> ForeignMapping:
    """Read a mapping file; without one, the defaults.

    Raises:
        ConfigError: The file is missing, or has keys or values that are none of a mapping.
    """
    if path is None:
        return ForeignMapping()
    data: dict[str, Any] = read_yaml(path, ConfigError)
    if isinstance(data.get("scenes"), Mapping):
        data["scenes"] = {str(key): value for key, value in data["scenes"].items()}
    return validate(ForeignMapping, data, str(path), ConfigError)
