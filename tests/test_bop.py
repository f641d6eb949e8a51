from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest
from commands import tubepose
from scipy.spatial.transform import Rotation

from tubepose.capture.ply import read_ply
from tubepose.foreign.bop_models import discrete_symmetries, models_info, ply_text, tube_mesh, vertex_mssd_mm
from tubepose.labware import load_tube
from tubepose.pose_errors import mssd_mm
from tubepose.transforms import make_transform

TUBE = load_tube("chen2023-tube-1")


def poses(seed: int):
    rng = np.random.default_rng(seed)
    truth = make_transform(Rotation.random(random_state=seed).as_matrix(), rng.normal(0, 0.3, 3))
    lean = Rotation.from_rotvec(np.add(rng.normal(0, 0.03, 3), [0, 0, rng.uniform(-3, 3)]))
    return truth, truth @ make_transform(lean.as_matrix(), rng.normal(0, 2e-3, 3))


def published_mssd_mm(T_truth, T_estimate, vertices_mm):
    """The published definition, line by line: the least over symmetries of the largest distance of a vertex."""
    errors = []
    for i in range(315):  # ceil(pi / 0.01)
        S = Rotation.from_rotvec([0, 0, 2 * np.pi * i / 315]).as_matrix()
        a = vertices_mm @ T_estimate[:3, :3].T + 1e3 * T_estimate[:3, 3]
        b = vertices_mm @ (T_truth[:3, :3] @ S).T + 1e3 * T_truth[:3, 3]
        errors.append(np.linalg.norm(a - b, axis=1).max())
    return min(errors)


@pytest.mark.parametrize("seed", range(4))
def test_mssd_is_that_of_bop(seed: int) -> None:
    truth, estimate = poses(seed)
    vertices_m = tube_mesh(TUBE).vertices_m
    expected = published_mssd_mm(truth, estimate, vertices_m * 1e3)
    assert len(discrete_symmetries()) == 315
    assert vertex_mssd_mm(truth, estimate, vertices_m, discrete_symmetries()) == pytest.approx(expected, abs=1e-6)
    ours = mssd_mm(truth[None], estimate[None], TUBE.outer_profile_m(1e-3))[0]
    assert ours == pytest.approx(expected, abs=1e-2 * TUBE.max_radius_m * 1e3)
    assert expected > 1.0


def test_models_have_the_tubes_size_and_turn_about_z(tmp_path: Path) -> None:
    info = models_info({1: TUBE})["1"]
    assert info["size_z"] == pytest.approx(TUBE.height_mm)
    assert info["size_x"] == pytest.approx(2e3 * TUBE.max_radius_m)
    assert (info["min_z"], info["symmetries_continuous"][0]["axis"]) == (0, [0, 0, 1])
    assert np.hypot(info["size_z"], 0) < info["diameter"] <= np.hypot(info["size_z"], info["size_x"]) + 1e-9
    (tmp_path / "m.ply").write_text(ply_text(tube_mesh(TUBE)))
    np.testing.assert_allclose(read_ply(tmp_path / "m.ply").xyz, tube_mesh(TUBE).vertices_m * 1e3, atol=1e-4)


def test_an_exported_session_is_judged_as_it_was(small_session: Path, tmp_path: Path) -> None:
    methods = ("--methods", "upright", "--detector", "geometric")
    assert tubepose("bench", small_session, *methods, "--exact-truth", "--out", tmp_path / "run").code == 0
    ended = tubepose(
        "export-bop", small_session, "--exact-truth", "--estimates", tmp_path / "run", "--out", tmp_path / "b"
    )
    assert (ended.code, ended.errors) == (0, [])
    scene = tmp_path / "b" / "test" / "000000"
    cameras, truths = (json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt"))
    boxes = json.loads((scene / "scene_gt_info.json").read_text())
    depth = cv2.imread(str(scene / "depth" / "000000.png"), cv2.IMREAD_UNCHANGED) * cameras["0"]["depth_scale"]
    K = np.array(cameras["0"]["cam_K"]).reshape(3, 3)
    model = read_ply(tmp_path / "b" / "models" / f"obj_{truths['0'][0]['obj_id']:06d}.ply").xyz
    for pose, info in zip(truths["0"], boxes["0"], strict=True):
        points = model @ np.array(pose["cam_R_m2c"]).reshape(3, 3).T + pose["cam_t_m2c"]
        top = points[np.argmin(points[:, 2])]
        u, v = (K @ top / top[2])[:2]
        x, y, width, height = info["bbox_obj"]
        assert x - 1 <= u <= x + width + 1
        assert y - 1 <= v <= y + height + 1
        seen = depth[round(v) - 3 : round(v) + 4, round(u) - 3 : round(u) + 4]
        assert np.abs(seen[seen > 0] - top[2]).min() < 3
    results = tmp_path / "b" / "results" / "upright_tubepose-test.csv"
    arguments = ("--truth", small_session, "--exact-truth", "--mapping", tmp_path / "b" / "tubepose_mapping.yaml")
    assert tubepose("evaluate", results, *arguments, "--out", tmp_path / "again").code == 0
    first, again = (pd.read_csv(tmp_path / name / "errors.csv") for name in ("run", "again"))
    keys = ["trial", "slot"]
    first, again = (t[t["outcome"] == "ok"].sort_values(keys).reset_index() for t in (first, again))
    assert list(first["slot"]) == list(again["slot"])
    np.testing.assert_allclose(again[["tilt_deg", "mssd_mm"]], first[["tilt_deg", "mssd_mm"]], atol=1e-6)
    twice = tubepose("export-bop", small_session, "--exact-truth", "--out", tmp_path / "b")
    assert (twice.code, "data set already" in twice.errors[0]) == (1, True)
