"""What a rack's top looks like to a search: its signed distance on a grid, a coarse picture of it, and its spectrum.

All of it follows from the rack's definition alone, and is computed once per rack.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from tubepose.labware import RackModel
from tubepose.rack import kernels as kernels
from tubepose.transforms import FloatArray, parts

Float32 = NDArray[np.float32]
# Distances are looked up to first order: a cell of 0.25 mm errs by less than 0.01 mm on a corner of 2 mm radius.
GRID_M = 2.5e-4
# Nothing is known of what stands this far outside the outline; nearer, the rack's own top would be in the way.
RING_M = 8e-3
# How far into a solid part distances are followed; farther ones say no more than that they are far.
REACH_M = 5e-3
# Cells of the coarse pictures: as wide as the ribs of most racks.
PICTURE_M = 2e-3
TURNS = 180
# Lengths of the waves that a spectrum is compared at: from wide slots to narrow ribs.
WAVES_M = (45e-3, 5e-3)
WAVE_COUNT = 40
# Radius of the tops of tubes in a full rack, as a share of the distance of slots: caps nearly touch.
TOP_SHARE = 0.42
# Tops that differ by less than this from their half turn cannot be told from it by any scan.
SAME_M = 5e-5


@dataclass(frozen=True, slots=True, eq=False)
class TopField:
    """Signed distance to the solid part of a rack's top on a grid.

    Attributes:
        low_m: Place of the first cell, rack frame, shape (2,), metres.
        shape: Cells along x and y.
        table: Per cell the distance (negative in the solid, metres) and its gradient along x and y, shape (X * Y, 3).
        alike: How many of the four quarter turns leave the top as it is: 1, 2 or 4.
    """

    low_m: FloatArray
    shape: tuple[int, int]
    table: Float32
    alike: int

    def look_up(self, xy_m: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
        """Distance (N,), gradient (N, 2) and whether the point lies on the grid (N,), of points (N, 2), rack frame."""
        distance, slope, known = kernels.look_up(xy_m, *self.grid)
        return distance, slope, known

    def on_solid(
        self, points_m: FloatArray, T_camera_top: FloatArray, height_m: float, inside_m: float = 0.0
    ) -> FloatArray:
        """Points (N, 3), camera frame, in a top's frame: within a height of it, and so far inside its solid part."""
        local, distance, _ = kernels.laid(points_m, *parts(T_camera_top), height_m, *self.grid)
        return np.asarray(local[distance < -inside_m])

    @property
    def grid(self) -> tuple[FloatArray, float, tuple[int, int], Float32]:
        """What the kernels take: place of the first cell, side of a cell (metres), cells along x and y, the table."""
        return self.low_m, GRID_M, self.shape, self.table


@lru_cache(maxsize=32)
def top_field(rack: RackModel) -> TopField:
    """The signed distance field of a rack's top, out to `RING_M` beyond its outline."""
    x, y = _axes(rack)
    return _tabled(x, y, np.maximum(_to_outline(x, y, rack), _to_openings(x, y, rack)))


@lru_cache(maxsize=32)
def openings_field(rack: RackModel) -> TopField:
    """The same of its openings alone, as if the face went on for ever."""
    x, y = _axes(rack)
    return _tabled(x, y, _to_openings(x, y, rack))


@lru_cache(maxsize=32)
def outline_field(rack: RackModel) -> TopField:
    """The same of its outline alone, as if the face had no openings."""
    x, y = _axes(rack)
    return _tabled(x, y, _to_outline(x, y, rack))


def _axes(rack: RackModel) -> tuple[FloatArray, FloatArray]:
    counts = np.ceil((rack.outline_m / 2 + RING_M) / GRID_M).astype(int)
    x, y = (np.arange(-n, n + 1) * GRID_M for n in counts)
    return x, y


def _to_outline(x: FloatArray, y: FloatArray, rack: RackModel) -> FloatArray:
    half = rack.outline_m / 2
    edge = np.stack(np.broadcast_arrays(np.abs(x)[:, None] - half[0], np.abs(y)[None] - half[1]))
    outside = np.hypot(*np.maximum(edge, 0))
    return np.asarray(np.maximum(outside + np.minimum(edge.max(axis=0), 0), -REACH_M))


def _to_openings(x: FloatArray, y: FloatArray, rack: RackModel) -> FloatArray:
    distance = np.full((len(x), len(y)), -REACH_M)
    for slot in rack.all_slots:
        window = []
        for axis, values in enumerate((x, y)):
            reach = slot.half_size_m[axis] + REACH_M
            window.append(slice(*np.searchsorted(values, slot.center_m[axis] + np.array([-reach, reach]))))
        place = tuple(window)
        xy = np.stack(np.meshgrid(x[place[0]], y[place[1]], indexing="ij"), axis=-1)
        distance[place] = np.maximum(distance[place], -slot.signed_distance_m(xy))
    return distance


def _tabled(x: FloatArray, y: FloatArray, distance: FloatArray) -> TopField:
    slopes = np.gradient(distance, GRID_M)
    table = np.stack([distance, *slopes], axis=-1).reshape(-1, 3).astype(np.float32)
    return TopField(np.array([x[0], y[0]]), (len(x), len(y)), table, _alike(distance))


def _alike(distance: FloatArray) -> int:
    def same(quarters: int) -> bool:
        turned = np.rot90(distance, quarters)
        return turned.shape == distance.shape and bool(np.abs(distance - turned).max() < SAME_M)

    return 1 if not same(2) else 4 if same(1) else 2


@lru_cache(maxsize=64)
def picture(rack: RackModel, cell_m: float = PICTURE_M, tops: bool = False) -> Float32:
    """The top as cells, (X, Y), centred, odd sides: 1 solid, less than 0 opening or ring around it, 0 beyond.

    Its sum is 0, so that neither a closed surface nor free space looks like a rack. Of the tops of a full rack's tubes
    what is 1 are discs over its slots.
    """
    half = rack.outline_m / 2
    counts = np.ceil((half + RING_M) / cell_m).astype(int)
    fine = 4
    offsets = (np.arange(fine) + 0.5) / fine - 0.5
    axes = [(np.arange(-n, n + 1)[:, None] + offsets).ravel() * cell_m for n in counts]
    xy = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    distance, _, known = top_field(rack).look_up(xy.reshape(-1, 2))
    if tops:
        apart = np.linalg.norm(xy.reshape(-1, 1, 2) - rack.slot_centers_m[None], axis=2)
        distance = (apart - TOP_SHARE * rack.pitches_m).min(axis=1)
    value = np.where(known, np.where(distance < 0, 1.0, -1.0), 0.0)
    value[value < 0] *= np.sum(value > 0) / np.sum(value < 0)
    value = value.reshape(2 * counts[0] + 1, fine, 2 * counts[1] + 1, fine).mean(axis=(1, 3))
    return np.asarray(value, np.float32)


@lru_cache(maxsize=64)
def picture_spectrum(rack: RackModel, size: int, turned: bool, tops: bool = False) -> NDArray[np.complex64]:
    """Conjugate spectrum of the picture in a square of `size` cells, its centre at cell (0, 0)."""
    image = picture(rack, tops=tops)
    image = image[::-1, ::-1] if turned else image
    padded = np.zeros((size, size), np.float32)
    padded[: image.shape[0], : image.shape[1]] = image
    padded = np.roll(padded, (-(image.shape[0] // 2), -(image.shape[1] // 2)), axis=(0, 1))
    return np.asarray(np.conj(fft.rfft2(padded)), np.complex64)


def turn_signature(spectrum: NDArray[np.complexfloating], size: int, cell_m: float = PICTURE_M) -> Float32:
    """How strong a picture's waves are per direction: (TURNS, WAVE_COUNT), each length's mean taken off.

    The strength of waves does not change when the picture is moved, and turns with it: so pictures can be turned onto
    each other before it is known where they lie. Directions cover half a turn, because a wave has no sign.
    """
    strength = np.sqrt(np.abs(spectrum.ravel()[_signature_places(size, cell_m)])).reshape(TURNS, WAVE_COUNT)
    return np.asarray(strength - strength.mean(axis=0), np.float32)


@lru_cache(maxsize=16)
def _signature_places(size: int, cell_m: float) -> NDArray[np.intp]:
    """Where in a flattened half spectrum the waves of every direction and length are."""
    angles = np.arange(TURNS) * np.pi / TURNS
    waves = np.geomspace(1 / WAVES_M[0], 1 / WAVES_M[1], WAVE_COUNT) * cell_m * size
    u = np.rint(np.outer(np.cos(angles), waves)).astype(int)
    v = np.rint(np.outer(np.sin(angles), waves)).astype(int)
    negative = v < 0
    u, v = np.where(negative, -u, u) % size, np.abs(v)
    return np.asarray((u * (size // 2 + 1) + v).ravel())


@lru_cache(maxsize=32)
def solid_signature(rack: RackModel, tops: bool = False) -> NDArray[np.complex64]:
    """Conjugate Fourier transform over the directions of the signature of the solid part."""
    size = 512
    image = np.maximum(picture(rack, tops=tops), 0)
    padded = np.zeros((size, size), np.float32)
    padded[: image.shape[0], : image.shape[1]] = image
    signature = turn_signature(fft.rfft2(padded), size)
    signature /= np.linalg.norm(signature)
    return np.asarray(np.conj(fft.rfft(signature, axis=0)), np.complex64)
