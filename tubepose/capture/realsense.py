"""What recordings of the RealSense SDK say beside the pictures: the unit of depth, and where the cameras are.

The SDK's recorder writes `.db3` since version 2.58 and ROS 1 `.bag` before. Topics are
`/device_D/sensor_S/STREAM_N/image/data` and the like; depth is not aligned to colour, and its unit stands in topics of
text (`/device_D/sensor_S/option/Depth_Units/value`, `.../image/metadata`) or of a number (`.bag`).
"""

from __future__ import annotations

import math
import re

_SENSOR = re.compile(r"(/device_\d+/sensor_\d+)/.*")
_OPTION = re.compile(r"(/device_\d+/sensor_\d+)/option/Depth[ _]Units/value")
_METADATA = re.compile(r"(/device_\d+/sensor_\d+)/[^/]+/image/metadata")
_METADATA_UNIT = re.compile(r"(?:^|;)\s*depth_units=([^;]+)")
_STREAM_TRANSFORM = re.compile(r"(/device_\d+)/sensor_\d+/([^/]+)/tf/(.+)")
# A metre per count is no depth camera's.
_MOST_UNIT_M = 0.05

UNIT_HINT = "--depth-scale 0.001 for a D435 or D455, 0.0001 for a D405, 0.00025 for an L515"
"""What to give where a recording does not tell the unit."""


class DepthUnits:
    """Metres per count of the depth of each recorded sensor."""

    def __init__(self) -> None:
        self._by_option: dict[str, float] = {}
        self._by_frame: dict[str, float] = {}

    def is_told_by(self, topic: str) -> bool:
        """Whether messages of a topic may tell a unit."""
        found = _METADATA.fullmatch(topic)
        if found is not None:
            return found[1] not in self._by_frame
        return _OPTION.fullmatch(topic) is not None

    def note(self, topic: str, data: object) -> None:
        """Take up what a message of such a topic says: a number, a number as text, or a frame's metadata."""
        option, metadata = _OPTION.fullmatch(topic), _METADATA.fullmatch(topic)
        text = str(data)
        if metadata is not None:
            stated = _METADATA_UNIT.search(text)
            text = stated[1] if stated is not None else ""
        try:
            unit_m = float(text)
        except ValueError:
            return
        if not (math.isfinite(unit_m) and 0 < unit_m <= _MOST_UNIT_M):
            return
        # A float32 is written as 9.9999997e-05 or 0.000100; both mean 0.0001.
        unit_m = float(f"{unit_m:.6g}")
        if option is not None:
            self._by_option[option[1]] = unit_m
        elif metadata is not None:
            self._by_frame.setdefault(metadata[1], unit_m)

    def of(self, topic: str) -> float | None:
        """Metres per count of a depth topic; None where the recording does not say."""
        sensor = _SENSOR.fullmatch(topic)
        if sensor is None:
            return None
        return self._by_option.get(sensor[1], self._by_frame.get(sensor[1]))


def is_sdk_topic(topic: str) -> bool:
    """Whether a topic is of the SDK's recorder."""
    return _SENSOR.fullmatch(topic) is not None


def sdk_frame(topic: str) -> str | None:
    """A name for the coordinate frame of a stream of the SDK, whose ROS 1 messages name none; None for other topics."""
    found = re.fullmatch(r"(/device_\d+)/sensor_\d+/([^/]+)/.*", topic)
    return f"{found[1]}/{found[2]}".lstrip("/") if found is not None else None


def stream_extrinsics(topic: str) -> tuple[str, str] | None:
    """Reference and stream that a `/device_D/sensor_S/STREAM/tf/REFERENCE` topic of a `.bag` is about, as frames.

    Its transform maps points of the reference to points of the stream.
    """
    found = _STREAM_TRANSFORM.fullmatch(topic)
    if found is None:
        return None
    return f"{found[1]}/reference_{found[3]}".lstrip("/"), f"{found[1]}/{found[2]}".lstrip("/")
