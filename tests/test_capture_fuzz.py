"""Damaged files: one line each, no traceback, no memory for what is only claimed."""

from __future__ import annotations

import json
import struct
import tracemalloc
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import test_capture_formats as formats
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tubepose.capture import open_captures
from tubepose.capture.frame import RgbdFrame
from tubepose.errors import CaptureError, LabwareError
from tubepose.labware.reading import read_yaml

MOST_BYTES = 64 << 20
"""Memory that a damaged file of some kilobytes may take."""


def outcome(path: Path, **options) -> str | None:
    """None where a file is read, else the one line that is said."""
    try:
        for capture in open_captures(path, **options):
            for frame in capture.frames():
                assert isinstance(frame, RgbdFrame)
                assert not np.isinf(frame.cloud_m).any()
    except CaptureError as problem:
        told = str(problem)
    else:
        return None
    assert "\n" not in told
    assert len(told) < 2000
    return told


def sample(kind: str, folder: Path) -> bytes:
    """A whole file of a kind."""
    path = folder / f"whole.{kind.split('-')[0]}"
    if kind.startswith("pcd"):
        return formats.pcd(kind.split("-")[1])
    if kind == "ptx":
        return formats.write_ptx(path, formats.CLOUD, formats.PICTURE, (formats.W, formats.H)).read_bytes()
    if kind == "ply-ascii":
        rows = "\n".join(" ".join(f"{x:.5g}" for x in point) for point in formats.CLOUD.reshape(-1, 3))
        head = f"ply\nformat ascii 1.0\nelement vertex {formats.W * formats.H}\n"
        return f"{head}property float x\nproperty float y\nproperty float z\nend_header\n{rows}\n".encode()
    if kind == "ply-binary":
        line = f"obj_info Photoneo PLY PointCloud ( Width = {formats.W}; Height = {formats.H})"
        return formats.write_phoxi_ply(path, line, extra=True).read_bytes()
    depth = np.nan_to_num(formats.DEPTH_M * 1e3)
    formats.write_depth(path, depth.astype(np.uint16 if kind == "png" else np.float32))
    return path.read_bytes()


KINDS = (
    "pcd-ascii",
    "pcd-binary",
    "pcd-binary_compressed",
    "ptx",
    "ply-ascii",
    "ply-binary",
    "png",
    "tiff",
    "exr",
    "npy",
)


def place(kind: str, folder: Path, data: bytes) -> Path:
    """A capture with these bytes in it."""
    suffix = kind.split("-")[0]
    if suffix in ("pcd", "ptx", "ply"):
        (folder / f"scan.{suffix}").write_bytes(data)
        return folder / f"scan.{suffix}"
    shot = folder / "shot"
    shot.mkdir(exist_ok=True)
    (shot / f"depth.{suffix}").write_bytes(data)
    (shot / "capture.yaml").write_text(yaml.safe_dump({"unit": "mm", "intrinsics": formats.CAMERA_KEYS}))
    return shot


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=30, deadline=None, suppress_health_check=list(HealthCheck))
@given(data=st.data())
def test_damaged_files_are_read_or_refused_in_one_line(tmp_path_factory, capfd, kind, data):
    folder = tmp_path_factory.mktemp("fuzz")
    whole = bytearray(sample(kind, folder))
    head = min(len(whole), 400)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, head - 1) | st.integers(0, len(whole) - 1))
        whole[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=4) | st.sampled_from(WORDS))
    if data.draw(st.booleans()):
        del whole[data.draw(st.integers(0, len(whole))) :]
    outcome(place(kind, folder, bytes(whole)), unit="mm")
    assert capfd.readouterr() == ("", "")


WORDS = (b"99999999999", b"-1", b"nan", b"\n", b"0", "²".encode(), b"1e308", b"\xff\xff\xff\xff", b"list", b"\x00" * 4)

XYZ = b"property float x\nproperty float y\nproperty float z\nend_header\n"
CLAIMS = {
    "ply": b"ply\nformat %b 1.0\nelement vertex 99999999999\n" + XYZ,
    "ply-before": b"ply\nformat %b 1.0\nelement a 999999999999999\nproperty double q\nelement vertex 9\n" + XYZ,
    "ply-many": b"ply\nformat %b 1.0\nelement vertex " + b"9" * 5000 + b"\n" + XYZ,
}


@pytest.mark.parametrize("claim", CLAIMS)
@pytest.mark.parametrize("order", [b"ascii", b"binary_little_endian"])
@pytest.mark.parametrize("body", [b"", b"1 2 3\n" * 9, b"1\n2\n3\n"])
def test_a_ply_takes_no_memory_for_what_it_claims(tmp_path, claim, order, body):
    (tmp_path / "scan.ply").write_bytes(CLAIMS[claim] % order + body)
    assert bounded(tmp_path / "scan.ply")


@pytest.mark.parametrize("data", [b"ascii", b"binary", b"binary_compressed"])
@pytest.mark.parametrize("sizes", [(99999, 99999, 9999800001), (9999800001, 1, 9999800001), (3, 3, 9)])
def test_a_pcd_takes_no_memory_for_what_it_claims(tmp_path, data, sizes):
    head = b"FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH %d\nHEIGHT %d\nPOINTS %d\nDATA %b\n" % (*sizes, data)
    (tmp_path / "scan.pcd").write_bytes(head + struct.pack("<II", 8, 0xFFFFFFFF) + b"12345678")
    assert bounded(tmp_path / "scan.pcd")


def test_a_ptx_and_an_npy_take_no_memory_for_what_they_claim(tmp_path):
    head = "99999\n99999\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 2 3 0.5\n"
    (tmp_path / "scan.ptx").write_text(head)
    assert bounded(tmp_path / "scan.ptx")
    np.save(tmp_path / "small.npy", np.zeros((3, 3), np.float32))
    text = (tmp_path / "small.npy").read_bytes()
    shot = place("npy", tmp_path, text.replace(b"(3, 3), }" + b" " * 8, b"(99999, 99999), }"))
    assert b"99999" in (shot / "depth.npy").read_bytes()
    assert bounded(shot)


def test_a_png_that_claims_many_pixels_is_refused_before_they_are_made(tmp_path):
    """32000 x 32000 zeros pack into a megabyte, and would take two gigabytes."""
    size = struct.pack(">IIBBBBB", 32000, 32000, 16, 0, 0, 0, 0)
    chunk = b"IHDR" + size
    png = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk))
    rest = b"IDAT" + zlib.compress(b"\0" * 1000)
    png += struct.pack(">I", len(rest) - 4) + rest + struct.pack(">I", zlib.crc32(rest)) + b"\0\0\0\0IEND\xaeB`\x82"
    told = bounded(place("png", tmp_path, png))
    assert told is not None
    assert "claims more than 67108864 pixels" in told


def bounded(path: Path) -> str | None:
    """What is said of a capture; fails where more than `MOST_BYTES` were taken."""
    tracemalloc.start()
    try:
        told = outcome(path, unit="mm")
        assert tracemalloc.get_traced_memory()[1] < MOST_BYTES
    finally:
        tracemalloc.stop()
    return told


JSON_VALUES = st.recursive(
    st.none() | st.booleans() | st.floats() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=10) | st.dictionaries(st.text(max_size=5), inner, max_size=4),
    max_leaves=12,
)


@settings(max_examples=50, deadline=None)
@given(
    entries=st.dictionaries(st.sampled_from(["0", "1", "x", ""]), JSON_VALUES, max_size=3) | JSON_VALUES, raw=st.text()
)
def test_any_scene_camera_is_read_or_refused_in_one_line(tmp_path_factory, entries, raw):
    folder = tmp_path_factory.mktemp("fuzz")
    for text in (json.dumps(entries), raw, json.dumps({"0": {"cam_K": entries, "depth_scale": entries}})):
        (folder / "scene_camera.json").write_text(text, encoding="utf-8", errors="surrogatepass")
        assert outcome(folder)


@settings(max_examples=50, deadline=None)
@given(values=st.fixed_dictionaries({}, optional=dict.fromkeys(
    ("width", "height", "intrinsic_matrix", "depth_scale"), JSON_VALUES | st.lists(st.floats(), min_size=9, max_size=9)
)))  # fmt: skip
def test_any_intrinsic_json_is_read_or_refused_in_one_line(tmp_path_factory, values):
    folder = tmp_path_factory.mktemp("fuzz")
    (folder / "depth").mkdir()
    (folder / "intrinsic.json").write_text(json.dumps(values))
    assert cv2.imwrite(str(folder / "depth" / "0.png"), np.ones((4, 5), np.uint16))
    outcome(folder, unit="mm")


def test_a_json_that_is_nested_without_end_is_one_line(tmp_path):
    (tmp_path / "scene_camera.json").write_text("[" * 100_000)
    assert "not valid JSON" in (outcome(tmp_path) or "")


def nested_aliases(levels: int) -> str:
    lines = ["a0: &a0 [lol, lol, lol, lol, lol, lol, lol, lol, lol]"]
    return "\n".join(lines + [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, levels)])


@pytest.mark.parametrize(
    "text",
    [
        nested_aliases(12), "a: &a [*a]", "unit: !!timestamp never", "unit: !!float ''", "unit: !!int _", "- " * 5000,
        "? [a, b]\n: 1", "? {a: b}\n: 1", "unit: !!python/object:os.system x", "unit: \x00", "unit: !!binary a",
    ],
)  # fmt: skip
def test_yaml_that_is_none_is_one_line(tmp_path, text):
    (tmp_path / "capture.yaml").write_text(text)
    told = bounded(tmp_path)
    assert told is not None


@settings(max_examples=150, deadline=None)
@given(text=st.text(st.sampled_from("ab:- \n[]{}&*!?|>'\"#%@,.0123456789_~<=\t")) | st.text(max_size=30))
def test_any_yaml_is_a_mapping_or_one_line(tmp_path_factory, text):
    path = tmp_path_factory.mktemp("fuzz") / "a.yaml"
    path.write_text(text, encoding="utf-8", errors="surrogatepass")
    try:
        assert isinstance(read_yaml(path, LabwareError), dict)
    except LabwareError as problem:
        told = str(problem)
    else:
        return
    assert "\n" not in told
