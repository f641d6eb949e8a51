"""Sensor ``structured-light``: what light itself makes of a scene. One pass gives all phase images.

1. The scene becomes analytic shapes in its rack's frame.
2. Photons carry the projector's light through plastic into the light map.
3. Four camera paths per pixel collect projector light, tagged with its column, and room light.
4. More paths go where the noise of the lens-blurred image is still above that of the camera.
5. The camera makes a frame of the sums: blur, exposure, noise, decoding, triangulation.
"""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import RgbdFrame
from tubepose.simulation.camera import CHANNELS, FULL_RESOLUTION, MIN_BLUR_PX, Float32Array, StructuredLightCamera
from tubepose.simulation.scene import Scene
from tubepose.simulation.structured_light.light_map import make_light_map
from tubepose.simulation.structured_light.paths import expose_pixels, scratch
from tubepose.simulation.structured_light.photons import light_through_plastic
from tubepose.simulation.structured_light.projector import projector_of
from tubepose.simulation.structured_light.shapes import shapes_of
from tubepose.transforms import FloatArray, invert_transform

_BLOCK_PX = 4096
_NEIGHBOURHOOD_PX = 5


@dataclass(frozen=True, slots=True)
class Effort:
    """How many photons and paths are spent.

    Attributes:
        photons_per_mm2: Photons per square millimetre across the light, at the working distance, towards every tube.
        side: Every pixel gets side * side paths.
        more_side: A pixel that is still noisy gets more_side * more_side more, per round.
        rounds: Rounds of more paths.
        relative_error: Largest standard error of the blurred phasor, as a share of it: the phase's error in radians.
        absolute_error: Where it is dark, the largest standard error in units of a white surface's return.
    """

    photons_per_mm2: float = 30.0
    side: int = 2
    more_side: int = 3
    rounds: int = 1
    relative_error: float = 0.03
    absolute_error: float = 0.003


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """What the paths collected.

    Attributes:
        sums: Mean over the paths of each pixel, shape (CHANNELS, H, W).
        samples: Paths per pixel, shape (H, W).
        error: Standard error of the phasor of the blurred image, shape (H, W).
    """

    sums: Float32Array
    samples: NDArray[np.int32]
    error: Float32Array


def expose(
    scene: Scene, camera: StructuredLightCamera, seed: int, *, effort: Effort = Effort(), threads: int = 1
) -> Exposure:
    """Sums of all light paths of a scene, before the camera: the same for any number of threads.

    The rack is flat here, whatever its bow; `bowed.bowed_sums` moves its light.
    """
    shapes = shapes_of(scene)
    projector = projector_of(camera, scene.T_camera_rack)
    light_map = make_light_map(shapes)
    per_steradian = effort.photons_per_mm2 * (camera.working_distance_m * 1e3) ** 2
    light_through_plastic(shapes, light_map, projector, per_steradian, seed, threads)
    k = camera.intrinsics
    T_rack_camera = invert_transform(scene.T_camera_rack)
    lens = np.array([*T_rack_camera[:3, 3], k.fx, k.fy, k.cx, k.cy])
    rotation = np.ascontiguousarray(T_rack_camera[:3, :3])
    count = k.width * k.height
    sums, squares, samples = np.zeros((count, CHANNELS)), np.zeros(count), np.zeros(count, dtype=np.int32)
    pixels, side, first = np.arange(count), effort.side, 0
    with ThreadPoolExecutor(threads) as pool:
        for _ in range(effort.rounds + 1):

            def work(block: NDArray[np.intp], side: int = side, first: int = first) -> None:
                expose_pixels(
                    shapes, light_map, projector, lens, rotation, block, k.width, side, first, seed, sums, squares,
                    *scratch(),
                )  # fmt: skip

            list(pool.map(work, _blocks(pixels)))
            samples[pixels] += side * side
            first, side = first + side * side, effort.more_side
            error, wanted = _errors(sums, squares, samples, camera, effort)
            pixels = np.flatnonzero(wanted)
    mean = (sums / samples[:, None]).astype(np.float32).T.reshape(CHANNELS, k.height, k.width)
    return Exposure(np.ascontiguousarray(mean), samples.reshape(k.height, k.width), error)


def _blocks(pixels: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    for i in range(0, len(pixels), _BLOCK_PX):
        yield pixels[i : i + _BLOCK_PX]


def _errors(
    sums: FloatArray, squares: FloatArray, samples: NDArray[np.int32], camera: StructuredLightCamera, effort: Effort
) -> tuple[Float32Array, NDArray[np.bool_]]:
    """Standard error of the blurred phasor, shape (H, W), and the pixels whose paths should be more.

    It is taken from the middle period: within a pixel the finest one turns, which the grid of samples averages well and
    which is no noise.
    """
    shape = (camera.intrinsics.height, camera.intrinsics.width)
    phasor = sums[:, 4:6] / samples[:, None]
    variance = (squares / samples - np.sum(phasor**2, axis=1)) / np.maximum(samples - 1, 1)
    variance_image = np.maximum(variance, 0).astype(np.float32).reshape(shape)
    size = np.sqrt(np.sum(phasor**2, axis=1)).astype(np.float32).reshape(shape)
    sigma = _blur_sigma_px(camera)
    if sigma > 0:
        # White noise of variance v behind a Gaussian: the kernel squared is one of sigma / sqrt 2, of weight
        # 1 / (4 pi sigma^2).
        variance_image = cv2.GaussianBlur(variance_image, (0, 0), sigma / np.sqrt(2)) * np.float32(
            min(1.0, 1 / (4 * np.pi * sigma**2))
        )
        size = cv2.GaussianBlur(size, (0, 0), sigma)
    error = np.sqrt(variance_image)
    wanted = error > np.maximum(effort.relative_error * size, effort.absolute_error)
    # Whole neighbourhoods are chosen: a pixel must not get more paths because its own happened to be bright.
    spread = cv2.dilate(wanted.astype(np.uint8), np.ones((_NEIGHBOURHOOD_PX, _NEIGHBOURHOOD_PX), np.uint8))
    return error, np.asarray(spread.reshape(-1) > 0)


def _blur_sigma_px(camera: StructuredLightCamera) -> float:
    blur = camera.noise.blur_px
    return 0.0 if blur == 0 else max(blur * camera.intrinsics.width / FULL_RESOLUTION, MIN_BLUR_PX)


def render(scene: Scene, camera: StructuredLightCamera, rng: np.random.Generator, *, threads: int = 1) -> RgbdFrame:
    """Simulate one capture of a scene; the frame's capture name is empty and its time unknown."""
    seed = int(rng.integers(2**63))
    sums = expose(scene, camera, seed, threads=threads).sums
    if not scene.bow.flat:
        # Imported here: only a bowed rack needs meshes.
        from tubepose.simulation.structured_light.bowed import bowed_sums

        sums = bowed_sums(scene, camera, sums, threads)
    return camera.capture(sums, rng)
