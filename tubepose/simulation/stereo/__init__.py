"""Sensor ``stereo``: depth and colour as cameras of RealSense's class give them, from the exact surface."""

from tubepose.simulation.stereo.stereo_camera import CAMERAS, StereoCamera, load_stereo_camera

__all__ = ["CAMERAS", "StereoCamera", "load_stereo_camera"]
