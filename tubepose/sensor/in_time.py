"""What changes between the frames of a static recording: noise in time, and drift."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tubepose.capture.frame import RgbdFrame

MOST_PIXELS = 200_000


@dataclass(frozen=True, slots=True)
class InTime:
    """Depth over the frames of a static recording.

    Attributes:
        std_share: Standard deviation of a pixel about its mean over the frames, as a share of its depth (median).
        drift_share: Change of the depth's scale from the first frame to the last one, as a share: a straight line
            through the median changes of the frames.
        drift_std_share: Standard deviation of that.
        flicker_share: Share of the pixels that have depth in some frames and not in all.
        n_frames: Frames.
    """

    std_share: float
    drift_share: float
    drift_std_share: float
    flicker_share: float
    n_frames: int


def in_time(frames: Sequence[RgbdFrame]) -> InTime | None:
    """Noise and drift over frames of one size; None with fewer than 2 or without pixels.

    Args:
        frames: Frames of a scene and a camera that do not move.
    """
    if len(frames) < 2 or not all(frame.organised for frame in frames):
        return None
    if len({frame.cloud_m.shape for frame in frames}) > 1:
        return None
    step = max(1, frames[0].cloud_m[..., 2].size // MOST_PIXELS)
    depth = np.array([frame.cloud_m[..., 2].ravel()[::step] for frame in frames])
    seen = np.isfinite(depth).sum(axis=0)
    always = seen == len(frames)
    if not always.any():
        return None
    mean = depth[:, always].mean(axis=0)
    change = depth[:, always] / mean - 1
    # The drift is common to all pixels: it is taken out of what each of them scatters.
    common = np.median(change, axis=1)
    std = float(np.median(np.std(change - common[:, None], axis=0, ddof=1)))
    place = np.arange(len(frames)) - (len(frames) - 1) / 2
    slope = float(place @ common / (place @ place))
    left = common - slope * place
    spare = max(len(frames) - 2, 1)
    known = float(np.sqrt(left @ left / spare / (place @ place))) if len(frames) > 2 else float("nan")
    span = len(frames) - 1
    flicker = float(np.mean((seen > 0) & ~always))
    return InTime(std, slope * span, known * span, flicker, len(frames))
