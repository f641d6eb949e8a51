"""Drawings of labware with its measures, so that a definition can be checked by eye."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle

from tubepose.labware.definition import MM
from tubepose.labware.racks import RackModel, SlotModel
from tubepose.labware.tubes import CapModel, TubeModel
from tubepose.transforms import FloatArray

_LINE: dict[str, Any] = {"edgecolor": "black", "linewidth": 0.8}
_SOLID = "0.82"
_MATERIAL_COLOR = {"opaque": "0.55", "translucent": "#b9cfe4", "transparent": "#e2eef8"}


def draw_labware(item: RackModel | TubeModel | CapModel) -> Figure:
    """Draw one definition to scale, in millimetres.

    A rack: top view with slot names and sizes, and a section through the first slot's row. A tube: its profile of
    revolution in section. A cap: top view, and a section with the rim that it sits on.

    Returns:
        A figure that belongs to no window; ``figure.savefig(path)`` writes it.
    """
    if isinstance(item, RackModel):
        return _draw_rack(item)
    return _draw_tube(item) if isinstance(item, TubeModel) else _draw_cap(item)


def _draw_rack(rack: RackModel) -> Figure:
    width, depth = rack.outline_mm
    margin = 0.14 * width + 8
    heights = [depth + 2 * margin, rack.height_mm + 2 * margin]
    figure = Figure(figsize=(10, 10 * sum(heights) / (width + 2 * margin) + 1), layout="constrained")
    top, section = figure.subplots(2, 1, height_ratios=heights)
    figure.suptitle(f"{rack.name}: {len(rack.all_slots)} slots")
    _rack_top(top, rack)
    _rack_section(section, rack)
    for axes, low, high in ((top, -depth / 2, depth / 2), (section, 0.0, rack.height_mm)):
        _finish(axes, (-width / 2 - margin, width / 2 + margin), (low - margin, high + margin / 2))
    return figure


def _rack_top(axes: Axes, rack: RackModel) -> None:
    width, depth = rack.outline_mm
    axes.add_patch(Rectangle((-width / 2, -depth / 2), width, depth, facecolor=_SOLID, **_LINE))
    sizes = {slot.size_mm for slot in rack.all_slots}
    for slot in rack.all_slots:
        axes.add_patch(Polygon(slot.boundary_m() / MM, closed=True, facecolor="white", **_LINE))
        label = slot.name if len(sizes) == 1 else f"{slot.name}\n{_size(slot.size_mm, slot.shape)}"
        axes.text(*slot.center_mm, label, ha="center", va="center", fontsize=7)
    _dimension_x(axes, -width / 2, width / 2, -depth / 2 - 0.05 * width, f"{width:g}")
    _dimension_y(axes, -depth / 2, depth / 2, -width / 2 - 0.05 * width, f"{depth:g}")
    first = rack.all_slots[0]
    title = f"top, x to the right, y up; slot {_size(first.size_mm, first.shape)}" if len(sizes) == 1 else "top"
    if rack.grid is not None:
        title += f"; pitch {rack.grid.pitch_mm[0]:g} along x, {rack.grid.pitch_mm[1]:g} along y"
    axes.set_title(f"{title} (mm)", fontsize=9)


def _rack_section(axes: Axes, rack: RackModel) -> None:
    width, height = rack.outline_mm[0], rack.height_mm
    axes.add_patch(Rectangle((-width / 2, 0), width, height, facecolor=_SOLID, hatch="///", **_LINE))
    y_mm = rack.all_slots[0].center_mm[1]
    cut = [(slot, _chord_mm(slot, y_mm)) for slot in rack.all_slots if _chord_mm(slot, y_mm) > 0]
    for slot, chord in cut:
        corner = (slot.center_mm[0] - chord / 2, rack.floor_mm)
        axes.add_patch(Rectangle(corner, chord, height - rack.floor_mm, facecolor="white", **_LINE))
        axes.text(slot.center_mm[0], height / 2, slot.name, ha="center", va="center", fontsize=7)
    _dimension_y(axes, 0, height, -width / 2 - 0.05 * width, f"{height:g}")
    _dimension_y(axes, 0, rack.floor_mm, width / 2 + 0.03 * width, f"floor {rack.floor_mm:g}", outside=True)
    axes.set_title(f"section at y = {y_mm:g}, z up (mm)", fontsize=9)


def _chord_mm(slot: SlotModel, y_mm: float) -> float:
    """Width of a slot along x at height y of the top view; 0 where the line misses it."""
    off, (width, depth) = abs(slot.center_mm[1] - y_mm), slot.size_mm
    if off >= depth / 2:
        return 0.0
    return float(np.sqrt(width**2 - (2 * off) ** 2)) if slot.shape == "round" else width


def _draw_tube(tube: TubeModel) -> Figure:
    height, radius = tube.height_mm, tube.max_radius_m / MM
    margin = 0.22 * height + 6
    figure = Figure(figsize=(9 * (2 * radius + 2.6 * margin) / (height + margin) + 1, 9), layout="constrained")
    axes = figure.subplots()
    figure.suptitle(f"{tube.name}\nbody {tube.body.material}, {tube.body.bottom} bottom, wall {tube.body.wall_mm:g}")
    outside, inside = tube.body_profile_m() / MM, tube.cavity_profile_m() / MM
    _revolve(axes, np.vstack([outside, inside]), tube.body.material)
    if tube.cap is not None:
        _revolve(axes, _cap_section_mm(tube), tube.cap.material)
    _tube_dimensions(axes, tube)
    axes.axvline(0, color="0.5", linewidth=0.6, linestyle="-.")
    _finish(axes, (-radius - 1.2 * margin, radius + 1.4 * margin), (-0.5 * margin, height + 0.5 * margin))
    return figure


def _tube_dimensions(axes: Axes, tube: TubeModel) -> None:
    body, step, radius = tube.body, 0.05 * tube.height_mm, tube.max_radius_m / MM
    _dimension_y(axes, 0, tube.height_mm, -radius - 2.5 * step, f"{tube.height_mm:g}")
    low, high = body.bottom_diameter_mm / 2, body.top_diameter_mm / 2
    _dimension_x(axes, -low, low, -step, f"{body.bottom_diameter_mm:g} where the wall begins")
    if tube.cap is None:
        _dimension_x(axes, -high, high, body.height_mm + step, f"{body.top_diameter_mm:g}")
        return
    cap, top = tube.cap, tube.height_mm
    if cap.top_mm > 0:
        _dimension_y(axes, 0, body.height_mm, -radius - step, f"rim {body.height_mm:g}")
    _dimension_y(axes, top - cap.height_mm, top, radius + step, f"{cap.height_mm:g}", outside=True)
    word = "flange" if cap.open else "cap"
    _dimension_x(axes, -cap.diameter_mm / 2, cap.diameter_mm / 2, top + step, f"{word} {cap.diameter_mm:g}")
    below = top - cap.height_mm - step
    _dimension_x(axes, -high, high, below, f"{body.top_diameter_mm:g} at the rim")


def _cap_section_mm(tube: TubeModel) -> FloatArray:
    """Section (z, r) of the cap or flange from outside to the wall (and over the rim), millimetres."""
    profile = tube.cap_profile_m() / MM
    rim = tube.body.height_mm
    wall = tube.body.top_diameter_mm / 2
    inner = [[rim, 0.0]] if not tube.is_open else []
    return np.vstack([profile[:3] if tube.is_open else profile, *([row] for row in inner), [[rim, wall]]])


def _draw_cap(cap: CapModel) -> Figure:
    half, margin = cap.square_mm / 2, 0.35 * cap.square_mm
    figure = Figure(figsize=(6, 9), layout="constrained")
    top, section = figure.subplots(2, 1)
    figure.suptitle(cap.name)
    top.add_patch(Rectangle((-half, -half), 2 * half, 2 * half, facecolor=_SOLID, **_LINE))
    top.plot(0, 0, "+", color="black")
    top.set_title("top; the cross is on the tube's axis (mm)", fontsize=9)
    _dimension_x(top, -half, half, -half - 0.3 * margin, f"{cap.square_mm:g}")
    low = cap.seat_mm - cap.thickness_mm
    section.add_patch(Rectangle((-half, low), 2 * half, cap.thickness_mm, facecolor=_SOLID, hatch="///", **_LINE))
    section.axhline(0, color="0.5", linewidth=0.8, linestyle="--")
    section.text(0, -0.1 * margin, "rim of the tube", ha="center", va="top", fontsize=8)
    section.set_title("section (mm)", fontsize=9)
    _dimension_y(section, 0, cap.seat_mm, -half - 0.3 * margin, f"seat {cap.seat_mm:g}")
    _dimension_y(section, low, cap.seat_mm, half + 0.3 * margin, f"{cap.thickness_mm:g}", outside=True)
    for axes, lowest, highest in ((top, -half, half), (section, 0.0, cap.seat_mm)):
        _finish(axes, (-half - 1.5 * margin, half + 1.5 * margin), (lowest - margin, highest + margin))
    return figure


def _revolve(axes: Axes, section_zr_mm: FloatArray, material: str) -> None:
    for side in (1, -1):
        outline = section_zr_mm[:, ::-1] * [side, 1]
        axes.add_patch(Polygon(outline, closed=True, facecolor=_MATERIAL_COLOR[material], **_LINE))


def _dimension_x(axes: Axes, start: float, end: float, y: float, text: str) -> None:
    axes.annotate("", (start, y), (end, y), arrowprops={"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0, "lw": 0.7})
    axes.text((start + end) / 2, y, text, ha="center", va="bottom", fontsize=8)


def _dimension_y(axes: Axes, start: float, end: float, x: float, text: str, outside: bool = False) -> None:
    axes.annotate("", (x, start), (x, end), arrowprops={"arrowstyle": "<->", "shrinkA": 0, "shrinkB": 0, "lw": 0.7})
    middle = (start + end) / 2
    if outside:
        axes.text(x, middle, f"  {text}", ha="left", va="center", fontsize=8)
    else:
        axes.text(x, middle, text, ha="right", va="center", fontsize=8, rotation=90)


def _finish(axes: Axes, x_limits: tuple[float, float], y_limits: tuple[float, float]) -> None:
    axes.set_xlim(*x_limits)
    axes.set_ylim(*y_limits)
    axes.set_aspect("equal")
    axes.set_axis_off()


def _size(size_mm: tuple[float, float], shape: str) -> str:
    return f"⌀{size_mm[0]:g}" if shape == "round" else f"{size_mm[0]:g} x {size_mm[1]:g}"
