"""A session folder: trials that tie captures with printed caps to captures with original caps.

`session.yaml` is written by a person or by the simulator; docs/capture-format.md describes it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from tubepose.capture.description import Unit
from tubepose.capture.fusion import Average
from tubepose.capture.hints import SlotHint, read_hint
from tubepose.errors import CaptureError, LabwareError
from tubepose.labware import CapModel, RackModel, TubeModel, load_cap, load_rack, load_tube, unique_tubes
from tubepose.labware.reading import read_yaml, validate

SESSION_FILE = "session.yaml"


class Trial(BaseModel):
    """One placement of tubes, scanned twice with the tubes unmoved.

    Attributes:
        name: Unique in its session.
        tubes: Tube (name or file) per occupied slot.
        original: Capture with the original caps, relative to the session folder.
        printed: Capture with the printed caps, or None where there is no ground truth.
        hint: Which way round the rack stands, if that was noted; in the file the keys of `SlotHint`, or a text as
            `read_hint` takes it.
        previous: Whether a rack that was left alone since an earlier trial stands as it did there; set by the text.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    name: str = Field(min_length=1)
    tubes: dict[str, str]
    original: str
    printed: str | None = None
    hint: SlotHint | None = None
    previous: bool = False

    @model_validator(mode="before")
    @classmethod
    def _read_hint(cls, data: Any) -> Any:
        if not isinstance(data, dict) or not isinstance(data.get("hint"), str):
            return data
        try:
            hint = read_hint(data["hint"])
        except ValueError as problem:
            raise ValueError(f"hint {data['hint']}: {problem}") from None
        return {"previous": hint.previous, **data, "hint": hint.place}


class Topics(BaseModel):
    """Topics of the recordings, where several would fit."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    cloud: str | None = None
    depth: str | None = None
    image: str | None = None
    info: str | None = None


class _SessionFile(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    format: Literal[1]
    name: str = Field(min_length=1)
    origin: Literal["recorded", "simulated"]
    sensor: str = "unknown"
    unit: Unit | None = None
    depth_scale_m: Annotated[float, Field(gt=0)] | None = None
    max_stamp_difference_ms: Annotated[float, Field(ge=0)] | None = None
    topics: Topics = Topics()
    rack: str
    printed_cap: str | None = None
    trials: tuple[Trial, ...] = Field(min_length=1)


class Session(BaseModel):
    """A session with its labware loaded.

    Attributes:
        folder: Where `session.yaml` lies.
        unit: Of the clouds' coordinates, as `open_captures` takes it.
        depth_scale_m: Metres per count of depth images, likewise.
        max_stamp_difference_ms: Of a picture and its cloud in recordings, likewise.
        topics: Of the recordings.
        rack: The rack of every trial.
        printed_cap: The printed cap, or None where no trial has one.
        tubes: Every tube model that the trials name, by the name that they use.
        average: Frames of its recordings that are fused into one, as `open_captures` takes it.
        allow_outside: Whether captures, and files that these name, may lie out of their folders.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
    folder: Path
    name: str
    origin: Literal["recorded", "simulated"]
    sensor: str
    unit: Unit | None = None
    depth_scale_m: float | None = None
    max_stamp_difference_ms: float | None = None
    topics: Topics = Topics()
    rack: RackModel
    printed_cap: CapModel | None
    tubes: dict[str, TubeModel]
    trials: tuple[Trial, ...]
    average: Average = 1
    allow_outside: bool = False

    def tubes_of(self, trial: Trial) -> tuple[TubeModel, ...]:
        """The kinds of tube in a trial, each once, in a fixed order."""
        return tuple(dict.fromkeys(self.tubes[name] for name in sorted(set(trial.tubes.values()))))

    @property
    def types(self) -> dict[str, TubeModel]:
        """Every tube model that the trials name, by its own name, as tables have it."""
        return {tube.name: tube for tube in self.tubes.values()}


def is_session(path: Path) -> bool:
    """True when the folder holds a `session.yaml`."""
    return (path / SESSION_FILE).is_file()


def load_session(path: Path, average: Average = 1) -> Session:
    """Read a session folder (or its `session.yaml`) and the labware that it names.

    Args:
        path: The folder, or the file.
        average: Frames of its recordings that are fused into one, as `open_captures` takes it.

    Raises:
        CaptureError: No session there, or one that breaks the format.
        LabwareError: It names labware that does not exist.
    """
    folder = path.parent if path.name == SESSION_FILE else path
    file = folder / SESSION_FILE
    if not file.is_file():
        raise CaptureError(f"{path}: no {SESSION_FILE} found; docs/capture-format.md shows how to write one")
    data = validate(_SessionFile, read_yaml(file, CaptureError), str(file), CaptureError)
    try:
        rack = load_rack(data.rack, folder)
        cap = load_cap(data.printed_cap, folder) if data.printed_cap is not None else None
        tubes = {name: load_tube(name, folder) for trial in data.trials for name in trial.tubes.values()}
        unique_tubes(tubes.values(), "the trials")
    except LabwareError as problem:
        raise LabwareError(f"{file}: {problem}") from None
    _check_trials(file, data, rack)
    return Session(
        folder=folder,
        name=data.name,
        origin=data.origin,
        sensor=data.sensor,
        unit=data.unit,
        depth_scale_m=data.depth_scale_m,
        max_stamp_difference_ms=data.max_stamp_difference_ms,
        topics=data.topics,
        rack=rack,
        printed_cap=cap,
        tubes=tubes,
        trials=data.trials,
        average=average,
    )


def _check_trials(file: Path, data: _SessionFile, rack: RackModel) -> None:
    names = [trial.name for trial in data.trials]
    doubled = sorted({name for name in names if names.count(name) > 1})
    if doubled:
        raise CaptureError(f"{file}: trial names must be unique, found twice: {', '.join(doubled)}")
    known = {slot.name for slot in rack.all_slots}
    for trial in data.trials:
        named = set(trial.tubes) | ({trial.hint.slot} if trial.hint is not None else set())
        unknown = sorted(named - known)
        if unknown:
            raise CaptureError(
                f"{file}: trial {trial.name}: no slot {', '.join(unknown)} in rack {rack.name}; {rack.slot_words}"
            )
        if trial.printed is not None and data.printed_cap is None:
            raise CaptureError(
                f"{file}: trial {trial.name} has a printed capture, but the session names no printed_cap"
            )
