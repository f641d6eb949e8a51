"""From light to a picture as cameras give it: exposure, blur, noise, colour, compression."""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.simulation.looks.appearance import Sensor

Float32Array = NDArray[np.float32]
Quality = Literal["any", "good"]


def expose(
    radiance: Float32Array,
    sensor: Sensor,
    rng: np.random.Generator,
    quality: Quality = "any",
    noise_rng: np.random.Generator | None = None,
) -> NDArray[np.uint8]:
    """An 8-bit RGB picture (H, W, 3) of linear light; gray for the gray sensors.

    Args:
        radiance: Linear light, shape (H, W, 3).
        sensor: Kind of picture.
        rng: Source of randomness.
        quality: ``good`` is a camera that someone has set up: in focus, not moved, and next to nothing too bright.
            ``any`` has everything else as well.
        noise_rng: Of the noise of pixels, where that shall differ between pictures by one camera; by default `rng`.
    """
    good = quality == "good"
    light = radiance
    if sensor != "color":
        light = np.repeat(radiance.mean(axis=2, keepdims=True), 3, axis=2)
    light = _lens(light, rng, good)
    level = float(np.percentile(light, rng.uniform(*((99.0, 99.7) if good else (80, 99.7)))))
    light = light * np.float32(rng.uniform(*((0.7, 1.0) if good else (0.4, 1.1))) / max(level, 1e-4))
    if sensor == "color":
        light = light * rng.uniform(0.85, 1.15, 3).astype(np.float32)
    light = _noisy(light, sensor, rng, noise_rng or rng)
    gamma = rng.uniform(1.6, 2.6) if rng.uniform() < 0.85 else 1.0
    picture = np.clip(light, 0, 1) ** np.float32(1 / gamma)
    if sensor == "color" and rng.uniform() < 0.5:
        gray = picture.mean(axis=2, keepdims=True)
        picture = np.clip(gray + (picture - gray) * np.float32(rng.uniform(0.6, 1.5)), 0, 1)
    data = np.round(picture * 255).astype(np.uint8)
    if rng.uniform() < 0.3:  # sharpened, as phones and RealSense do
        soft = cv2.GaussianBlur(data, (0, 0), float(rng.uniform(0.8, 2.0)))
        amount = float(rng.uniform(0.3, 1.2))
        data = np.asarray(cv2.addWeighted(data, 1.0 + amount, soft, -amount, 0), np.uint8)
    return data


def _lens(light: Float32Array, rng: np.random.Generator, sharp: bool) -> Float32Array:
    """Blur of focus or motion, unless it is sharp, and darker corners."""
    sigma = float(rng.uniform(0.35, 0.8)) if rng.uniform() < 0.75 or sharp else float(rng.uniform(0.8, 2.0))
    light = np.asarray(cv2.GaussianBlur(light, (0, 0), sigma), np.float32)
    if rng.uniform() < 0.08 and not sharp:
        length, angle = int(rng.integers(3, 8)), rng.uniform(0, np.pi)
        kernel = np.zeros((2 * length + 1, 2 * length + 1), np.float32)
        reach = (length * np.array([np.cos(angle), np.sin(angle)])).astype(int)
        cv2.line(
            kernel,
            (length - int(reach[0]), length - int(reach[1])),
            (length + int(reach[0]), length + int(reach[1])),
            1,
        )
        light = np.asarray(cv2.filter2D(light, -1, kernel / kernel.sum()), np.float32)
    if rng.uniform() < 0.4:
        height, width = light.shape[:2]
        v, u = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j].astype(np.float32)
        light = light * (1 - np.float32(rng.uniform(0, 0.35)) * (u**2 + v**2)[..., None] / 2)
    return np.asarray(light, np.float32)


def _noisy(
    light: Float32Array, sensor: Sensor, rng: np.random.Generator, noise_rng: np.random.Generator
) -> Float32Array:
    """Shot noise and read noise, whose sizes are drawn from the first generator."""
    shape = light.shape if sensor == "color" else (*light.shape[:2], 1)
    shot, read = np.exp(rng.uniform(np.log(1e-4), np.log(1e-3))), np.exp(rng.uniform(np.log(5e-4), np.log(6e-3)))
    spread = np.sqrt(np.maximum(light, 0) * np.float32(shot) + np.float32(read**2))
    return np.asarray(light + spread * noise_rng.standard_normal(shape, np.float32), np.float32)
