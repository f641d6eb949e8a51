"""Boxes of racks and tubes: from a network, from a file, or from the cloud's geometry."""

from tubepose.detection.model import TUBE_CLASS, Detection, Detector, best_rack, points_in_box, rows_in_box
from tubepose.labware.tubes import RACK_CLASS

__all__ = ["RACK_CLASS", "TUBE_CLASS", "Detection", "Detector", "best_rack", "points_in_box", "rows_in_box"]
