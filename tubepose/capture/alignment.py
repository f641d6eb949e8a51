"""The paper's assumption 3 for recordings: cloud and picture brought into the pixels of one pinhole camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tubepose.capture.calibration import contradiction_px
from tubepose.capture.frame import CameraIntrinsics
from tubepose.capture.lens import PixelCamera
from tubepose.capture.registration import project_cloud
from tubepose.errors import CaptureError
from tubepose.transforms import FloatArray, transform_points

# A cloud whose points project this far from their pixels is not organised by that camera.
_MAX_MEDIAN_OFF_PX = 2.0
_CHECKED_PIXELS = 20_000
_STILL = 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """What was recorded of one moment, before it is brought together.

    Attributes:
        cloud_m: Array of shape (H, W, 3), coordinate frame of its sensor, metres; (1, N, 3) without pixels.
        image: Picture, or None.
        source_camera: Of the cloud or depth, where known.
        image_camera: Of the picture, where known.
        T_image_cloud: Maps the cloud's points to the picture's frame, where known.
        source: Name of the cloud's topic and its coordinate frame, for messages.
        shot: The same of the picture.
        is_depth: Whether the cloud is a depth image's, so that `source_camera` made its points.
        claims_alignment: Whether the depth's name says that it goes pixel to pixel with the picture.
        infos: Names of both CameraInfo topics.
    """

    cloud_m: FloatArray
    image: NDArray[np.uint8] | None
    source_camera: PixelCamera | None
    image_camera: PixelCamera | None
    T_image_cloud: FloatArray | None
    source: tuple[str, str]
    shot: tuple[str, str]
    is_depth: bool
    claims_alignment: bool
    infos: tuple[str, str]


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """Cloud and picture, pixel to pixel.

    Attributes:
        cloud_m: Array of shape (H, W, 3), camera frame, metres.
        image: Picture of the same pixels, or None.
        camera: The pinhole camera of both, where known.
        note: What was taken for granted, in words; may be empty.
    """

    cloud_m: FloatArray
    image: NDArray[np.uint8] | None
    camera: CameraIntrinsics | None
    note: str = ""


def align(views: Views, where: str) -> Aligned:
    """Bring cloud and picture together: as they are, without their lens, or the cloud projected into the picture.

    Raises:
        CaptureError: They are not pixel to pixel and what is needed to project is missing, or two CameraInfos
            contradict each other.
    """
    if views.image is None:
        return _alone(views)
    if views.image_camera is None:
        return _by_pixels(views, where)
    T_image_cloud = views.T_image_cloud
    if T_image_cloud is None:
        cloud = _with_pixels(views.cloud_m, views.image_camera)
        if not _organised_by(cloud, views.image_camera):
            raise CaptureError(_not_aligned(views, where))
        told = (
            f"no transform between '{views.source[1]}' and '{views.shot[1]}' is recorded: depth and picture were taken"
        )
        note = f"{told} to go pixel to pixel, as one CameraInfo fits both" if views.source[1] != views.shot[1] else ""
        return _in_pixels(cloud, views.image, views.image_camera, note)
    still = bool(np.abs(T_image_cloud - np.eye(4)).max() <= _STILL)
    if still and views.is_depth and views.source_camera is not None:
        _refuse_contradiction(views, where)
    moved = views.cloud_m if still else transform_points(T_image_cloud, views.cloud_m)
    moved = _with_pixels(moved, views.image_camera)
    if _organised_by(moved, views.image_camera):
        return _in_pixels(moved, views.image, views.image_camera)
    pinhole = views.image_camera.pinhole
    projected = project_cloud(moved, np.eye(4), pinhole)
    return Aligned(projected, views.image_camera.rectify_picture(views.image), pinhole)


def _alone(views: Views) -> Aligned:
    """A cloud without a picture, in its own camera's pixels where it has one."""
    camera = views.source_camera
    if camera is None:
        return Aligned(views.cloud_m, None, None)
    cloud = views.cloud_m
    if views.T_image_cloud is not None and not views.is_depth:
        cloud = transform_points(views.T_image_cloud, cloud)
    cloud = _with_pixels(cloud, camera)
    if not _organised_by(cloud, camera):
        return Aligned(cloud, None, None)
    return Aligned(camera.rectify_cloud(cloud), None, camera.pinhole)


def _by_pixels(views: Views, where: str) -> Aligned:
    """A picture without a camera: of the cloud's size it is taken as it is."""
    assert views.image is not None
    cloud, camera = views.cloud_m, views.source_camera
    if cloud.shape[0] == 1 or cloud.shape[:2] != views.image.shape[:2]:
        raise CaptureError(_not_aligned(views, where))
    if camera is None or not _organised_by(cloud, camera):
        return Aligned(cloud, views.image, None)
    return _in_pixels(cloud, views.image, camera)


def _in_pixels(cloud: FloatArray, image: NDArray[np.uint8], camera: PixelCamera, note: str = "") -> Aligned:
    return Aligned(camera.rectify_cloud(cloud), camera.rectify_picture(image), camera.pinhole, note)


def _with_pixels(cloud: FloatArray, camera: PixelCamera) -> FloatArray:
    """A cloud in one row that has a point for every pixel of a camera, in the camera's rows if they fit."""
    size = (camera.pinhole.height, camera.pinhole.width)
    if cloud.shape[0] != 1 or cloud.shape[1] != size[0] * size[1] or 1 in size:
        return cloud
    rows = cloud.reshape(*size, 3)
    return rows if _organised_by(rows, camera) else cloud


def _organised_by(cloud: FloatArray, camera: PixelCamera) -> bool:
    """True when the points of a cloud project onto their own pixels; a look at some of them tells."""
    if cloud.shape[:2] != (camera.pinhole.height, camera.pinhole.width):
        return False
    v, u = np.nonzero(np.isfinite(cloud[..., 2]))
    step = max(1, len(u) // _CHECKED_PIXELS)
    v, u = v[::step], u[::step]
    off = np.abs(camera.project(cloud[v, u]) - np.stack([u, v], axis=1)).max(axis=1)
    return len(off) == 0 or bool(np.median(np.nan_to_num(off, nan=np.inf)) <= _MAX_MEDIAN_OFF_PX)


def _refuse_contradiction(views: Views, where: str) -> None:
    """Of one camera there is one calibration: which of two is right, cannot be known."""
    assert views.source_camera is not None
    assert views.image_camera is not None
    worst = contradiction_px(views.source_camera, views.image_camera, claimed=views.claims_alignment)
    if worst is None:
        return
    one, other = _camera_words(views.source_camera), _camera_words(views.image_camera)
    raise CaptureError(
        f"{where}: two CameraInfos contradict each other by up to {worst:.1f} pixels: {views.infos[0]} ({one}) of the "
        f"depth and {views.infos[1]} ({other}) of the picture, though both are in frame '{views.shot[1]}'; name the "
        f"right one: --info-topic {views.infos[0]} or --info-topic {views.infos[1]}"
    )


def _camera_words(camera: PixelCamera) -> str:
    pinhole = camera.pinhole
    lens = f", lens {camera.model}" if camera.model is not None else ""
    return f"fx {pinhole.fx:.2f}, fy {pinhole.fy:.2f}, cx {pinhole.cx:.2f}, cy {pinhole.cy:.2f}{lens}"


def _not_aligned(views: Views, where: str) -> str:
    assert views.image is not None
    height, width = views.cloud_m.shape[:2]
    size = f"{width} x {height}" if height > 1 else f"{width} points in no order"
    return (
        f"{where}: the image is {views.image.shape[1]} x {views.image.shape[0]} pixels in frame '{views.shot[1]}', the "
        f"cloud {size} in frame '{views.source[1]}', and they are not pixel to pixel; record the cloud in the image's "
        "frame (align the depth) or /tf_static between the frames, and the image's CameraInfo with it"
    )


def without_picture(views: Views) -> Views:
    """The same without the picture and its camera."""
    return replace(views, image=None, image_camera=None)
