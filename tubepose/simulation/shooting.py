"""Captures of given scenes by a simulated sensor, written as they are done."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from tubepose.capture.frame import RgbdFrame
from tubepose.capture.mcap_writing import write_mcap
from tubepose.capture.writing import write_folder_capture
from tubepose.simulation.camera import StructuredLightCamera
from tubepose.simulation.scene import Scene

CaptureFormat = Literal["folder", "mcap"]


class Sensor(Protocol):
    """A simulated sensor."""

    def __call__(
        self, scene: Scene, camera: StructuredLightCamera, rng: np.random.Generator, *, threads: int = 1
    ) -> RgbdFrame:
        """Capture a scene; the number of threads changes nothing but the time."""
        ...


# The sensors are imported when they are used: each needs a large library that the other does without.
def _raycast(scene: Scene, camera: StructuredLightCamera, rng: np.random.Generator, *, threads: int = 1) -> RgbdFrame:
    from tubepose.simulation import raycast

    return raycast.render(scene, camera, rng, threads=threads)


def _structured_light(
    scene: Scene, camera: StructuredLightCamera, rng: np.random.Generator, *, threads: int = 1
) -> RgbdFrame:
    from tubepose.simulation import structured_light

    return structured_light.render(scene, camera, rng, threads=threads)


SENSORS: dict[str, Sensor] = {"raycast": _raycast, "structured-light": _structured_light}


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One capture to be made.

    Attributes:
        name: Of the capture.
        place: File (MCAP) or folder to write, relative to the session.
        scene: What is captured.
        timestamp_ns: When.
        seed: Of the sensor's noise.
    """

    name: str
    place: str
    scene: Scene
    timestamp_ns: int
    seed: np.random.SeedSequence


@dataclass(frozen=True, slots=True)
class Shooting:
    """What all captures of a session share; called with a shot, it makes and writes it.

    Attributes:
        folder: Of the session.
        camera: The camera.
        sensor: Name of the sensor.
        capture_format: How captures are stored.
    """

    folder: Path
    camera: StructuredLightCamera
    sensor: str
    capture_format: CaptureFormat

    def __call__(self, shot: Shot, threads: int) -> None:
        """Make and write one capture; no part of it is seen before it is whole."""
        with _bounded(threads):
            frame = SENSORS[self.sensor](shot.scene, self.camera, np.random.default_rng(shot.seed), threads=threads)
            frame = replace(
                frame,
                capture=shot.name,
                timestamp_ns=shot.timestamp_ns,
                sensor=f"simulated-{self.sensor}",
                simulated=True,
            )
            place = self.folder / shot.place
            if self.capture_format == "mcap":
                write_mcap(place, [frame], as_depth=True, compressed=True)
            else:
                write_folder_capture(place, frame)


@contextmanager
def _bounded(threads: int) -> Iterator[None]:
    """Bound OpenCV's threads, and BLAS to one: its sums depend on how many share them."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(threads)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        cv2.setNumThreads(before)
