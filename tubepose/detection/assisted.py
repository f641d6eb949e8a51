"""The network's boxes, and the geometric detector's where the network is of no help; the result says which."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tubepose.capture.frame import RgbdFrame
from tubepose.detection.geometric import GeometricDetector
from tubepose.detection.model import Detection
from tubepose.detection.yolo import YoloDetector
from tubepose.transforms import FloatArray

SURE_SCORE = 0.5
"""A rack that a network gives less than this is looked for in the cloud too."""
KNOWN_SHARE = 0.5
"""A tube of the cloud is known to the network when one of its boxes holds this share of the tube's points."""


@dataclass(frozen=True, slots=True)
class AssistedDetector:
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

    def second_opinion(self, frame: RgbdFrame, reason: str) -> tuple[Detection, ...]:
        """Boxes of the cloud, for a frame in which the network's rack could not be registered."""
        return self._from_cloud(frame, f"no rack in the network's box ({reason})")

    def missed(
        self, frame: RgbdFrame, T_camera_rack: FloatArray, found: tuple[Detection, ...]
    ) -> tuple[Detection, ...]:
        """Tubes that stand on a registered rack and of which the network says nothing.

        Args:
            frame: The frame.
            T_camera_rack: The rack's pose, shape (4, 4), metres.
            found: What is known; a tube most of whose points lie in one box of a tube is.
        """
        boxes = np.array([other.box_xyxy_px for other in found if not other.is_rack]).reshape(-1, 4)
        missed = []
        for tube in self.geometric.tubes_on(frame, T_camera_rack):
            if tube.point_rows is None or not np.isfinite(tube.box_xyxy_px).all():
                continue
            v, u = np.divmod(tube.point_rows, frame.cloud_m.shape[1])
            inside = (u[:, None] >= boxes[:, 0]) & (u[:, None] <= boxes[:, 2])
            inside &= (v[:, None] >= boxes[:, 1]) & (v[:, None] <= boxes[:, 3])
            if inside.mean(axis=0).max(initial=0.0) < KNOWN_SHARE:
                missed.append(replace(tube, note="the network saw no tube there"))
        return tuple(missed)

    def _from_cloud(self, frame: RgbdFrame, why: str) -> tuple[Detection, ...]:
        return tuple(replace(detection, note=why) for detection in self.geometric.detect(frame))


def _rack_score(found: tuple[Detection, ...]) -> float:
    return max((detection.score for detection in found if detection.is_rack), default=0.0)
