"""Clouds made ready for the estimators: units, invalid points, and the projection into an image's pixels.

The paper's assumption 3 wants every pixel to have its point. Where a sensor does not give that, the recorded
calibration does: `project_cloud` puts the cloud into the image's grid.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.errors import CaptureError
from tubepose.transforms import FloatArray, transform_points

METRES_PER_UNIT = {"m": 1.0, "mm": 1.0e-3}

# An organised cloud whose points miss their pixels by more than this is no pinhole image of its camera frame.
_MAX_RESIDUAL_PX = 1.0
_MIN_POINTS = 100


MIRROR_PIXELS = 4000
"""So many pixels, evenly spread, tell a mirrored cloud."""
_MOVED_SHARE = 0.5
"""A centre elsewhere has to leave this share, or less, of what lines of sight from the origin leave: a lens's
distortion, which no centre explains, is not taken for a cloud that was moved."""
_LENS_SHARE = 0.01
"""RMS residual of a pinhole fit to a camera with a usual lens's distortion, as a share of the image's longer side;
clouds whose pixels are in no order leave a quarter."""
FARTHEST_M = 1e4
"""No sensor of racks sees as far: numbers like this mark a missing point."""


def clean_cloud(xyz: ArrayLike, metres_per_unit: float) -> FloatArray:
    """Coordinates in metres, with NaN for every invalid point.

    Sensors mark a missing point by NaN (Zivid, ROS), by (0, 0, 0) (PhoXi) or by a number that is no distance; all come
    out as NaN.

    Args:
        xyz: Array of shape (..., 3) in the source's unit.
        metres_per_unit: 1 for metres, 0.001 for millimetres.
    """
    points = np.array(xyz, dtype=np.float64)
    with np.errstate(invalid="ignore", over="ignore"):  # NaN is no distance either
        invalid = ~(np.abs(points) * metres_per_unit < FARTHEST_M).all(axis=-1) | (points == 0).all(axis=-1)
    points *= metres_per_unit
    points[invalid] = np.nan
    return points


def depth_to_metres(counts: NDArray[np.generic], metres_per_count: float) -> FloatArray:
    """Depth (H, W) in metres from counts; zero, negative, non-finite and 65535 of 16 bits (overflow) become NaN.

    So does what is farther than `FARTHEST_M`: renderers write 1e10 where nothing is.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        depth = counts.astype(np.float64) * metres_per_count
        invalid = ~((depth > 0) & (depth < FARTHEST_M))
    if counts.dtype.kind == "u":
        invalid |= counts == np.iinfo(np.uint16).max
    depth[invalid] = np.nan
    return depth


def project_cloud(points_m: FloatArray, T_image_cloud: FloatArray, intrinsics: CameraIntrinsics) -> FloatArray:
    """Organise a cloud by the pixels of an image: a z-buffer in which the nearest point wins.

    Args:
        points_m: Array of shape (..., 3), frame of the cloud, metres.
        T_image_cloud: Array of shape (4, 4); maps cloud points to the image's camera frame, metres.
        intrinsics: Of the image.

    Returns:
        Array of shape (H, W, 3), camera frame of the image, metres. Points keep their measured coordinates: they are
        not moved to the pixel's centre. NaN where no point falls. Points that the image cannot see but that no
        nearer point covers stay.
    """
    points = transform_points(T_image_cloud, points_m.reshape(-1, 3))
    points = points[np.isfinite(points).all(axis=1)]
    uv = np.rint(intrinsics.project(points))
    size = (intrinsics.width, intrinsics.height)
    inside = (uv >= 0).all(axis=1) & (uv < size).all(axis=1)
    points, uv = points[inside], uv[inside].astype(np.intp)
    pixel = uv[:, 1] * intrinsics.width + uv[:, 0]
    # Far to near: of several points in one pixel NumPy keeps the last that is assigned.
    order = np.argsort(-points[:, 2], kind="stable")
    organised = np.full((intrinsics.height * intrinsics.width, 3), np.nan)
    organised[pixel[order]] = points[order]
    return organised.reshape(intrinsics.height, intrinsics.width, 3)


def known_intrinsics(frame: RgbdFrame) -> CameraIntrinsics | None:
    """Intrinsics of a frame: its own, else those that its organised cloud implies; None where neither is there."""
    if frame.intrinsics is None and frame.organised:
        return estimate_intrinsics(frame.cloud_m)
    return frame.intrinsics


def estimate_intrinsics(cloud_m: FloatArray) -> CameraIntrinsics | None:
    """Pinhole intrinsics that an organised cloud implies: least squares of u on X/Z and of v on Y/Z.

    Args:
        cloud_m: Array of shape (H, W, 3), camera frame, metres, NaN for invalid pixels.

    Returns:
        The intrinsics, or None where the cloud is no pinhole image: fewer than 100 points in front of the camera,
        points on one line of sight, or an RMS residual above 1 px along u or v.
    """
    lines = _fit_lines(cloud_m)
    if lines is None or min(lines[0][0], lines[1][0]) <= 0:
        return None
    (fx, cx), (fy, cy) = lines
    return CameraIntrinsics(cloud_m.shape[1], cloud_m.shape[0], fx, fy, cx, cy)


def is_mirrored(cloud_m: FloatArray) -> bool:
    """Whether an organised cloud (H, W, 3) is a camera's view in a mirror: x or y, not both, run against its pixels.

    Some pixels of it are looked at. A cloud that is turned with its pixels, or that is no camera's, is not mirrored.
    """
    step = max(1, int(np.sqrt(cloud_m.shape[0] * cloud_m.shape[1] / MIRROR_PIXELS)))
    lines = _fit_lines(cloud_m[::step, ::step])
    return lines is not None and lines[0][0] * lines[1][0] < 0


def refuse_mirrored(frame: RgbdFrame) -> None:
    """Say so where a frame's cloud is mirrored: poses in it would be, too.

    Raises:
        CaptureError: It is.
    """
    if frame.organised and is_mirrored(frame.cloud_m):
        raise CaptureError(
            f"frame {frame.index}: the cloud is mirrored against its pixels; expected x to the right of the image, "
            "y down and z forward: turn the sign of one axis when you export it"
        )


def refuse_foreign_frame(frame: RgbdFrame) -> None:
    """Say so where a frame's organised cloud is not in its camera's frame but in another one, a robot's say.

    Raises:
        CaptureError: The lines of sight of its pixels meet in a point that is not the origin.
    """
    center_m = foreign_center_m(frame.cloud_m) if frame.organised else None
    if center_m is not None:
        x, y, z = (f"{value:.2f}" for value in center_m)
        raise CaptureError(
            f"frame {frame.index}: the cloud is not in the camera's frame: the lines of sight of its pixels meet at "
            f"({x}, {y}, {z}) m; expected at the origin, with x to the right of the image, y down and z forward: "
            "export it in the camera's coordinate space, without a transformation to a robot or a marker"
        )


def foreign_center_m(cloud_m: FloatArray) -> FloatArray | None:
    """Where the lines of sight of an organised cloud meet, if that is not the origin: direct linear transformation.

    A pinhole camera at the origin maps points to pixels by a matrix (3, 3), wherever its axes point; one elsewhere by
    a matrix (3, 4), whose null space is its centre (Hartley and Zisserman, sections 6.2 and 7.1). Some pixels are
    looked at. Points of one plane fit both, so that nothing is told by them.

    Args:
        cloud_m: Array of shape (H, W, 3), metres, NaN for invalid pixels.

    Returns:
        The centre, shape (3,), metres; None where the lines meet at the origin within a residual (RMS) of 1 px, where
        no camera explains the cloud clearly better, and with fewer than 100 points.
    """
    step = max(1, int(np.sqrt(cloud_m.shape[0] * cloud_m.shape[1] / MIRROR_PIXELS)))
    some = cloud_m[::step, ::step]
    v, u = np.nonzero(np.isfinite(some).all(axis=-1))
    if len(u) < _MIN_POINTS:
        return None
    points: FloatArray = some[v, u]
    pixels = np.asarray(np.column_stack([u, v]) * float(step), float)
    _, here_px = _fit_projection(points, pixels)
    if here_px <= _MAX_RESIDUAL_PX:
        return None
    middle = points.mean(axis=0)
    scale = float(np.abs(points - middle).max())
    matrix, anywhere_px = _fit_projection(np.column_stack([(points - middle) / scale, np.ones(len(points))]), pixels)
    lens_px = _LENS_SHARE * max(cloud_m.shape[:2])
    if anywhere_px > max(_MAX_RESIDUAL_PX, min(lens_px, _MOVED_SHARE * here_px)):
        return None
    center = np.linalg.svd(matrix)[2][-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        center_m = middle + scale * center[:3] / center[3]
    return np.asarray(center_m) if np.isfinite(center_m).all() else None


def _fit_projection(points: FloatArray, pixels: FloatArray) -> tuple[FloatArray, float]:
    """Matrix (3, K) that maps points (N, K) to pixels (N, 2) with least algebraic error; its RMS residual, pixels."""
    size = float(np.abs(pixels).max()) or 1.0
    scaled = pixels / size - 0.5
    zero = np.zeros_like(points)
    rows = np.vstack(
        [
            np.hstack([points, zero, -scaled[:, :1] * points]),
            np.hstack([zero, points, -scaled[:, 1:] * points]),
        ]
    )
    matrix = np.linalg.eigh(rows.T @ rows)[1][:, 0].reshape(3, -1)
    seen = points @ matrix.T
    with np.errstate(divide="ignore", invalid="ignore"):
        off = size * (seen[:, :2] / seen[:, 2:] - scaled)
        rms = float(np.sqrt(2 * np.mean(off**2)))
    return matrix, rms if np.isfinite(rms) else float("inf")


def _fit_lines(cloud_m: FloatArray) -> tuple[tuple[float, float], tuple[float, float]] | None:
    """Focal length and principal point along u and along v, pixels; a length is negative where an axis is turned."""
    v, u = np.nonzero(np.isfinite(cloud_m).all(axis=-1) & (np.nan_to_num(cloud_m[..., 2]) > 0))
    if len(u) < _MIN_POINTS:
        return None
    points = cloud_m[v, u]
    horizontal = _fit_line(points[:, 0] / points[:, 2], u)
    vertical = _fit_line(points[:, 1] / points[:, 2], v)
    return None if horizontal is None or vertical is None else (horizontal, vertical)


def _fit_line(tangent: FloatArray, pixel: NDArray[np.intp]) -> tuple[float, float] | None:
    """Focal length, which may be negative, and principal point of one axis, pixels; None where the fit is no camera."""
    t, p = tangent - tangent.mean(), pixel - pixel.mean()
    spread = float(t @ t)
    if spread <= 0:
        return None
    focal = float(t @ p) / spread
    rms = float(np.sqrt(np.mean((p - focal * t) ** 2)))
    if focal == 0 or rms > _MAX_RESIDUAL_PX:
        return None
    return focal, float(pixel.mean() - focal * tangent.mean())
