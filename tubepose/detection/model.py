"""What every source of boxes returns, and what it must offer (paper, section III)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import RgbdFrame, finite_points
from tubepose.labware.tubes import RACK_CLASS
from tubepose.transforms import FloatArray

TUBE_CLASS = "tube"
CAPPED_CLASS = "tube-capped"
OPEN_CLASS = "tube-open"
"""What can be seen of a tube of any make; the bundled network knows these two and `RACK_CLASS`."""


def visible_class(*, closed: bool) -> str:
    """What can be seen of a tube: the class of one that is closed by a cap, or of one that is open."""
    return CAPPED_CLASS if closed else OPEN_CLASS


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """One detected object.

    Attributes:
        class_name: The detector's word: ``rack``, ``tube`` (a tube of unknown type), or a class of a labware file.
        score: 0 to 1; 1 for a recorded box.
        box_xyxy_px: Left, top, right, bottom in pixels, edges included; NaN where the cloud has no pixels.
        source: ``yolo``, ``recorded`` or ``geometric``.
        point_rows: Rows of `RgbdFrame.points_m` that belong to the object, where the detector knows them (geometric);
            None means every point in the box.
        note: Why another source than the one that was asked for found it; empty otherwise.
    """

    class_name: str
    score: float
    box_xyxy_px: tuple[float, float, float, float]
    source: str
    point_rows: NDArray[np.intp] | None = None
    note: str = ""

    @property
    def is_rack(self) -> bool:
        """True for a rack; every other class is a tube."""
        return self.class_name == RACK_CLASS


class Detector(Protocol):
    """A source of boxes; what it can do beside finding them is empty unless its class says otherwise."""

    @property
    def name(self) -> str:
        """Name in the tables: ``geometric``, ``yolo`` or ``recorded``."""
        ...

    def detect(self, frame: RgbdFrame) -> tuple[Detection, ...]:
        """Find racks and tubes in a frame.

        Raises:
            DetectorError: The detector cannot work on this frame at all (a network without an image, say).
        """
        ...

    def second_opinion(
        self,
        frame: RgbdFrame,  # noqa: ARG002
        found: tuple[Detection, ...],  # noqa: ARG002
        reason: str,  # noqa: ARG002
    ) -> tuple[Detection, ...]:
        """Other boxes of a frame whose rack could not be registered; none from a detector with one source of boxes.

        Args:
            frame: The frame.
            found: What `detect` said of it.
            reason: Why its rack has no pose.
        """
        return ()

    def checked(
        self,
        frame: RgbdFrame,  # noqa: ARG002
        T_camera_rack: FloatArray,  # noqa: ARG002
        found: tuple[Detection, ...],
    ) -> tuple[Detection, ...]:
        """Boxes of tubes held against a registered rack; as they are from a detector with one source of boxes.

        Args:
            frame: The frame.
            T_camera_rack: The rack's pose, shape (4, 4), metres.
            found: What is known so far.
        """
        return found


def best_rack(detections: Sequence[Detection]) -> Detection | None:
    """The rack that is registered: the one of the best score."""
    racks = [detection for detection in detections if detection.is_rack]
    return max(racks, key=lambda detection: detection.score, default=None)


def rows_in_box(frame: RgbdFrame, detection: Detection, margin: float = 0.0) -> NDArray[np.intp]:
    """Rows of `RgbdFrame.points_m` that a detection selects, valid points only.

    Args:
        frame: The frame.
        detection: What selects.
        margin: By how much the box is wider on every side, as a share of its longer side; nothing for `point_rows`.
    """
    if detection.point_rows is not None:
        return _valid_rows(frame, detection.point_rows)
    (v0, v1), (u0, u1) = _pixels(frame, detection, margin)
    grid = np.arange(v0, v1)[:, None] * frame.cloud_m.shape[1] + np.arange(u0, u1)[None, :]
    return _valid_rows(frame, grid.reshape(-1))


def points_in_box(frame: RgbdFrame, detection: Detection, margin: float = 0.0) -> FloatArray:
    """Valid points that a detection selects, camera frame, shape (N, 3), metres: those of `rows_in_box`, sooner."""
    if detection.point_rows is not None:
        return frame.points_m[_valid_rows(frame, detection.point_rows)]
    (v0, v1), (u0, u1) = _pixels(frame, detection, margin)
    return finite_points(frame.cloud_m[v0:v1, u0:u1])


def _pixels(frame: RgbdFrame, detection: Detection, margin: float) -> tuple[tuple[int, int], tuple[int, int]]:
    """First rows and columns of pixels of a box, and those after the last."""
    height, width = frame.cloud_m.shape[:2]
    left, top, right, bottom = detection.box_xyxy_px
    more = margin * max(right - left, bottom - top)
    left, top, right, bottom = left - more, top - more, right + more, bottom + more
    u0, u1 = int(np.clip(np.floor(left), 0, width)), int(np.clip(np.ceil(right) + 1, 0, width))
    v0, v1 = int(np.clip(np.floor(top), 0, height)), int(np.clip(np.ceil(bottom) + 1, 0, height))
    return (v0, v1), (u0, u1)


def _valid_rows(frame: RgbdFrame, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    return np.asarray(rows[np.isfinite(frame.points_m[rows, 2])], np.intp)
