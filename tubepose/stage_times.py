"""How long the stages of a frame take."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class StageTime:
    """How long one instance of a stage took.

    Attributes:
        stage: ``load``, ``detect``, ``rack``, ``sensor``, ``slots`` or ``tube``.
        method: The tube method, or ``all`` for a stage that every method shares.
        instance: The slot for a tube, else empty.
        seed: Seed of a stochastic method, else None.
        duration_ms: Wall time, milliseconds.
    """

    stage: str
    method: str
    instance: str
    seed: int | None
    duration_ms: float


@dataclass(slots=True)
class Clock:
    """Times stages as they end."""

    times: list[StageTime] = field(default_factory=list)

    @contextmanager
    def stage(self, stage: str, method: str = "all", instance: str = "", seed: int | None = None) -> Iterator[None]:
        """Time a block; the arguments are those of `StageTime`."""
        start = time.perf_counter_ns()
        yield
        self.times.append(StageTime(stage, method, instance, seed, (time.perf_counter_ns() - start) / 1e6))

    def shared(self) -> tuple[StageTime, ...]:
        """One row per stage that all methods share, in the order of their beginning: what is done twice is added up."""
        total: dict[str, float] = {}
        for entry in self.times:
            total[entry.stage] = total.get(entry.stage, 0.0) + entry.duration_ms
        return tuple(StageTime(stage, "all", "", None, duration_ms) for stage, duration_ms in total.items())
