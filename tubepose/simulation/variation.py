"""How simulated scenes vary: the ranges that every trial is drawn from, in the YAML that `--scenes` reads."""

from __future__ import annotations

from collections.abc import Iterator
from math import inf
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, BaseModel, BeforeValidator, ConfigDict, Field

from tubepose.errors import ConfigError
from tubepose.labware.reading import read_yaml, validate


def _two(value: Any) -> Any:
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise ValueError(f"expected [least, most], found {value!r}")
    return value


def _range(least: float, most: float) -> AfterValidator:
    def check(value: tuple[float, float]) -> tuple[float, float]:
        if not least <= value[0] <= value[1] <= most:
            bounds = f"{least:g} <= least <= most" + (f" <= {most:g}" if most < inf else "")
            raise ValueError(f"expected [least, most] with {bounds}, found {list(value)}")
        return value

    return AfterValidator(check)


Finite = Annotated[float, Field(allow_inf_nan=False)]
Pair = Annotated[tuple[Finite, Finite], BeforeValidator(_two)]
Range = Annotated[Pair, _range(0.0, inf)]
ShareRange = Annotated[Pair, _range(0.0, 1.0)]
IndexRange = Annotated[Pair, _range(1.0, 2.5)]
DistanceRange = Annotated[Pair, _range(0.05, 10.0)]
TiltRange = Annotated[Pair, _range(0.0, 60.0)]
BowRange = Annotated[Pair, _range(-5.0, 5.0)]
RoughnessRange = Annotated[Pair, _range(0.01, 1.0)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Spread = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class Tolerances(BaseModel):
    """Parts as they are made: standard deviations of what labware files do not know. 0 makes perfect parts.

    Attributes:
        cap_tilt_deg: Own cap seated crooked, about each of two axes.
        cap_radius_mm: Radius of the own cap.
        cap_height_mm: Height at which the own cap sits.
        printed_cap_tilt_deg: Printed cap seated crooked, about each of two axes.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    cap_tilt_deg: Spread = 0.15
    cap_radius_mm: Spread = 0.05
    cap_height_mm: Spread = 0.2
    printed_cap_tilt_deg: Spread = 0.1


class SceneVariation(BaseModel):
    """Ranges of a session's scenes; every value is drawn uniformly, once per trial unless said otherwise.

    Attributes:
        fill: Share of the slots that hold a tube; at least one does.
        scanner_tilt_deg: Angle between the camera's axis and the rack's normal.
        distance_m: Depth of the middle of the rack's face; null is what the camera is made for.
        rack_bow_mm: Height of the middles of the rack's sides over the centre of its face, drawn for x and y apart;
            positive is away from the base.
        scattering_per_mm: Of see-through walls, one value per trial; null keeps what the labware files say.
        absorption_per_mm: As `scattering_per_mm`.
        refractive_index: As `scattering_per_mm`.
        liquid_share: Share of the tubes that hold liquid, up to a level between 0.2 and 0.8 of the cavity.
        liquid_absorption_per_m: Absorption of the liquid, per tube.
        label_share: Share of the tubes that wear a paper label; a tube without 5 mm of straight wall wears none.
        rack_albedo: Brightness of the rack.
        table_albedo: Brightness of the table.
        printed_cap_albedo: Brightness of the printed caps.
        cap_albedo: Brightness of the tubes' own caps, one value per type and trial.
        label_albedo: Brightness of labels, per tube.
        gloss_roughness: GGX roughness of rack and own caps, drawn apart.
        wall_roughness: GGX roughness of see-through walls.
        tolerances: Parts as they are made.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    fill: ShareRange = (0.10, 0.40)
    scanner_tilt_deg: TiltRange = (0.0, 20.0)
    distance_m: DistanceRange | None = None
    rack_bow_mm: BowRange = (0.0, 0.0)
    scattering_per_mm: Range | None = None
    absorption_per_mm: Range | None = None
    refractive_index: IndexRange | None = None
    liquid_share: Share = 0.0
    liquid_absorption_per_m: Range = (1.0, 10.0)
    label_share: Share = 0.0
    rack_albedo: ShareRange = (0.50, 0.50)
    table_albedo: ShareRange = (0.15, 0.15)
    printed_cap_albedo: ShareRange = (0.80, 0.80)
    cap_albedo: ShareRange = (0.35, 0.85)
    label_albedo: ShareRange = (0.70, 0.90)
    gloss_roughness: RoughnessRange = (0.30, 0.60)
    wall_roughness: RoughnessRange = (0.05, 0.10)
    tolerances: Tolerances = Tolerances()

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Fields as they are printed. Not a flat rack, not a usual distance: sessions are named by digests of this."""
        for name, value in super().__repr_args__():
            if (name, value) not in (("rack_bow_mm", (0.0, 0.0)), ("distance_m", None)):
                yield name, value


def scene_variation(data: Any, where: str) -> SceneVariation:
    """Check ranges read from a file.

    Raises:
        ConfigError: They break the format; one line that names the key.
    """
    return validate(SceneVariation, data, where, ConfigError)


def load_scene_variation(path: Path) -> SceneVariation:
    """Read ranges from a YAML file; keys left out keep their defaults."""
    return scene_variation(read_yaml(path, ConfigError), str(path))
