"""Frames of a static recording fused into one; frames that show something else are left out and told of."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.capture.fusion import AveragedCapture, read_average
from tubepose.capture.fusion.frame_fusion import MOST_AT_ONCE, robust_mean_m
from tubepose.capture.fusion.motion import CAMERA_MOVED, SCENE_MOVED, motion_between, still_of
from tubepose.capture.mcap_writing import write_mcap
from tubepose.capture.source import open_captures
from tubepose.errors import CaptureError, ConfigError

CAMERA = CameraIntrinsics(320, 240, 300.0, 300.0, 159.5, 119.5)
SHAPE = (240, 320)
NOISE_M = 1.0e-3


def picture(shift_px=(0.0, 0.0), box=None, gain=1.0, seed=0):
    """A textured ground with a bright disc on it where `box` says, and the noise of a camera."""
    ground = np.random.default_rng(5).uniform(40, 180, (30, 40)).astype(np.float32)
    image = cv2.resize(ground, (320, 240), interpolation=cv2.INTER_CUBIC)
    if box is not None:
        cv2.circle(image, box, 14, 230.0, -1, cv2.LINE_AA)
    move = np.array([[1, 0, shift_px[0]], [0, 1, shift_px[1]]], np.float32)
    image = cv2.warpAffine(image, move, (320, 240), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
    image = gain * image + np.random.default_rng(seed).normal(0, 2.0, SHAPE)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def depth_of(box=None, seed=0):
    depth = np.full(SHAPE, 0.5)
    if box is not None:
        cv2.circle(depth, box, 14, 0.45, -1)
    return depth + np.random.default_rng(seed).normal(0, NOISE_M, SHAPE)


def frame(index=0, image=True, **changes):
    box = changes.get("box")
    shown = picture(changes.get("shift_px", (0.0, 0.0)), box, changes.get("gain", 1.0), index) if image else None
    cloud = CAMERA.backproject(depth_of(box, index + 100))
    return RgbdFrame(cloud, shown, CAMERA, 1_000 + index, "still", index)


@dataclass(frozen=True)
class Recording:
    given: tuple[RgbdFrame, ...]
    broken: bool = False
    name: str = "still"
    path: Path = Path("still.mcap")

    def frames(self) -> Iterator[RgbdFrame]:
        yield from self.given
        if self.broken:
            raise CaptureError("still.mcap: cut")


def fused(*frames, average="all"):
    return list(AveragedCapture(Recording(frames), average).frames())


# ---------------------------------------------------------------- motion


@pytest.mark.parametrize(
    ("change", "moved"),
    [
        ({}, ""),
        ({"gain": 0.8}, ""),
        ({"box": (100, 80)}, ""),
        ({"shift_px": (0.05, 0.05)}, ""),
        ({"box": (103, 80)}, SCENE_MOVED),
        ({"box": (200, 160)}, SCENE_MOVED),
        ({"box": None}, SCENE_MOVED),
        ({"shift_px": (0.7, 0.0)}, CAMERA_MOVED),
        ({"shift_px": (-4.0, 3.0)}, CAMERA_MOVED),
    ],
)
def test_what_moved_is_told(change, moved) -> None:
    first, second = still_of(frame(box=(100, 80))), still_of(frame(1, **({"box": (100, 80)} | change)))
    assert motion_between(first, second) == moved


def test_depth_alone_tells_what_came_and_went() -> None:
    first = still_of(frame(image=False))
    assert motion_between(first, still_of(frame(1, image=False))) == ""
    assert motion_between(first, still_of(frame(1, image=False, box=(100, 80)))) == SCENE_MOVED
    farther = replace(frame(1, image=False), cloud_m=1.1 * frame(1, image=False).cloud_m)
    assert motion_between(first, still_of(farther)) == CAMERA_MOVED


# ---------------------------------------------------------------- fusion


def test_the_mean_of_frames_has_less_noise_and_the_first_ones_place() -> None:
    (one,) = fused(*(frame(k) for k in range(9)))
    assert np.std(one.cloud_m[..., 2]) == pytest.approx(NOISE_M / 3, rel=0.1)
    assert (one.index, one.timestamp_ns, one.capture) == (0, 1_000, "still")
    assert one.averaging is not None
    assert (one.averaging.n_frames, one.averaging.left_out, one.averaging.reason_code) == (9, (), "")
    assert (one.averaging.counts == 9).all()
    u, v = np.meshgrid(np.arange(320), np.arange(240))
    np.testing.assert_allclose(CAMERA.project(one.cloud_m), np.stack([u, v], axis=-1), atol=1e-9)
    assert np.std(one.image - picture(seed=50).astype(float)) < np.std(frame(0).image - picture(seed=50).astype(float))


def test_frames_that_show_something_else_are_left_out() -> None:
    frames = [frame(k, box=(100, 80)) for k in range(5)] + [frame(k, box=(200, 160)) for k in range(5, 8)]
    (one,) = fused(*frames)
    assert one.averaging is not None
    assert one.averaging.left_out == (5, 6, 7)
    assert one.averaging.reason_code == SCENE_MOVED
    assert one.cloud_m[160, 200, 2] == pytest.approx(0.5, abs=3e-3)
    assert one.cloud_m[80, 100, 2] == pytest.approx(0.45, abs=3e-3)


def test_the_larger_set_is_kept_even_if_it_comes_later() -> None:
    (one,) = fused(frame(0, shift_px=(3, 2)), *(frame(k) for k in range(1, 4)))
    assert one.averaging is not None
    assert one.averaging.left_out == (0,)
    assert one.averaging.reason_code == CAMERA_MOVED
    assert one.index == 1


def test_frames_in_a_row_make_one_each_and_the_rest_one_more() -> None:
    found = fused(*(frame(k) for k in range(7)), average=3)
    assert [one.index for one in found] == [0, 3, 6]
    assert [one.averaging.n_frames for one in found if one.averaging] == [3, 3, 1]
    np.testing.assert_array_equal(found[2].image, frame(6).image)


def test_wild_values_and_flickering_pixels() -> None:
    depth = np.full((9, 4, 4), 0.5) + np.random.default_rng(0).normal(0, 1e-3, (9, 4, 4))
    depth[0, 0, 0] = 3.0
    depth[1:, 1, 1] = np.nan
    depth[:, 2, 2] = np.nan
    mean, counts = robust_mean_m(depth)
    assert mean[0, 0] == pytest.approx(0.5, abs=1.5e-3)
    assert counts[1, 1] == 1
    assert np.isnan(mean[2, 2])
    assert counts[2, 2] == 0
    cloud = [CAMERA.backproject(depth_of(seed=k)) for k in range(6)]
    for k in range(5):
        cloud[k][7, 7] = np.nan
    (one,) = fused(*(replace(frame(k), cloud_m=cloud[k]) for k in range(6)))
    assert np.isnan(one.cloud_m[7, 7]).all()


@given(st.lists(st.floats(0.2, 2.0), min_size=1, max_size=12))
def test_the_mean_lies_between_the_values(values) -> None:
    mean, counts = robust_mean_m(np.array(values).reshape(-1, 1, 1))
    assert counts[0, 0] == len(values)
    assert min(values) - 1e-6 <= mean[0, 0] <= max(values) + 1e-6


def test_long_recordings_are_fused_in_parts() -> None:
    small = [replace(one, cloud_m=one.cloud_m[:24, :32], image=None) for one in (frame(k) for k in range(4))]
    many = [replace(small[k % 4], intrinsics=None, index=k) for k in range(MOST_AT_ONCE + 8)]
    (one,) = fused(*many)
    assert one.averaging is not None
    assert (one.averaging.counts == MOST_AT_ONCE + 8).all()
    mean = np.mean([part.cloud_m[..., 2] for part in small], axis=0)
    np.testing.assert_allclose(one.cloud_m[..., 2], mean, atol=1e-3)


def test_a_cut_recording_gives_what_was_read_and_then_says_so() -> None:
    frames = AveragedCapture(Recording((frame(0), frame(1)), broken=True), "all").frames()
    assert next(frames).averaging.n_frames == 2
    with pytest.raises(CaptureError, match="cut"):
        next(frames)


def test_clouds_without_pixels_and_other_sizes_are_refused() -> None:
    flat = replace(frame(), cloud_m=frame().cloud_m.reshape(1, -1, 3), organised=False, image=None)
    with pytest.raises(CaptureError, match="leave --average out"):
        fused(flat)
    small = replace(frame(1), cloud_m=frame().cloud_m[:100], image=None)
    with pytest.raises(CaptureError, match="320 x 100 pixels, those before it 320 x 240"):
        fused(frame(0), small)


def test_recordings_are_averaged_where_they_are_opened(tmp_path) -> None:
    write_mcap(tmp_path / "r.mcap", [frame(k) for k in range(4)], as_depth=True)
    (capture,) = open_captures(tmp_path / "r.mcap", average="all")
    assert (capture.name, capture.path) == ("r", tmp_path / "r.mcap")
    (one,) = capture.frames()
    assert one.averaging.n_frames == 4


@pytest.mark.parametrize(("text", "value"), [("all", "all"), ("2", 2), ("30", 30)])
def test_what_average_takes(text, value) -> None:
    assert read_average(text) == value


@pytest.mark.parametrize("text", ["1", "0", "-3", "some", "2.5", ""])
def test_what_average_does_not_take(text) -> None:
    with pytest.raises(ConfigError, match="2 or more, or all"):
        read_average(text)
