"""What a scene is made of: solids of revolution (bodies with their walls, caps, labels) and boxes (printed caps).

A body's profile runs from the bottom's centre up the outside, over the rim and down the cavity, so that the solid lies
on its left in (r, z); a lid closes it inside its cap. Profiles are segments: cones and cylinders, flat rings, spheres.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from tubepose.labware import CapModel, TubeModel, WallOptics
from tubepose.simulation.scene import Label, Liquid, Material, PlacedTube, Scene
from tubepose.simulation.structured_light.codes import CAVITY, FLAT, LINE, OPAQUE, OUTSIDE, SPHERE
from tubepose.transforms import FloatArray, translation

PROFILE_STEP_M = 1e-4
# A lid closes a body this far inside its cap, and a cap reaches this far into the wall: a crooked cap leaves no gap.
LID_INSET_M, CAP_OVERLAP_M = 1e-4, 3e-4
LABEL_GAP_M = 1e-4
# An opaque flange ends this far outside the see-through body that it sits on.
FLANGE_INSET_M = 2e-5
FULL_TURN_RAD = 2 * np.pi


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """Segments (N, 11) of one kind (OPAQUE, OUTSIDE or CAVITY) and one material; see `Shapes.segments`."""

    segments: FloatArray
    kind: int
    material: Material


@dataclass(frozen=True, slots=True, eq=False)
class RevolvedPart:
    """A solid of revolution about z of its frame.

    Attributes:
        T_rack_object: Array of shape (4, 4); maps its points to rack points, metres.
        pieces: Its surface.
        optics: The plastic of a see-through body.
        profile_m: Outer and inner radius of a see-through body at steps of `PROFILE_STEP_M`, shape (N, 2).
        liquid: What stands in it.
        cavity_at_level: The cavity's wall at the liquid's surface: z, radius, slope, shape (3,).
    """

    T_rack_object: FloatArray
    pieces: tuple[Piece, ...]
    optics: WallOptics | None = None
    profile_m: FloatArray | None = None
    liquid: Liquid | None = None
    cavity_at_level: FloatArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class BoxPart:
    """A box about the origin of its frame; `half_m` (3,) are half its sides, metres."""

    T_rack_box: FloatArray
    half_m: FloatArray
    material: Material


def scene_parts(scene: Scene) -> tuple[list[RevolvedPart], list[BoxPart]]:
    """All tubes and caps of a scene, rack frame."""
    revolved: list[RevolvedPart] = []
    boxes: list[BoxPart] = []
    for tube in scene.tubes:
        revolved.append(_body(tube, scene))
        revolved.extend(_flange(tube, scene))
        if scene.printed_cap is not None:
            plate, neck = _printed_cap(tube, scene.printed_cap, scene.finishes.printed_cap)
            boxes.append(plate)
            revolved.extend(neck)
        elif not tube.model.is_open:
            revolved.append(_own_cap(tube, scene))
    return revolved, boxes


def segments_of(profile_zr_m: FloatArray) -> FloatArray:
    """Cones, cylinders and flat rings between the points of a profile (N, 2) of (z, r); the solid lies on its left."""
    rows = []
    for (z0, r0), (z1, r1) in pairwise(profile_zr_m):
        length = float(np.hypot(z1 - z0, r1 - r0))
        if length < 1e-9:
            continue
        normal_r, normal_z = (z1 - z0) / length, -(r1 - r0) / length
        flat = abs(z1 - z0) < 1e-9
        slope = 0.0 if flat else (r1 - r0) / (z1 - z0)
        kind = FLAT if flat else LINE
        rows.append([kind, z0, r0, z1, r1, slope, 0.0, normal_r, normal_z, 0.0, FULL_TURN_RAD])
    return np.array(rows).reshape(-1, 11)


def _half_sphere(center_z: float, radius: float, outwards: bool) -> FloatArray:
    sign = 1.0 if outwards else -1.0
    row = [SPHERE, center_z - radius, 0.0, center_z, radius, center_z, radius, sign, 0.0, 0.0, FULL_TURN_RAD]
    return np.array([row])


def _bottom_and_wall(model: TubeModel, inset_m: float, top_m: float) -> FloatArray:
    """Outside (inset 0) or cavity (inset = wall) of a body up to a height, listed upwards."""
    body = model.body
    start = body.bottom_height_mm * 1e-3
    r0 = body.bottom_diameter_mm * 0.5e-3 - inset_m
    r_top = float(model.body_radius_m(top_m)) - inset_m
    if body.bottom == "round":
        return np.vstack([_half_sphere(start, r0, True), segments_of(np.array([[start, r0], [top_m, r_top]]))])
    if body.bottom == "conical":
        tip = max(body.cone_tip_diameter_mm * 0.5e-3 - inset_m, 0.0)
        points = [[inset_m, 0.0], [inset_m, tip], [start + inset_m, r0], [top_m, r_top]]
    else:
        points = [[inset_m, 0.0], [inset_m, r0], [top_m, r_top]]
    return segments_of(np.array(points))


def _reversed(segments: FloatArray) -> FloatArray:
    """The same surface with its normals turned."""
    turned = segments[::-1].copy()
    turned[:, [1, 2, 3, 4]] = turned[:, [3, 4, 1, 2]]
    turned[:, 7:9] *= -1
    return turned


def lid_height_m(tube: PlacedTube, printed: bool) -> float | None:
    """Where a body ends inside a cap, metres above its origin; None if it is open."""
    model = tube.model
    if printed:
        return model.rim_height_m
    if model.is_open:
        return None
    return float(tube.own_cap_profile_m()[0, 0]) + tube.cap_fit.height_error_m + LID_INSET_M


def _flange_in_wall(model: TubeModel) -> bool:
    """Whether the flange is one piece with the wall: both see-through, or both opaque."""
    cap = model.cap
    return cap is not None and cap.open and (cap.material == "opaque") == (model.body.material == "opaque")


def _body(tube: PlacedTube, scene: Scene) -> RevolvedPart:
    model, printed = tube.model, scene.printed_cap is not None
    lid = lid_height_m(tube, printed)
    top = model.rim_height_m if lid is None else min(lid, model.rim_height_m)
    wall = model.body.wall_mm * 1e-3
    optics = tube.wall_optics
    outer = _bottom_and_wall(model, 0.0, top)
    rim_radius = float(model.body_radius_m(top))
    if _flange_in_wall(model):
        assert model.cap is not None
        skirt, rim_radius = top - model.cap.height_mm * 1e-3, model.cap.diameter_mm * 0.5e-3
        below = _bottom_and_wall(model, 0.0, skirt)
        edge = [[skirt, float(model.body_radius_m(skirt))], [skirt, rim_radius], [top, rim_radius]]
        outer = np.vstack([below, segments_of(np.array(edge))])
    cavity = _reversed(_bottom_and_wall(model, wall, top))
    inner_radius = float(model.body_radius_m(top)) - wall
    body = scene.finishes.opaque_body
    outside, inside = (OPAQUE, OPAQUE) if optics is None else (OUTSIDE, CAVITY)
    if lid is None:
        rim = segments_of(np.array([[top, rim_radius], [top, inner_radius]]))
        pieces = [Piece(np.vstack([outer, rim]), outside, body), Piece(cavity, inside, body)]
    else:
        cover = scene.finishes.printed_cap if printed else own_cap_material(tube, scene)
        disc = segments_of(np.array([[top, 0.0], [top, rim_radius]]))
        pieces = [Piece(outer, outside, body), Piece(cavity, inside, body), Piece(disc, OPAQUE, cover)]
    if tube.label is not None:
        pieces.append(_label(model, tube.label))
    liquid = tube.liquid if optics is not None else None
    profile = None if optics is None else _profile(outer, cavity, top)
    at_level = None if liquid is None else _cavity_at(cavity, liquid.level_m)
    return RevolvedPart(tube.T_rack_tube, tuple(pieces), optics, profile, liquid, at_level)


def own_cap_material(tube: PlacedTube, scene: Scene) -> Material:
    """How a tube's own cap returns light."""
    return Material(tube.cap_albedo, roughness=scene.finishes.cap_roughness)


def _label(model: TubeModel, label: Label) -> Piece:
    points = [[z, float(model.body_radius_m(z)) + LABEL_GAP_M] for z in (label.low_m, label.high_m)]
    segments = segments_of(np.array(points))
    segments[:, 9:11] = label.start_rad % FULL_TURN_RAD, min(label.span_rad, FULL_TURN_RAD)
    return Piece(segments, OPAQUE, Material(label.albedo))


def _radii_at(segments: FloatArray, z_m: FloatArray) -> FloatArray:
    """Largest radius of a surface at heights (N,), 0 where it has none."""
    radii = np.zeros(len(z_m))
    for row in segments:
        low, high = sorted((row[1], row[3]))
        within = (z_m >= low) & (z_m <= high)
        if row[0] == SPHERE:
            here = np.sqrt(np.clip(row[6] ** 2 - (z_m - row[5]) ** 2, 0.0, None))
        elif row[0] == LINE:
            here = row[2] + row[5] * (z_m - row[1])
        else:
            continue
        radii = np.where(within, np.maximum(radii, here), radii)
    return radii


def _profile(outer: FloatArray, cavity: FloatArray, top_m: float) -> FloatArray:
    z = (np.arange(np.ceil(top_m / PROFILE_STEP_M), dtype=np.float64) + 0.5) * PROFILE_STEP_M
    return np.column_stack([_radii_at(outer, z), _radii_at(cavity, z)])


def _cavity_at(cavity: FloatArray, level_m: float) -> FloatArray:
    """The cavity's wall about a height: z, radius and slope of a straight line."""
    around: FloatArray = np.array([level_m - PROFILE_STEP_M, level_m + PROFILE_STEP_M])
    low, high = _radii_at(cavity, around)
    return np.array([level_m, (low + high) / 2, (high - low) / (2 * PROFILE_STEP_M)])


def _flange(tube: PlacedTube, scene: Scene) -> list[RevolvedPart]:
    """A flange that is not one piece with the wall: an opaque ring on a see-through body, or the other way round.

    Both are drawn as an opaque ring around the body: light inside such a flange is not modelled.
    """
    model = tube.model
    if model.cap is None or not model.cap.open or _flange_in_wall(model):
        return []
    profile = model.cap_profile_m()
    profile[0, 1] += FLANGE_INSET_M
    bore = profile[3].copy()
    profile[2:, 0] += FLANGE_INSET_M
    ring = np.vstack([profile[:3], [[profile[2, 0], bore[1]]]])
    material = Material(scene.finishes.opaque_body.albedo, roughness=scene.finishes.cap_roughness)
    return [RevolvedPart(tube.T_rack_tube, (Piece(segments_of(ring), OPAQUE, material),))]


def _own_cap(tube: PlacedTube, scene: Scene) -> RevolvedPart:
    profile = tube.own_cap_profile_m()
    profile[0, 1] -= CAP_OVERLAP_M
    piece = Piece(segments_of(profile), OPAQUE, own_cap_material(tube, scene))
    return RevolvedPart(tube.T_rack_tube @ tube.T_tube_own_cap, (piece,))


def _printed_cap(tube: PlacedTube, cap: CapModel, material: Material) -> tuple[BoxPart, list[RevolvedPart]]:
    T_rack_cap = tube.T_rack_tube @ tube.T_tube_cap
    top, thickness, rim = cap.offset_m(tube.model), cap.thickness_mm * 1e-3, tube.model.rim_height_m
    center = translation([0.0, 0.0, top - thickness / 2])
    plate = BoxPart(T_rack_cap @ center, np.array([cap.square_m, cap.square_m, thickness]) / 2, material)
    if top - thickness - rim < 1e-6:
        return plate, []
    radius = float(tube.model.body_radius_m(rim))
    side = segments_of(np.array([[rim, radius], [top - thickness, radius]]))
    return plate, [RevolvedPart(T_rack_cap, (Piece(side, OPAQUE, material),))]
