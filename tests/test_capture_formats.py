"""Files of other programs: clouds, depth images, and folders of them."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tubepose.batch import trial_capture
from tubepose.capture import CameraIntrinsics, RgbdFrame, open_captures
from tubepose.capture.formats.text_numbers import read_rows
from tubepose.capture.session import load_session
from tubepose.errors import CaptureError

W, H = 14, 11
CAMERA = CameraIntrinsics(W, H, 20.0, 21.0, 6.5, 5.25)
SPELLINGS = (
    *("nan", "-nan", "NaN", "nan(ind)", "-nan(ind)", "nan(snan)", "-nan(snan)", "nan(0x8000000000000)"),
    *("1.#QNAN", "-1.#IND", "1.#IND00", "-1.#IND000000", "1.#SNAN", "1.#QNAN0", "1.#R", "-1.#J", "1.#INF", "-1.#INF00"),
)


def scene() -> tuple[np.ndarray, np.ndarray]:
    """An organised cloud (H, W, 3) in metres with holes, and its picture."""
    rng = np.random.default_rng(7)
    v, u = np.mgrid[:H, :W]
    depth = 0.6 + 0.002 * u + 0.003 * v + rng.normal(0, 1e-4, (H, W))
    depth[2, 3] = depth[0, 0] = depth[-1, -1] = np.nan
    return CAMERA.backproject(depth), rng.integers(0, 256, (H, W, 3)).astype(np.uint8)


CLOUD, PICTURE = scene()


def read(path: Path, **options) -> RgbdFrame:
    (capture,) = open_captures(path, **options)
    return next(iter(capture.frames()))


def refusal(path: Path, **options) -> str:
    with pytest.raises(CaptureError) as caught:
        read(path, **options)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def check(frame: RgbdFrame, *, picture: np.ndarray | None = PICTURE, atol: float = 1e-6) -> None:
    assert frame.organised
    np.testing.assert_allclose(frame.cloud_m, CLOUD, atol=atol)
    if picture is None:
        assert frame.image is None
    else:
        np.testing.assert_array_equal(frame.image, picture)


# PLY -----------------------------------------------------------------------------------------------------------------


def write_phoxi_ply(path: Path, size_line: str, extra: bool = False) -> Path:
    """As PhoXi Control writes it: millimetres, zeros for missing points, other elements behind the vertices."""
    kinds = [*((name, "<f4") for name in ("x", "y", "z", "nx", "ny", "nz"))]
    kinds += [*((name, "u1") for name in ("red", "green", "blue")), ("Texture32", "<f4")]
    table = np.zeros(W * H, kinds)
    for i, axis in enumerate("xyz"):
        table[axis] = np.nan_to_num(CLOUD[..., i].ravel() * 1e3)
    for i, name in enumerate(("red", "green", "blue")):
        table[name] = PICTURE[..., i].ravel()
    words = {"<f4": "float", "u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", size_line, f"element vertex {W * H}"]
    lines += [f"property {words[kind]} {name}" for name, kind in kinds]
    tail = b""
    if extra:
        lines += ["element camera 1", "property float view_px", "element phoxi_frame_params 1"]
        lines += ["property uint32 frame_width", "property uint32 frame_height"]
        tail = struct.pack("<fII", 1.0, W, H)
    path.write_bytes(("\n".join([*lines, "end_header"]) + "\n").encode() + table.tobytes() + tail)
    return path


@pytest.mark.parametrize(
    "line",
    [
        f"obj_info Photoneo PLY PointCloud ( Width = {W}; Height = {H})",
        f"obj_info Photoneo PLY PointCloud (Width = {W}; Height = {H}; Ordered)",
        f"obj_info Zivid point cloud width: {W} height: {H}",
    ],
)
@pytest.mark.parametrize("unit", [None, "mm"])
def test_size_and_unit_of_programs_that_write_millimetres(tmp_path, line, unit):
    check(read(write_phoxi_ply(tmp_path / "scan.ply", line), unit=unit))


def test_what_the_user_says_of_the_unit_overrides_the_header(tmp_path):
    path = write_phoxi_ply(tmp_path / "scan.ply", f"obj_info Photoneo PLY PointCloud ( Width = {W}; Height = {H})")
    np.testing.assert_allclose(read(path, unit="m").cloud_m, CLOUD * 1e3, rtol=1e-5)


@pytest.mark.parametrize(
    ("line", "metres"), [("comment made by me, unit metre", 1), ("comment unit: mm", 1e-3), ("comment by phoxi", 1)]
)
def test_unit_line_of_a_header(tmp_path, line, metres):
    path = write_phoxi_ply(tmp_path / "scan.ply", line, extra=True)
    np.testing.assert_allclose(read(path).cloud_m, CLOUD * 1e3 * metres, rtol=1e-5)


def test_size_from_the_frame_parameters_of_phoxi_control(tmp_path):
    check(read(write_phoxi_ply(tmp_path / "scan.ply", "comment nothing", extra=True), unit="mm"))


@pytest.mark.parametrize("order", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_size_from_the_camera_of_pcl(tmp_path, order):
    """PCL: an `element camera` behind the vertices."""
    floats, ints = ("view_px", "view_py", "k1", "k2"), ("viewportx", "viewporty")
    head = ["ply", f"format {order} 1.0", "comment PCL generated", f"element vertex {W * H}"]
    head += [*(f"property float {axis}" for axis in "xyz"), "element camera 1"]
    head += [*(f"property float {name}" for name in floats), *(f"property int {name}" for name in ints), "end_header"]
    points = CLOUD.reshape(-1, 3)
    if order == "ascii":
        rows = [" ".join(f"{x:.8g}" for x in row) for row in points] + [f"0 0 0 0 {W} {H}"]
        body = "\n".join(rows).encode()
    else:
        end = "<" if "little" in order else ">"
        body = points.astype(f"{end}f4").tobytes() + struct.pack(f"{end}4f2i", 0, 0, 0, 0, W, H)
    (tmp_path / "scan.ply").write_bytes("\n".join(head).encode() + b"\n" + body)
    check(read(tmp_path / "scan.ply"), picture=None)


@pytest.mark.parametrize("spelling", SPELLINGS)
@pytest.mark.parametrize("per_line", [1, 3])
def test_every_spelling_of_nan_in_text(tmp_path, spelling, per_line):
    numbers = [spelling if np.isnan(x) else f"{x:.8g}" for x in CLOUD.ravel()]
    rows = [" ".join(numbers[i : i + per_line]) for i in range(0, len(numbers), per_line)]
    head = f"ply\nformat ascii 1.0\nobj_info num_cols {W}\nobj_info num_rows {H}\nelement vertex {W * H}\n"
    head += "property float x\nproperty float y\nproperty float z\nend_header\n"
    (tmp_path / "scan.ply").write_text(head + "\n".join(rows))
    check(read(tmp_path / "scan.ply"), picture=None)


def test_numbers_that_are_cut_or_none_are_refused_whatever_their_lines():
    assert read_rows(b"1\n2\n3\n4\n5\n6\n", (0, 0), 2, 3).tolist() == [[1, 2, 3], [4, 5, 6]]
    assert read_rows(b"1 2 3 9\n4 5 6 9\n", (1, 4), 5, 3).tolist() == [[4, 5, 6]]
    assert len(read_rows(b"1\n2\n3\n4\n", (0, 0), 2, 3)) == 1
    for text in (b"1\n2\nthree\n", b"1 2 x\n", b"1,5 2 3\n"):
        with pytest.raises(ValueError, match=r".+"):
            read_rows(text, (0, 0), 1, 3)


# PCD -----------------------------------------------------------------------------------------------------------------


def lzf(data: bytes) -> bytes:
    """LZF by the book: the longest of copies at one byte and at four back, else single bytes."""
    out, i = bytearray(), 0
    while i < len(data):
        best = (0, 0)
        for back in (1, 4, 300):
            n = 0
            while back <= i and n < 264 and i + n < len(data) and data[i + n] == data[i - back + n]:
                n += 1
            best = max(best, (n, back))
        length, back = best
        if length < 3:
            out += bytes([0, data[i]])
            i += 1
            continue
        high, low = (back - 1) >> 8, (back - 1) & 255
        out += bytes([((length - 2) << 5) | high, low] if length < 9 else [(7 << 5) | high, length - 9, low])
        i += length
    return bytes(out)


def pcd(data: str, colours: str | None = "F", size: tuple[int, int] = (W, H)) -> bytes:
    """A PCD as the Point Cloud Library writes it."""
    points = CLOUD.reshape(-1, 3).astype("<f4")
    rgb = PICTURE.reshape(-1, 3).astype(np.uint32)
    packed = (rgb[:, 0] << 16) | (rgb[:, 1] << 8) | rgb[:, 2]
    fields, sizes, kinds = ("x y z", "4 4 4", "F F F")
    if colours:
        fields, sizes, kinds = f"{fields} rgb", f"{sizes} 4", f"{kinds} {colours}"
    counts = " ".join("1" * len(fields.split()))
    head = f"# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS {fields}\nSIZE {sizes}\nTYPE {kinds}\n"
    head += f"COUNT {counts}\nWIDTH {size[0]}\nHEIGHT {size[1]}\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {W * H}\nDATA {data}\n"
    if data == "ascii":
        tail = packed.view("<f4") if colours == "F" else packed
        rows = [" ".join(f"{x:.9g}" for x in p) + (f" {t:.9g}" if colours == "F" else f" {t}" if colours else "")
                for p, t in zip(points, tail, strict=True)]  # fmt: skip
        return head.encode() + "\n".join(rows).encode()
    columns = [*points.T, *([packed.astype("<u4").view("<f4")] if colours else [])]
    if data == "binary":
        return head.encode() + np.stack(columns, axis=1).astype("<f4").tobytes()
    plain = b"".join(column.astype("<f4").tobytes() for column in columns)
    packed_bytes = lzf(plain)
    return head.encode() + struct.pack("<II", len(packed_bytes), len(plain)) + packed_bytes


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
@pytest.mark.parametrize("colours", ["F", "U", None])
def test_organised_pcd(tmp_path, data, colours):
    (tmp_path / "scan.pcd").write_bytes(pcd(data, colours))
    check(read(tmp_path / "scan.pcd"), picture=None if colours is None else PICTURE)


def test_pcd_of_one_row_has_no_pixels(tmp_path):
    (tmp_path / "scan.pcd").write_bytes(pcd("binary", size=(W * H, 1)))
    frame = read(tmp_path / "scan.pcd")
    assert not frame.organised
    assert frame.image is None
    np.testing.assert_allclose(frame.points_m, CLOUD.reshape(-1, 3), atol=1e-6)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b"DATA binary", b"DATA zip", "expected DATA ascii"),
        (b"WIDTH 14", b"WIDTH 15", "are not the 154 POINTS"),
        (b"WIDTH 14", b"WIDTH -1", "expected 'WIDTH NUMBER'"),
        (b"TYPE F F F F", b"TYPE F F X F", "field z: expected TYPE"),
        (b"SIZE 4 4 4 4", b"SIZE 4 4 4", "of one length"),
        (b"FIELDS x y z", b"FIELDS x y q", "expected the fields x, y and z"),
    ],
)
def test_wrong_pcd_is_refused(tmp_path, old, new, message):
    content = pcd("binary")
    assert old in content
    (tmp_path / "scan.pcd").write_bytes(content.replace(old, new))
    assert message in refusal(tmp_path / "scan.pcd")


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_cut_pcd_is_refused(tmp_path, data):
    content = pcd(data)
    (tmp_path / "scan.pcd").write_bytes(content[: len(content) * 3 // 4])
    assert "truncated" in refusal(tmp_path / "scan.pcd") or "is cut" in refusal(tmp_path / "scan.pcd")


def test_pcd_and_ply_that_open3d_wrote(tmp_path):
    """A genuine writer; it has no organised clouds."""
    open3d = pytest.importorskip("open3d")
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(CLOUD.reshape(-1, 3)))
    cloud.colors = open3d.utility.Vector3dVector(PICTURE.reshape(-1, 3) / 255)
    written = {
        "ascii.pcd": {"write_ascii": True}, "binary.pcd": {}, "packed.pcd": {"compressed": True},
        "ascii.ply": {"write_ascii": True}, "binary.ply": {},
    }  # fmt: skip
    for name, options in written.items():
        folder = tmp_path / name
        folder.mkdir()
        assert open3d.io.write_point_cloud(str(folder / f"cloud{Path(name).suffix}"), cloud, **options)
        np.testing.assert_allclose(read(folder).points_m, CLOUD.reshape(-1, 3), atol=1e-6)
        keys = {"unit": "m", "cloud_width": W, "cloud_height": H}
        (folder / "capture.yaml").write_text(yaml.safe_dump(keys))
        check(read(folder))


# PTX -----------------------------------------------------------------------------------------------------------------


def write_ptx(path: Path, cloud_m: np.ndarray, picture: np.ndarray, sides: tuple[int, int]) -> Path:
    head = [str(sides[0]), str(sides[1]), "0 0 0", "1 0 0", "0 1 0", "0 0 1"]
    head += ["1 0 0 0", "0 1 0 0", "0 0 1 0", "0 0 0 1"]
    rows = [
        " ".join(f"{x:.8g}" for x in np.nan_to_num(point * 1e3)) + f" 0.5 {r} {g} {b}"
        for point, (r, g, b) in zip(cloud_m.reshape(-1, 3), picture.reshape(-1, 3), strict=True)
    ]
    path.write_text("\n".join(head + rows) + "\n")
    return path


@pytest.mark.parametrize("sides", [(W, H), (H, W)])
@pytest.mark.parametrize("by_columns", [False, True])
def test_ptx_in_every_order(tmp_path, sides, by_columns):
    turn = (1, 0, 2) if by_columns else (0, 1, 2)
    path = write_ptx(tmp_path / "scan.ptx", CLOUD.transpose(turn), PICTURE.transpose(turn), sides)
    check(read(path, unit="mm"))


def test_unit_of_a_ptx_is_asked_for_and_the_hint_works(tmp_path):
    path = write_ptx(tmp_path / "scan.ptx", CLOUD, PICTURE, (W, H))
    assert "add --unit mm (PhoXi Control writes millimetres) or --unit m" in refusal(path)
    check(read(path, unit="mm"))


def test_wrong_ptx_is_refused(tmp_path):
    path = write_ptx(tmp_path / "scan.ptx", CLOUD, PICTURE, (W, H))
    whole = path.read_text()
    path.write_text("\n".join(whole.splitlines()[:-5]))
    assert "truncated: the header promises 154 points, the file holds 149" in refusal(path, unit="mm")
    path.write_text(whole * 2)
    assert "save one scan a file" in refusal(path, unit="mm")
    path.write_text("x y z\n1 2 3\n")
    assert "expected a PTX file" in refusal(path, unit="mm")


# Depth images --------------------------------------------------------------------------------------------------------


def write_exr(path: Path, channels: dict[str, np.ndarray]) -> None:
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, channels).write(str(path))


DEPTH_M = CLOUD[..., 2]


def write_depth(path: Path, depth: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, depth)
    elif path.suffix == ".exr":
        write_exr(path, {"Z": np.ascontiguousarray(depth, dtype=np.float32)})
    else:
        assert cv2.imwrite(str(path), depth)


CAMERA_KEYS = {key: getattr(CAMERA, key) for key in ("width", "height", "fx", "fy", "cx", "cy")}


@pytest.mark.parametrize("suffix", [".tiff", ".tif", ".exr", ".npy"])
@pytest.mark.parametrize(("unit", "scale"), [("m", 1.0), ("mm", 1e3)])
def test_float_depth_of_a_capture_folder(tmp_path, suffix, unit, scale):
    write_depth(tmp_path / "shot" / f"depth{suffix}", (DEPTH_M * scale).astype(np.float32))
    (tmp_path / "shot" / "capture.yaml").write_text(yaml.safe_dump({"unit": unit, "intrinsics": CAMERA_KEYS}))
    check(read(tmp_path / "shot"), picture=None)


@pytest.mark.parametrize("kind", ["<u2", ">u2", "<i4", "<f8", "<f2"])
def test_numpy_depth_of_every_kind(tmp_path, kind):
    write_depth(tmp_path / "shot" / "depth.npy", np.nan_to_num(DEPTH_M * 1e3).astype(kind))
    (tmp_path / "shot" / "capture.yaml").write_text(yaml.safe_dump({"unit": "mm", "intrinsics": CAMERA_KEYS}))
    check(read(tmp_path / "shot"), picture=None, atol=1e-3)


def test_given_scale_overrides_what_a_folder_says(tmp_path):
    write_depth(tmp_path / "shot" / "depth.npy", np.nan_to_num(DEPTH_M * 1e4).astype(np.uint16))
    (tmp_path / "shot" / "capture.yaml").write_text(yaml.safe_dump({"unit": "mm", "intrinsics": CAMERA_KEYS}))
    check(read(tmp_path / "shot", depth_scale_m=1e-4), picture=None, atol=1e-3)
    assert "expected the metres of one count" in refusal(tmp_path / "shot", depth_scale_m=1000)


def test_channels_of_an_exr(tmp_path):
    depth = DEPTH_M.astype(np.float32)
    (tmp_path / "shot").mkdir()
    (tmp_path / "shot" / "capture.yaml").write_text(yaml.safe_dump({"unit": "m", "intrinsics": CAMERA_KEYS}))
    other = np.zeros_like(depth)
    for channels in (
        {"ViewLayer.Depth.Z": depth, "ViewLayer.Combined.R": other},
        {"R": depth, "G": depth, "B": depth},
        {"Y": depth},
        {"R": depth},
    ):
        write_exr(tmp_path / "shot" / "depth.exr", channels)
        check(read(tmp_path / "shot"), picture=None)
    write_exr(tmp_path / "shot" / "depth.exr", {"R": depth, "G": other, "B": other})
    assert "expected one channel of depth" in refusal(tmp_path / "shot")


def test_infinity_and_what_renderers_write_for_it_are_no_depth(tmp_path):
    depth = DEPTH_M.astype(np.float32)
    depth[1, 1], depth[1, 2], depth[1, 3] = 1e10, np.inf, -1
    write_depth(tmp_path / "shot" / "depth.npy", depth)
    (tmp_path / "shot" / "capture.yaml").write_text(yaml.safe_dump({"unit": "m", "intrinsics": CAMERA_KEYS}))
    assert np.isnan(read(tmp_path / "shot").cloud_m[1, 1:4]).all()


@pytest.mark.parametrize("suffix", [".png", ".npy", ".tiff", ".exr"])
def test_a_lone_depth_image_says_what_to_write_and_that_works(tmp_path, suffix):
    """Following the hint to the letter gives a capture."""
    scale = 1.0 if suffix == ".exr" else 1e3
    kind = np.float32 if suffix == ".exr" else np.uint16
    write_depth(tmp_path / f"shot{suffix}", np.nan_to_num(DEPTH_M * scale).astype(kind))
    told = refusal(tmp_path / f"shot{suffix}")
    assert f"as depth{suffix} beside capture.yaml with 'unit: mm' (or depth_scale_m) and 'intrinsics:" in told
    (tmp_path / "own").mkdir()
    (tmp_path / f"shot{suffix}").rename(tmp_path / "own" / f"depth{suffix}")
    unit = "m" if suffix == ".exr" else "mm"
    (tmp_path / "own" / "capture.yaml").write_text(yaml.safe_dump({"unit": unit, "intrinsics": CAMERA_KEYS}))
    check(read(tmp_path / "own"), picture=None, atol=2e-3)


def test_what_is_no_depth_is_refused(tmp_path):
    (tmp_path / "shot").mkdir()
    (tmp_path / "shot" / "capture.yaml").write_text(yaml.safe_dump({"unit": "mm", "intrinsics": CAMERA_KEYS}))
    for array in (np.zeros((H, W), np.uint8), np.zeros((H, W, 3), np.float32), np.zeros(H, np.float32)):
        np.save(tmp_path / "shot" / "depth.npy", array)
        assert "expected a depth image of 16 bits and 1 channel" in refusal(tmp_path / "shot")
    np.save(tmp_path / "shot" / "depth.npy", np.array([{"a": 1}], dtype=object), allow_pickle=True)
    assert "expected a whole .npy file of one array of numbers" in refusal(tmp_path / "shot")


# Folders -------------------------------------------------------------------------------------------------------------


def write_pictures(folder: Path, names: list[str], suffix: str = ".png") -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        assert cv2.imwrite(str(folder / f"{name}{suffix}"), PICTURE[..., ::-1])


def write_bop(folder: Path, ids: list[int], sensor: str = "", depth_scale: float | None = 0.1) -> Path:
    names = [f"{i:06d}" for i in ids]
    write_pictures(folder / f"rgb{sensor}", names)
    for name in names:
        write_depth(folder / f"depth{sensor}" / f"{name}.png", np.nan_to_num(DEPTH_M * 1e4).astype(np.uint16))
    K = [CAMERA.fx, 0.0, CAMERA.cx, 0.0, CAMERA.fy, CAMERA.cy, 0.0, 0.0, 1.0]
    entry = {"cam_K": K} | ({"depth_scale": depth_scale} if depth_scale is not None else {})
    (folder / f"scene_camera{sensor}.json").write_text(json.dumps({str(i): entry for i in ids}))
    return folder


def test_bop_scene(tmp_path):
    write_bop(tmp_path / "test" / "000003", [0, 7, 12])
    (capture,) = open_captures(tmp_path)
    assert capture.name == "test/000003"
    frames = list(capture.frames())
    assert [frame.index for frame in frames] == [0, 7, 12]
    for frame in frames:
        check(frame, atol=2e-4)
        assert frame.intrinsics == CAMERA


def test_a_bad_frame_of_a_scene_stops_none_of_the_others(tmp_path):
    folder = write_bop(tmp_path / "000003", [0, 7, 12])
    (folder / "depth" / "000007.png").write_bytes(b"no image")
    found = []
    (capture,) = open_captures(folder)
    with pytest.raises(CaptureError, match=r"000007\.png: cannot be decoded.*1 of 3 frames"):
        found.extend(frame.index for frame in capture.frames())
    assert found == [0, 12]


def test_bop_scene_of_several_sensors(tmp_path):
    write_bop(tmp_path / "000003", [0], "_photoneo")
    write_bop(tmp_path / "000003", [1, 2], "_realsense")
    told = refusal(tmp_path / "000003" / ".")
    assert "give one of its camera files: scene_camera_photoneo.json, scene_camera_realsense.json" in told
    check(read(tmp_path / "000003" / "scene_camera_photoneo.json"), atol=2e-4)
    names = {capture.name: len(list(capture.frames())) for capture in open_captures(tmp_path)}
    assert names == {"000003/scene_camera_photoneo": 1, "000003/scene_camera_realsense": 2}


def test_bop_without_scale_asks_for_it(tmp_path):
    folder = write_bop(tmp_path / "000003", [0], depth_scale=None)
    assert "add --depth-scale METRES" in refusal(folder)
    check(read(folder, depth_scale_m=1e-4), atol=2e-4)


def write_open3d(folder: Path, keys: dict[str, object], depth: np.ndarray, suffix: str = ".png") -> Path:
    write_pictures(folder / "color", ["000000", "000001"], ".png")
    for name in ("000000", "000001"):
        write_depth(folder / "depth" / f"{name}{suffix}", depth)
    column_by_column = [CAMERA.fx, 0, 0, 0, CAMERA.fy, 0, CAMERA.cx, CAMERA.cy, 1]
    camera = {"width": W, "height": H, "intrinsic_matrix": column_by_column}
    (folder / "intrinsic.json").write_text(json.dumps(camera | keys))
    return folder


def test_open3d_folder_with_its_scale(tmp_path):
    counts = np.nan_to_num(DEPTH_M * 1e4).astype(np.uint16)
    folder = write_open3d(tmp_path / "rec", {"depth_scale": 10000.0}, counts)
    (capture,) = open_captures(folder)
    frames = list(capture.frames())
    assert [frame.index for frame in frames] == [0, 1]
    for frame in frames:
        check(frame, atol=2e-4)
        assert frame.intrinsics == CAMERA


def test_open3d_folder_without_scale_asks_and_each_hint_works(tmp_path):
    folder = write_open3d(tmp_path / "rec", {}, np.nan_to_num(DEPTH_M * 1e3).astype(np.uint16))
    told = refusal(folder)
    assert "add --depth-scale METRES, the metres of one count (0.001 for millimetres), or --unit mm" in told
    for options in ({"unit": "mm"}, {"depth_scale_m": 0.001}):
        for frame in open_captures(folder, **options)[0].frames():
            check(frame, atol=2e-3)
    assert "16-bit counts cannot be whole metres; add --unit mm, or --depth-scale" in refusal(folder, unit="m")


@pytest.mark.parametrize("suffix", [".tiff", ".exr", ".npy"])
def test_open3d_folder_of_floats(tmp_path, suffix):
    folder = write_open3d(tmp_path / "rec", {}, DEPTH_M.astype(np.float32), suffix)
    assert "add --depth-scale" in refusal(folder)
    for options in ({"unit": "m"}, {"depth_scale_m": 1.0}):
        for frame in open_captures(folder, **options)[0].frames():
            check(frame)


def write_foundation_pose(folder: Path, names: list[str]) -> Path:
    write_pictures(folder / "rgb", names)
    for name in names:
        write_depth(folder / "depth" / f"{name}.png", np.nan_to_num(DEPTH_M * 1e3).astype(np.uint16))
    text = f"{CAMERA.fx:.6e} 0 {CAMERA.cx:.6e}\n0 {CAMERA.fy:.6e} {CAMERA.cy:.6e}\n0 0 1\n"
    (folder / "cam_K.txt").write_text(text)
    return folder


def test_foundation_pose_folder(tmp_path):
    folder = write_foundation_pose(tmp_path / "demo", ["1581120424", "1581120500"])
    told = refusal(folder)
    assert "0.001 for millimetres, which FoundationPose's own reader expects" in told
    for frame in open_captures(folder, depth_scale_m=0.001)[0].frames():
        check(frame, atol=2e-3)
        assert frame.intrinsics == CAMERA


def test_depth_scale_of_a_session(tmp_path):
    write_foundation_pose(tmp_path / "shot", ["0"])
    trial = {"name": "one", "tubes": {}, "original": "shot"}
    keys = {"format": 1, "name": "s", "origin": "recorded", "rack": "chen2023-soft-5x10", "trials": [trial]}
    (tmp_path / "session.yaml").write_text(yaml.safe_dump(keys | {"depth_scale_m": 0.001}))
    session = load_session(tmp_path)
    (frame,) = trial_capture(session, session.trials[0], "shot").frames()
    check(frame, atol=2e-3)


def test_depth_without_camera_says_what_to_write_and_that_works(tmp_path):
    folder = write_foundation_pose(tmp_path / "demo", ["0"])
    (folder / "cam_K.txt").unlink()
    assert "write cam_K.txt beside depth/, 3 lines: fx 0 cx, 0 fy cy, 0 0 1" in refusal(folder, unit="mm")
    (folder / "cam_K.txt").write_text(f"{CAMERA.fx} 0 {CAMERA.cx}\n0 {CAMERA.fy} {CAMERA.cy}\n0 0 1\n")
    check(read(folder, unit="mm"), atol=2e-3)


def test_pictures_and_depth_are_paired_by_name_number_or_order(tmp_path):
    other = PICTURE[::-1]
    for case, (depth_names, picture_names) in {
        "name": (["a", "b"], ["a", "b"]),
        "number": (["frame-07.depth", "frame-09.depth"], ["frame-7.color", "frame-9.color"]),
        "order": (["x", "y"], ["p", "q"]),
    }.items():
        folder = write_foundation_pose(tmp_path / case, [])
        for name, pixels in zip(picture_names, (PICTURE, other), strict=True):
            assert cv2.imwrite(str(folder / "rgb" / f"{name}.png"), pixels[..., ::-1])
        for name in depth_names:
            write_depth(folder / "depth" / f"{name}.png", np.full((H, W), 700, np.uint16))
        first, second = (frame.image for frame in open_captures(folder, unit="mm")[0].frames())
        np.testing.assert_array_equal(first, PICTURE)
        np.testing.assert_array_equal(second, other)
    (folder / "rgb" / "q.png").unlink()
    assert "2 depth images and 1 pictures with other names" in refusal(folder, unit="mm")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3", "expected a camera matrix of 3 x 3 numbers"),
        ("0 0 1 0 5 1 0 0 1", "expected a camera matrix"),
        ("one", "expected a camera matrix of 3 x 3 numbers, fx 0 cx, 0 fy cy, 0 0 1, found one"),
        ("1e-300 0 1 0 1e-300 1 0 0 1", "expected a focal length in pixels"),
    ],
)
def test_wrong_camera_is_refused(tmp_path, text, message):
    folder = write_foundation_pose(tmp_path / "demo", ["0"])
    (folder / "cam_K.txt").write_text(text)
    assert message in refusal(folder, unit="mm")


def test_a_camera_that_nobody_builds_is_refused():
    for wrong, word in (
        ({"fx": 1e-320}, "fx"),
        ({"fy": 7.8e12}, "fy"),
        ({"cx": 1e30}, "cx"),
        ({"width": 10**9}, "most"),
    ):
        assert word in replace(CAMERA, **wrong).fault
    assert not CAMERA.fault
