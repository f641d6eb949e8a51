"""Ground truth on scenes whose poses are known, cast here ray by ray from nothing but planes."""

from __future__ import annotations

import ast
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import tubepose.ground_truth
from tubepose.capture.frame import CameraIntrinsics, RgbdFrame
from tubepose.capture.hints import SlotHint
from tubepose.ground_truth import GroundTruthConfig, GroundTruthResult, measure_ground_truth
from tubepose.labware import CapModel, RackModel, TubeModel
from tubepose.transforms import axis_rotation, invert_transform, make_transform, tilt_rad, transform_points, translation

RACK = RackModel.model_validate(
    {
        "kind": "rack",
        "name": "test-3x5",
        "outline_mm": [96.5, 60.0],
        "height_mm": 50.0,
        "floor_mm": 3.0,
        "grid": {"rows": 3, "columns": 5, "pitch_mm": [18, 18], "slot": {"shape": "square", "size_mm": [16.5, 16.5]}},
    }
)
CAP = CapModel.model_validate({"kind": "cap", "name": "cap", "square_mm": 16.7, "thickness_mm": 3, "seat_mm": 4})


def _tube(height_mm: float) -> TubeModel:
    body = {"height_mm": height_mm, "bottom_diameter_mm": 14, "top_diameter_mm": 14, "material": "opaque"}
    return TubeModel.model_validate({"kind": "tube", "name": f"tube-{height_mm:g}", "body": body})


TALL, SHORT = _tube(100.0), _tube(90.0)
LAYOUT = {"A1": TALL, "A2": SHORT, "B4": TALL, "C3": SHORT, "C5": TALL}
CAMERA = CameraIntrinsics(width=300, height=250, fx=1400.0, fy=1400.0, cx=149.5, cy=124.5)
VIEW_M = 0.7
PROJECTOR_M = np.array([0.25, 0.0, 0.0])


@dataclass
class Scene:
    """Tubes with known axes; the rest of the scene follows from the labware."""

    layout: dict[str, TubeModel] = field(default_factory=lambda: dict(LAYOUT))
    seed: int = 0
    yaw_deg: float = 20.0
    camera_tilt_deg: float = 8.0
    noise_m: float = 1e-4
    max_tilt_deg: float = 1.5
    shadows: bool = False
    table: bool = True
    bend_m: dict[str, float] = field(default_factory=dict)
    hide: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        R = Rotation.from_euler("x", 180 + self.camera_tilt_deg, degrees=True) * Rotation.from_euler(
            "z", self.yaw_deg, degrees=True
        )
        center = np.array([0.0, 0.0, VIEW_M])
        self.T_camera_rack = make_transform(R.as_matrix(), center - R.apply([0.0, 0.0, 0.08]))
        self.T_rack_tube, self.T_rack_square = {}, {}
        for slot, tube in self.layout.items():
            alpha, beta = np.deg2rad(rng.uniform(-self.max_tilt_deg, self.max_tilt_deg, 2))
            axis = np.array([np.sin(beta), -np.sin(alpha), 1.0])
            bottom = RACK.bottom_center_m(RACK.slot(slot)) + np.array([*rng.uniform(-3e-4, 3e-4, 2), 0.0])
            self.T_rack_tube[slot] = make_transform(axis_rotation(axis), bottom)
            turn = Rotation.from_euler("z", rng.uniform(-4, 4), degrees=True).as_matrix()
            lift = make_transform(turn, np.array([0.0, 0.0, CAP.offset_m(tube)]))
            self.T_rack_square[slot] = self.T_rack_tube[slot] @ lift
        self.rng = rng

    def frame(self, camera: CameraIntrinsics = CAMERA) -> RgbdFrame:
        """Cast the scene."""
        rays = camera.rays().reshape(-1, 3)
        depth = self._cast(np.zeros(3), rays)
        points = rays * depth[:, None]
        if self.shadows:
            towards = points - PROJECTOR_M
            seen = self._cast(PROJECTOR_M, towards)
            depth = np.where(seen < 1 - 1e-3, np.nan, depth)
        depth = depth + self.rng.normal(0, self.noise_m, depth.shape)
        cloud = camera.backproject(depth.reshape(camera.height, camera.width))
        return RgbdFrame(cloud, None, camera, None, "cast", simulated=True)

    def _cast(self, origin: np.ndarray, rays: np.ndarray) -> np.ndarray:
        """Distance to the first surface in units of each ray; NaN where there is none."""
        distance = np.full(len(rays), np.inf)
        if self.table:
            distance = self._plane(self.T_camera_rack, origin, rays, lambda xy: np.full(len(xy), True))
        top = self.T_camera_rack @ translation([0, 0, RACK.height_m])
        distance = np.fmin(distance, self._plane(top, origin, rays, lambda xy: RACK.top_signed_distance_m(xy) <= 0))
        for slot, T_rack_square in self.T_rack_square.items():
            kept = 1 - 2 * self.hide.get(slot, 0.0)
            half = CAP.square_m / 2

            def plate(xy: np.ndarray, kept: float = kept, half: float = half) -> np.ndarray:
                return (np.abs(xy).max(axis=1) <= half) & (xy[:, 0] <= kept * half)

            distance = np.fmin(
                distance,
                self._plane(self.T_camera_rack @ T_rack_square, origin, rays, plate, self.bend_m.get(slot, 0.0)),
            )
        return np.where(np.isfinite(distance), distance, np.nan)

    @staticmethod
    def _plane(T_camera_plane, origin, rays, inside, bend_m=0.0):
        T = invert_transform(T_camera_plane)
        start, steps = transform_points(T, origin), rays @ T[:3, :3].T
        distance = -start[2] / steps[:, 2]
        at = start + steps * distance[:, None]
        if bend_m:
            distance = distance + (bend_m * (at[:, 0] / (CAP.square_m / 2)) ** 2) / steps[:, 2]
        return np.where((distance > 0) & inside(at[:, :2]), distance, np.inf)

    def measure(self, frame: RgbdFrame | None = None, **changes) -> GroundTruthResult:
        """Measure with the scene's own declaration unless it is changed."""
        given = {"tubes": self.layout, "hint": None, "config": GroundTruthConfig(), "rack": RACK, "cap": CAP} | changes
        return measure_ground_truth(frame or self.frame(), **given)


def errors(scene: Scene, result: GroundTruthResult) -> tuple[np.ndarray, np.ndarray]:
    """Tilt errors in degrees and bottom errors in metres of the accepted tubes."""
    tilts, shifts = [], []
    for truth in result.tubes:
        if truth.T_camera_tube is not None:
            exact = scene.T_camera_rack @ scene.T_rack_tube[truth.slot]
            tilts.append(np.rad2deg(tilt_rad(truth.T_camera_tube[:3, 2], exact[:3, 2])))
            shifts.append(np.linalg.norm(truth.T_camera_tube[:3, 3] - exact[:3, 3]))
    return np.array(tilts), np.array(shifts)


def reason_of(result: GroundTruthResult, slot: str) -> str:
    """Reason of one refused slot."""
    truth = next(truth for truth in result.tubes if truth.slot == slot)
    assert truth.status == "refused"
    assert truth.T_camera_tube is None
    return truth.reason


@pytest.mark.parametrize(("seed", "yaw_deg", "camera_tilt_deg"), [(0, 0.0, 0.0), (1, 55.0, -8.0), (2, 200.0, 12.0)])
def test_recovers_known_poses_within_the_noise(seed: int, yaw_deg: float, camera_tilt_deg: float) -> None:
    scene = Scene(seed=seed, yaw_deg=yaw_deg, camera_tilt_deg=camera_tilt_deg)
    result = scene.measure()
    assert result.status == "ok"
    assert [truth.slot for truth in result.tubes] == list(LAYOUT)
    assert {truth.status for truth in result.tubes} == {"ok"}
    tilts, shifts = errors(scene, result)
    # 0.1 mm of noise on 1300 points gives 0.05 deg; four times that never happens by chance.
    assert tilts.mean() < 0.1
    assert tilts.max() < 0.2
    assert shifts.max() < 5e-4
    off = invert_transform(scene.T_camera_rack) @ result.T_camera_rack
    np.testing.assert_allclose(off, np.eye(4), atol=4e-4)


def test_stated_uncertainty_matches_the_error() -> None:
    stated, seen = [], []
    for seed in range(3):
        scene = Scene(seed=seed, noise_m=2e-4)
        result = scene.measure()
        stated += [np.rad2deg(truth.tilt_std_rad) for truth in result.tubes]
        seen += list(errors(scene, result)[0])
    assert np.sqrt(np.mean(np.square(seen))) == pytest.approx(np.mean(stated), rel=0.4)


def test_centre_is_not_drawn_by_a_neighbours_shadow() -> None:
    lit, shadowed = Scene(seed=4, yaw_deg=0.0), Scene(seed=4, yaw_deg=0.0, shadows=True)
    near = {truth.slot: truth.n_points for truth in lit.measure().tubes}
    result = shadowed.measure()
    assert sum(truth.n_points for truth in result.tubes) < sum(near.values())
    for truth in result.tubes:
        if truth.T_camera_tube is None:
            continue
        top = truth.T_camera_tube[:3, 3] + truth.T_camera_tube[:3, 2] * CAP.offset_m(LAYOUT[truth.slot])
        exact = (shadowed.T_camera_rack @ shadowed.T_rack_square[truth.slot])[:3, 3]
        assert np.linalg.norm(top - exact) < 2.5e-4


def test_spin_follows_the_fixed_rule_in_the_rack_frame() -> None:
    result = Scene().measure()
    for truth in result.tubes:
        rotation = result.T_camera_rack[:3, :3].T @ truth.T_camera_tube[:3, :3]
        np.testing.assert_allclose(rotation, axis_rotation(rotation[:, 2]), atol=1e-9)


def test_moving_the_camera_changes_no_relative_pose() -> None:
    scene = Scene(seed=3)
    frame = scene.frame()
    move = make_transform(
        Rotation.from_euler("xyz", [4, -3, 10], degrees=True).as_matrix(), np.array([0.02, -0.01, 0.05])
    )
    moved = replace(frame, cloud_m=transform_points(move, frame.cloud_m), intrinsics=None)
    before, after = scene.measure(frame), scene.measure(moved)
    for a, b in zip(before.tubes, after.tubes, strict=True):
        np.testing.assert_allclose(move @ a.T_camera_tube[:, 3], b.T_camera_tube[:, 3], atol=2e-5)
        assert tilt_rad(move[:3, :3] @ a.T_camera_tube[:3, 2], b.T_camera_tube[:3, 2]) < 2e-4


def test_same_frame_gives_the_same_truth() -> None:
    scene = Scene()
    frame = scene.frame()
    first, second = scene.measure(frame), scene.measure(frame)
    for a, b in zip(first.tubes, second.tubes, strict=True):
        np.testing.assert_array_equal(a.T_camera_tube, b.T_camera_tube)


def test_unorganised_cloud_gives_the_same_caps() -> None:
    scene = Scene(seed=1)
    frame = scene.frame()
    points = frame.points_m[frame.valid]
    loose = replace(frame, cloud_m=points[None], intrinsics=None, organised=False)
    tilts, shifts = errors(scene, scene.measure(loose))
    assert len(tilts) == len(LAYOUT)
    assert tilts.max() < 0.2
    assert shifts.max() < 5e-4


def test_works_without_a_table() -> None:
    scene = Scene(seed=2, table=False)
    tilts, _ = errors(scene, scene.measure())
    assert len(tilts) == len(LAYOUT)
    assert tilts.max() < 0.2


def test_dropped_pixels_do_not_tear_a_cap() -> None:
    scene = Scene(seed=5)
    frame = scene.frame()
    cloud = frame.cloud_m.copy()
    cloud[np.random.default_rng(0).random(cloud.shape[:2]) < 0.05] = np.nan
    tilts, _ = errors(scene, scene.measure(replace(frame, cloud_m=cloud)))
    assert len(tilts) == len(LAYOUT)


def test_bent_cap_is_refused_by_its_plane_rms() -> None:
    scene = Scene(bend_m={"B4": 1.5e-3})
    assert "plane rms" in reason_of(scene.measure(), "B4")


def test_half_hidden_cap_is_refused_by_its_coverage() -> None:
    scene = Scene(hide={"B4": 0.5})
    result = scene.measure()
    assert "coverage" in reason_of(result, "B4")
    assert sum(truth.status == "ok" for truth in result.tubes) == 4


def test_hidden_edge_that_nothing_explains_is_refused() -> None:
    assert "an edge is hidden" in reason_of(Scene(hide={"B4": 0.12}).measure(), "B4")


def test_missing_cap_is_refused_alone() -> None:
    scene = Scene()
    del scene.T_rack_square["A2"]
    result = scene.measure()
    assert reason_of(result, "A2") == "no cap found at the slot"
    assert sum(truth.status == "ok" for truth in result.tubes) == 4


def test_cap_at_an_undeclared_slot_is_named() -> None:
    scene = Scene()
    declared = {slot: tube for slot, tube in LAYOUT.items() if slot != "C5"}
    result = scene.measure(tubes=declared)
    assert result.undeclared_slots == ("C5",)
    assert [truth.status for truth in result.tubes] == ["ok"] * 4


def test_wrong_slot_declared_names_where_the_cap_stands() -> None:
    scene = Scene()
    declared = {("B1" if slot == "A1" else slot): tube for slot, tube in LAYOUT.items()}
    result = scene.measure(tubes=declared)
    assert reason_of(result, "B1") == "no cap found at the slot; caps stand at undeclared A1"


def test_second_cap_near_a_slot_is_refused() -> None:
    scene = Scene()
    beside = translation([19e-3, -4e-3, 0.0])
    scene.T_rack_square["C5 again"] = beside @ scene.T_rack_square["C5"]
    assert "two caps on one slot" in reason_of(scene.measure(), "C5")


def test_caps_that_touch_in_a_coarse_scan_are_separated() -> None:
    coarse = CameraIntrinsics(width=140, height=115, fx=600.0, fy=600.0, cx=69.5, cy=57.0)
    scene = Scene(layout={"A1": TALL, "A2": TALL, "A3": TALL, "C4": SHORT}, max_tilt_deg=0.3)
    for step, slot in enumerate(("A1", "A2", "A3")):
        T = translation([-36e-3 + 16.75e-3 * step, 18e-3, RACK.floor_m + CAP.offset_m(TALL)])
        scene.T_rack_square[slot] = T
        scene.T_rack_tube[slot] = T @ translation([0.0, 0.0, -CAP.offset_m(TALL)])
    result = scene.measure(scene.frame(coarse))
    _, shifts = errors(scene, result)
    assert len(shifts) == 4, [truth.reason for truth in result.tubes]
    assert shifts.max() < 1e-3


def test_wrong_tube_declared_is_told_by_its_height() -> None:
    scene = Scene()
    assert "off the slot floor" in reason_of(scene.measure(tubes=LAYOUT | {"B4": SHORT}), "B4")


def test_crooked_cap_is_refused() -> None:
    scene = Scene()
    for angle_deg, message in ((8.0, "off the slot's centre|no cap found"), (14.0, "tilt|no cap found")):
        crooked = Rotation.from_euler("x", angle_deg, degrees=True).as_matrix()
        T = scene.T_rack_square["C3"].copy()
        T[:3, :3] = crooked
        scene.T_rack_square["C3"] = T
        reason = reason_of(scene.measure(), "C3")
        assert any(part in reason for part in message.split("|")), reason


SYMMETRIC = {"A1": TALL, "C5": TALL, "B3": TALL}


def test_symmetric_layout_without_hint_is_ambiguous() -> None:
    result = Scene(layout=SYMMETRIC).measure()
    assert result.status == "refused"
    assert result.ambiguous
    assert result.T_camera_rack is None
    assert "ambiguous turn" in result.reason
    assert reason_of(result, "B3").startswith("frame: ambiguous turn")


@pytest.mark.parametrize("known", [True, False], ids=["intrinsics", "organised-cloud-alone"])
@pytest.mark.parametrize("yaw_deg", [20.0, 200.0])
def test_hint_resolves_a_symmetric_layout(yaw_deg: float, known: bool) -> None:
    scene = Scene(layout=SYMMETRIC, yaw_deg=yaw_deg)
    frame = scene.frame() if known else replace(scene.frame(), intrinsics=None)
    opening = np.array([*RACK.slot("A1").center_m, RACK.height_m])
    u, v = CAMERA.project(transform_points(scene.T_camera_rack, opening))
    result = scene.measure(frame, hint=SlotHint(slot="A1", pixel=(float(u) + 3, float(v) - 2)))
    assert result.status == "ok"
    np.testing.assert_allclose(invert_transform(scene.T_camera_rack) @ result.T_camera_rack, np.eye(4), atol=3e-4)


@pytest.mark.parametrize("yaw_deg", [20.0, 200.0])
def test_hints_without_pixels_resolve_a_symmetric_layout(yaw_deg: float) -> None:
    scene = Scene(layout=SYMMETRIC, yaw_deg=yaw_deg)
    place = transform_points(scene.T_camera_rack, np.array([*RACK.slot("A1").center_m, RACK.height_m]))
    point = SlotHint(slot="A1", point_m=(place[0], place[1], place[2] - 0.02))
    for hint in (point, SlotHint(slot="A1", toward="left" if place[0] < 0 else "right")):
        result = scene.measure(hint=hint)
        assert result.status == "ok"
        np.testing.assert_allclose(invert_transform(scene.T_camera_rack) @ result.T_camera_rack, np.eye(4), atol=3e-4)


def test_hint_that_contradicts_the_caps_refuses_the_frame() -> None:
    scene = Scene()
    opening = np.array([*RACK.slot("C5").center_m, RACK.height_m])
    u, v = CAMERA.project(transform_points(scene.T_camera_rack, opening))
    result = scene.measure(hint=SlotHint(slot="A1", pixel=(float(u), float(v))))
    assert result.status == "refused"
    assert not result.ambiguous
    assert "hint contradicts" in result.reason


def test_no_rack_in_view_refuses_the_frame() -> None:
    frame = Scene().frame()
    empty = replace(frame, cloud_m=np.full_like(frame.cloud_m, np.nan))
    other = RACK.model_copy(update={"outline_mm": (140.0, 80.0)})
    for result in (Scene().measure(empty), Scene().measure(frame, rack=other)):
        assert result.status == "refused"
        assert "no rack top" in result.reason
        assert all(truth.T_camera_tube is None for truth in result.tubes)


def test_truth_shares_no_code_with_the_estimators() -> None:
    allowed = {"errors", "transforms", "labware", "capture", "ground_truth"}
    for path in Path(tubepose.ground_truth.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            for name in names:
                if name.startswith("tubepose"):
                    assert name.split(".")[1] in allowed, f"{path.name} imports {name}"
