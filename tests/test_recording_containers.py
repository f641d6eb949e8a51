from __future__ import annotations

import sqlite3
import struct
from pathlib import Path

import numpy as np
import pytest
import yaml
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer
from recordings import (
    CAMERA,
    DEPTH,
    SECOND_NS,
    STAMP_NS,
    assert_same,
    bag1,
    bag2,
    cdr,
    cloud_shots,
    mcap,
    read_all,
    shots,
)
from rosbags.rosbag2 import CompressionMode, StoragePlugin

from tubepose.capture import open_captures
from tubepose.capture.message_types import IMAGE, STRING
from tubepose.errors import CaptureError


def only_file(folder: Path) -> Path:
    (file,) = [path for path in folder.iterdir() if path.name != "metadata.yaml"]
    return file


@pytest.mark.parametrize("storage", list(StoragePlugin))
@pytest.mark.parametrize("compression", [CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE])
@pytest.mark.parametrize("whole_folder", [True, False])
def test_ros2_bags_of_every_storage_and_compression(tmp_path, storage, compression, whole_folder):
    folder = bag2(tmp_path / "scan", shots(), storage=storage, compression=compression)
    (frame,) = read_all(folder if whole_folder else only_file(folder))
    assert_same(frame)
    assert frame.intrinsics == CAMERA


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
@pytest.mark.parametrize("make", [shots, cloud_shots])
def test_ros1_bags(tmp_path, compression, make):
    (frame,) = read_all(bag1(tmp_path / "scan.bag", make(), compression))
    assert_same(frame)


@pytest.mark.parametrize("make", [shots, cloud_shots])
def test_ros1_messages_in_mcap(tmp_path, make):
    (frame,) = read_all(mcap(tmp_path / "scan.mcap", make(), ros=1))
    assert_same(frame)


@pytest.mark.parametrize("suffix", [".mcap.zstd", ".mcap.zst"])
def test_a_file_compressed_by_hand(tmp_path, suffix):
    path = mcap(tmp_path / "scan.mcap", shots())
    packed = tmp_path / f"other{suffix}"
    packed.write_bytes(zstandard.compress(path.read_bytes()))
    (frame,) = read_all(packed)
    assert_same(frame)


def split(folder: Path, kind: str = "mcap", listed: int = 2) -> Path:
    """Two parts; the CameraInfo is in the first alone, as a latched topic is."""
    folder.mkdir()
    later = [message for message in shots(stamp_ns=STAMP_NS + SECOND_NS) if "info" not in message[0]]
    names = [f"scan_{number}.{kind}" for number in range(listed)]
    for name, messages in zip(names, (shots(), later), strict=False):
        if kind == "mcap":
            mcap(folder / name, messages, chunk_size=1024)
        else:
            only_file(bag2(folder / "made", messages)).rename(folder / name)
            (folder / "made" / "metadata.yaml").unlink()
            (folder / "made").rmdir()
    information = {"version": 4, "storage_identifier": kind, "relative_file_paths": names}
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": information}))
    return folder


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_a_split_recording_is_one_capture_with_the_info_of_its_first_part(tmp_path, kind):
    folder = split(tmp_path / "scan", kind)
    frames = read_all(folder)
    assert [(frame.capture, frame.index) for frame in frames] == [("scan", 0), ("scan", 1)]
    assert [frame.timestamp_ns for frame in frames] == [STAMP_NS, STAMP_NS + SECOND_NS]
    assert [frame.intrinsics for frame in frames] == [CAMERA, CAMERA]
    np.testing.assert_allclose(frames[1].cloud_m, frames[0].cloud_m)


def test_a_part_by_itself_has_the_info_of_the_others(tmp_path):
    (frame,) = read_all(split(tmp_path / "scan") / "scan_1.mcap")
    assert frame.intrinsics == CAMERA
    assert frame.timestamp_ns == STAMP_NS + SECOND_NS


def test_a_searched_folder_holds_recordings_of_all_kinds_once(tmp_path):
    split(tmp_path / "split")
    bag2(tmp_path / "humble", shots())
    bag1(tmp_path / "old.bag", shots())
    mcap(tmp_path / "new.mcap", shots())
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "metadata.yaml").write_text("kind: something else\n")
    captures = open_captures(tmp_path)
    assert [capture.name for capture in captures] == ["humble", "new", "old", "split"]
    assert [len(list(capture.frames())) for capture in captures] == [1, 1, 1, 2]


def test_a_part_that_is_lost_is_named_and_the_others_are_read_by_themselves(tmp_path):
    folder = split(tmp_path / "scan")
    (folder / "scan_0.mcap").unlink()
    with pytest.raises(CaptureError, match=r"metadata\.yaml: lists scan_0\.mcap, which is not there; .* one by one"):
        read_all(folder)
    with pytest.raises(CaptureError, match="needs the CameraInfo of its camera, found none"):
        read_all(folder / "scan_1.mcap")
    folder = split(tmp_path / "other")
    (folder / "scan_1.mcap").unlink()
    with pytest.raises(CaptureError, match=r"lists scan_1\.mcap, which is not there"):
        read_all(folder)
    assert_same(read_all(folder / "scan_0.mcap")[0])


@pytest.mark.parametrize("kind", ["mcap", "db3"])
def test_a_part_that_is_cut_costs_its_own_frames(tmp_path, kind):
    folder = split(tmp_path / "scan", kind)
    part = folder / f"scan_0.{kind}"
    whole = part.read_bytes()
    # Of the depth image, which is stored last.
    part.write_bytes(whole[: len(whole) * 6 // 10 if kind == "mcap" else len(whole) - 2000])
    frames = []
    with pytest.raises(CaptureError, match=rf"truncated.* after 1 whole frame.*scan_0\.{kind}"):
        frames.extend(open_captures(folder)[0].frames())
    assert [frame.timestamp_ns for frame in frames] == [STAMP_NS + SECOND_NS]
    part.write_bytes(whole[:100])
    with pytest.raises(CaptureError, match=rf"CameraInfo of its camera, found none; .*truncated.*scan_0\.{kind}"):
        read_all(folder)


def many(count: int) -> list:
    return [message for number in range(count) for message in shots(stamp_ns=STAMP_NS + number * SECOND_NS)]


@pytest.mark.parametrize("keep", [0.35, 0.6, 0.9])
def test_a_cut_sqlite_bag_gives_its_whole_frames_and_then_the_error(tmp_path, keep):
    path = only_file(bag2(tmp_path / "scan", many(40)))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * keep)])
    frames = []
    with pytest.raises(CaptureError, match="truncated") as caught:
        frames.extend(open_captures(path)[0].frames())
    assert "\n" not in str(caught.value)
    assert f"after {len(frames)} whole" in str(caught.value)
    assert 40 * keep - 4 <= len(frames) < 40
    for frame in frames:
        np.testing.assert_allclose(frame.cloud_m[..., 2], DEPTH)


@pytest.mark.parametrize("keep", [0.35, 0.6, 0.9])
def test_a_cut_ros1_bag_gives_its_whole_frames_and_then_the_error(tmp_path, keep):
    path = bag1(tmp_path / "scan.bag", many(100))
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * keep)])
    frames = []
    with pytest.raises(CaptureError, match="truncated") as caught:
        frames.extend(open_captures(path)[0].frames())
    assert f"after {len(frames)} whole" in str(caught.value)
    assert 100 * keep - 4 <= len(frames) < 100
    np.testing.assert_allclose(frames[-1].cloud_m[..., 2], DEPTH)


@settings(max_examples=25)
@given(kind=st.sampled_from(["db3", "bag", "zstd"]), keep=st.floats(0, 0.999), flip=st.booleans())
def test_a_recording_that_is_cut_or_damaged_anywhere_ends_in_one_line(tmp_path_factory, kind, keep, flip):
    folder = tmp_path_factory.mktemp("damaged")
    if kind == "bag":
        path = bag1(folder / "a.bag", shots())
    elif kind == "db3":
        path = only_file(bag2(folder / "a", shots()))
    else:
        path = only_file(bag2(folder / "a", shots(), compression=CompressionMode.FILE))
    data = bytearray(path.read_bytes())
    at = int(len(data) * keep)
    if flip:
        data[at] ^= 0x5A
    path.write_bytes(data if flip else data[:at])
    try:
        read_all(path)
    except CaptureError as told:
        assert str(told).isprintable()  # noqa: PT017  # frames are as good


@pytest.mark.parametrize(
    ("name", "expected"),
    [("a.db3", "a ROS 2 bag in SQLite"), ("a.bag", "a ROS 1 bag"), ("a.mcap", "an MCAP file")],
)
def test_other_content_is_named(tmp_path, name, expected):
    (tmp_path / name).write_bytes(b"something else")
    with pytest.raises(CaptureError, match=f"expected {expected}, found other content"):
        read_all(tmp_path / name)


def test_the_content_tells_the_kind_and_not_the_ending(tmp_path):
    path = bag1(tmp_path / "scan.bag", shots())
    (frame,) = read_all(path.rename(tmp_path / "scan.mcap"))
    assert_same(frame)
    (frame,) = read_all((tmp_path / "scan.mcap").rename(tmp_path / "scan.bag.active"))  # one that was not closed
    assert_same(frame)


def test_a_database_that_is_no_bag_is_named(tmp_path):
    with sqlite3.connect(tmp_path / "a.db3") as connection:
        connection.execute("CREATE TABLE songs (id INTEGER)")
    connection.close()
    with pytest.raises(CaptureError, match="but no ROS 2 bag: expected the tables topics and messages, found songs"):
        read_all(tmp_path / "a.db3")


def test_a_file_that_inflates_without_end_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("tubepose.capture.formats.containers.LEAST_LIMIT_BYTES", 1 << 20)
    (tmp_path / "a.mcap.zst").write_bytes(zstandard.compress(bytes(4 << 20)))
    with pytest.raises(CaptureError, match="holds more than 200 times its own size"):
        read_all(tmp_path / "a.mcap.zst")


def test_a_message_that_inflates_without_end_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("tubepose.capture.formats.raw_messages.MAX_MESSAGE_BYTES", 1000)
    with pytest.raises(CaptureError, match="truncated or damaged"):
        read_all(bag2(tmp_path / "scan", shots(), compression=CompressionMode.MESSAGE))


def test_nothing_that_makes_a_frame_names_what_is_there(tmp_path):
    path = bag2(tmp_path / "scan", [("/words", STRING, {"data": "hello"})])
    with pytest.raises(CaptureError, match=r"nothing to make a frame of; .* found /words \(std_msgs/msg/String\)"):
        read_all(path)


def test_a_log_beside_the_database_is_read(tmp_path):
    """SQLite keeps the last messages of a bag that was not closed in a file of its own."""
    made = only_file(bag2(tmp_path / "made", shots()))
    live = sqlite3.connect(made)
    live.execute("PRAGMA journal_mode=WAL")
    live.execute("PRAGMA wal_autocheckpoint=0")
    image_topic = live.execute("SELECT id FROM topics WHERE name LIKE '%depth%'").fetchone()[0]
    message = next(one for topic, _, one in shots(stamp_ns=STAMP_NS + SECOND_NS) if "depth" in topic)
    live.execute(
        "INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", (image_topic, 1, cdr(IMAGE, message))
    )
    live.commit()
    copied = tmp_path / "copied"
    copied.mkdir()
    for file in made.parent.glob(f"{made.name}*"):
        if not file.name.endswith("-shm"):
            (copied / file.name).write_bytes(file.read_bytes())
    live.close()
    frames = read_all(copied / made.name)
    assert [frame.timestamp_ns for frame in frames] == [STAMP_NS, STAMP_NS + SECOND_NS]


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
@pytest.mark.parametrize("claims", [True, False])
def test_a_chunk_that_inflates_without_end_is_refused(tmp_path, monkeypatch, compression, claims):
    """Whether it says so or not."""
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream, compression=compression, enable_crcs=False)
        writer.start()
        schema = writer.register_schema("a/msg/B", "ros2msg", b"")
        writer.add_message(writer.register_channel("/t", "cdr", schema), 1, bytes(4 << 20), 1)
        writer.finish()
    data = bytearray((tmp_path / "a.mcap").read_bytes())
    size = data.index(struct.pack("<Q", _chunk_bytes(bytes(data))))
    if not claims:
        data[size : size + 8] = struct.pack("<Q", 1000)
    (tmp_path / "a.mcap").write_bytes(data)
    monkeypatch.setattr("tubepose.capture.formats.mcap_file.LEAST_LIMIT_BYTES", 1 << 20)
    with pytest.raises(CaptureError, match=r"a chunk of \d+ bytes"):
        read_all(tmp_path / "a.mcap")


def _chunk_bytes(data: bytes) -> int:
    """Size that the first chunk claims."""
    at = data.index(b"\x06", 9)
    while True:
        (size,) = struct.unpack_from("<Q", data, at + 9 + 16)
        if (4 << 20) < size < (5 << 20):
            return int(size)
        at = data.index(b"\x06", at + 1)
