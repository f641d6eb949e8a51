"""JSON of captures, read with one-line errors."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tubepose.capture.images import read_bytes
from tubepose.errors import CaptureError


def read_json(path: Path) -> dict[str, Any]:
    """One JSON object.

    Raises:
        CaptureError: The file is missing, no JSON, or holds something else than an object.
    """
    try:
        data = json.loads(read_bytes(path).decode("utf-8-sig"))
    except (ValueError, RecursionError) as problem:
        raise CaptureError(f"{path}: not valid JSON: {problem}") from None
    if not isinstance(data, dict):
        raise CaptureError(f"{path}: expected a JSON object, found a {type(data).__name__}")
    return data
