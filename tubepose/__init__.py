"""tubepose: poses of in-rack test tubes from recorded RGB-D captures, with ground truth and honest tables."""

__version__ = "0.1.0"
