"""Formats of captures, one file each; `tubepose.capture.source.open_captures` stands before them."""
