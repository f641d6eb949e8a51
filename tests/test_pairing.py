from __future__ import annotations

import numpy as np
import pytest
from recordings import CAMERA, DEPTH, STAMP_NS, cloud_message, image_message, mcap, read_all

from tubepose.capture import open_captures
from tubepose.capture.message_types import IMAGE, POINT_CLOUD
from tubepose.errors import CaptureError

MS = 1_000_000


def cloud(stamp_ms: float) -> tuple:
    message = cloud_message(CAMERA.backproject(DEPTH), stamp_ns=STAMP_NS + round(stamp_ms * MS))
    return ("/points", POINT_CLOUD, message)


def shot(stamp_ms: float, level: int) -> tuple:
    pixels = np.full((24, 32), level, np.uint8)
    return ("/texture", IMAGE, image_message(pixels, "mono8", stamp_ns=STAMP_NS + round(stamp_ms * MS)))


def levels(path, **options) -> list[int | None]:
    return [None if frame.image is None else int(frame.image[0, 0]) for frame in read_all(path, **options)]


@pytest.mark.parametrize("gap_ms", [120, 75.5])
def test_the_difference_that_is_named_can_be_allowed(tmp_path, gap_ms):
    path = mcap(tmp_path / "a.mcap", [cloud(0), shot(gap_ms, 7)])
    with pytest.raises(CaptureError, match="within 50 ms of one of /points") as caught:
        read_all(path)
    allowed = str(caught.value).split("--max-stamp-difference ")[1].split()[0]
    assert levels(path, max_stamp_difference_ms=float(allowed)) == [7]
    with pytest.raises(CaptureError, match=f"within {gap_ms - 1:g} ms"):
        levels(path, max_stamp_difference_ms=gap_ms - 1)


@pytest.mark.parametrize("difference", [-1, float("nan"), float("inf")])
def test_a_difference_that_is_none_is_refused(tmp_path, difference):
    path = mcap(tmp_path / "a.mcap", [cloud(0)])
    with pytest.raises(CaptureError, match="expected 0 or more"):
        open_captures(path, max_stamp_difference_ms=difference)


def test_a_frame_without_a_picture_says_so(tmp_path):
    (first, second) = read_all(mcap(tmp_path / "a.mcap", [cloud(0), shot(3, 1), cloud(500)]))
    assert first.notes == ()
    assert second.image is None
    assert second.notes == ("frame without picture: none of /texture is near in time",)


def looped(passes: int, *, lost: set[tuple[int, int]] = frozenset()) -> tuple[list, list[int]]:
    """A recording of three moments that was played several times and recorded again; some pictures were lost."""
    messages, times = [], []
    for number in range(passes):
        for moment in range(3):
            messages.append(cloud(moment * 100))
            times.append((number * 1000 + moment * 100) * MS)
            # Two pictures for each cloud: the nearer one, and one 30 ms off.
            for late, level in ((5, 1), (30, 2)):
                if late == 5 and (number, moment) in lost:
                    continue
                messages.append(shot(moment * 100 + late, 10 * number + level + 3 * moment))
                times.append((number * 1000 + moment * 100 + late) * MS)
    return messages, [time + STAMP_NS for time in times]


def test_looped_recordings_pair_within_their_pass(tmp_path):
    messages, times = looped(3)
    path = mcap(tmp_path / "a.mcap", messages, log_times_ns=times)
    assert levels(path) == [10 * number + 1 + 3 * moment for number in range(3) for moment in range(3)]


def test_a_picture_that_is_lost_in_a_pass_is_not_taken_from_another(tmp_path):
    messages, times = looped(3, lost={(1, 1)})
    path = mcap(tmp_path / "a.mcap", messages, log_times_ns=times)
    assert levels(path)[4] == 10 + 2 + 3  # the later one of its own pass
    assert levels(path)[3] == 11


def test_one_moment_that_is_looped_pairs_within_its_pass(tmp_path):
    messages = [one for number in range(4) for one in (cloud(0), shot(4, number))]
    times = [STAMP_NS + (2 * number + late) * 1000 * MS for number in range(4) for late in (0, 0.004)]
    assert levels(mcap(tmp_path / "a.mcap", messages, log_times_ns=[round(time) for time in times])) == [0, 1, 2, 3]


def test_a_cloud_that_was_sent_twice_is_no_loop(tmp_path):
    messages = [cloud(0), cloud(0), shot(-30, 5)]
    times = [STAMP_NS + 40 * MS, STAMP_NS + 41 * MS, STAMP_NS - 10 * MS]
    assert levels(mcap(tmp_path / "a.mcap", messages, log_times_ns=times)) == [5, 5]
