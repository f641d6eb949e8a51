"""Which picture belongs to which cloud: the nearest stamp, within the same pass of a recording that loops."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from tubepose.capture.topics import Topic
from tubepose.errors import CaptureError

PAIRING_TOLERANCE_NS = 50_000_000
"""Stamps of a picture and its cloud differ by no more, unless the user says otherwise."""


def pair_by_stamp(source: Topic, image: Topic | None, tolerance_ns: int, where: str) -> list[int | None]:
    """For every cloud (or depth image) the number of its picture in the picture's topic, or None.

    A bag that is played in a loop and recorded has every stamp several times; between two passes the difference of
    the time of recording and the stamp leaps. Pictures of another pass are not looked at.

    Args:
        source: Topic of the clouds.
        image: Topic of the pictures; None gives no pairs.
        tolerance_ns: Largest difference of two stamps.
        where: Start of error messages.

    Raises:
        CaptureError: No cloud has a picture.
    """
    if image is None:
        return [None] * len(source.stamps_ns)
    stamps, clouds = _stamps(image), _stamps(source)
    offsets = np.array(image.log_times_ns, dtype=np.int64) - stamps
    cloud_offsets = np.array(source.log_times_ns, dtype=np.int64) - clouds
    reach_ns = _pass_reach_ns(clouds, cloud_offsets, tolerance_ns)
    reach_ns = min(reach_ns, _pass_reach_ns(stamps, offsets, tolerance_ns))
    pairs: list[int | None] = []
    nearest_ns = np.iinfo(np.int64).max
    for stamp, offset in zip(clouds, cloud_offsets, strict=True):
        gaps = np.abs(stamps - stamp)
        shifts = np.abs(offsets - offset)
        inside = np.flatnonzero(shifts <= reach_ns) if reach_ns < np.inf else np.arange(len(stamps))
        # Of equally near stamps the one that was recorded nearest.
        best = inside[np.lexsort((shifts[inside], gaps[inside]))[0]] if len(inside) else None
        gap_ns = int(gaps[best]) if best is not None else int(gaps.min())
        nearest_ns = min(nearest_ns, gap_ns)
        pairs.append(int(best) if best is not None and gap_ns <= tolerance_ns else None)
    if all(pair is None for pair in pairs):
        raise CaptureError(
            f"{where}: no message of {image.name} is within {tolerance_ns / 1e6:g} ms of one of {source.name}, the "
            f"nearest is {nearest_ns / 1e6:.0f} ms away; if they belong together, allow it: --max-stamp-difference "
            f"{math.ceil(nearest_ns / 1e6)} (ms); else record both with one clock, or name another --image-topic"
        )
    return pairs


def _stamps(topic: Topic) -> np.ndarray[tuple[int], np.dtype[np.int64]]:
    return np.array([stamp or 0 for stamp in topic.stamps_ns], dtype=np.int64)


def _pass_reach_ns(stamps: Sequence[int] | np.ndarray, offsets: np.ndarray, tolerance_ns: int) -> float:
    """Half of the least leap between two passes: offsets of one pass differ by less; infinite without passes."""
    back = np.diff(np.asarray(stamps))
    leaps = np.abs(np.diff(offsets))[(back < -tolerance_ns) | (back == 0)]
    leaps = leaps[leaps > 2 * tolerance_ns]  # a message that was sent twice makes no pass
    return float(leaps.min()) / 2 if len(leaps) else float("inf")
