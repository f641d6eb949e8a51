"""Several frames of a static recording made into one."""

from tubepose.capture.fusion.frame_fusion import Average, AveragedCapture, read_average

__all__ = ["Average", "AveragedCapture", "read_average"]
