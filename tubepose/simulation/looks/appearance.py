"""What a scene for a picture is made of: surfaces with looks, and light."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tubepose.simulation.meshes import Mesh

Float32Array = NDArray[np.float32]
Sensor = Literal["projector", "lamp-gray", "color"]
"""Kind of picture: gray under a scanner's projector, gray or in colour under lamps."""

NOTHING = -1
"""Owner of table, walls and clutter, and of pixels that meet nothing."""


@dataclass(frozen=True, slots=True, eq=False)
class Texture:
    """A picture that lies on a surface.

    Attributes:
        image: Array of shape (H, W, 3), 0 to 1; it repeats.
        to_uv: Array of shape (2, 4); maps camera points to columns and rows of `image`.
    """

    image: Float32Array
    to_uv: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """How a surface looks.

    Attributes:
        albedo: Share of red, green and blue that is returned diffusely.
        gloss: Strength of its highlights, 0 to 1.
        sharpness: Exponent of its highlights.
        transmission: Share of red, green and blue that crosses the wall straight on; None for an opaque surface.
        texture: Goes before `albedo` on opaque surfaces.
    """

    albedo: tuple[float, float, float]
    gloss: float = 0.1
    sharpness: float = 20.0
    transmission: tuple[float, float, float] | None = None
    texture: Texture | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A mesh with its look and the object that it belongs to.

    Attributes:
        mesh: Camera frame, metres.
        surface: Its look.
        owner: Number of the object, or `NOTHING`.
    """

    mesh: Mesh
    surface: Surface
    owner: int = NOTHING


@dataclass(frozen=True, slots=True, eq=False)
class Lamp:
    """A round lamp that casts shadows.

    Attributes:
        position_m: Array of shape (3,), camera frame.
        radius_m: Its size, which softens shadows.
        color: Red, green and blue at one metre's distance, straight on.
    """

    position_m: NDArray[np.float64]
    radius_m: float
    color: tuple[float, float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """All light of a scene.

    Attributes:
        lamps: Lamps with shadows.
        room: Red, green and blue that come from everywhere.
        up: Array of shape (3,): the direction most of the room's light comes from, camera frame.
        environment: Picture (H, W, 3) of what lies around, by direction: for reflections and beyond the table.
    """

    lamps: Sequence[Lamp]
    room: tuple[float, float, float]
    up: NDArray[np.float64]
    environment: Float32Array
