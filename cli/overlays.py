"""Pictures of results: one per frame, by name of its capture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tubepose.batch import Job, UnnamedJob
    from tubepose.scene import Scene, TubeEstimate

LONGEST_NAME = 200
"""Bytes of an overlay's name before its numbers; a file system takes 255."""


def overlay_names(jobs: Sequence[Job | UnnamedJob]) -> tuple[str, ...]:
    """Of every job the name of its pictures before the frame's number: not too long, and no two alike."""
    taken: set[str] = set()
    names = []
    for job in jobs:
        capture = job.capture.name
        trial = "" if job.trial in capture else job.trial  # trials may call their captures by the same name
        parts = "-".join(part for part in (job.session, trial, capture) if part)
        plain = "".join(c if c.isprintable() and c != "/" else "_" for c in parts)
        plain = plain.encode()[:LONGEST_NAME].decode(errors="ignore")
        name, number = plain, 1
        while name in taken:
            number += 1
            name = f"{plain}-{number}"
        taken.add(name)
        names.append(name)
    return tuple(names)


@dataclass(frozen=True, slots=True)
class Overlays:
    """Draws the picture of a frame; another process can have it."""

    folder: Path
    names: tuple[str, ...]

    def __call__(self, number: int, job: Job, scene: Scene, estimates: tuple[TubeEstimate, ...]) -> None:  # noqa: ARG002
        """Write the picture."""
        write_overlay(self.folder / f"{self.names[number]}-{scene.frame.index:04d}.png", scene, estimates)


def write_overlay(path: Path, scene: Scene, estimates: Sequence[TubeEstimate]) -> None:
    """One overlay picture."""
    import cv2

    from tubepose.report.overlay import draw_overlay
    from tubepose.report.writing import write_bytes

    _, png = cv2.imencode(".png", draw_overlay(scene, estimates))
    write_bytes(path, png.tobytes())
