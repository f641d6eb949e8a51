"""Folders of numbered depth images and pictures: what BOP scenes and the layouts of Open3D and FoundationPose share."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.description import Unit
from tubepose.capture.formats.depth_images import read_depth
from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.capture.images import read_picture
from tubepose.capture.registration import METRES_PER_UNIT, depth_to_metres
from tubepose.errors import CaptureError
from tubepose.transforms import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class DepthView:
    """One depth image of a folder with its picture and its camera.

    Attributes:
        index: Number of the frame.
        depth: The depth image.
        picture: The picture, pixel to pixel with it; None without one.
        K: Camera matrix, shape (3, 3), pixels.
        size: (width, height) that the camera matrix is for, where the folder says so.
        metres_per_count: As the folder says it; None where it does not.
    """

    index: int
    depth: Path
    picture: Path | None
    K: FloatArray
    size: tuple[int, int] | None = None
    metres_per_count: float | None = None


@dataclass(frozen=True, slots=True)
class GivenScale:
    """What the user says about depth images.

    Attributes:
        unit: Unit of one count where no scale is known.
        depth_scale_m: Metres per count; it overrides what files say.
    """

    unit: Unit | None = None
    depth_scale_m: float | None = None

    def metres_per_count(self, depth: NDArray[np.generic], where: Path, stated: float | None, hint: str = "") -> float:
        """Metres per count of a depth image.

        Raises:
            CaptureError: Nobody says it, or whole numbers are called metres.
        """
        unit_m = METRES_PER_UNIT[self.unit] if self.unit is not None else None
        scale = next((known for known in (self.depth_scale_m, stated, unit_m) if known is not None), None)
        if scale is None:
            raise CaptureError(
                f"{where}: the unit of the depth images is not stated; add --depth-scale METRES, the metres of one "
                f"count (0.001 for millimetres{hint}), or --unit mm; in a session "
                "write 'depth_scale_m:' into session.yaml"
            )
        if scale == 1 and depth.dtype.kind != "f":
            raise CaptureError(
                f"{where}: {depth.dtype.itemsize * 8}-bit counts cannot be whole metres; add --unit mm, or "
                "--depth-scale METRES (metres of one count)"
            )
        return scale


def read_views(
    views: Sequence[DepthView], name: str, where: Path, given: GivenScale, hint: str = ""
) -> Iterator[RgbdFrame]:
    """Yield a frame for each view; a bad one stops none of the others.

    Args:
        views: What to read, in order.
        name: Of the capture.
        where: The folder, for messages.
        given: What the user says about the depth.
        hint: What messages add about the unit.

    Raises:
        CaptureError: After the last frame, if some could not be read: the first of them and how many there are.
    """
    problems: list[str] = []
    for view in views:
        try:
            frame = _read_view(view, name, given, hint)
        except CaptureError as problem:
            problems.append(str(problem))
        else:
            yield frame
    if problems:
        others = f" ({len(problems)} of {len(views)} frames of {where} cannot be read)" if len(views) > 1 else ""
        raise CaptureError(f"{problems[0]}{others}")


def _read_view(view: DepthView, name: str, given: GivenScale, hint: str) -> RgbdFrame:
    counts = read_depth(view.depth)
    scale = given.metres_per_count(counts, view.depth, view.metres_per_count, hint)
    height, width = counts.shape
    if view.size is not None and view.size != (width, height):
        raise CaptureError(
            f"{view.depth}: {width} x {height} pixels, its camera matrix is for {view.size[0]} x {view.size[1]}; both "
            "must be of the same picture"
        )
    image = None if view.picture is None else read_picture(view.picture)
    if image is not None and image.shape[:2] != counts.shape:
        raise CaptureError(
            f"{view.depth}: {width} x {height} pixels, {view.picture} has {image.shape[1]} x {image.shape[0]}; align "
            "the depth to the picture when you record"
        )
    (fx, _, cx), (_, fy, cy) = view.K[:2].tolist()
    camera = CameraIntrinsics(width, height, fx, fy, cx, cy)
    if camera.fault:
        raise CaptureError(f"{view.depth}: its camera has {camera.fault}")
    return RgbdFrame(
        cloud_m=camera.backproject(depth_to_metres(counts, scale)),
        image=image,
        intrinsics=camera,
        timestamp_ns=None,
        capture=name,
        index=view.index,
    )


def camera_matrix(numbers: object, where: Path) -> FloatArray:
    """Camera matrix (3, 3), pixels, from 9 numbers or 3 rows of 3; row by row, or column by column as Open3D writes it.

    Raises:
        CaptureError: Other numbers, a focal length that is not positive, or skew.
    """
    try:
        K = np.asarray(numbers, dtype=np.float64).reshape(3, 3)
    except (ValueError, TypeError, OverflowError):
        K = np.zeros((3, 3))
    if K[2, 0] != 0 and K[0, 2] == K[1, 2] == 0:
        K = K.T
    good = np.isfinite(K).all() and min(K[0, 0], K[1, 1]) > 0
    if not good or not np.array_equal(K[2], (0, 0, 1)) or K[1, 0] != 0 or abs(K[0, 1]) > 1e-6 * K[0, 0]:
        raise CaptureError(
            f"{where}: expected a camera matrix of 3 x 3 numbers, fx 0 cx, 0 fy cy, 0 0 1, found {str(numbers)[:120]}"
        )
    return K
