"""`capture.yaml`: what a person or a writer says about a capture folder."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictInt, model_validator

from tubepose.capture.frame import CameraIntrinsics
from tubepose.transforms import FloatArray

CAPTURE_FILE = "capture.yaml"
CLOUD_FILE = "cloud.ply"
DEPTH_FILE = "depth.png"
CLOUD_FILES = (CLOUD_FILE, "cloud.pcd", "cloud.ptx")
DEPTH_FILES = (DEPTH_FILE, "depth.tiff", "depth.tif", "depth.exr", "depth.npy")
IMAGE_FILES = ("image.png", "image.jpg", "image.jpeg")

Unit = Literal["m", "mm"]
_Row = tuple[float, float, float, float]
_FORBID = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
# Counts coarser than this are a scale given in the wrong unit; floats can be whole metres.
_MAX_DEPTH_SCALE_M = 0.01


def is_depth_scale(metres_per_count: float) -> bool:
    """Whether a number can be the metres of one count: up to 0.01, or 1 for floats that are metres."""
    return 0 < metres_per_count <= _MAX_DEPTH_SCALE_M or metres_per_count == 1


class IntrinsicsEntry(BaseModel):
    """Pinhole intrinsics as `capture.yaml` has them, pixels."""

    model_config = _FORBID
    width: int = Field(gt=0)
    height: int = Field(gt=0)
    fx: float = Field(gt=0)
    fy: float = Field(gt=0)
    cx: float
    cy: float

    @model_validator(mode="after")
    def _check(self) -> IntrinsicsEntry:
        if fault := self.camera().fault:
            raise ValueError(fault)
        return self

    def camera(self) -> CameraIntrinsics:
        """The same as the library's type."""
        return CameraIntrinsics(**self.model_dump())


class CaptureFile(BaseModel):
    """`capture.yaml`; docs/capture-format.md explains every key.

    Attributes:
        unit: Of the cloud's coordinates and of `T_image_cloud`'s translation; of one depth count
            where `depth_scale_m` is not given.
        cloud: Cloud in the folder: PLY, PCD or PTX.
        cloud_width: Width of an organised cloud, where neither PLY header nor image tells it.
        cloud_height: Its height.
        depth: Depth image in the folder: whole numbers of 16 bits or more, or floats.
        depth_scale_m: Metres per count of the depth image.
        image: Picture in the folder.
        intrinsics: Of the image; of the depth image too, unless `cloud_intrinsics` is there.
        cloud_intrinsics: Of a depth image that is not pixel to pixel with the image.
        T_image_cloud: Rows of the (4, 4) transform from the cloud's frame to the image's camera frame. Its presence
            means that image and cloud are not pixel to pixel: the cloud is projected.
        timestamp_ns: Integer nanoseconds.
        sensor: What recorded it.
        simulated: True if no sensor did.
    """

    model_config = _FORBID
    unit: Unit
    cloud: str | None = None
    cloud_width: int | None = Field(default=None, gt=0)
    cloud_height: int | None = Field(default=None, gt=0)
    depth: str | None = None
    depth_scale_m: Annotated[float, Field(gt=0)] | None = None
    image: str | None = None
    intrinsics: IntrinsicsEntry | None = None
    cloud_intrinsics: IntrinsicsEntry | None = None
    T_image_cloud: tuple[_Row, _Row, _Row, _Row] | None = None
    timestamp_ns: Annotated[StrictInt, Field(ge=0, lt=2**63)] | None = None
    sensor: str = "unknown"
    simulated: StrictBool = False

    @model_validator(mode="after")
    def _check(self) -> CaptureFile:
        if self.cloud is not None and self.depth is not None:
            raise ValueError("'cloud' and 'depth' are both given; keep the one that is to be used")
        if (self.cloud_width is None) != (self.cloud_height is None):
            raise ValueError("cloud_width and cloud_height belong together; give both or neither")
        if self.depth_scale_m is not None and not is_depth_scale(self.depth_scale_m):
            raise ValueError(
                f"depth_scale_m is in metres per count (0.001 for millimetres), found {self.depth_scale_m}"
            )
        if self.unit == "mm" and self.depth_scale_m not in (None, 0.001):
            raise ValueError(
                f"'unit: mm' says that one count of the depth image is 0.001 m, depth_scale_m says "
                f"{self.depth_scale_m:g}; correct one of them (with 'unit: m' depth_scale_m alone counts)"
            )
        if self.cloud_intrinsics is not None and self.T_image_cloud is None:
            raise ValueError("cloud_intrinsics needs T_image_cloud, the transform from the cloud to the image's camera")
        if self.T_image_cloud is not None:
            _check_transform(np.array(self.T_image_cloud))
            if self.intrinsics is None:
                raise ValueError("T_image_cloud needs 'intrinsics' of the image to project the cloud by")
        return self


def _check_transform(T: FloatArray) -> None:
    rigid = np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-3) and np.linalg.det(T[:3, :3]) > 0
    if not rigid or not np.allclose(T[3], (0, 0, 0, 1)):
        raise ValueError("T_image_cloud is no rigid transform; give 4 rows: rotation and translation, then 0 0 0 1")
