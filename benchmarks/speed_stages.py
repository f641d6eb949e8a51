"""What `python -m benchmarks.speed` measures inside `profile`, and the least that the machine would need."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any
from unittest.mock import patch

import numpy as np

from tubepose.profile import closed_tops, estimate, fusing, measure
from tubepose.scene import Scene, TubeEstimate
from tubepose.transforms import transform_points

STAGES: dict[str, tuple[ModuleType, tuple[str, ...]]] = {
    "gather": (measure, ("gather_standing",)),
    "find tops": (measure, ("find_tops",)),
    "label": (closed_tops, ("label_points",)),
    "planes": (closed_tops, ("fit_top_planes",)),
    "outlines": (closed_tops, ("fit_discs",)),
    "types": (closed_tops, ("name_tops",)),
    "rims": (measure, ("fit_rims",)),
    "faint rims": (measure, ("find_faint_rims",)),
    "leftovers": (estimate, ("find_leftovers",)),
    "posterior": (fusing, ("top_evidence", "combine")),
    "walls": (fusing, ("wall_evidence",)),
    "covariance": (estimate, ("believed", "pose_covariance")),
}
"""Stages of `profile` by the public functions that make them up, and the modules that call them."""
REST = "rest"


@contextmanager
def timed_stages() -> Iterator[dict[str, float]]:
    """Milliseconds of every stage of `profile`, summed up while this is entered; two clock readings per call."""
    spent = dict.fromkeys(STAGES, 0.0)

    def timed(stage: str, call: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(call)
        def wrapper(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter_ns()
            try:
                return call(*args, **kwargs)
            finally:
                spent[stage] += (time.perf_counter_ns() - start) / 1e6

        return wrapper

    with ExitStack() as stack:
        for stage, (module, names) in STAGES.items():
            for name in names:
                stack.enter_context(patch.object(module, name, timed(stage, getattr(module, name))))
        yield spent


def rack_bytes(scene: Scene) -> int:
    """Bytes of the cloud over the rack: the box about the image of what can stand above its top."""
    assert scene.rack_pose.T_camera_rack is not None
    assert scene.intrinsics is not None
    tallest = scene.rack.floor_m + max(tube.height_m for tube in scene.tubes)
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (scene.rack.height_m, tallest)])
    corners[:, :2] *= scene.rack.outline_m / 2
    uv = scene.intrinsics.project(transform_points(scene.rack_pose.T_camera_rack, corners))
    size = np.array([scene.intrinsics.width, scene.intrinsics.height])
    width, height = np.clip(uv.max(axis=0), 0, size) - np.clip(uv.min(axis=0), 0, size)
    return int(width * height) * scene.frame.cloud_m.itemsize * 3


def bandwidth(megabytes: int) -> float:
    """Bytes per second that this machine moves, from the fastest of a few copies of a large array: read and written."""
    source = np.ones(megabytes * 2**20 // 8)
    target = np.zeros_like(source)
    return 2 * source.nbytes / _fastest(lambda: np.copyto(target, source))


def normal_equations(points: int) -> tuple[float, float]:
    """Operations, and operations per second, of the normal equations of planes through this many points."""
    A = np.random.default_rng(0).normal(size=(max(points, 1), 4))
    operations = 2.0 * A.size * A.shape[1]
    return operations, operations / _fastest(lambda: A.T @ A)


def _fastest(call: Callable[[], object], tries: int = 7) -> float:
    seconds = []
    for _ in range(tries):
        start = time.perf_counter_ns()
        call()
        seconds.append((time.perf_counter_ns() - start) / 1e9)
    return min(seconds[1:])


def bound(scene: Scene, estimates: tuple[TubeEstimate, ...], bytes_per_s: float) -> dict[str, float]:
    """The least time for a frame: the rack's part of the cloud read once, and one linear fit to the tubes' points.

    Args:
        scene: The frame, its rack registered.
        estimates: Of `profile`, whose points are counted.
        bytes_per_s: What `bandwidth` found.

    Returns:
        bytes, bytes_per_s, read_ms, points, operations, operations_per_s, fit_ms, bound_ms.
    """
    size = rack_bytes(scene)
    points = sum(len(each.target.points_m) for each in estimates if each.pose.T_rack_tube is not None)
    operations, rate = normal_equations(points)
    read_ms, fit_ms = size / bytes_per_s * 1e3, operations / rate * 1e3
    return {
        "bytes": size,
        "bytes_per_s": bytes_per_s,
        "read_ms": read_ms,
        "points": points,
        "operations": operations,
        "operations_per_s": rate,
        "fit_ms": fit_ms,
        "bound_ms": read_ms + fit_ms,
    }
