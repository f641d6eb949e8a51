"""The network's boxes, and the geometric detector's where the network is of no help; the result says which."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from tubepose.capture.frame import RgbdFrame
from tubepose.detection.boxes import edges_from_box
from tubepose.detection.geometric import GeometricDetector
from tubepose.detection.metrics import overlaps
from tubepose.detection.model import CAPPED_CLASS, Detection, Detector, rows_in_box
from tubepose.detection.yolo import YoloDetector
from tubepose.transforms import FloatArray

SURE_SCORE = 0.5
"""A rack that a network gives less than this is looked for in the cloud too, a tube must be seen there."""
KNOWN_SHARE = 0.2
"""Least overlap of a network's box and of a tube of the cloud (intersection over union) that can be one."""
LEAST_COMMON = 0.3
"""A box that holds less than this share of its tube's points is off."""


@dataclass(frozen=True, slots=True)
class AssistedDetector(Detector):
    """A network with the geometric detector at its side.

    Attributes:
        yolo: The network.
        geometric: The helper; it looks for one rack's shape in the cloud.
        name: ``yolo``.
    """

    yolo: YoloDetector
    geometric: GeometricDetector
    name: str = "yolo"

    def detect(self, frame: RgbdFrame) -> tuple[Detection, ...]:
        """Boxes of the network; of the cloud where there is no image, or no rack that the network is sure of."""
        if frame.image is None:
            return self._from_cloud(frame, "the frame has no image for the network")
        found = self.yolo.detect(frame)
        best = max((detection.score for detection in found if detection.is_rack), default=None)
        if best is not None and best >= SURE_SCORE:
            return found
        why = "the network saw no rack" if best is None else f"the network was unsure of the rack ({best:.2f})"
        helped = self._from_cloud(frame, why)
        # A cloud without a rack is a rack of score 0: then the network's doubtful box is the better one.
        return helped if best is None or _rack_score(helped) > 0 else found

    def second_opinion(self, frame: RgbdFrame, found: tuple[Detection, ...], reason: str) -> tuple[Detection, ...]:
        """Boxes of the cloud, where the network's rack could not be registered and the cloud was not asked yet."""
        if any(box.is_rack and box.source == self.geometric.name for box in found):
            return ()
        return self._from_cloud(frame, f"no rack in the network's box ({reason})")

    def checked(
        self, frame: RgbdFrame, T_camera_rack: FloatArray, found: tuple[Detection, ...]
    ) -> tuple[Detection, ...]:
        """Boxes of tubes against what stands on a registered rack: one box, one tube.

        A tube that both see keeps the network's box, class and score. If the network is unsure of it, it gets the
        points of the cloud's tube: a box that is off would cut some away. A box of a closed tube keeps those of its
        points that are of the cloud's tube too: others are of neighbours. What the cloud makes of openings is no better
        than their boxes. A tube of the cloud without a box of its own is added. A tube's box without a tube of the
        cloud stays if the network is sure of it.

        Args:
            frame: The frame.
            T_camera_rack: The rack's pose, shape (4, 4), metres.
            found: What is known so far; where the cloud has helped already, all of it is the cloud's.
        """
        if any(box.source == self.geometric.name for box in found):
            return found
        told = [k for k, box in enumerate(found) if not box.is_rack and box.source == self.name]
        standing = [
            tube for tube in self.geometric.tubes_on(frame, T_camera_rack) if np.isfinite(tube.box_xyxy_px).all()
        ]
        edges = [
            np.array([edges_from_box(box.box_xyxy_px) for box in boxes], float).reshape(-1, 4)
            for boxes in (standing, [found[k] for k in told])
        ]
        shares = overlaps(*edges)
        pairs = [(k, m) for k, m in zip(*linear_sum_assignment(-shares), strict=True) if shares[k, m] >= KNOWN_SHARE]
        seen = {told[int(m)]: standing[int(k)] for k, m in pairs}
        kept = [
            replace(box, point_rows=_rows_of_both(frame, box, seen[k])) if k in seen else box
            for k, box in enumerate(found)
            if k not in told or k in seen or box.score >= SURE_SCORE
        ]
        without = {*range(len(standing))} - {int(k) for k, _ in pairs}
        return (*kept, *(replace(standing[k], note="the network saw no tube there") for k in sorted(without)))

    def _from_cloud(self, frame: RgbdFrame, why: str) -> tuple[Detection, ...]:
        return tuple(replace(detection, note=why) for detection in self.geometric.detect(frame))


def _rack_score(found: tuple[Detection, ...]) -> float:
    return max((detection.score for detection in found if detection.is_rack), default=0.0)


def _rows_of_both(frame: RgbdFrame, box: Detection, tube: Detection) -> NDArray[np.intp] | None:
    """Rows of a tube that network and cloud see, None for all in the network's box; see `AssistedDetector.checked`."""
    if tube.point_rows is None or box.score < SURE_SCORE:
        return tube.point_rows
    if box.class_name != CAPPED_CLASS:
        return None
    common = np.intersect1d(rows_in_box(frame, box), tube.point_rows, assume_unique=True)
    return common if len(common) >= LEAST_COMMON * len(tube.point_rows) else tube.point_rows
