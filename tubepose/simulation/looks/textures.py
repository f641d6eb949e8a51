"""Pictures made by program for tables, walls, labels and clutter: no photograph is needed to train."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

Float32Array = NDArray[np.float32]
SIZE = 256
"""Side of a texture, pixels; it repeats."""


def random_color(rng: np.random.Generator, *, vivid: float = 0.5) -> tuple[float, float, float]:
    """A colour as red, green and blue from 0 to 1: with probability `vivid` a saturated one, else nearly gray."""
    hue, light = rng.uniform(0, 360), rng.uniform(0.02, 0.95)
    saturation = rng.uniform(0.4, 1.0) if rng.uniform() < vivid else rng.uniform(0.0, 0.15)
    rgb = cv2.cvtColor(np.array([[[hue, saturation, light]]], np.float32), cv2.COLOR_HSV2RGB)[0, 0]
    return float(rgb[0]), float(rgb[1]), float(rgb[2])


def noise(rng: np.random.Generator, coarse: int, stretch: tuple[int, int] = (1, 1)) -> Float32Array:
    """Smooth noise of several sizes, shape (SIZE, SIZE), mean 0 and deviation 1; it repeats at its edges."""
    total = np.zeros((SIZE, SIZE), np.float32)
    for octave in range(4):
        cells = np.clip(np.array([coarse * stretch[0], coarse * stretch[1]]) * 2**octave, 1, SIZE)
        seed = rng.standard_normal((int(cells[0]), int(cells[1])), np.float32)
        padded = np.pad(seed, 1, mode="wrap")
        scale = SIZE / cells
        big = cv2.resize(padded, None, fx=float(scale[1]), fy=float(scale[0]), interpolation=cv2.INTER_LINEAR)
        top, left = round(float(scale[0])), round(float(scale[1]))
        total += big[top : top + SIZE, left : left + SIZE][:SIZE, :SIZE] * np.float32(0.55**octave)
    return np.asarray(total / max(float(total.std()), 1e-6), np.float32)


def _mix(a: tuple[float, float, float], b: tuple[float, float, float], share: Float32Array) -> Float32Array:
    first, second = np.array(a, np.float32), np.array(b, np.float32)
    return np.asarray(first + (second - first) * np.clip(share, 0, 1)[..., None], np.float32)


def plain(rng: np.random.Generator) -> Float32Array:
    """One colour with a little unevenness."""
    base = np.array(random_color(rng, vivid=0.25), np.float32)
    return np.clip(base * (1 + rng.uniform(0, 0.15) * noise(rng, 2))[..., None], 0, 1)


def marbled(rng: np.random.Generator) -> Float32Array:
    """Two colours that run into each other: stone, stained cloth."""
    share = 0.5 + rng.uniform(0.2, 0.8) * noise(rng, int(rng.integers(1, 9)))
    return _mix(random_color(rng, vivid=0.3), random_color(rng, vivid=0.3), share)


def grained(rng: np.random.Generator) -> Float32Array:
    """Long fibres: wood, brushed metal."""
    share = 0.5 + rng.uniform(0.1, 0.5) * noise(rng, 1, (int(rng.integers(8, 40)), 1))
    tone = random_color(rng, vivid=0.4)
    other = tuple(float(np.clip(c * rng.uniform(0.4, 0.9), 0, 1)) for c in tone)
    return _mix(tone, (other[0], other[1], other[2]), share)


def speckled(rng: np.random.Generator) -> Float32Array:
    """Grains on a ground: granite, terrazzo, dust."""
    share = (rng.random((SIZE, SIZE), np.float32) < rng.uniform(0.02, 0.3)).astype(np.float32)
    soft = cv2.GaussianBlur(share, (0, 0), float(rng.uniform(0.4, 1.2)), borderType=cv2.BORDER_REFLECT)
    grains = np.asarray(soft, np.float32) * 1.5
    return _mix(random_color(rng, vivid=0.2), random_color(rng, vivid=0.2), grains)


def tiled(rng: np.random.Generator) -> Float32Array:
    """Lines in a grid, or a checkerboard."""
    count = int(rng.integers(1, 9))
    v, u = np.mgrid[:SIZE, :SIZE].astype(np.float32) * (count / SIZE)
    if rng.uniform() < 0.4:
        share = ((np.floor(u) + np.floor(v)) % 2).astype(np.float32)
    else:
        wide = rng.uniform(0.02, 0.12)
        share = ((np.mod(u, 1) < wide) | (np.mod(v, 1) < wide)).astype(np.float32)
    return _mix(random_color(rng, vivid=0.3), random_color(rng, vivid=0.3), share)


def dotted(rng: np.random.Generator) -> Float32Array:
    """Round holes or studs in a grid: a breadboard, perforated sheet."""
    count = int(rng.integers(2, 9))
    v, u = np.mgrid[:SIZE, :SIZE].astype(np.float32) * (count / SIZE)
    if rng.uniform() < 0.3:
        u = u + 0.5 * (np.floor(v) % 2)
    radius = rng.uniform(0.08, 0.38)
    apart = np.hypot(np.mod(u, 1) - 0.5, np.mod(v, 1) - 0.5)
    share = np.clip((radius - apart) * 12 + 0.5, 0, 1).astype(np.float32)
    ground, mark = random_color(rng, vivid=0.2), random_color(rng, vivid=0.2)
    return np.clip(_mix(ground, mark, share) * (1 + 0.1 * noise(rng, 2))[..., None], 0, 1)


def collage(rng: np.random.Generator) -> Float32Array:
    """Discs, rings, boxes, lines and letters over each other: paper, screens, packages."""
    picture = np.ascontiguousarray(np.round(plain(rng) * 255), np.uint8)
    for _ in range(int(rng.integers(5, 50))):
        color = tuple(round(255 * value) for value in random_color(rng, vivid=0.5))
        at = tuple(int(value) for value in rng.integers(0, SIZE, 2))
        size, thick = int(rng.integers(3, 60)), int(rng.integers(1, 5))
        kind = rng.integers(5)
        if kind == 0:
            cv2.circle(picture, at, size, color, -1 if rng.uniform() < 0.5 else thick, cv2.LINE_AA)
        elif kind == 1:
            other = tuple(int(value) for value in rng.integers(0, SIZE, 2))
            cv2.line(picture, at, other, color, thick, cv2.LINE_AA)
        elif kind == 2:
            corner = (at[0] + size, at[1] + int(rng.integers(3, 60)))
            cv2.rectangle(picture, at, corner, color, -1 if rng.uniform() < 0.6 else thick)
        elif kind == 3:
            text = "".join(chr(int(code)) for code in rng.integers(48, 123, int(rng.integers(2, 9))))
            cv2.putText(picture, text, at, int(rng.integers(8)), float(rng.uniform(0.3, 1.5)), color, thick)
        else:
            corners = (np.array(at) + rng.integers(-size, size + 1, (5, 2))).astype(np.int32)
            cv2.fillPoly(picture, [corners], color, cv2.LINE_AA)
    return np.asarray(picture, np.float32) / np.float32(255)


def coded(rng: np.random.Generator) -> Float32Array:
    """Black cells on white: a fiducial marker or a matrix code with its margin."""
    cells = int(rng.integers(5, 14))
    code = np.ones((cells + 2, cells + 2), np.float32)
    code[1:-1, 1:-1] = rng.random((cells, cells)) < 0.5
    if rng.uniform() < 0.7:
        code[1, 1:-1] = code[-2, 1:-1] = code[1:-1, 1] = code[1:-1, -2] = 0
    big = cv2.resize(code, (SIZE, SIZE), interpolation=cv2.INTER_NEAREST)
    return np.asarray(np.repeat((0.04 + 0.8 * big)[..., None], 3, axis=2), np.float32)


def washers(rng: np.random.Generator) -> Float32Array:
    """Discs within discs, scattered: coins, lids, washers, printed targets; round, and no tubes."""
    picture = np.ascontiguousarray(np.round(plain(rng) * 255), np.uint8)
    largest = int(rng.integers(6, 60))
    for _ in range(int(rng.integers(3, 40))):
        at = tuple(int(value) for value in rng.integers(0, SIZE, 2))
        radius = float(rng.uniform(0.4, 1.0)) * largest
        for _ in range(int(rng.integers(1, 6))):
            color = tuple(round(255 * value) for value in random_color(rng, vivid=0.4))
            cv2.circle(picture, at, max(1, round(radius)), color, -1, cv2.LINE_AA)
            radius *= float(rng.uniform(0.4, 0.92))
    return np.asarray(picture, np.float32) / np.float32(255)


GROUNDS: tuple[Callable[[np.random.Generator], Float32Array], ...] = (
    plain, plain, marbled, grained, speckled, tiled, dotted, collage, washers,
)  # fmt: skip
"""What a table or a wall may look like; plain ones come twice as often."""


def woven(rng: np.random.Generator) -> Float32Array:
    """Threads over and under each other: cloth, mats, plaid."""
    v, u = np.mgrid[:SIZE, :SIZE].astype(np.float32) * np.float32(2 * np.pi / SIZE)
    across, along = (np.float32(rng.integers(2, 24)) for _ in range(2))
    share = 0.5 + rng.uniform(0.1, 0.3) * (np.sin(u * across) + np.sin(v * along) * np.sin(u * 2 * across))
    return _mix(random_color(rng, vivid=0.4), random_color(rng, vivid=0.4), share)


def ringed(rng: np.random.Generator) -> Float32Array:
    """Rings around some places: stains, turned plates, targets."""
    v, u = np.mgrid[:SIZE, :SIZE].astype(np.float32)
    share = np.zeros((SIZE, SIZE), np.float32)
    for _ in range(int(rng.integers(1, 6))):
        apart = np.hypot(u - rng.uniform(0, SIZE), v - rng.uniform(0, SIZE))
        share += 0.5 * np.sin(apart * np.float32(rng.uniform(0.05, 0.5))) * np.exp(-apart / np.float32(60))
    return _mix(random_color(rng, vivid=0.3), random_color(rng, vivid=0.3), 0.5 + share)


HELD_OUT_GROUNDS: tuple[Callable[[np.random.Generator], Float32Array], ...] = (woven, ringed)
"""Grounds for pictures to judge by: no picture to train on has them."""


def random_ground(rng: np.random.Generator, *, held_out: bool = False) -> Float32Array:
    """Any of `GROUNDS`, or of `HELD_OUT_GROUNDS`."""
    grounds = HELD_OUT_GROUNDS if held_out else GROUNDS
    return grounds[int(rng.integers(len(grounds)))](rng)


def surroundings(rng: np.random.Generator) -> Float32Array:
    """What lies around a scene, by direction: light above, dark below, and things in between."""
    picture = collage(rng) if rng.uniform() < 0.6 else marbled(rng)
    picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), float(rng.uniform(1, 12))), np.float32)
    fall = np.linspace(rng.uniform(0.6, 1.6), rng.uniform(0.1, 0.8), SIZE, dtype=np.float32)
    return np.asarray(picture * fall[:, None, None] * np.float32(rng.uniform(0.3, 1.0)), np.float32)
