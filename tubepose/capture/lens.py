"""Lens distortion and its removal: Brown-Conrady, rational polynomial and Kannala-Brandt (fisheye) models, by OpenCV.

A picture of a distorting lens is sampled anew on the pixels of a pinhole camera. Points of a cloud or a depth image
keep their coordinates, along the distorted lines of sight on which they were measured; they are only sorted into the
new pixels. (Brown 1966; Kannala and Brandt 2006; OpenCV's `calib3d` has the formulas.)
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tubepose.capture.frame import CameraIntrinsics
from tubepose.transforms import FloatArray

# Lenses that move no pixel by more are none: their coefficients are zeros with rounding.
_LEAST_SHIFT_PX = 0.01
# Inverting a distortion: when the iterations end, and what may be left, pixels.
_CRITERIA = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 60, 1e-10)
_LEFT_PX = 0.01
# A pixel and the one it is sampled from see lines of sight that are nearer than this, pixels.
_OTHER_PX = 5.0
# Normalised coordinates beyond this are no picture's.
_FARTHEST = 20.0

LensModel = Literal["polynomial", "fisheye"]
_MODELS: dict[str, LensModel] = {
    "plumb_bob": "polynomial",
    "rational_polynomial": "polynomial",
    "brown_conrady": "polynomial",
    "inverse_brown_conrady": "polynomial",
    "modified_brown_conrady": "polynomial",
    "equidistant": "fisheye",
    "fisheye": "fisheye",
    "kannala_brandt": "fisheye",
    "kannala_brandt4": "fisheye",
}
LENS_MODELS = tuple(_MODELS)
"""Names of `distortion_model` that are read, in small letters with underscores."""
_LENGTHS = {"polynomial": (4, 5, 8, 12, 14), "fisheye": (4,)}


def lens_model(name: str) -> LensModel | None:
    """The model that a CameraInfo's `distortion_model` names; None for one that is not read."""
    return _MODELS.get(name.strip().lower().replace(" ", "_"))


def coefficients_of(model: LensModel, values: FloatArray) -> tuple[float, ...] | None:
    """Coefficients filled up with zeros to a length that the model has; None for too many."""
    longer = [length for length in _LENGTHS[model] if length >= len(values)]
    if not longer:
        return None if np.any(values[_LENGTHS[model][-1] :]) else tuple(float(x) for x in values[: _LENGTHS[model][-1]])
    return tuple(float(value) for value in values) + (0.0,) * (longer[0] - len(values))


@dataclass(frozen=True, slots=True)
class PixelCamera:
    """A camera as a CameraInfo describes it: a pinhole camera behind a lens.

    Attributes:
        pinhole: The camera without its lens; also the one that pictures are sampled on.
        model: Of the lens; None for none.
        coefficients: Of the lens, in OpenCV's order.
    """

    pinhole: CameraIntrinsics
    model: LensModel | None = None
    coefficients: tuple[float, ...] = ()

    def project(self, points_m: FloatArray) -> FloatArray:
        """Pixels (..., 2) of camera-frame points (..., 3), metres, through the lens; NaN behind the camera."""
        if self.model is None:
            return self.pinhole.project(points_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = np.where(points_m[..., 2] > 0, points_m[..., 2], np.nan)
            return self._pixels(_distort(points_m[..., :2] / z[..., None], self.model, self.coefficients))

    def rays(self) -> FloatArray:
        """Direction of every pixel with z = 1, through the lens, shape (H, W, 3); NaN where the lens has none."""
        return self.pinhole.rays() if self.model is None else _rays(self)

    def backproject(self, depth_m: FloatArray) -> FloatArray:
        """Points (H, W, 3) of a depth image (H, W), metres, in the pixels as they were recorded."""
        return np.asarray(self.rays() * np.asarray(depth_m, dtype=float)[..., None])

    def rectify_cloud(self, cloud_m: FloatArray) -> FloatArray:
        """A cloud (H, W, 3) that goes pixel to pixel with the recorded picture, in the pinhole camera's pixels.

        Every new pixel gets the point of the recorded pixel that is nearest: coordinates stay as they were measured.
        """
        if self.model is None:
            return cloud_m
        inside, u, v = _nearest(_recorded_px(self), self.pinhole)
        return np.where(inside[..., None], cloud_m[v, u], np.nan)

    def rectify_picture(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """A picture (H, W) or (H, W, 3) in the pinhole camera's pixels, between pixels linearly; black outside."""
        if self.model is None:
            return picture
        seen = np.clip(np.nan_to_num(_recorded_px(self), nan=-1e4), -1e4, 1e5).astype(np.float32)
        return np.asarray(cv2.remap(picture, seen[..., 0], seen[..., 1], cv2.INTER_LINEAR), dtype=np.uint8)

    def _pixels(self, normalised: FloatArray) -> FloatArray:
        camera = self.pinhole
        return np.asarray(normalised * (camera.fx, camera.fy) + (camera.cx, camera.cy))

    def normalised(self) -> FloatArray:
        """Every pixel (u, v) in units of the focal length from the principal point, shape (H, W, 2)."""
        return self.pinhole.rays()[..., :2]


def without_idle_lens(camera: PixelCamera) -> PixelCamera:
    """The same camera, without its lens where that moves no pixel."""
    if camera.model is None:
        return camera
    shift = np.abs(
        _recorded_px(camera)[::8, ::8] - PixelCamera(camera.pinhole).project(camera.pinhole.rays())[::8, ::8]
    )
    return PixelCamera(camera.pinhole) if np.nanmax(shift, initial=0) < _LEAST_SHIFT_PX else camera


@lru_cache(maxsize=8)
def _recorded_px(camera: PixelCamera) -> FloatArray:
    """Where every pixel of the pinhole camera lies in the recorded picture, shape (H, W, 2); NaN where it does not.

    Far off the axis a polynomial turns back: a pixel there would show what another one sees.
    """
    pinhole = camera.pinhole
    K = np.array([[pinhole.fx, 0, pinhole.cx], [0, pinhole.fy, pinhole.cy], [0, 0, 1]], dtype=float)
    maps = cv2.fisheye.initUndistortRectifyMap if camera.model == "fisheye" else cv2.initUndistortRectifyMap
    size = (pinhole.width, pinhole.height)
    u_px, v_px = maps(K, np.array(camera.coefficients), np.eye(3), K, size, cv2.CV_32FC1)
    seen = np.stack([u_px, v_px], axis=-1).astype(float)
    inside, u, v = _nearest(seen, camera.pinhole)
    back = camera._pixels(_rays(camera)[v, u, :2]) - camera._pixels(camera.normalised())
    with np.errstate(invalid="ignore"):
        other = inside & ~(np.abs(back).max(axis=-1) <= _OTHER_PX)
    return np.where(other[..., None], np.nan, seen)


def _nearest(
    seen_px: FloatArray, size: CameraIntrinsics
) -> tuple[NDArray[np.bool_], NDArray[np.intp], NDArray[np.intp]]:
    """Which pixels (H, W, 2) lie in a picture, and the column and row of the nearest pixel (0 for the others)."""
    near = np.rint(seen_px)
    with np.errstate(invalid="ignore"):
        inside = np.asarray(((near >= 0) & (near < (size.width, size.height))).all(axis=-1))
    u, v = np.where(inside[..., None], near, 0).astype(np.intp).transpose(2, 0, 1)
    return inside, u, v


@lru_cache(maxsize=8)
def _rays(camera: PixelCamera) -> FloatArray:
    assert camera.model is not None
    seen = camera.normalised()
    ideal = _undistort(seen, camera.model, camera.coefficients)
    left = np.abs(_distort(ideal, camera.model, camera.coefficients) - seen) * (camera.pinhole.fx, camera.pinhole.fy)
    with np.errstate(invalid="ignore"):
        ideal = np.where((left.max(axis=-1) <= _LEFT_PX)[..., None], ideal, np.nan)
    return np.concatenate([ideal, np.ones((*ideal.shape[:-1], 1))], axis=-1)


def _distort(ideal: FloatArray, model: LensModel, coefficients: tuple[float, ...]) -> FloatArray:
    """Normalised coordinates (..., 2) behind the lens; NaN stays NaN, and what no picture reaches becomes NaN."""
    flat = ideal.reshape(-1, 2)
    with np.errstate(invalid="ignore"):
        good = np.asarray((np.abs(flat) < _FARTHEST).all(axis=1))
    points = np.ones((len(flat), 1, 3))
    points[good, 0, :2] = flat[good]
    still, turn, unit = np.zeros(3), np.zeros(3), np.eye(3)
    if model == "fisheye":
        seen = cv2.fisheye.projectPoints(points, turn, still, unit, np.array(coefficients))[0]
    else:
        seen = cv2.projectPoints(points, turn, still, unit, np.array(coefficients))[0]
    return np.where(good[:, None], np.asarray(seen, dtype=float).reshape(-1, 2), np.nan).reshape(ideal.shape)


def _undistort(seen: FloatArray, model: LensModel, coefficients: tuple[float, ...]) -> FloatArray:
    """Normalised coordinates (..., 2) before the lens, by OpenCV's iterations."""
    flat, unit, lens = np.ascontiguousarray(seen.reshape(-1, 1, 2)), np.eye(3), np.array(coefficients)
    if model == "fisheye":
        ideal = cv2.fisheye.undistortPoints(flat, unit, lens)
    elif hasattr(cv2, "undistortPointsIter"):  # OpenCV 4
        ideal = cv2.undistortPointsIter(flat, unit, lens, None, None, _CRITERIA)
    else:
        ideal = cv2.undistortPoints(flat, unit, lens, criteria=_CRITERIA)
    return np.asarray(ideal, dtype=float).reshape(seen.shape)
