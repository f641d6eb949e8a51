from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from tubepose.capture import CameraIntrinsics, RgbdFrame, open_captures, write_folder_capture
from tubepose.capture.ply import read_ply
from tubepose.errors import CaptureError

STAMP_NS = 1_700_000_000_123_456_789
CAMERA = CameraIntrinsics(width=32, height=24, fx=40.0, fy=41.0, cx=15.25, cy=11.75)


def make_frame(**changes) -> RgbdFrame:
    rng = np.random.default_rng(1)
    depth = rng.uniform(0.5, 1.2, (24, 32))
    depth[3, 4] = np.nan
    frame = RgbdFrame(
        cloud_m=CAMERA.backproject(depth),
        image=rng.integers(0, 256, (24, 32, 3)).astype(np.uint8),
        intrinsics=CAMERA,
        timestamp_ns=STAMP_NS,
        capture="shot",
        sensor="PhoXi M",
        simulated=True,
    )
    return replace(frame, **changes)


def read_one(path: Path, **options) -> RgbdFrame:
    (capture,) = open_captures(path, **options)
    (frame,) = capture.frames()
    return frame


def describe(folder: Path, **keys) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "capture.yaml").write_text(yaml.safe_dump(keys), encoding="utf-8")


def camera_keys(camera: CameraIntrinsics = CAMERA) -> dict[str, float]:
    return {key: getattr(camera, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}


def write_ply(path: Path, xyz: np.ndarray, header: str = "") -> Path:
    lines = "\n".join(" ".join(f"{value:.9g}" for value in row) for row in xyz)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        f"ply\nformat ascii 1.0\n{header}element vertex {len(xyz)}\nproperty float x\nproperty float y\n"
        f"property float z\nend_header\n{lines}\n"
    )
    return path


def write_png(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), pixels)


# Round trips ---------------------------------------------------------------------------------------------------------


def test_depth_capture_survives_the_round_trip(tmp_path):
    frame = make_frame()
    write_folder_capture(tmp_path / "shot", frame)
    again = read_one(tmp_path / "shot")
    assert sorted(file.name for file in (tmp_path / "shot").iterdir()) == ["capture.yaml", "depth.png", "image.png"]
    np.testing.assert_allclose(again.cloud_m, frame.cloud_m, atol=1.01e-5)
    np.testing.assert_array_equal(again.image, frame.image)
    assert (again.timestamp_ns, again.intrinsics, again.capture) == (STAMP_NS, CAMERA, "shot")
    assert (again.sensor, again.simulated, again.organised) == ("PhoXi M", True, True)


def test_cloud_without_intrinsics_survives_as_ply(tmp_path):
    frame = make_frame(intrinsics=None, image=None, simulated=False)
    write_folder_capture(tmp_path / "shot", frame)
    again = read_one(tmp_path / "shot")
    assert (tmp_path / "shot" / "cloud.ply").is_file()
    np.testing.assert_array_equal(again.cloud_m, frame.cloud_m.astype(np.float32).astype(float))
    assert (again.timestamp_ns, again.intrinsics, again.image, again.simulated) == (STAMP_NS, None, None, False)


def test_points_off_their_lines_of_sight_are_not_forced_into_a_depth_image(tmp_path):
    shifted = make_frame().cloud_m + np.array([0.002, 0.0, 0.0])
    write_folder_capture(tmp_path / "shot", make_frame(cloud_m=shifted))
    again = read_one(tmp_path / "shot")
    np.testing.assert_allclose(again.cloud_m, shifted, atol=1e-6)
    assert again.intrinsics == CAMERA


def test_unorganised_cloud_stays_unorganised(tmp_path):
    cloud = make_frame().cloud_m.reshape(1, -1, 3)
    write_folder_capture(tmp_path / "shot", make_frame(cloud_m=cloud, image=None, intrinsics=None, organised=False))
    again = read_one(tmp_path / "shot")
    assert again.cloud_m.shape == (1, 24 * 32, 3)
    assert not again.organised


def test_same_frame_gives_same_bytes(tmp_path):
    for name in ("a", "b"):
        write_folder_capture(tmp_path / name, make_frame())
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


def test_writer_leaves_nothing_partial_and_overwrites_nothing(tmp_path):
    with pytest.raises(CaptureError, match=r"farthest point is at .* m, 16 bits reach 0\.655 m"):
        write_folder_capture(tmp_path / "shot", make_frame(), depth_scale_m=1e-5)
    assert list(tmp_path.iterdir()) == []
    write_folder_capture(tmp_path / "shot", make_frame())
    with pytest.raises(CaptureError, match="there is something already"):
        write_folder_capture(tmp_path / "shot", make_frame())


# PLY -----------------------------------------------------------------------------------------------------------------

_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_KINDS = {"float": "f4", "double": "f8", "short": "i2", "uchar": "u1", "int32": "i4"}


@settings(max_examples=60)
@given(
    order=st.sampled_from(sorted(_ORDERS)),
    coordinate=st.sampled_from(["float", "double"]),
    extra=st.lists(st.sampled_from(sorted(_KINDS)), max_size=3),
    at=st.integers(0, 3),
    before=st.integers(0, 2),
    newline=st.sampled_from(["\n", "\r\n"]),
    values=st.lists(st.tuples(*[st.sampled_from([0.0, 1.5, -2.25, 1e4, float("nan")])] * 3), max_size=6),
)
def test_every_ply_layout_gives_its_points_in_order(
    tmp_path_factory, order, coordinate, extra, at, before, newline, values
):
    names = [(f"q{i}", kind) for i, kind in enumerate(extra)]
    at = min(at, len(names))
    names[at:at] = [(axis, coordinate) for axis in "zxy"]
    vertex = np.dtype([(name, _ORDERS[order] + _KINDS[kind]) for name, kind in names])
    table = np.zeros(len(values), vertex)
    for axis, column in zip("xyz", np.array(values).reshape(-1, 3).T, strict=True):
        table[axis] = column
    head = ["ply", f"format {order} 1.0", "comment made by a test"]
    if before:
        head += [f"element camera {before}", "property float view", "property uchar flag"]
    head += [f"element vertex {len(values)}", *[f"property {kind} {name}" for name, kind in names], "end_header"]
    if order == "ascii":
        rows = ["1.5 7"] * before + [" ".join(repr(value.item()) for value in row) for row in table]
        body = "".join(row + newline for row in rows).encode()
    else:
        body = np.zeros(before, [("view", _ORDERS[order] + "f4"), ("flag", "u1")]).tobytes() + table.tobytes()
    path = tmp_path_factory.mktemp("ply") / "cloud.ply"
    path.write_bytes((newline.join(head) + newline).encode() + body)
    np.testing.assert_array_equal(read_ply(path).xyz, np.array(values).reshape(-1, 3))


def test_zeros_and_nan_are_invalid_and_keep_their_place(tmp_path):
    xyz = np.array([[0, 0, 0], [np.nan, 1, 2], [1, 2, 3], [0, 0, 4.0]])
    frame = read_one(write_ply(tmp_path / "scan.ply", xyz))
    np.testing.assert_array_equal(frame.valid, [False, False, True, True])
    np.testing.assert_array_equal(frame.points_m[2:], xyz[2:])
    assert np.isnan(frame.points_m[:2]).all()


def test_a_folder_that_may_not_be_read_is_listed_and_the_others_are_read(tmp_path, monkeypatch):
    for name in ("a", "b", "c"):
        write_folder_capture(tmp_path / name, make_frame())
    closed = tmp_path / "b"
    monkeypatch.setattr("os.access", lambda path, _mode: Path(path) != closed)
    found = open_captures(tmp_path)
    assert [capture.name for capture in found] == ["a", "b", "c"]
    for capture in (found[1], *open_captures(closed)):
        with pytest.raises(CaptureError, match="b: may not be read by this user; change its permissions"):
            list(capture.frames())
    assert len(list(found[2].frames())) == 1


@pytest.mark.parametrize(("unit", "scale"), [(None, 1.0), ("m", 1.0), ("mm", 1e-3)])
def test_unit_of_a_ply(tmp_path, unit, scale):
    path = write_ply(tmp_path / "scan.ply", np.array([[100.0, 200.0, 300.0]]))
    np.testing.assert_allclose(read_one(path, unit=unit).points_m, np.array([[100.0, 200.0, 300.0]]) * scale)


def test_typed_unit_goes_before_the_file(tmp_path):
    describe(tmp_path / "shot", unit="m")
    write_ply(tmp_path / "shot" / "cloud.ply", np.array([[100.0, 200.0, 300.0]]))
    np.testing.assert_allclose(read_one(tmp_path / "shot", unit="mm").points_m, [[0.1, 0.2, 0.3]])
    np.testing.assert_allclose(read_one(tmp_path / "shot").points_m, [[100.0, 200.0, 300.0]])


@pytest.mark.parametrize(
    "header",
    [
        "obj_info num_cols 3\nobj_info num_rows 2\n",
        "comment width: 3\ncomment height: 2\n",
        "obj_info width 3\ncomment rows 2\n",
    ],
)
def test_header_says_how_a_cloud_is_organised(tmp_path, header):
    xyz = np.arange(18, dtype=float).reshape(6, 3) + 1
    frame = read_one(write_ply(tmp_path / "scan.ply", xyz, header))
    assert frame.organised
    np.testing.assert_array_equal(frame.cloud_m, xyz.reshape(2, 3, 3))


def test_header_with_another_number_of_points_is_not_believed(tmp_path):
    frame = read_one(write_ply(tmp_path / "scan.ply", np.ones((5, 3)), "obj_info num_cols 3\nobj_info num_rows 2\n"))
    assert not frame.organised
    assert frame.cloud_m.shape == (1, 5, 3)


@pytest.mark.parametrize("sides", [(6, 1), (1, 6)])
def test_a_cloud_of_one_row_is_not_organised(tmp_path, sides):
    header = "obj_info num_cols {}\nobj_info num_rows {}\n".format(*sides)
    frame = read_one(write_ply(tmp_path / "scan.ply", np.ones((6, 3)), header))
    assert not frame.organised
    assert frame.cloud_m.shape == (1, 6, 3)


def test_image_of_as_many_pixels_organises_a_cloud(tmp_path):
    xyz = np.arange(18, dtype=float).reshape(6, 3) + 1
    write_ply(tmp_path / "shot" / "cloud.ply", xyz)
    write_png(tmp_path / "shot" / "image.png", np.zeros((2, 3), np.uint8))
    np.testing.assert_array_equal(read_one(tmp_path / "shot").cloud_m, xyz.reshape(2, 3, 3))


def test_colours_of_an_organised_cloud_are_its_image(tmp_path):
    table = np.zeros(6, [(axis, "<f4") for axis in "xyz"] + [(c, "u1") for c in ("red", "green", "blue")])
    table["z"], table["red"], table["blue"] = 1, np.arange(6), 9
    properties = "".join(f"property float {axis}\n" for axis in "xyz")
    colours = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    head = "ply\nformat binary_little_endian 1.0\nobj_info num_cols 3\nobj_info num_rows 2\nelement vertex 6\n"
    (tmp_path / "scan.ply").write_bytes((head + properties + colours + "end_header\n").encode() + table.tobytes())
    image = read_one(tmp_path / "scan.ply").image
    assert image is not None
    np.testing.assert_array_equal(image[..., 0], [[0, 1, 2], [3, 4, 5]])
    assert (image[..., 1:] == [0, 9]).all()


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian"])
@pytest.mark.parametrize("keep", [0.3, 0.7, 0.99])
def test_cut_ply_is_refused(tmp_path, order, keep):
    xyz = np.random.default_rng(0).uniform(0.1, 1, (100, 3))
    path = tmp_path / "scan.ply"
    if order == "ascii":
        write_ply(path, xyz)
    else:
        write_folder_capture(
            tmp_path / "w", make_frame(cloud_m=xyz[None], image=None, intrinsics=None, organised=False)
        )
        path.write_bytes((tmp_path / "w" / "cloud.ply").read_bytes())
    whole = path.read_bytes()
    path.write_bytes(whole[: int(len(whole) * keep)])
    with pytest.raises(CaptureError, match=r"scan\.ply: (truncated: the header promises 100|a vertex line is cut)"):
        read_one(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected a PLY file"),
        (b"\x00" * 64, "expected a PLY file"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\n", "no 'end_header' line"),
        (b"ply\nformat ascii 1.0\nelement face 0\nend_header\n", "'element vertex', found face"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n1\n", "x, y and z, found x"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 0\n"
            b"property float x\nproperty float y\nproperty float z\nproperty list uchar int q\nend_header\n",
            "holds a list",
        ),
        (b"ply\nformat gzip 1.0\nelement vertex 0\nend_header\n", "expected a PLY of format ascii"),
        (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty half x\nend_header\n", "found 'property half x'"),
    ],
)
def test_file_that_is_no_ply_is_refused(tmp_path, content, message):
    (tmp_path / "scan.ply").write_bytes(content)
    with pytest.raises(CaptureError, match=message):
        read_one(tmp_path / "scan.ply")


# capture.yaml --------------------------------------------------------------------------------------------------------


def test_depth_in_millimetres(tmp_path):
    counts = np.full((24, 32), 700, np.uint16)
    counts[0, 0], counts[0, 1] = 0, 65535
    write_png(tmp_path / "shot" / "depth.png", counts)
    describe(tmp_path / "shot", unit="mm", intrinsics=camera_keys())
    frame = read_one(tmp_path / "shot")
    np.testing.assert_allclose(frame.cloud_m[1:, :, 2], 0.7)
    assert np.isnan(frame.cloud_m[0, :2]).all()
    np.testing.assert_allclose(frame.intrinsics.project(frame.cloud_m[5, 7]), [7, 5])


def test_jpeg_image_and_16_bit_image_are_read(tmp_path):
    write_folder_capture(tmp_path / "shot", make_frame(image=None))
    picture = np.zeros((24, 32, 3), np.uint8)
    picture[..., 2] = 200
    assert cv2.imwrite(str(tmp_path / "shot" / "image.jpg"), picture)
    red = read_one(tmp_path / "shot").image
    assert red is not None
    assert red[..., 0].mean() > 150 > red[..., 2].mean()
    ramp = np.linspace(1000, 3000, 24 * 32).reshape(24, 32).astype(np.uint16)
    write_png(tmp_path / "shot" / "image.png", ramp)
    gray = read_one(tmp_path / "shot").image
    assert gray is not None
    assert gray.dtype == np.uint8
    assert (int(gray.min()), int(gray.max())) == (0, 255)


def test_cloud_that_is_not_pixel_to_pixel_is_projected(tmp_path):
    T_image_cloud = np.eye(4)
    T_image_cloud[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    T_image_cloud[:3, 3] = [10, -20, 5]
    cloud = make_frame().points_m * 1000
    cloud_frame = (cloud - T_image_cloud[:3, 3]) @ T_image_cloud[:3, :3]
    write_ply(tmp_path / "shot" / "cloud.ply", cloud_frame[::-1])
    write_png(tmp_path / "shot" / "image.png", make_frame().image)
    describe(tmp_path / "shot", unit="mm", intrinsics=camera_keys(), T_image_cloud=T_image_cloud.tolist())
    frame = read_one(tmp_path / "shot")
    assert frame.organised
    assert frame.intrinsics == CAMERA
    np.testing.assert_allclose(frame.cloud_m, make_frame().cloud_m, atol=1e-6)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({}, "the key 'unit' is missing"),
        ({"unit": "cm"}, r"unit: Input should be 'm' or 'mm' \(found 'cm'\)"),
        ({"unit": "m", "units": 3}, "unknown key 'units'; known keys: unit, cloud"),
        ({"unit": "m", "intrinsics": {**camera_keys(), "f": 1}}, "unknown key 'intrinsics.f'; known keys: width"),
        ({"unit": "m", "timestamp_ns": 1.7e18}, "timestamp_ns"),
        ({"unit": "mm", "depth_scale_m": 2e-5}, "one count of the depth image is 0.001 m, depth_scale_m says 2e-05"),
        ({"unit": "m", "depth_scale_m": 2.0}, "depth_scale_m is in metres per count"),
        ({"unit": "m", "cloud": "a.ply", "depth": "d.png"}, "'cloud' and 'depth' are both given"),
        ({"unit": "m", "cloud_width": 3}, "cloud_width and cloud_height belong together"),
        ({"unit": "m", "T_image_cloud": np.eye(4).tolist()}, "T_image_cloud needs 'intrinsics'"),
        ({"unit": "m", "T_image_cloud": np.diag([2, 1, 1, 1.0]).tolist()}, "no rigid transform"),
        ({"unit": "m"}, "neither cloud.ply nor depth.png"),
        ({"unit": "m", "cloud": "gone.ply"}, r"gone\.ply: no such file"),
    ],
)
def test_wrong_description_is_refused_in_one_line(tmp_path, keys, message):
    describe(tmp_path / "shot", **keys)
    with pytest.raises(CaptureError, match=message) as caught:
        read_one(tmp_path / "shot")
    assert "\n" not in str(caught.value)


def test_depth_without_intrinsics_or_scale_says_what_to_write(tmp_path):
    write_png(tmp_path / "shot" / "depth.png", np.ones((24, 32), np.uint16))
    with pytest.raises(CaptureError, match=r"write one with 'unit: mm'.*'intrinsics: \{width"):
        read_one(tmp_path / "shot")
    describe(tmp_path / "shot", unit="mm")
    with pytest.raises(CaptureError, match=r"needs the camera's intrinsics; write into capture\.yaml"):
        read_one(tmp_path / "shot")
    describe(tmp_path / "shot", unit="m", intrinsics=camera_keys())
    with pytest.raises(CaptureError, match="cannot be whole metres"):
        read_one(tmp_path / "shot")


def test_image_and_cloud_of_different_sizes_are_refused_with_both_sizes(tmp_path):
    write_folder_capture(tmp_path / "shot", make_frame(image=None, intrinsics=None))
    write_png(tmp_path / "shot" / "image.png", np.zeros((48, 64), np.uint8))
    with pytest.raises(CaptureError, match=r"the image is 64 x 48 pixels, the cloud 32 x 24; give 'intrinsics'"):
        read_one(tmp_path / "shot")


def test_intrinsics_of_another_size_are_refused(tmp_path):
    write_png(tmp_path / "shot" / "depth.png", np.ones((12, 16), np.uint16))
    describe(tmp_path / "shot", unit="mm", intrinsics=camera_keys())
    with pytest.raises(CaptureError, match=r"depth\.png is 16 x 12 pixels, intrinsics 32 x 24"):
        read_one(tmp_path / "shot")


def test_picture_of_depth_and_cut_png_are_refused(tmp_path, capfd):
    describe(tmp_path / "shot", unit="mm", intrinsics=camera_keys())
    write_png(tmp_path / "shot" / "depth.png", np.zeros((24, 32, 3), np.uint8))
    with pytest.raises(CaptureError, match=r"16 bits and 1 channel \(or of floats\), found 8 bits and 3 channel"):
        read_one(tmp_path / "shot")
    write_png(tmp_path / "shot" / "depth.png", np.ones((24, 32), np.uint16))
    whole = (tmp_path / "shot" / "depth.png").read_bytes()
    (tmp_path / "shot" / "depth.png").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CaptureError, match=r"depth\.png: truncated"):
        read_one(tmp_path / "shot")
    assert capfd.readouterr() == ("", "")


def test_cloud_and_depth_together_must_be_told_apart(tmp_path):
    write_folder_capture(tmp_path / "shot", make_frame())
    write_ply(tmp_path / "shot" / "cloud.ply", np.ones((3, 3)))
    describe(tmp_path / "shot", unit="m")
    with pytest.raises(CaptureError, match=r"both cloud\.ply and depth\.png"):
        read_one(tmp_path / "shot")


# open_captures -------------------------------------------------------------------------------------------------------


def test_directory_is_searched_in_order_without_the_truth(tmp_path):
    for name in ("b/original", "b/printed", "a", "simulation_truth/hidden"):
        write_folder_capture(tmp_path / name, make_frame())
    write_ply(tmp_path / "b" / "scan.ply", np.ones((3, 3)))
    (tmp_path / "b" / "scan.zdf").write_bytes(b"")
    (tmp_path / "notes.txt").write_text("nothing")
    names = [capture.name for capture in open_captures(tmp_path)]
    assert names == ["a", "b/original", "b/printed", "b/scan.ply", "b/scan.zdf"]


def test_bad_capture_does_not_stop_the_others(tmp_path):
    write_folder_capture(tmp_path / "a", make_frame())
    describe(tmp_path / "b", unit="parsec")
    write_folder_capture(tmp_path / "c", make_frame())
    outcome = []
    for capture in open_captures(tmp_path):
        try:
            outcome += [len(list(capture.frames()))]
        except CaptureError as problem:
            outcome += [str(problem)]
    assert outcome[0] == outcome[2] == 1
    assert "found 'parsec'" in outcome[1]


def test_what_is_left_of_a_capture_is_told_of(tmp_path):
    write_folder_capture(tmp_path / "whole", make_frame())
    for name in ("lost/image.png", "capitals/DEPTH.PNG", "overview/image.png"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).touch()
    write_folder_capture(tmp_path / "overview" / "inside", make_frame())
    (tmp_path / "empty").mkdir()
    captures = {capture.name: capture for capture in open_captures(tmp_path)}
    assert list(captures) == ["capitals", "lost", "overview/inside", "whole"]
    for name, word in (("lost", "image.png"), ("capitals", "DEPTH.PNG")):
        with pytest.raises(CaptureError, match=f"{name}: no capture: {word} without cloud.ply, depth.png or"):
            list(captures[name].frames())


@pytest.mark.parametrize("suffix", [".zdf", ".praw"])
def test_other_formats_say_how_to_convert(tmp_path, suffix):
    (tmp_path / f"scan{suffix}").write_bytes(b"")
    with pytest.raises(CaptureError, match=r"convert|save it as PLY"):
        read_one(tmp_path / f"scan{suffix}")


def test_nothing_to_open_is_said(tmp_path):
    with pytest.raises(CaptureError, match="no such file or folder"):
        open_captures(tmp_path / "gone")
    with pytest.raises(CaptureError, match=r"no capture found; looked .* capture\.yaml, cloud\.ply or depth\.png"):
        open_captures(tmp_path)
    (tmp_path / "scan.xyz").write_text("1 2 3")
    with pytest.raises(CaptureError, match=r"ending in \.ply, \.pcd, \.ptx, \.mcap, \.db3, \.bag, found '\.xyz'"):
        open_captures(tmp_path / "scan.xyz")
    with pytest.raises(CaptureError, match="unit 'cm' is not known; expected m or mm"):
        open_captures(tmp_path, unit="cm")


def write_depth_capture(folder: Path, **keys) -> None:
    describe(folder, **({"unit": "mm", "intrinsics": camera_keys()} | keys))
    cv2.imwrite(str(folder / "depth.png"), np.full((24, 32), 700, np.uint16))


def test_a_link_in_a_circle_leads_nowhere_new(tmp_path):
    write_depth_capture(tmp_path / "in" / "one")
    (tmp_path / "in" / "loop").symlink_to(tmp_path / "in")
    (tmp_path / "in" / "up").symlink_to(tmp_path)
    (tmp_path / "in" / "again").symlink_to(tmp_path / "in" / "one")
    write_depth_capture(tmp_path / "beside")
    assert [capture.name for capture in open_captures(tmp_path / "in")] == ["again", "one"]


def test_a_unit_that_is_typed_goes_before_the_files_for_depth_too(tmp_path):
    write_depth_capture(tmp_path / "one")
    frame = read_one(tmp_path / "one")
    write_depth_capture(tmp_path / "one", unit="m")
    with pytest.raises(CaptureError, match="16-bit counts cannot be whole metres"):
        read_one(tmp_path / "one")
    np.testing.assert_array_equal(read_one(tmp_path / "one", unit="mm").cloud_m, frame.cloud_m)
    write_depth_capture(tmp_path / "one")
    np.testing.assert_array_equal(read_one(tmp_path / "one", unit="m").cloud_m, frame.cloud_m)  # no count is a metre


@pytest.mark.parametrize("stamp", [-5, 10**25])
def test_a_stamp_that_is_none_is_one_line(tmp_path, stamp):
    write_depth_capture(tmp_path / "one", timestamp_ns=stamp)
    with pytest.raises(CaptureError, match="timestamp_ns"):
        read_one(tmp_path / "one")
