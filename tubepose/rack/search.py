"""Where a rack's top could be among points: level directions, height bands, and the picture of the top laid on each.

Every pixel says something about the height of a candidate top: a point at that height says "solid there", a point below
says "the view through the top is free there", a point above says nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import fft

from tubepose.config import RackTopConfig
from tubepose.labware import RackModel
from tubepose.preprocessing import fit_plane
from tubepose.rack import view_kernels
from tubepose.rack.field import PICTURE_M, TURNS, picture, picture_spectrum, solid_signature, top_field, turn_signature
from tubepose.transforms import FloatArray, make_transform, translation

# Points that planes are drawn from and judged by, and how many planes are drawn: a top of a tenth of the points is
# drawn twice; planes of rims, caps, floors and the table are as level, and help.
PLANE_SAMPLE = 600
PLANE_DRAWS = 1500
# Half thickness of a band before its plane is known well, and after.
ROUGH_BAND_M = 4.0e-3
BAND_M = 3.0e-3
# Points this far below are not of the top.
BELOW_M = 5e-3
# Directions nearer than this are the same, and peaks of one height.
SAME_DIRECTION_RAD = 0.05
SAME_TURN = 4
# How many angles of a band are tried: a lattice that is nearly square has two.
TURN_TRIES = 3
# Poses that are worth a refinement: the best of those tried at a time, if they explain this share of what lies there;
# any with a larger one, at once.
BEST_PLACED = 2
LEAST_SHARE = 0.12
# Pictures of more than 1.6 m are not searched: no capture that shows ribs is as wide.
MOST_CELLS = 800
CLEAR_SHARE = 0.3
# Where tops hide a rack: angles that are tried, how far below them its face may be, and heights of it that are.
MOST_TOP_TURNS = 6
DEEPEST_M, HEIGHT_BIN_M, TOP_HEIGHTS = 0.12, 1e-3, 2
# Points that a band's plane is fitted to, those that they are chosen from, those that tell where a picture ends, and
# free ones that it is made of.
PLANE_POINTS = 2000
ROUGH_POINTS = 6000
ENDS_POINTS = 4000
FREE_POINTS = 10_000


@dataclass(frozen=True, slots=True, eq=False)
class Hypothesis:
    """A pose that the rack could have.

    Attributes:
        T_camera_rack: Array of shape (4, 4), metres.
        score: How well the coarse picture of the top explains the band, in cells of rib.
        share: The same over all cells with points where the picture lies: 1 when all of them are ribs that agree.
    """

    T_camera_rack: FloatArray
    score: float
    share: float

    @property
    def worth(self) -> float:
        """What hypotheses are ranked by: much is explained, and little else lies there."""
        return self.score * self.share


@dataclass(frozen=True, slots=True, eq=False)
class Band:
    """Points about one height, on a plane.

    Attributes:
        T_camera_band: Frame on the plane, z up (towards the camera), shape (4, 4), metres.
        solid_m: Points at the plane's height, shape (N, 2), frame of the band, metres.
        free_m: Where the lines of sight of points below cross the plane, shape (M, 2), metres.
        free_weight: How many points each of them stands for.
    """

    T_camera_band: FloatArray
    solid_m: FloatArray
    free_m: FloatArray
    free_weight: float


def level_directions(points_m: FloatArray, config: RackTopConfig) -> Iterator[tuple[FloatArray, FloatArray]]:
    """Normal (towards the camera at the origin) and a point of the dominant planes, the fullest first."""
    rng = np.random.default_rng(config.seed)
    sample = points_m[rng.integers(0, len(points_m), PLANE_SAMPLE)]
    a, b, c = (sample[rng.integers(0, len(sample), PLANE_DRAWS)] for _ in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    kept = length > 1e-6
    normals, a = normals[kept] / length[kept, None], a[kept]
    offsets = np.einsum("ij,ij->i", normals, a)
    off = normals.astype(np.float32) @ sample.T.astype(np.float32)
    counts = view_kernels.close_counts(off, offsets.astype(np.float32), np.float32(config.plane_distance_m))
    found: list[tuple[FloatArray, FloatArray]] = []
    free = np.ones(len(normals), bool)
    while free.any() and len(found) < config.max_planes:
        best = int(np.argmax(np.where(free, counts, -1)))
        if counts[best] < 10:
            break
        free &= np.abs(normals @ normals[best]) < np.cos(SAME_DIRECTION_RAD)
        normal, origin = _settled(sample, normals[best], a[best], config.plane_distance_m)
        if all(abs(normal @ other) < np.cos(SAME_DIRECTION_RAD) for other, _ in found):
            found.append((normal, origin))
            yield normal, origin


def _settled(
    points_m: FloatArray, normal: FloatArray, origin: FloatArray, distance_m: float
) -> tuple[FloatArray, FloatArray]:
    for _ in range(3):
        near = points_m[np.abs((points_m - origin) @ normal) < distance_m]
        if len(near) < 10:
            break
        normal, origin = fit_plane(near)
    return (-normal if normal @ origin > 0 else normal), origin


def levels(points_m: FloatArray, config: RackTopConfig) -> Iterator[list[Band]]:
    """Bands of points (N, 3), camera frame, metres, one level direction after the other."""
    for normal, origin in level_directions(points_m, config):
        yield list(bands(points_m, normal, origin, config))


def search(found_levels: Iterable[list[Band]], rack: RackModel) -> Iterator[Hypothesis]:
    """Poses that a rack could have in the bands of `levels`: the likeliest first, the best placed.

    One level direction after the other is searched, so that whoever is content with the first answer is soon done.
    """
    for level in found_levels:
        found = [turn for band in level for turn in turns(band, rack, TURN_TRIES)]
        found.sort(key=lambda turn: -turn.strength)
        for some in (found[:4], found[4:12], found[12:]):
            placed = []
            for hypothesis in (hypothesis for turn in some for hypothesis in place(turn, rack)):
                if hypothesis.share > CLEAR_SHARE:
                    yield hypothesis
                elif hypothesis.share > LEAST_SHARE:
                    placed.append(hypothesis)
            yield from sorted(placed, key=lambda hypothesis: -hypothesis.worth)[:BEST_PLACED]


def bands(points_m: FloatArray, normal: FloatArray, origin: FloatArray, config: RackTopConfig) -> Iterator[Band]:
    """Candidates for the top at one level direction, the fullest heights first."""
    x = np.cross([0.0, 1.0, 0.0] if abs(normal[1]) < 0.9 else [1.0, 0.0, 0.0], normal)
    x /= np.linalg.norm(x)
    R = np.stack([x, np.cross(normal, x), normal], axis=1)
    local = points_m @ R
    local -= origin @ R
    local = _by_height(local)
    for height in _peaks(local[:, 2], config):
        band = _band(local, height, make_transform(R, origin))
        if band is not None:
            yield band


def _by_height(points_m: FloatArray) -> FloatArray:
    """Points (N, 3) in the order of z, to single precision: z and row sorted as one number, which is sooner done."""
    z = (points_m[:, 2] - points_m[:, 2].min()).astype(np.float32)
    keys = (z.view(np.uint32).astype(np.uint64) << 32) | np.arange(len(z), dtype=np.uint64)
    keys.sort()
    return np.asarray(np.take(points_m, (keys & 0xFFFFFFFF).astype(np.intp), axis=0))


def _peaks(heights: FloatArray, config: RackTopConfig) -> FloatArray:
    """Heights (sorted, as they come) with most points."""
    low, high = heights[int(0.002 * len(heights))], heights[int(0.998 * (len(heights) - 1))]
    if not 0 < (high - low) / config.bin_m < 20_000:
        return np.array([(high + low) / 2])
    edges = np.arange(low - 2 * config.bin_m, high + 3 * config.bin_m, config.bin_m)
    counts = np.diff(np.searchsorted(heights, edges)).astype(float)
    smooth = np.convolve(counts, [0.25, 0.5, 1.0, 0.5, 0.25])[2:-2]
    padded = np.pad(smooth, 1)
    peaks = np.flatnonzero((smooth >= padded[:-2]) & (smooth > padded[2:]) & (smooth >= 2e-3 * len(heights)))
    order = peaks[np.argsort(-smooth[peaks], kind="stable")][: config.max_bands]
    return np.asarray(edges[order] + config.bin_m / 2)


def _band(local_m: FloatArray, height: float, T_camera_level: FloatArray) -> Band | None:
    """The band at a height of points (N, 3) sorted by height, on the plane that they have there."""
    low, high, below = np.searchsorted(local_m[:, 2], [height - ROUGH_BAND_M, height + ROUGH_BAND_M, height - BELOW_M])
    rough = local_m[low:high]
    if len(rough) < 50:
        return None
    center, slope = _tilt(rough[:: len(rough) // PLANE_POINTS + 1])
    some = rough[:: len(rough) // ROUGH_POINTS + 1]
    near = some[np.abs(some[:, 2] - center[2] - (some[:, :2] - center[:2]) @ slope) < BAND_M]
    if len(near) >= 50:
        center, slope = _tilt(near[:: len(near) // PLANE_POINTS + 1])
    if np.hypot(*slope) > np.tan(SAME_DIRECTION_RAD):
        return None
    up = np.array([*-slope, 1.0]) / np.sqrt(1 + slope @ slope)
    x = np.array([1.0, 0.0, slope[0]]) / np.hypot(1, slope[0])
    T_level_band = make_transform(np.stack([x, np.cross(up, x), up], axis=1), center)
    T_camera_band = T_camera_level @ T_level_band
    R = T_level_band[:3, :3]
    solid = view_kernels.band_places(rough, R, center, BAND_M)
    if len(solid) < 50:
        return None
    camera = -T_camera_band[:3, 3] @ T_camera_band[:3, :3]
    free = view_kernels.crossed(local_m[:below], below // FREE_POINTS + 1, R, center, camera)
    return Band(T_camera_band, solid, free, max(1.0, below / FREE_POINTS))


def _tilt(points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centroid (3,) and slopes of z along x and y (2,) of the least-squares plane through points (N, 3)."""
    center = points_m.mean(axis=0)
    off = points_m - center
    slope = np.linalg.solve(off[:, :2].T @ off[:, :2] + 1e-9 * np.eye(2), off[:, :2].T @ off[:, 2])
    return center, np.asarray(slope)


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """An angle of the rack's x axis in a band, modulo half a turn, and how well its waves agree (1 at most)."""

    band: Band
    angle_rad: float
    strength: float


def search_by_tops(found_levels: Iterable[list[Band]], points_m: FloatArray, rack: RackModel) -> Iterator[Hypothesis]:
    """Poses that a rack could have whose tubes hide it: where their tops lie as its slots do, and ribs show below.

    Args:
        found_levels: Bands of `levels`.
        points_m: The points that they are of, camera frame, shape (N, 3), metres.
        rack: The rack.
    """
    for level in found_levels:
        found = [turn for band in level for turn in turns(band, rack, TURN_TRIES, tops=True)]
        found.sort(key=lambda turn: -turn.strength)
        placed = [hypothesis for turn in found[:MOST_TOP_TURNS] for hypothesis in place(turn, rack, tops=True)]
        placed = [hypothesis for hypothesis in placed if hypothesis.share > LEAST_SHARE]
        for hypothesis in sorted(placed, key=lambda hypothesis: -hypothesis.worth)[:BEST_PLACED]:
            for height_m in _heights_below(points_m, hypothesis.T_camera_rack, rack):
                T = hypothesis.T_camera_rack @ translation([0.0, 0.0, height_m])
                yield replace(hypothesis, T_camera_rack=T)


def _heights_below(points_m: FloatArray, T_camera_rack: FloatArray, rack: RackModel) -> FloatArray:
    """Where a face shows below tops, the likeliest first: how far below, (K,), negative, metres.

    At the height of the face points lie on its solid part; bodies of tubes lie in its openings.
    """
    T = T_camera_rack @ translation([0.0, 0.0, rack.height_m])
    local = (points_m - T[:3, 3]) @ T[:3, :3]
    local = local[(local[:, 2] > -DEEPEST_M) & (local[:, 2] < -BELOW_M)]
    distance, _, known = top_field(rack).look_up(local)
    edges = np.arange(-DEEPEST_M, 0.0, HEIGHT_BIN_M)
    solid, opened = (
        np.histogram(local[known & part, 2], edges)[0].astype(float) for part in (distance < 0, distance > HEIGHT_BIN_M)
    )
    score = np.convolve(solid - opened, [0.5, 1.0, 1.0, 1.0, 0.5], "same")
    best = []
    for _ in range(TOP_HEIGHTS):
        k = int(score.argmax())
        if score[k] <= 0:
            break
        best.append(edges[k] + HEIGHT_BIN_M / 2)
        score[max(k - 4, 0) : k + 5] = -np.inf
    return np.array(best)


def turns(band: Band, rack: RackModel, count: int, *, tops: bool = False) -> list[Turn]:
    """Angles of the rack's x axis in a band (modulo half a turn), the best first, by the strength of its waves."""
    low, size = _frame(band.solid_m, np.eye(2), rack, padded=False)
    if size > MOST_CELLS:
        return []
    image = view_kernels.cell_counts(band.solid_m, np.eye(2), low, PICTURE_M, size)
    signature = turn_signature(fft.rfft2(np.minimum(image, np.float32(view_kernels.median_count(image)))), size)
    norm = float(np.linalg.norm(signature))
    match = fft.irfft((fft.rfft(signature, axis=0) * solid_signature(rack, tops)).sum(axis=1), TURNS) / max(norm, 1e-12)
    found = []
    for _ in range(count):
        best = int(match.argmax())
        found.append(Turn(band, best * np.pi / TURNS, float(match[best])))
        match[np.arange(best - SAME_TURN, best + SAME_TURN + 1) % TURNS] = -1
    return found


def _frame(points_m: FloatArray, turn: FloatArray, rack: RackModel, padded: bool) -> tuple[FloatArray, int]:
    """First corner (2,), metres, and side in cells of a picture of points (N, 2), turned by a matrix from the right."""
    low, high = _ends(points_m[:: len(points_m) // ENDS_POINTS + 1] @ turn)
    side = float((high - low).max()) + 10e-3
    if padded:
        side = max(side, float((high - low).max()) + 0.5 * float(np.hypot(*rack.outline_m)))
    cells = max(int(side / PICTURE_M), 200) + 1
    return np.asarray((low + high) / 2 - cells * PICTURE_M / 2), fft.next_fast_len(cells, real=True)


def _ends(points_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Percentiles 0.5 and 99.5 of points (N, 2), shape (2,) each."""
    ranks = np.array([0.005, 0.995]) * (len(points_m) - 1)
    below = ranks.astype(np.intp)
    above = np.minimum(below + 1, len(points_m) - 1)
    ordered = np.partition(points_m.T.copy(), np.unique([below, above]), axis=1)
    low, high = ordered[:, below].T + (ranks - below)[:, None] * (ordered[:, above] - ordered[:, below]).T
    return low, high


def place(turn: Turn, rack: RackModel, *, tops: bool = False) -> list[Hypothesis]:
    """Where the picture of the top lies best at one angle; for a top that half a turn changes, both ways round."""
    cos, sin = np.cos(turn.angle_rad), np.sin(turn.angle_rad)
    T_turned = np.array([[cos, -sin], [sin, cos]])
    low, size = _frame(turn.band.solid_m, T_turned, rack, padded=True)
    hits, misses = (
        view_kernels.cell_counts(places, T_turned, low, PICTURE_M, size)
        for places in (turn.band.solid_m, turn.band.free_m)
    )
    # Points of a cell that is seen well: more of them say no more.
    full = float(view_kernels.median_count(hits))
    evidence = view_kernels.clipped(hits, misses, np.float32(turn.band.free_weight), np.float32(full))
    spectrum = fft.rfft2(evidence)
    half = np.array(picture(rack).shape) // 2
    found = []
    for half_turn in (False, True) if top_field(rack).alike == 1 else (False,):
        match = fft.irfft2(spectrum * picture_spectrum(rack, size, half_turn, tops), (size, size))
        i, j = np.unravel_index(int(match.argmax()), match.shape)
        center = low + (np.array([i, j]) + 0.5) * PICTURE_M
        R = np.eye(3)
        R[:2, :2] = T_turned * (-1 if half_turn else 1)
        T_band_rack = make_transform(R, np.array([*(T_turned @ center), -rack.height_m]))
        score = float(match[i, j])
        around = np.abs(evidence[max(0, i - half[0]) : i + half[0] + 1, max(0, j - half[1]) : j + half[1] + 1]).sum()
        share = score / max(float(around), 1.0)
        found.append(Hypothesis(turn.band.T_camera_band @ T_band_rack, score / full, share))
    return found
