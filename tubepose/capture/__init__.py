"""Recorded RGB-D captures: one model of a frame, several sources behind `open_captures`."""

from tubepose.capture.folder import FolderCapture
from tubepose.capture.formats.bop import BopScene
from tubepose.capture.formats.cloud_files import CloudFileCapture
from tubepose.capture.formats.depth_folders import DepthFolder
from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.capture.mcap_writing import write_mcap
from tubepose.capture.recorded import RecordedCapture
from tubepose.capture.registration import estimate_intrinsics, project_cloud
from tubepose.capture.source import Capture, open_captures
from tubepose.capture.writing import write_folder_capture

__all__ = [
    "BopScene",
    "CameraIntrinsics",
    "Capture",
    "CloudFileCapture",
    "DepthFolder",
    "FolderCapture",
    "RecordedCapture",
    "RgbdFrame",
    "estimate_intrinsics",
    "open_captures",
    "project_cloud",
    "write_folder_capture",
    "write_mcap",
]
