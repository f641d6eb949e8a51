"""Boxes of racks and tubes: from a network, from a file, or from the cloud's geometry."""

from tubepose.detection.model import RACK_CLASS, TUBE_CLASS, Detection, Detector, rows_in_box

__all__ = ["RACK_CLASS", "TUBE_CLASS", "Detection", "Detector", "rows_in_box"]
