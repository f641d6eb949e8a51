"""Depth images: PNG and TIFF, float TIFF, OpenEXR and NumPy arrays."""

from __future__ import annotations

import io
import os
import tokenize
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import MOST_PIXELS
from tubepose.capture.images import decode, depth_counts, read_bytes
from tubepose.errors import CaptureError

DEPTH_SUFFIXES = (".png", ".tiff", ".tif", ".exr", ".npy")
# What NumPy's reader raises for a damaged header.
_NO_ARRAY = (
    *(ValueError, OSError, EOFError, SyntaxError, TypeError, OverflowError, RecursionError, MemoryError, Warning),
    *(tokenize.TokenError, KeyError, IndexError, AttributeError),
)
_NPY, _EXR = b"\x93NUMPY", b"\x76\x2f\x31\x01"
_DEPTH_CHANNELS = ("z", "depth", "distance", "y", "v", "r")
"""Names that renderers give the channel of an EXR with the depth in it, without layers, best first."""


def read_depth(path: Path) -> NDArray[np.generic]:
    """A depth image as stored, shape (H, W): whole numbers of 16 bits or more, or floats.

    The content tells the format, not the name.

    Raises:
        CaptureError: Missing, cut, of another format, or no depth: 8 bits, or several channels.
    """
    head = _head(path)
    if head.startswith(_NPY):
        return _checked(_read_npy(path), path)
    if head.startswith(_EXR):
        return _checked(_read_exr(path), path)
    return depth_counts(decode(read_bytes(path), str(path)), str(path))


def _head(path: Path) -> bytes:
    try:
        with path.open("rb") as stream:
            return stream.read(8)
    except FileNotFoundError:
        raise CaptureError(f"{path}: no such file") from None
    except OSError as problem:
        raise CaptureError(f"{path}: cannot be read: {problem.strerror}") from None


def _checked(depth: NDArray[np.generic], path: Path) -> NDArray[np.generic]:
    """A plain copy of what is surely depth."""
    if depth.ndim == 3 and 1 in (depth.shape[0], depth.shape[2]):
        depth = depth[..., 0] if depth.shape[2] == 1 else depth[0]
    return depth_counts(depth, str(path))


def _read_npy(path: Path) -> NDArray[np.generic]:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # NumPy warns of damaged headers that it can still make something of
            # Mapped, so that nothing is taken for an array that is larger than its file.
            mapped = np.load(path, mmap_mode="r", allow_pickle=False)
            # A copy in the machine's byte order.
            return np.array(mapped, dtype=mapped.dtype.newbyteorder("="))
    except _NO_ARRAY:
        raise CaptureError(
            f"{path}: truncated or damaged; expected a whole .npy file of one array of numbers"
        ) from None


@contextmanager
def _silence() -> Iterator[None]:
    """Nothing of this process reaches stderr inside, or is printed: OpenEXR does both with what it raises as well."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        with redirect_stdout(io.StringIO()):
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _read_exr(path: Path) -> NDArray[np.generic]:
    import OpenEXR

    try:
        with _silence(), OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            (left, top), (right, bottom) = file.header()["dataWindow"]
        if (int(right) - int(left) + 1) * (int(bottom) - int(top) + 1) > MOST_PIXELS:
            raise CaptureError(f"{path}: claims more than {MOST_PIXELS} pixels; expected a depth image of a camera")
        with _silence(), OpenEXR.File(str(path), separate_channels=True) as file:
            channels = {name: np.array(channel.pixels) for name, channel in file.channels().items()}
    except (RuntimeError, ValueError, OSError, KeyError, TypeError, IndexError, MemoryError):
        raise CaptureError(f"{path}: truncated or damaged; expected a whole OpenEXR file") from None
    best: dict[str, NDArray[np.generic]] = {}
    for name, pixels in channels.items():
        best.setdefault(name.rsplit(".", 1)[-1].casefold(), pixels)
    for name in _DEPTH_CHANNELS:
        # Red is depth only where it is the one channel, or the others say the same.
        same = name != "r" or all(np.array_equal(best[k], best["r"], equal_nan=True) for k in best if k in "rgb")
        if name in best and same:
            return best[name]
    raise CaptureError(
        f"{path}: expected one channel of depth ({', '.join(_DEPTH_CHANNELS)}), found {', '.join(channels) or 'none'}"
    )
