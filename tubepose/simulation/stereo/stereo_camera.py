"""What is known of a stereo camera: optics, matching, noise. Bundled cameras by name, others by a YAML file."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from tubepose.capture.description import IntrinsicsEntry
from tubepose.capture.frame import CameraIntrinsics
from tubepose.errors import ConfigError
from tubepose.labware.reading import read_yaml, validate
from tubepose.transforms import FloatArray

CAMERAS = ("d405", "d435", "d435-640")
"""Bundled cameras."""

_FORBID = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
_Positive = Annotated[float, Field(gt=0)]
_Least0 = Annotated[float, Field(ge=0)]
_Share = Annotated[float, Field(ge=0, le=1)]


class Wave(BaseModel):
    """One part of the depth error, smooth over the image.

    Attributes:
        length_px: Distances along u and v at which its correlation ``exp(-(d / length)^2)`` has fallen to 1/e.
        temporal: New in every frame; else it stays over the frames of a recording.
    """

    model_config = _FORBID
    length_px: tuple[_Positive, _Positive]
    temporal: bool = False


class NoiseAt(BaseModel):
    """Size of the depth error at one depth.

    Attributes:
        depth_m: The depth.
        std_mm: Standard deviation of each wave, in the order of the camera's `waves`.
    """

    model_config = _FORBID
    depth_m: _Positive
    std_mm: tuple[_Least0, ...]


class StereoCamera(BaseModel):
    """A stereo camera whose depth is aligned to its colour image.

    Attributes:
        name: Of the camera.
        source: Where its numbers are from.
        image: Size and pinhole of the aligned images.
        baseline_m: Distance of its two imagers; the second one lies on the side of +x.
        stereo_focal_px: Focal length of the images that are matched, before they are aligned.
        subpixel: Disparity comes in steps of 1 / subpixel pixels; 0 turns that off.
        depth_step_m: Depth is stored as whole multiples of this.
        depth_range_m: Nearer and farther points are not reported.
        face_distance_m: Distances of a rack's face that scenes are drawn from where `--scenes` does not say.
        window_px: Side of the window that is matched, pixels of the image.
        near_share: Share of a window that a nearer surface must fill to win it: 0.5 puts edges where they are, less
            fattens the foreground by ``(0.5 - near_share) * window_px``.
        ramp_px: Width of a depth edge from 10 to 90 % of its step.
        wander_px: Standard deviation by which depth edges wander along the edge.
        blind_columns: Whether depth ends ``fx * baseline / z`` pixels before the left border, as it does where the
            image is that of the left imager in full.
        missing_share: Share of a well textured plane without depth, in patches.
        scale_std: Standard deviation of the depth's scale error, one value for all captures of a scene.
        waves: Parts of the depth error.
        noise: Their sizes by depth: linear between the depths that are given, beyond them proportional to depth.
    """

    model_config = _FORBID
    kind: Literal["stereo-camera"]
    name: str = Field(min_length=1)
    source: str = ""
    image: IntrinsicsEntry
    baseline_m: _Positive
    stereo_focal_px: _Positive
    subpixel: Annotated[int, Field(ge=0)] = 32
    depth_step_m: Annotated[float, Field(gt=0, le=0.01)] = 1.0e-3
    depth_range_m: tuple[_Positive, _Positive] = (0.1, 10.0)
    face_distance_m: tuple[_Positive, _Positive]
    window_px: Annotated[int, Field(ge=1, le=63)] = 17
    near_share: Annotated[float, Field(gt=0, le=0.5)] = 0.35
    ramp_px: _Least0 = 9.0
    wander_px: _Least0 = 1.2
    blind_columns: bool = False
    missing_share: _Share = 0.003
    scale_std: _Least0 = 0.0025
    waves: tuple[Wave, ...] = ()
    noise: tuple[NoiseAt, ...] = ()

    @model_validator(mode="after")
    def _check(self) -> StereoCamera:
        for name, (low, high) in (("depth_range_m", self.depth_range_m), ("face_distance_m", self.face_distance_m)):
            if low > high:
                raise ValueError(f"{name}: expected [least, most], found [{low:g}, {high:g}]")
        if self.face_distance_m[0] < self.depth_range_m[0] or self.face_distance_m[1] > self.depth_range_m[1]:
            raise ValueError(f"face_distance_m: expected distances within depth_range_m {list(self.depth_range_m)}")
        if bool(self.waves) != bool(self.noise):
            raise ValueError("waves and noise belong together; give both or neither")
        depths = [entry.depth_m for entry in self.noise]
        if depths != sorted(set(depths)):
            raise ValueError(f"noise: expected rising values of depth_m, found {depths}")
        for entry in self.noise:
            if len(entry.std_mm) != len(self.waves):
                raise ValueError(
                    f"noise at {entry.depth_m:g} m: expected {len(self.waves)} values of std_mm, one per wave, found "
                    f"{len(entry.std_mm)}"
                )
        if (65534 * self.depth_step_m) < self.depth_range_m[1]:
            raise ValueError(
                f"depth_range_m: 16 bits of {self.depth_step_m:g} m reach {65534 * self.depth_step_m:.3f} m, expected "
                f"{self.depth_range_m[1]:g} m to be nearer; lower it, or raise depth_step_m"
            )
        return self

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """Pinhole of the aligned images."""
        return self.image.camera()

    @property
    def inverse_depth_per_px(self) -> float:
        """Inverse depth of one pixel of disparity, 1/m."""
        return 1.0 / (self.stereo_focal_px * self.baseline_m)

    def wave_std_m(self, wave: int, depth_m: FloatArray) -> FloatArray:
        """Standard deviation of a wave at depths of any shape, metres."""
        depths = np.array([entry.depth_m for entry in self.noise])
        stds = np.array([entry.std_mm[wave] for entry in self.noise]) * 1e-3
        near, far = depth_m / depths[0], depth_m / depths[-1]
        between = np.interp(depth_m, depths, stds)
        return np.asarray(np.where(near < 1, stds[0] * near, np.where(far > 1, stds[-1] * far, between)))

    def exact(self) -> StereoCamera:
        """The camera without an error of its depth's scale."""
        return self.model_copy(update={"scale_std": 0.0})


def load_stereo_camera(name: str) -> StereoCamera:
    """A bundled camera by name, or one from a YAML file.

    Raises:
        ConfigError: No such camera or file, or a file that breaks the format.
    """
    if name in CAMERAS:
        path = Path(str(files("tubepose.simulation.stereo"))) / f"{name}.yaml"
    elif name.endswith((".yaml", ".yml")):
        path = Path(name)
    else:
        raise ConfigError(f"unknown camera '{name}'; known: {', '.join(CAMERAS)}, or a YAML file (docs/simulation.md)")
    return validate(StereoCamera, read_yaml(path, ConfigError), str(path), ConfigError)
