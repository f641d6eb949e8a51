"""Frames of a static recording fused into one: a robust mean of depth at every pixel.

Every frame is compared with the first of those before it that show another thing (`motion`); the largest set of frames
that show the same is fused, and the others are told of. What is new in each frame averages out. What stays over the
frames of a camera (its fixed waves) does not: the noise of the fused frame has to be measured again, and is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import Averaging, RgbdFrame
from tubepose.capture.fusion.motion import Still, motion_between, still_of
from tubepose.errors import CaptureError, ConfigError
from tubepose.transforms import FloatArray

Average = int | Literal["all"]
"""Frames that make one: a number, or all of a recording."""

HUBER = 1.5
"""Residuals above so many standard deviations count linearly: 96 % efficient for normal errors (Huber 1981)."""
ROUNDS = 4
LEAST_SPREAD = 1.0e-4
"""Smallest standard deviation of depth in time, as a share of it: counted depth can be the same in most frames."""
LEAST_SHARE = 1 / 3
"""A pixel needs depth in this share of the frames: else what flickers at edges and in holes would stay."""
MOST_AT_ONCE = 32
"""Frames that are held: longer recordings are fused in parts, and the parts by their counts."""


class Frames(Protocol):
    """A capture that frames are read from."""

    @property
    def name(self) -> str:
        """As the tables show it."""
        ...

    @property
    def path(self) -> Path:
        """Folder or file."""
        ...

    def frames(self) -> Iterator[RgbdFrame]:
        """Its frames, in order."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class AveragedCapture:
    """A capture whose frames are fused.

    Attributes:
        capture: What is read.
        average: So many frames in a row make one, or all; the last ones may be fewer.
    """

    capture: Frames
    average: Average

    @property
    def name(self) -> str:
        """As the tables show it."""
        return self.capture.name

    @property
    def path(self) -> Path:
        """Folder or file."""
        return self.capture.path

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield the fused frames, each with the number and time of the first frame in it.

        Raises:
            CaptureError: The capture cannot be read, or its frames have no pixels in common; frames before were good.
        """
        fusing = Fusion()
        frames = self.capture.frames()
        while True:
            try:
                frame = next(frames, None)
            except CaptureError:
                if fusing.n_frames:
                    yield fusing.fused()
                raise
            if frame is None:
                break
            fusing.add(frame, str(self.path))
            if fusing.n_frames == self.average:
                yield fusing.fused()
                fusing = Fusion()
        if fusing.n_frames:
            yield fusing.fused()


@dataclass(slots=True, eq=False)
class _Alike:
    """Frames that show the same: the first one, how it is compared, and sums over all."""

    first: RgbdFrame
    still: Still
    numbers: list[int] = field(default_factory=list)
    waiting: list[FloatArray] = field(default_factory=list)
    depth: FloatArray | None = None
    counts: NDArray[np.uint16] | None = None
    image: FloatArray | None = None

    def add(self, frame: RgbdFrame) -> None:
        self.numbers.append(frame.index)
        self.waiting.append(np.asarray(frame.cloud_m[..., 2], np.float32))
        if frame.image is not None:
            total = 0.0 if self.image is None else self.image
            self.image = np.asarray(total + frame.image.astype(np.float32))
        if len(self.waiting) == MOST_AT_ONCE:
            self.join()

    def join(self) -> None:
        """Fuse the frames that wait, and their mean with that of those before."""
        if not self.waiting:
            return
        depth, counts = robust_mean_m(np.array(self.waiting))
        if self.depth is not None and self.counts is not None:
            before = self.counts.astype(float)
            total = np.nan_to_num(self.depth) * before + np.nan_to_num(depth) * counts
            both = before + counts
            with np.errstate(invalid="ignore"):
                depth = np.where(both > 0, total / both, np.nan)
            counts = (self.counts + counts).astype(np.uint16)
        self.depth, self.counts = depth, counts
        self.waiting.clear()


class Fusion:
    """Collects frames of one camera and fuses the largest set of them that show the same."""

    def __init__(self) -> None:
        """Begin without frames."""
        self.n_frames = 0
        self._sets: list[_Alike] = []
        self._moved: list[str] = []

    def add(self, frame: RgbdFrame, where: str) -> None:
        """Take a frame.

        Args:
            frame: It needs pixels, as many as those before it.
            where: Start of error messages.

        Raises:
            CaptureError: It has no pixels, or others.
        """
        if not frame.organised:
            raise CaptureError(
                f"{where}: frame {frame.index} is a cloud without pixels, and frames are averaged pixel by pixel; "
                "leave --average out, or record an organised cloud or a depth image"
            )
        if self._sets and self._sets[0].first.cloud_m.shape != frame.cloud_m.shape:
            size, other = (f"{one.cloud_m.shape[1]} x {one.cloud_m.shape[0]}" for one in (frame, self._sets[0].first))
            raise CaptureError(
                f"{where}: frame {frame.index} has {size} pixels, those before it {other}; expected frames of one "
                "camera; leave --average out"
            )
        self.n_frames += 1
        still = still_of(frame)
        for alike in self._sets:
            moved = motion_between(alike.still, still)
            if not moved:
                alike.add(frame)
                return
            self._moved.append(moved)
        self._sets.append(_Alike(frame, still))
        self._sets[-1].add(frame)

    def fused(self) -> RgbdFrame:
        """The fused frame: number, time and pixels of the first frame in it, and `averaging`."""
        best = max(self._sets, key=lambda alike: len(alike.numbers))
        best.join()
        assert best.depth is not None
        assert best.counts is not None
        least = max(1, int(np.ceil(LEAST_SHARE * len(best.numbers))))
        depth = np.where(best.counts >= least, best.depth, np.nan)
        image = None
        if best.image is not None:
            image = np.asarray(np.rint(best.image / len(best.numbers)), np.uint8)
        left = tuple(sorted(number for alike in self._sets if alike is not best for number in alike.numbers))
        code = max(set(self._moved), key=self._moved.count) if left else ""
        averaging = Averaging(self.n_frames, left, code, best.counts)
        return replace(best.first, cloud_m=_along_sight(best.first, depth), image=image, averaging=averaging)


def robust_mean_m(depth_m: NDArray[np.floating]) -> tuple[FloatArray, NDArray[np.uint16]]:
    """Huber's mean over frames at every pixel, from the median by iteratively reweighted least squares.

    The spread is the median absolute deviation of each pixel, at least the median over all of them: a few frames tell
    their own badly.

    Args:
        depth_m: Shape (N, H, W), metres; NaN where a frame has none.

    Returns:
        Mean depth (H, W), NaN where no frame has any, and the number of frames that have.
    """
    counts = np.isfinite(depth_m).sum(axis=0).astype(np.uint16)
    if len(depth_m) <= 2:
        total = np.where(np.isfinite(depth_m), depth_m, 0.0).sum(axis=0, dtype=float)
        with np.errstate(invalid="ignore"):
            return np.where(counts > 0, total / counts, np.nan), counts
    mean = _median(depth_m, counts)
    share = np.abs(depth_m / mean - 1)
    spread = 1.4826 * _median(share, counts)
    usual = np.nanmedian(spread) if np.isfinite(spread).any() else 0.0
    spread = np.maximum(spread, max(float(usual), LEAST_SPREAD))
    valid = np.isfinite(depth_m)
    known = np.where(valid, depth_m, 0.0)
    for _ in range(ROUNDS):
        with np.errstate(invalid="ignore", divide="ignore"):
            off = np.abs(known / mean - 1) / spread
            weight = np.where(valid, np.minimum(1.0, HUBER / np.maximum(off, 1e-12)), 0.0)
            mean = (weight * known).sum(axis=0, dtype=float) / weight.sum(axis=0, dtype=float)
    return np.asarray(np.where(counts > 0, mean, np.nan)), counts


def _median(values: NDArray[np.floating], counts: NDArray[np.uint16]) -> FloatArray:
    """Median (H, W) over the first axis of the values that are numbers; NaN without any."""
    ordered = np.sort(values, axis=0)  # NaN comes last
    low = np.maximum((counts.astype(int) - 1) // 2, 0)[None]
    high = (counts.astype(int) // 2)[None]
    high = np.minimum(high, np.maximum(counts.astype(int) - 1, 0)[None])
    picked = [np.take_along_axis(ordered, place, axis=0)[0].astype(float) for place in (low, high)]
    return np.asarray(0.5 * (picked[0] + picked[1]))


def _along_sight(frame: RgbdFrame, depth_m: FloatArray) -> FloatArray:
    """Cloud (H, W, 3) of a depth image on the lines of sight of a frame, metres."""
    if frame.intrinsics is not None:
        return frame.intrinsics.backproject(depth_m)
    # Without intrinsics a pixel has the line of sight of its own point in the first frame.
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(frame.cloud_m * (depth_m / frame.cloud_m[..., 2])[..., None])


def read_average(text: str) -> Average:
    """What ``--average`` takes: a number of frames, 2 or more, or ``all``.

    Raises:
        ConfigError: It is neither.
    """
    if text == "all":
        return "all"
    if text.isdecimal() and int(text) >= 2:
        return int(text)
    raise ConfigError(f"--average {text}: expected a number of frames, 2 or more, or all")
