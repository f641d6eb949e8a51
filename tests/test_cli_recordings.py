"""`tubepose estimate` on recordings: options, notes, and a batch of which some cannot be read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from commands import tubepose
from recordings import GRAY, IMAGE, bag1, bag2, cloud_shots, image_message, mcap, shots

from tubepose.batch import Job, run_jobs
from tubepose.capture import open_captures, write_mcap
from tubepose.config import Config
from tubepose.detection.geometric import GeometricDetector
from tubepose.labware import load_rack
from tubepose.provenance import pinned_threads

RACK = "chen2023-soft-5x10"
OPTIONS = ("--rack", RACK, "--method", "upright", "--detector", "geometric", "--no-overlays")


def racks(out: Path) -> pd.DataFrame:
    return pd.read_csv(out / "racks.csv", keep_default_na=False).set_index("capture")


def test_a_batch_of_recordings_keeps_what_can_be_read(tmp_path):
    (tmp_path / "in").mkdir()
    bag1(tmp_path / "in" / "a_old.bag", shots())
    bag2(tmp_path / "in" / "b_humble", cloud_shots())
    (tmp_path / "in" / "c_cut.db3").write_bytes(b"SQLite format 3\x00" + bytes(40))
    unread = ("/camera/color/image_raw", IMAGE, image_message(GRAY, "mono8") | {"encoding": "hologram"})
    mcap(tmp_path / "in" / "d_picture.mcap", [cloud_shots()[0], unread])
    (tmp_path / "in" / "e_other.bag").write_bytes(b"no bag")
    ended = tubepose("estimate", tmp_path / "in", *OPTIONS, "--out", tmp_path / "out")
    assert ended.code == 1
    read = [line for line in ended.errors if "c_cut" in line or "e_other" in line]
    assert len(read) == 2
    assert any("c_cut.db3: truncated" in line for line in read)
    told = racks(tmp_path / "out")["capture_note"]
    assert (told["a_old"], told["b_humble"]) == ("", "")
    assert told["d_picture"].startswith("frame without its picture: /camera/color/image_raw: image encoding 'hologram'")
    assert f"d_picture frame 0: note: {told['d_picture']}" in ended.err


def test_the_options_of_recordings(tmp_path):
    late = image_message(GRAY, "mono8", stamp_ns=1_700_000_000_323_456_789)
    path = mcap(tmp_path / "late.mcap", [cloud_shots()[0], ("/camera/color/image_raw", IMAGE, late)])
    ended = tubepose("estimate", path, *OPTIONS, "--out", tmp_path / "one")
    assert any("--max-stamp-difference 200" in line for line in ended.errors)
    tubepose("estimate", path, *OPTIONS, "--max-stamp-difference", "200", "--out", tmp_path / "two")
    assert racks(tmp_path / "two")["capture_note"].tolist() == [""]
    ply = tmp_path / "a.ply"
    ply.write_text("ply\nformat ascii 1.0\nelement vertex 0\nend_header\n")
    ended = tubepose("estimate", ply, *OPTIONS, "--max-stamp-difference", "200", "--out", tmp_path / "three")
    assert ended.code == 1
    assert "--max-stamp-difference given, but no recording (.mcap, .db3, .bag) is there" in ended.errors[0]


@pytest.fixture(scope="module")
def sample_frame():
    from importlib.resources import files

    folder = Path(str(files("tubepose"))) / "sample" / "captures"
    return next(iter(open_captures(sorted(folder.glob("*original*"))[0])[0].frames()))


@pytest.mark.parametrize(("factor", "hint"), [(10, "--depth-scale, 0.1 times"), (1000, "--unit m or mm; ")])
def test_the_scale_that_a_wrong_unit_asks_for_works(tmp_path, sample_frame, factor, hint):
    """Depth in counts of 0.1 mm, or in floats of millimetres."""
    rack = load_rack(RACK)
    depth = np.nan_to_num(sample_frame.cloud_m[..., 2])
    camera = sample_frame.intrinsics
    from recordings import CAMERA_INFO, info_message

    counts = np.rint(depth * 1e4).astype(np.uint16) if factor == 10 else (depth * 1e3).astype(np.float32)
    encoding = "16UC1" if factor == 10 else "32FC1"
    messages = [
        ("/depth/image_raw", IMAGE, image_message(counts, encoding)),
        ("/depth/camera_info", CAMERA_INFO, info_message(camera)),
    ]
    path = mcap(tmp_path / "a.mcap", messages)

    def found(**options) -> dict:
        config = Config()
        job = Job(open_captures(path, **options)[0], rack, ())
        with pinned_threads(1):
            tables = run_jobs([job], ["upright"], lambda r, t: GeometricDetector(r, t, config), config)
        return tables.racks[0]

    wrong = found()
    assert wrong["status"] == "wrong_unit"
    assert hint in wrong["reason"]
    assert found(depth_scale_m=1e-4 if factor == 10 else 1e-3)["status"] == "ok"
    if factor == 1000:
        assert found(unit="mm")["status"] == "ok"


def test_our_own_recordings_are_read_as_before(tmp_path, sample_frame):
    write_mcap(tmp_path / "a.mcap", [sample_frame], as_depth=True, compressed=True)
    (again,) = open_captures(tmp_path / "a.mcap")[0].frames()
    assert again.intrinsics == sample_frame.intrinsics
    np.testing.assert_allclose(again.cloud_m, sample_frame.cloud_m, atol=5e-5)
