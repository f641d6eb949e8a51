"""Captures written as folders: aside first, then renamed, so that no partial capture is ever seen."""

from __future__ import annotations

import shutil
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tubepose.capture.description import CAPTURE_FILE, CLOUD_FILE, DEPTH_FILE, IMAGE_FILES
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.images import encode_png
from tubepose.capture.ply import encode_ply
from tubepose.errors import CaptureError

# The count 65535 is what sensors write when depth overflows; the reader takes it for invalid.
_MAX_COUNT = 65534


def write_folder_capture(folder: Path, frame: RgbdFrame, *, depth_scale_m: float = 2.0e-5) -> None:
    """Write one frame as a capture folder; the same frame gives the same bytes.

    An organised cloud with intrinsics, whose points lie on the lines of sight of their pixels, becomes a depth image
    of 16 bits; any other cloud becomes a PLY of float32.

    Args:
        folder: To be made; it may exist if it is empty.
        frame: What to write.
        depth_scale_m: Metres per count of the depth image; 65534 counts must reach the farthest point.

    Raises:
        CaptureError: The folder holds files already, or the depth does not fit into 16 bits.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise CaptureError(f"{folder}: there is something already; choose another place or remove it")
    files, described = _content(folder, frame, depth_scale_m)
    folder.parent.mkdir(parents=True, exist_ok=True)
    aside = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(aside, ignore_errors=True)
    aside.mkdir()
    try:
        for name, data in files.items():
            (aside / name).write_bytes(data)
        text = yaml.safe_dump(described, sort_keys=False, default_flow_style=None, width=120)
        (aside / CAPTURE_FILE).write_text(text, encoding="utf-8")
        if folder.exists():
            folder.rmdir()
        aside.rename(folder)
    finally:
        shutil.rmtree(aside, ignore_errors=True)


def _content(folder: Path, frame: RgbdFrame, depth_scale_m: float) -> tuple[dict[str, bytes], dict[str, Any]]:
    """File contents by name, and the keys of `capture.yaml`."""
    files: dict[str, bytes] = {}
    described: dict[str, Any] = {"unit": "m"}
    if is_depth_image(frame, depth_scale_m):
        described |= {"depth": DEPTH_FILE, "depth_scale_m": float(depth_scale_m)}
        files[DEPTH_FILE] = encode_png(_counts(folder, frame, depth_scale_m))
    else:
        height, width = frame.cloud_m.shape[:2]
        described["cloud"] = CLOUD_FILE
        if frame.organised:
            described |= {"cloud_width": width, "cloud_height": height}
        files[CLOUD_FILE] = encode_ply(frame.points_m, (width, height) if frame.organised else None)
    if frame.image is not None:
        described["image"] = IMAGE_FILES[0]
        files[IMAGE_FILES[0]] = encode_png(frame.image)
    if frame.intrinsics is not None:
        camera = asdict(frame.intrinsics)
        described["intrinsics"] = {k: int(x) if k in ("width", "height") else float(x) for k, x in camera.items()}
    if frame.timestamp_ns is not None:
        described["timestamp_ns"] = int(frame.timestamp_ns)
    described |= {"sensor": frame.sensor, "simulated": bool(frame.simulated)}
    return files, described


def is_depth_image(frame: RgbdFrame, tolerance_m: float) -> bool:
    """True when depth and intrinsics alone give the frame's cloud back, within a tolerance in metres."""
    if frame.intrinsics is None or not frame.organised:
        return False
    if frame.cloud_m.shape[:2] != (frame.intrinsics.height, frame.intrinsics.width):
        return False
    again = frame.intrinsics.backproject(frame.cloud_m[..., 2])
    off = np.abs(again - frame.cloud_m)[np.isfinite(frame.cloud_m[..., 2])]
    return bool((off <= tolerance_m).all() and (frame.cloud_m[..., 2][np.isfinite(frame.cloud_m[..., 2])] > 0).all())


def _counts(folder: Path, frame: RgbdFrame, depth_scale_m: float) -> np.ndarray[Any, np.dtype[np.uint16]]:
    depth_m = np.nan_to_num(frame.cloud_m[..., 2])
    farthest = float(depth_m.max(initial=0.0))
    if np.rint(farthest / depth_scale_m) > _MAX_COUNT:
        raise CaptureError(
            f"{folder}: the farthest point is at {farthest:.3f} m, 16 bits reach {_MAX_COUNT * depth_scale_m:.3f} m at "
            f"depth_scale_m {depth_scale_m:g}; use {farthest / _MAX_COUNT:.2g} or more"
        )
    return np.rint(depth_m / depth_scale_m).astype(np.uint16)
