"""Labware as the definitions state it: racks with slots, tubes as profiles of revolution, printed caps.

Definitions are written in millimetres, and every such field says so in its name; the methods and properties that
the pipeline uses give metres. All models are frozen and strict: an unknown key is an error at every level.

Frames. Rack: origin at the centre of the base, z up out of the slots, x along the columns (A1 to A2), y towards row A.
Tube: origin at the outermost point of the bottom on the axis, z towards the opening. Cap: as the tube that wears it.
"""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationInfo, field_validator

MM = 1e-3
Positive = Annotated[float, Field(gt=0)]
NonNegative = Annotated[float, Field(ge=0)]

LONGEST_NAME = 80
RESERVED_NAMES = frozenset({"all", "none", "unknown", "na", "nan", "null", "inf"})
"""What tables call all types, no type, and one that is not known; and what programs that read them take for nothing."""


def _name(text: str) -> str:
    """A name that files and rows can have."""
    if text.lower() in RESERVED_NAMES:
        raise ValueError(f"'{text}' is a word of the tables; choose another name")
    odd = sorted({c for c in text if c in "/\\" or not c.isprintable()})
    if odd or text.startswith(".") or text != text.strip():
        what = ", ".join(map(repr, odd)) or ("a dot at the start" if text.startswith(".") else "a blank at an end")
        raise ValueError(f"files and rows are named by it, so it cannot hold {what} (found {text!r})")
    return text


Name = Annotated[str, Field(min_length=1, max_length=LONGEST_NAME), AfterValidator(_name)]


class StrictModel(BaseModel):
    """Frozen, and strict about unknown keys, numbers that are none, and words for numbers."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    @field_validator("*", mode="before")
    @classmethod
    def _no_words_as_numbers(cls, value: Any, info: ValidationInfo) -> Any:
        """YAML reads `yes` as true, which would count as 1."""
        parts = value if isinstance(value, list | tuple) else [value]
        is_flag = cls.model_fields[info.field_name or ""].annotation is bool
        if not is_flag and any(isinstance(part, bool) for part in parts):
            raise ValueError(f"expected no yes or no (found {value!r})")
        return value


class Definition(StrictModel):
    """Base of every definition and of its parts."""

    model_config = ConfigDict(ignored_types=(cached_property,))

    def __eq__(self, other: object) -> bool:
        """Whether both define the same; what was computed of one of them, and kept, does not count."""
        if type(self) is not type(other):
            return NotImplemented
        return all(getattr(self, name) == getattr(other, name) for name in type(self).model_fields)

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash((type(self), *(getattr(self, name) for name in type(self).model_fields)))

    def __copy__(self) -> Self:
        """A copy that may be changed, as `model_copy` does: without what was computed of this one."""
        copied = super().__copy__()
        for name in copied.__dict__.keys() - type(self).model_fields.keys():
            del copied.__dict__[name]
        return copied

    def __getstate__(self) -> dict[Any, Any]:
        """What is sent to another process, in which texts have other hashes: nothing that was computed."""
        state = super().__getstate__()
        return {**state, "__dict__": {name: state["__dict__"][name] for name in type(self).model_fields}}
