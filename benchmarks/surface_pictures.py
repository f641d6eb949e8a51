"""Pictures of docs/simulation.md: what both simulated sensors make of the same scene, side by side."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image

from benchmarks.surfaces import SENSORS, SET_UPS, SetUp, Truth, pixel_rays, truth_of, with_own_and_printed_caps
from tubepose.capture.frame import RgbdFrame
from tubepose.simulation.camera import StructuredLightCamera, default_camera
from tubepose.simulation.scene import Scene
from tubepose.simulation.structured_light.codes import FLAT, LINE
from tubepose.simulation.structured_light.parts import scene_parts
from tubepose.transforms import FloatArray, invert_transform, transform_points

SEED = 1
"""Of the pictures: one short row of it holds all three types of tube."""
LIMIT_MM = 5.0
MARGIN_PX = 6
PALETTE = 200
KEY = "measured minus true distance along the ray (mm)"
ABOVE_M = 0.075
BELOW_M = 0.020
COLORS = mpl.colormaps["coolwarm"].resampled(15).with_extremes(bad="black")
SCALE = Normalize(-LIMIT_MM, LIMIT_MM)


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One scene as one sensor sees it.

    Attributes:
        set_up: How scanner and rack stand.
        scene: What is there.
        camera: What looks at it.
        truth: What each pixel should see.
        frame: What the sensor delivers.
    """

    set_up: SetUp
    scene: Scene
    camera: StructuredLightCamera
    truth: Truth
    frame: RgbdFrame

    @property
    def error_mm(self) -> FloatArray:
        """Measured minus true distance of every pixel (N,), NaN without a measurement."""
        return np.asarray((np.linalg.norm(self.frame.cloud_m.reshape(-1, 3), axis=1) - self.truth.distance_m) * 1e3)

    def cut(self) -> tuple[slice, slice]:
        """Rows and columns of the image that hold the rack and its tubes."""
        half, top = self.scene.rack.outline_m / 2, self.scene.rack.height_m + 0.055
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, top)]) * [*half, 1.0]
        uv = self.camera.intrinsics.project(transform_points(self.scene.T_camera_rack, corners))
        low, high = np.floor(uv.min(axis=0)).astype(int) - MARGIN_PX, np.ceil(uv.max(axis=0)).astype(int) + MARGIN_PX
        low = np.maximum(low, 0)
        return slice(low[1], high[1]), slice(low[0], high[0])


def draw(folder: Path, resolution: int, threads: int) -> None:
    """Write gray images, error maps and clouds from the side of the overhead and the tilted set-up into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    camera, views = default_camera(resolution), []
    for set_up in SET_UPS[:2]:
        scene = with_own_and_printed_caps(SEED, set_up)[0]
        truth = truth_of(scene, camera)
        for render in SENSORS.values():
            frame = render(scene, camera, np.random.default_rng(SEED), threads=threads)
            views.append(View(set_up, scene, camera, truth, frame))
    _sheet(folder / "surfaces-gray.jpg", views, _gray, (10.0, 6.1), None)
    _sheet(folder / "surfaces-error.png", views, _error, (10.0, 7.0), f"{KEY}; black: no depth")
    _sheet(folder / "surfaces-side.png", views, _side, (9.6, 10.6), KEY)


def _sheet(
    path: Path, views: list[View], panel: Callable[[Axes, View], None], size: tuple[float, float], key: str | None
) -> None:
    """Four panels, a row per set-up and a column per sensor, with the key to the colours below."""
    figure = Figure(figsize=size, layout="constrained")
    figure.set_layout_engine("constrained", hspace=0.05)
    axes = figure.subplots(2, 2, squeeze=False)
    for i, (ax, view) in enumerate(zip(axes.ravel(), views, strict=True)):
        panel(ax, view)
        ax.set_title(f"{list(SENSORS)[i % 2]}, {view.set_up.name}", fontsize=11)
    if key is not None:
        colors = mpl.cm.ScalarMappable(SCALE, COLORS)
        figure.colorbar(colors, ax=axes, location="bottom", shrink=0.5, aspect=40, label=key, extend="both")
    if path.suffix == ".jpg":
        figure.savefig(path, dpi=100, pil_kwargs={"quality": 85})
        return
    drawn = io.BytesIO()
    figure.savefig(drawn, dpi=100)
    # Few colours keep noisy images small.
    few = Image.open(drawn).convert("RGB").quantize(PALETTE, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
    few.save(path, optimize=True)


def _gray(ax: Axes, view: View) -> None:
    assert view.frame.image is not None
    ax.imshow(view.frame.image[view.cut()], cmap="gray", vmin=0, vmax=255, interpolation="antialiased")
    ax.set_axis_off()


def _error(ax: Axes, view: View) -> None:
    shape = view.frame.cloud_m.shape[:2]
    ax.imshow(view.error_mm.reshape(shape)[view.cut()], cmap=COLORS, norm=SCALE, interpolation="nearest")
    ax.set_axis_off()


def _side(ax: Axes, view: View) -> None:
    """The tubes of one short row of the rack, seen along its long axis."""
    scene, into_rack = view.scene, invert_transform(view.scene.T_camera_rack)
    middle = _fullest_row_m(scene)
    half = float(np.diff(_rows_m(scene)).min()) / 2
    true_m = transform_points(into_rack, pixel_rays(view.camera) * view.truth.distance_m[:, None])
    measured = transform_points(into_rack, view.frame.cloud_m.reshape(-1, 3))
    kept = (view.truth.surface >= 0) & (np.abs(true_m[:, 0] - middle) < half) & np.isfinite(measured[:, 2])
    top = scene.rack.height_m
    y, z = measured[kept, 1] * 1e3, (measured[kept, 2] - top) * 1e3
    ax.set_facecolor("0.25")
    ax.scatter(y, z, c=view.error_mm[kept], cmap=COLORS, norm=SCALE, s=2.0, linewidths=0)
    lines = _outlines_mm(scene, middle, half)
    ax.add_collection(LineCollection(list(lines), colors="yellow", linewidths=0.9))
    reach = scene.rack.outline_m[1] * 500
    ax.axhspan(-BELOW_M * 1e3, 0, color="0.45", zorder=0)
    ax.set(xlim=(-reach, reach), ylim=(-BELOW_M * 1e3, ABOVE_M * 1e3), aspect="equal")
    ax.set(xlabel="across the rack (mm)", ylabel="above the rack's top (mm)")
    for tube in scene.tubes:
        rim = (tube.T_rack_tube @ [0.0, 0.0, tube.model.height_m, 1.0])[:3]
        if abs(rim[0] - middle) < half:
            kind = f"{'open' if tube.model.is_open else 'capped'}\n{tube.model.body.material}"
            ax.text(rim[1] * 1e3, (rim[2] - top) * 1e3 + 2, kind, color="yellow", ha="center", fontsize=8)
    _arrow(ax, into_rack[:3, 3] - [0, 0, top], reach)


def _arrow(ax: Axes, scanner_m: FloatArray, reach_mm: float) -> None:
    """Where the scanner looks from."""
    towards = scanner_m[1:] / np.linalg.norm(scanner_m[1:])
    end = np.array([-0.70 * reach_mm, ABOVE_M * 1e3 - 16])
    ax.annotate(
        "scanner", xy=tuple(end), xytext=tuple(end + 11 * towards), color="white", ha="center", va="center",
        arrowprops={"arrowstyle": "->", "color": "white"},
    )  # fmt: skip


def _rows_m(scene: Scene) -> NDArray[np.float64]:
    return np.unique(np.round([slot.center_m[0] for slot in scene.rack.all_slots], 6))


def _fullest_row_m(scene: Scene) -> float:
    """Place along the long axis of the short row with the most types of tube, then the most tubes."""

    def rank(x: float) -> tuple[int, int]:
        tubes = [tube for tube in scene.tubes if abs(scene.rack.slot(tube.slot).center_m[0] - x) < 1e-3]
        return len({tube.model.name for tube in tubes}), len(tubes)

    return float(max(_rows_m(scene), key=rank))


def _outlines_mm(scene: Scene, middle_m: float, half_m: float) -> list[FloatArray]:
    """True profiles of tubes and caps of one row as lines (2, 2) of y and height above the rack's top."""
    lines = []
    for part in scene_parts(scene)[0]:
        top = transform_points(part.T_rack_object, np.array([[0.0, 0.0, scene.rack.height_m]]))[0]
        if abs(top[0] - middle_m) > half_m:
            continue
        for row in np.vstack([piece.segments for piece in part.pieces]):
            if row[0] not in (LINE, FLAT):
                continue
            for side in (-1, 1):
                ends = np.array([[0.0, side * row[2], row[1]], [0.0, side * row[4], row[3]]])
                ends = transform_points(part.T_rack_object, ends)
                lines.append((ends[:, 1:] - [0.0, scene.rack.height_m]) * 1e3)
    return lines
