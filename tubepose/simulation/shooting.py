"""Captures of given scenes by a simulated sensor, written as they are done."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, Protocol

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

from tubepose.capture.frame import RgbdFrame
from tubepose.capture.mcap_writing import write_mcap
from tubepose.capture.writing import write_folder_capture
from tubepose.simulation.camera import StructuredLightCamera
from tubepose.simulation.scene import Scene
from tubepose.simulation.stereo.stereo_camera import StereoCamera

CaptureFormat = Literal["folder", "mcap"]
Camera = StructuredLightCamera | StereoCamera
FRAME_NS = 33_333_333
"""Time between the frames of a recording: 30 in a second, as these cameras are usually run."""


class Sensor(Protocol):
    """A simulated sensor."""

    def __call__(self, scene: Scene, camera: Any, rng: np.random.Generator, *, threads: int = 1) -> RgbdFrame:
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


def _stereo(scene: Scene, camera: StereoCamera, rng: np.random.Generator, *, threads: int = 1) -> RgbdFrame:
    from tubepose.simulation.stereo.stereo_view import stereo_frames

    return next(stereo_frames(scene, camera, rng, threads=threads))


SENSORS: dict[str, Sensor] = {"raycast": _raycast, "structured-light": _structured_light, "stereo": _stereo}


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
        n_frames: Frames of each capture, of a scene that does not move.
    """

    folder: Path
    camera: Camera
    sensor: str
    capture_format: CaptureFormat
    n_frames: int = 1

    def __call__(self, shot: Shot, threads: int) -> None:
        """Make and write one capture; no part of it is seen before it is whole."""
        with _bounded(threads):
            frames = self._frames(shot, threads)
            place = self.folder / shot.place
            stereo = isinstance(self.camera, StereoCamera)
            if self.capture_format == "mcap":
                write_mcap(place, frames, as_depth=True, compressed=True, exact_depth=stereo)
            elif isinstance(self.camera, StereoCamera):
                write_folder_capture(place, next(frames), depth_scale_m=self.camera.depth_step_m)
            else:
                write_folder_capture(place, next(frames))

    def _frames(self, shot: Shot, threads: int) -> Iterator[RgbdFrame]:
        for number, frame in enumerate(self._seen(shot, np.random.default_rng(shot.seed), threads)):
            yield replace(
                frame,
                capture=shot.name,
                index=number,
                timestamp_ns=shot.timestamp_ns + number * FRAME_NS,
                sensor=f"simulated-{sensor_label(self.sensor, self.camera)}",
                simulated=True,
            )

    def _seen(self, shot: Shot, rng: np.random.Generator, threads: int) -> Iterator[RgbdFrame]:
        if isinstance(self.camera, StereoCamera) and self.n_frames > 1:
            from tubepose.simulation.stereo.stereo_view import stereo_frames

            yield from stereo_frames(shot.scene, self.camera, rng, self.n_frames, threads=threads)
            return
        # The first frame is that of a capture with one frame alone.
        others = rng.spawn(self.n_frames - 1)
        for own in (rng, *others):
            yield SENSORS[self.sensor](shot.scene, self.camera, own, threads=threads)


def sensor_label(sensor: str, camera: Camera) -> str:
    """Name of a sensor as sessions and captures have it."""
    return f"{sensor}-{camera.name}" if isinstance(camera, StereoCamera) else sensor


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
