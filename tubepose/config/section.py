"""What every section of the configuration is."""

from __future__ import annotations

from typing import Self

from pydantic import BaseModel, model_validator

from tubepose.labware.definition import StrictModel


class Section(StrictModel):
    """A frozen section: a gate of NaN would be open, and nothing in one means anything below zero."""

    @model_validator(mode="after")
    def _check_numbers(self) -> Self:
        """Counts are 1 or more, and so are the numbers of a list more than 0; what else may not be 0 says so itself."""
        for name, value in self:
            if isinstance(value, bool | str | BaseModel):
                continue
            least = 1 if isinstance(value, int) and name != "seed" else 0
            if isinstance(value, tuple) and (not value or min(value) <= 0):
                raise ValueError(f"{name}: expected one or more numbers, all more than 0, found {list(value)}")
            if not isinstance(value, tuple) and value < least:
                raise ValueError(f"{name}: expected {least} or more, found {value}")
        return self
