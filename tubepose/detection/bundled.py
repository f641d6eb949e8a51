"""The network that comes with the package."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from tubepose.errors import DetectorError

_FILE = "detector.onnx"


def bundled_model() -> Path:
    """The ONNX file of the bundled detector; docs/model-card.md says what it knows.

    Raises:
        DetectorError: The package lacks it.
    """
    path = Path(str(files("tubepose.detection") / _FILE))
    if not path.is_file():
        raise DetectorError(f"{path}: the bundled model is missing; install tubepose again, or give --model FILE.onnx")
    return path
