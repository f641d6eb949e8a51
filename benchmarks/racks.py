"""Registration of the rack, method against method: accuracy, time, robustness; and how well a real scan repeats.

    python -m benchmarks.racks SESSION [--trials N] [--methods edges,obb-icp]   # a simulated session
    python -m benchmarks.racks --scan FILE.ply [--rack NAME] [--starts N]       # a scan of the top of a rack

A session's original captures are used. Every method sees the same points: those of the rack's box, or what the
robustness rows make of them. Wrong is an accepted pose off by more than 0.5 mm or 0.2 deg on any axis, or of a
rack that is not there; a half turn is not counted.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from tubepose.capture.session import load_session
from tubepose.capture.source import open_captures
from tubepose.config import Config, RackConfig
from tubepose.labware import RackModel, load_rack
from tubepose.provenance import pinned_threads
from tubepose.rack import RackPose, RackStatus, register_rack
from tubepose.rack.naming import name_rack
from tubepose.simulation import read_exact_truth
from tubepose.transforms import HALF_TURN, FloatArray, invert_transform, make_transform, transform_points

BOX_MARGIN_M = 10e-3
TALLEST_M = 0.2
WRONG_MM, WRONG_DEG = 0.5, 0.2
METHODS = ("edges", "obb-icp")
BOWS_M = ((0.0, 0.0), (2.5e-3, 2.5e-3), (-2.5e-3, -2.5e-3), (2.5e-3, -2.5e-3))
"""Added to a scan's face, at the ends of its x axis and of its y axis."""


@dataclass(frozen=True, eq=False)
class View:
    """One capture: all of its points (N, 3), camera frame, the exact pose of its rack, and where the camera is."""

    points_m: FloatArray
    T_camera_rack: FloatArray
    rack: RackModel

    @property
    def local_m(self) -> FloatArray:
        """The points in the rack's frame."""
        return transform_points(invert_transform(self.T_camera_rack), self.points_m)

    def box(self) -> FloatArray:
        """The points of the rack's box."""
        local = self.local_m
        near = np.all(np.abs(local[:, :2]) < self.rack.outline_m / 2 + BOX_MARGIN_M, axis=1)
        return self.points_m[near & (local[:, 2] > -5e-3) & (local[:, 2] < TALLEST_M)]


def views(folder: Path, trials: int | None) -> Iterator[View]:
    """The original captures of a simulated session."""
    session = load_session(folder)
    names = [trial.name for trial in session.trials]
    for name in names if trials is None else names[:: max(1, len(names) // trials)]:
        capture = next(iter((folder / "captures").glob(f"{name}-original*")))
        frame = next(iter(open_captures(capture)[0].frames()))
        truth = read_exact_truth(folder, name)
        yield View(frame.measured_m, truth.T_camera_rack, session.rack)


def error(pose: RackPose, view: View) -> FloatArray:
    """Rotation vector (deg), then shift of the top's centre (mm), in the true rack's frame, but for half a turn."""
    assert pose.T_camera_rack is not None
    top = np.array([0.0, 0.0, view.rack.height_m])
    errors = []
    for turn in (np.eye(4), HALF_TURN):
        T_true = view.T_camera_rack @ turn
        R = T_true[:3, :3]
        turned = np.rad2deg(Rotation.from_matrix(R.T @ pose.T_camera_rack[:3, :3]).as_rotvec())
        shift = R.T @ (transform_points(pose.T_camera_rack, top) - transform_points(T_true, top))
        errors.append(np.concatenate([turned, 1e3 * shift]))
    return min(errors, key=lambda e: float(np.linalg.norm(e[:3])))


Case = Callable[[View, np.random.Generator], FloatArray]


def _covered(view: View, _: np.random.Generator) -> FloatArray:
    """A plate above half of the rack, across its long side, hides what is below it."""
    box = view.box()
    local = transform_points(invert_transform(view.T_camera_rack), box)
    hidden = local[:, 0] > 0.0
    plate = np.column_stack([local[hidden][:, :2], np.full(hidden.sum(), view.rack.height_m + 0.1)])
    return np.vstack([box[~hidden], transform_points(view.T_camera_rack, plate)])


def _cut(view: View, _: np.random.Generator) -> FloatArray:
    """The image ends before the last quarter of the rack."""
    box = view.box()
    local = transform_points(invert_transform(view.T_camera_rack), box)
    return box[local[:, 0] < view.rack.outline_m[0] / 4]


def _neighbour(view: View, _: np.random.Generator) -> FloatArray:
    """The same rack once more, 8 mm beside it along its short side."""
    box = view.box()
    return np.vstack([box, box + (_moved(view).T_camera_rack - view.T_camera_rack)[:3, 3]])


def _moved(view: View) -> View:
    """The same view of the rack's copy beside it."""
    T = view.T_camera_rack.copy()
    T[:3, 3] += T[:3, 1] * (view.rack.outline_m[1] + 8e-3)
    return View(view.points_m, T, view.rack)


def _clutter(view: View, rng: np.random.Generator) -> FloatArray:
    """Boards and balls around the rack, some as high as its top."""
    box = view.box()
    pieces = [box]
    for _ in range(6):
        center = np.array([rng.choice([-1, 1]) * rng.uniform(0.14, 0.2), rng.uniform(-0.1, 0.1), 0.0])
        size = np.array([*rng.uniform(0.02, 0.07, 2), 0.0])
        board = center + rng.uniform(-0.5, 0.5, (6000, 3)) * size
        board[:, 2] = view.rack.height_m + rng.choice([0.0, rng.uniform(-0.05, 0.1)]) + rng.normal(0, 1e-4, 6000)
        pieces.append(transform_points(view.T_camera_rack, board))
    return np.vstack(pieces)


def _dropped(view: View, rng: np.random.Generator) -> FloatArray:
    """Half of the points are missing."""
    box = view.box()
    return box[rng.random(len(box)) < 0.5]


TWO_RACKS = "a second rack beside it"
CASES: dict[str, Case] = {
    "rack's box": lambda view, _: view.box(),
    "whole frame": lambda view, _: view.points_m,
    "half under a plate": _covered,
    "a quarter out of the image": _cut,
    TWO_RACKS: _neighbour,
    "clutter": _clutter,
    "half of the points": _dropped,
}


@dataclass(frozen=True, eq=False)
class Answer:
    """What a method made of one case: accepted or not, its error and whitened error (None unless right), its time."""

    accepted: bool
    wrong: bool
    error: FloatArray | None
    whitened: FloatArray | None
    duration_ms: float


def ask(method: str, points_m: FloatArray, view: View, asked: RackModel) -> Answer:
    """Register a rack by one method."""
    config = Config(rack=RackConfig(method=method))
    start = time.perf_counter_ns()
    pose = register_rack(points_m, asked, config)
    duration_ms = (time.perf_counter_ns() - start) / 1e6
    if pose.status is not RackStatus.OK:
        return Answer(False, False, None, None, duration_ms)
    if asked != view.rack:
        return Answer(True, True, None, None, duration_ms)
    off = error(pose, view)
    wrong = bool(np.any(np.abs(off[3:]) > WRONG_MM) or np.any(np.abs(off[:3]) > WRONG_DEG))
    whitened = None
    if pose.covariance is not None:
        units = np.concatenate([np.deg2rad(off[:3]), off[3:] * 1e-3])
        whitened = units / np.sqrt(np.diag(pose.covariance))
    return Answer(True, wrong, off, whitened, duration_ms)


def row(name: str, method: str, answers: Sequence[Answer]) -> str:
    """One line of the table."""
    found = np.array([answer.error for answer in answers if answer.error is not None])
    times = [answer.duration_ms for answer in answers]
    cells = [name, method, f"{sum(a.accepted for a in answers)}/{len(answers)}", str(sum(a.wrong for a in answers))]
    for axis in (3, 4, 5, 0, 1, 2):
        size = np.abs(found[:, axis]) if len(found) else np.array([np.nan])
        cells.append(f"{size.mean():.3f} / {np.percentile(size, 95):.3f}")
    whitened = [answer.whitened for answer in answers if answer.whitened is not None]
    cells.append(f"{np.mean([z @ z for z in whitened]):.1f}" if whitened else "-")
    return "| " + " | ".join([*cells, f"{np.median(times):.0f}"]) + " |"


def session_tables(folder: Path, trials: int | None, methods: Sequence[str], wrong_racks: Sequence[str]) -> None:
    """Print the tables of a session."""
    answers: dict[tuple[str, str], list[Answer]] = {}
    named: list[str] = []
    for number, view in enumerate(views(folder, trials)):
        for case, make in CASES.items():
            points = make(view, np.random.default_rng(number))
            for method in methods:
                if number == 0 and case == "rack's box":
                    ask(method, points, view, view.rack)
                # Of two racks that are there neither is asked for: the nearer one counts.
                there = (view, _moved(view)) if case == TWO_RACKS else (view,)
                asked = [ask(method, points, one, view.rack) for one in there]
                answer = min(asked, key=lambda a: np.inf if a.error is None else float(np.abs(a.error[3:]).max()))
                answers.setdefault((case, method), []).append(answer)
        for name in wrong_racks:
            for method in methods:
                answers.setdefault((f"asked for {name}", method), []).append(
                    ask(method, view.box(), view, load_rack(name))
                )
        pose, _ = name_rack(view.box(), Config())
        named.append("none" if pose.rack is None else pose.rack.name)
    print("| points | method | accepted | wrong | x (mm) | y (mm) | z (mm) | x (deg) | y (deg) | yaw | z^2 | ms |")
    print("|---|---|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|")
    for (case, method), found in answers.items():
        print(row(case, method, found))
    print(
        "\nErrors: mean / 95th percentile of sizes, accepted ones. z^2: mean squared Mahalanobis length, 6 if honest."
    )
    print("ms: median, one thread.")
    print("Named out of the catalogue: " + ", ".join(f"{named.count(name)} {name}" for name in sorted(set(named))))


def scan_table(file: Path, rack: RackModel, starts: int) -> None:
    """Print how well a scan's registration repeats from random rigid starts, whole and with half of its points."""
    points = next(iter(open_captures(file, unit="m")[0].frames())).points_m
    points = points[np.isfinite(points[:, 2])]
    pose, ranking = name_rack(points, Config())
    told = ", ".join(f"{e.rack.name} {e.log_likelihood:.0f} nats{' (refused)' if e.reason else ''}" for e in ranking)
    name = pose.rack.name if pose.rack is not None else pose.reason
    print(f"{len(points)} points; named: {name}, ahead by {pose.named_by_nats:.0f} nats")
    print(f"log likelihoods: {told}")
    for bow_m in BOWS_M:
        print(f"with {bow_m[0] * 1e3:+g}, {bow_m[1] * 1e3:+g} mm of bow added: {_bow_words(points, pose, rack, bow_m)}")
    rng = np.random.default_rng(0)
    for drop in (0.0, 0.5):
        found = [_repeat(points[rng.random(len(points)) >= drop], rack, rng) for _ in range(starts)]
        poses = np.array([T for T in found if T is not None])
        print(f"drop-out {drop:.0%}: {len(poses)} of {starts} accepted; " + _spread(poses, rack))


def _bow_words(points_m: FloatArray, pose: RackPose, rack: RackModel, bow_m: tuple[float, float]) -> str:
    """What becomes of a scan whose face is bowed more, at the ends of its x axis and of its y axis, metres."""
    if pose.T_camera_rack is None:
        return "no pose to add it in"
    local = transform_points(invert_transform(pose.T_camera_rack), points_m)
    u, v = (2 * local[:, :2] / rack.outline_m).T
    local[:, 2] += bow_m[0] * u**2 + bow_m[1] * v**2
    bowed = register_rack(transform_points(pose.T_camera_rack, local), rack, Config())
    if bowed.bow_m is None or bowed.bow_std_m is None:
        return f"{bowed.status.value}: {bowed.reason}"
    found = ", ".join(f"{1e3 * b:.2f} +- {1e3 * std:.2f}" for b, std in zip(bowed.bow_m, bowed.bow_std_m, strict=True))
    return f"{bowed.status.value}, bow {found} mm"


def _repeat(points_m: FloatArray, rack: RackModel, rng: np.random.Generator) -> FloatArray | None:
    """T_scan_rack found from a rigid motion of the scan that leaves its upper side to the camera."""
    centre = points_m.mean(axis=0)
    normal = np.linalg.svd((points_m - centre)[::7], full_matrices=False)[2][2]
    normal = -normal if normal @ centre > 0 else normal
    level = Rotation.align_vectors([[0, 0, -1]], [normal])[0]
    axis = rng.uniform(0, 2 * np.pi)
    tilt = Rotation.from_rotvec(np.deg2rad(rng.uniform(0, 30)) * np.array([np.cos(axis), np.sin(axis), 0]))
    R = (tilt * Rotation.from_rotvec([0, 0, rng.uniform(0, 2 * np.pi)]) * level).as_matrix()
    place = np.array([*rng.uniform(-0.08, 0.08, 2), rng.uniform(0.5, 0.8)])
    T = make_transform(R, place - R @ centre)
    pose = register_rack(transform_points(T, points_m), rack, Config())
    return None if pose.T_camera_rack is None else invert_transform(T) @ pose.T_camera_rack


def _spread(poses: FloatArray, rack: RackModel) -> str:
    """Standard deviation and largest deviation from the mean, but for half turns."""
    poses = np.array([T if T[:3, 0] @ poses[0][:3, 0] > 0 else T @ HALF_TURN for T in poses])
    tops = np.array([transform_points(T, np.array([0.0, 0.0, rack.height_m])) for T in poses])
    shift = 1e3 * (tops - tops.mean(axis=0)) @ poses[0][:3, :3]
    turns = Rotation.from_matrix(poses[:, :3, :3])
    turned = np.rad2deg((turns.mean().inv() * turns).as_rotvec())
    words = []
    for name, values in (("x, y, z (mm)", shift), ("about x, y, z (deg)", turned)):
        std, most = (" ".join(f"{v:.3f}" for v in size) for size in (values.std(axis=0), np.abs(values).max(axis=0)))
        words.append(f"{name} std {std}, largest {most}")
    return "; ".join(words)


def main() -> None:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("session", type=Path, nargs="?")
    parser.add_argument("--trials", type=int)
    parser.add_argument("--methods", default=",".join(METHODS))
    parser.add_argument("--wrong", default="chen2023-hard-5x10,steel-round-13mm-5x10")
    parser.add_argument("--scan", type=Path)
    parser.add_argument("--rack", default="chen2023-soft-5x10")
    parser.add_argument("--starts", type=int, default=100)
    options = parser.parse_args()
    with pinned_threads(1):
        if options.session is not None:
            session_tables(
                options.session,
                options.trials,
                options.methods.split(","),
                [name for name in options.wrong.split(",") if name],
            )
        if options.scan is not None:
            scan_table(options.scan, load_rack(options.rack), options.starts)


if __name__ == "__main__":
    main()
