"""Image files and encoded images: 8-bit pictures in RGB order, depth."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tubepose.capture.frame import MOST_PIXELS
from tubepose.errors import CaptureError

_PNG = b"\x89PNG"
# What a damaged header makes Pillow raise.
_UNREADABLE = (
    *(OSError, SyntaxError, ValueError, struct.error, IndexError, KeyError, TypeError),
    *(ArithmeticError, AttributeError, MemoryError, RuntimeError),
)
# Percentiles that a picture of more than 8 bits is stretched between: a reflection must not turn the rest black.
_STRETCH_PERCENT = (0.5, 99.5)
# Noisy depth repeats nothing but runs of invalid pixels: no search for strings is 10 times as fast and nearly as small.
# A level that is given makes libpng choose a filter for every row.
_NOISY_PNG = [cv2.IMWRITE_PNG_COMPRESSION, 9, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]


def read_bytes(path: Path) -> bytes:
    """The content of a file; a missing or unreadable one is a `CaptureError` in one line."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise CaptureError(f"{path}: no such file") from None
    except OSError as problem:
        raise CaptureError(f"{path}: cannot be read: {problem.strerror}") from None


def _claimed_pixels(data: bytes) -> int:
    """Pixels that the header of an image claims; 0 where it is none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(io.BytesIO(data)) as image:
                return image.width * image.height
        except Image.DecompressionBombError:
            return MOST_PIXELS + 1
        except _UNREADABLE:
            return 0


def _is_cut_png(data: bytes) -> bool:
    """Whether a PNG breaks off before its end, or has a chunk of another checksum: libpng would complain on stderr."""
    at = len(_PNG) + 4
    while at + 12 <= len(data):
        length = int.from_bytes(data[at : at + 4], "big")
        end = at + 8 + length
        if end + 4 > len(data) or zlib.crc32(data[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return True
        if data[at + 4 : at + 8] == b"IEND":
            return False
        at = end + 4
    return True


def decode(data: bytes, where: str) -> NDArray[np.generic]:
    """Pixels of a PNG, JPEG or TIFF as they are stored, shape (H, W) or (H, W, C), OpenCV's channel order.

    Raises:
        CaptureError: Cut, damaged, no image at all, or one of more than `MOST_PIXELS`.
    """
    claimed = _claimed_pixels(data)
    if claimed > MOST_PIXELS:
        raise CaptureError(f"{where}: claims more than {MOST_PIXELS} pixels; expected a camera's picture")
    cut = data.startswith(_PNG) and _is_cut_png(data)
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        pixels = None if cut or not claimed else cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # a header that claims more pixels than OpenCV opens
        pixels = None
    if pixels is None:
        what = "truncated or damaged" if cut else "cannot be decoded"
        raise CaptureError(f"{where}: {what}; expected a whole PNG, JPEG or TIFF image")
    return np.asarray(pixels)


def to_picture(pixels: NDArray[np.generic], *, bgr: bool) -> NDArray[np.uint8]:
    """Pixels of any depth as uint8, shape (H, W) or (H, W, 3) in RGB order; an alpha channel is dropped."""
    if pixels.ndim == 3 and pixels.shape[2] <= 2:
        pixels = pixels[..., 0]
    if pixels.ndim == 3:
        pixels = pixels[..., 2::-1] if bgr else pixels[..., :3]
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels, dtype=np.uint8)
    levels = pixels.astype(np.float64)
    finite = levels[np.isfinite(levels)]
    low, high = np.percentile(finite, _STRETCH_PERCENT) if finite.size else (0.0, 1.0)
    scaled = (np.nan_to_num(levels, nan=low) - low) / max(high - low, 1e-12)
    return np.asarray(np.rint(np.clip(scaled, 0, 1) * 255), dtype=np.uint8)


def read_picture(path: Path) -> NDArray[np.uint8]:
    """A PNG or JPEG file as uint8 picture, shape (H, W) or (H, W, 3) in RGB order."""
    return to_picture(decode(read_bytes(path), str(path)), bgr=True)


def depth_counts(counts: NDArray[np.generic], where: str) -> NDArray[np.generic]:
    """Decoded pixels that must be depth, shape (H, W): whole numbers of 16 bits or more, or floats.

    Raises:
        CaptureError: Fewer bits, no numbers, or more than one channel.
    """
    if counts.ndim != 2 or counts.dtype.kind not in "uif" or counts.dtype.itemsize < 2:
        channels = 1 if counts.ndim == 2 else counts.shape[2] if counts.ndim == 3 else f"{counts.ndim}-dimensional"
        raise CaptureError(
            f"{where}: expected a depth image of 16 bits and 1 channel (or of floats), found "
            f"{counts.dtype.itemsize * 8} bits and {channels} channel(s); record the raw depth, not a coloured "
            "picture of it"
        )
    return counts


def is_depth_png(data: bytes | NDArray[np.uint8]) -> bool:
    """Whether an encoded image is a PNG of 16 bits and one channel, by its header (PNG specification, IHDR)."""
    start = bytes(data[:26])
    return start.startswith(_PNG) and len(start) == 26 and (start[24], start[25]) == (16, 0)


def encode_png(pixels: NDArray[np.uint8] | NDArray[np.uint16]) -> bytes:
    """PNG of a gray (H, W) or RGB (H, W, 3) picture, or of 16-bit depth; the same pixels give the same bytes."""
    return _encode(".png", pixels, [cv2.IMWRITE_PNG_COMPRESSION, 6])


def encode_depth_png(counts: NDArray[np.uint16]) -> bytes:
    """PNG of finely stepped depth of 16 bits (H, W); the same counts give the same bytes."""
    return _encode(".png", counts, _NOISY_PNG)


def encode_jpeg(pixels: NDArray[np.uint8], quality: int = 95) -> bytes:
    """JPEG of a gray (H, W) or RGB (H, W, 3) picture; the same pixels give the same bytes."""
    return _encode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_OPTIMIZE, 1])


def _encode(kind: str, pixels: NDArray[np.uint8] | NDArray[np.uint16], options: list[int]) -> bytes:
    stored = pixels[..., ::-1] if pixels.ndim == 3 else pixels
    done, data = cv2.imencode(kind, np.ascontiguousarray(stored), options)
    if not done:
        raise ValueError(f"no {kind} can be made of an array of shape {pixels.shape} and type {pixels.dtype}")
    return bytes(data.tobytes())
