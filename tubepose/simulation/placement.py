"""Random placements that a real rack allows: tubes that lean in their slots, and a rack before the camera."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from tubepose.capture.frame import CameraIntrinsics
from tubepose.errors import LabwareError
from tubepose.labware import CapModel, RackModel, SlotModel, TubeModel
from tubepose.simulation.bow import FLAT, Bow
from tubepose.simulation.collision import CLEARANCE_M, Solid, collide, solid_of
from tubepose.simulation.scene import PlacedTube
from tubepose.transforms import FloatArray, axis_rotation, make_transform, transform_points

MAX_CAP_SPIN_RAD = np.deg2rad(5.0)
SCANNER_TILT_RAD = (0.0, float(np.deg2rad(20.0)))
DISTANCE_M = (0.60, 0.70)
MAX_RACK_SHIFT_M = 0.06
IMAGE_MARGIN = 0.04
"""The rack keeps this share of the image's width away from its border."""
CAP_ALBEDO = (0.35, 0.85)

_LEAN_TRIES = 200
_SWEEPS = 2
_LEANS = 30
_POSE_TRIES = 500


def place_tubes(
    rack: RackModel,
    types: Sequence[TubeModel],
    count: int,
    cap: CapModel,
    rng: np.random.Generator,
    cap_albedo: tuple[float, float] = CAP_ALBEDO,
    bow: Bow = FLAT,
) -> tuple[PlacedTube, ...]:
    """Put up to `count` perfect tubes of random types into random slots of a rack.

    Tubes come upright, or leaning where their caps, own or printed, would cut into a neighbour's otherwise. Then, twice
    and in random order, each leans anew as its slot and its neighbours allow. Where no lean of a bounded number fits, a
    slot stays empty: a rack whose pitch is less than a cap's width holds fewer tubes than `count`.

    Args:
        rack: The rack.
        types: Tube types; each tube is of one of them.
        count: Tubes to place.
        cap: The printed cap that there must be room for.
        rng: Source of randomness; poses depend on nothing else but the arguments above.
        cap_albedo: Least and most brightness of own caps, one value per type.
        bow: Of the rack. Each tube stands in its slot as in a flat rack, and moves with the slot; tubes have room
            beside each other where they stand then.

    Raises:
        LabwareError: A type fits into no slot, or is too short to wear the printed cap there.
    """
    for model in types:
        if not any(_fits(rack, slot, model, cap) for slot in rack.all_slots):
            raise LabwareError(
                f"tube '{model.name}' cannot stand in rack '{rack.name}' and wear printed cap '{cap.name}' above its "
                "top; choose a tube that is narrower than the slots and reaches out of them"
            )
    albedo = {model.name: float(rng.uniform(*cap_albedo)) for model in types}
    placed: list[PlacedTube] = []
    solids: list[Solid] = []
    for i in rng.permutation(len(rack.all_slots)):
        if len(placed) == count:
            break
        slot = rack.all_slots[i]
        model = types[int(rng.integers(len(types)))]
        if not _fits(rack, slot, model, cap):
            continue
        upright = bow.moved(rack, slot, _standing(rack, slot, model, np.zeros(2), np.zeros(2)))
        tube = PlacedTube(slot.name, model, upright, 0.0, albedo[model.name])
        standing = solid_of(tube, cap)
        found: tuple[PlacedTube, Solid] | None = (tube, standing)
        if _collides(standing, solids, cap):
            found = _leaned(rack, tube, solids, cap, rng, bow)
        if found is not None:
            placed.append(found[0])
            solids.append(found[1])
    for _ in range(_SWEEPS):
        for k in rng.permutation(len(placed)):
            found = _leaned(rack, placed[k], solids[:k] + solids[k + 1 :], cap, rng, bow)
            if found is not None:
                placed[k], solids[k] = found
    order = {slot.name: k for k, slot in enumerate(rack.all_slots)}
    return tuple(sorted(placed, key=lambda tube: order[tube.slot]))


def _leaned(
    rack: RackModel, tube: PlacedTube, others: Sequence[Solid], cap: CapModel, rng: np.random.Generator, bow: Bow
) -> tuple[PlacedTube, Solid] | None:
    """The tube with a random lean and turn of its printed cap that fits beside others, or None."""
    for _ in range(_LEANS):
        slot = rack.slot(tube.slot)
        pose = bow.moved(rack, slot, lean(rack, slot, tube.model, rng))
        spin = float(rng.uniform(-MAX_CAP_SPIN_RAD, MAX_CAP_SPIN_RAD))
        leaned = dataclasses.replace(tube, T_rack_tube=pose, cap_spin_rad=spin)
        solid = solid_of(leaned, cap)
        if not _collides(solid, others, cap):
            return leaned, solid
    return None


def _collides(solid: Solid, others: Sequence[Solid], cap: CapModel) -> bool:
    return any(collide(solid, other, cap) for other in others)


def _fits(rack: RackModel, slot: SlotModel, model: TubeModel, cap: CapModel) -> bool:
    """Whether the tube goes into the slot, and its printed cap's plate stays above the rack."""
    z, r = model.outer_profile_m().T
    # A tapered body is widest at the rack's top, where its profile need not have a point.
    widest = max(float(r[z <= rack.depth_m].max()), float(model.body_radius_m(opening_height_m(rack, model))))
    room = -float(slot.signed_distance_m(slot.center_m))
    plate_low = cap.offset_m(model) - cap.thickness_mm * 1e-3
    return widest + CLEARANCE_M < room and plate_low > rack.depth_m + 1e-3


def lean(rack: RackModel, slot: SlotModel, model: TubeModel, rng: np.random.Generator) -> FloatArray:
    """Random T_rack_tube of shape (4, 4): the bottom within the floor's play, the body leaning as the slot allows.

    The bottom's offset is uniform in the disc of `floor_play_mm`, the axis at the height of the rack's top is uniform
    in what the opening leaves to the body's radius; pairs that would cut into the slot's wall are drawn again.
    """
    room = play_at_top_m(rack, slot, model)
    for _ in range(_LEAN_TRIES):
        low = in_disc(rng, rack.floor_play_mm * 1e-3)
        high = rng.uniform(-room, room)
        slope = (high - low) / (opening_height_m(rack, model) - model.pivot_height_m)
        if clears_walls(rack, slot, model, low[None], slope[None])[0]:
            return _standing(rack, slot, model, low, slope)
    return _standing(rack, slot, model, np.zeros(2), np.zeros(2))


@cache
def _bounded_profile_m(rack: RackModel, slot: SlotModel, model: TubeModel) -> tuple[FloatArray, FloatArray]:
    """Heights above the bottom and radii of the body between the slot's walls, metres."""
    z, r = model.outer_profile_m().T
    inside = z <= rack.depth_m
    z, r = z[inside], r[inside]
    if slot.shape == "round":
        # A straight wall has no point of its profile at the rack's top, where the play bounds square openings alone.
        above = opening_height_m(rack, model)
        z, r = np.append(z, above), np.append(r, float(model.body_radius_m(above)))
    return z, r


def opening_height_m(rack: RackModel, model: TubeModel) -> float:
    """Height above a tube's bottom at which the opening bounds it, metres."""
    return min(rack.depth_m, model.height_m)


def play_at_top_m(rack: RackModel, slot: SlotModel, model: TubeModel) -> FloatArray:
    """How far the axis can be off the slot's centre at the rack's top, along x and y, shape (2,), metres."""
    radius_m = float(model.body_radius_m(opening_height_m(rack, model)))
    return np.maximum(slot.half_size_m - radius_m - CLEARANCE_M, 0.0)


def clears_walls(
    rack: RackModel, slot: SlotModel, model: TubeModel, low_m: FloatArray, slope: FloatArray
) -> NDArray[np.bool_]:
    """Which tubes stay inside their slot: pivots `low_m` off its centre and slopes dx/dz, dy/dz, shape (N, 2) each."""
    z, r = _bounded_profile_m(rack, slot, model)
    stretch = np.sqrt(1 + (slope**2).sum(axis=1))
    centers = low_m[:, None] + (z - model.pivot_height_m)[:, None] * slope[:, None]
    off = slot.signed_distance_m(centers + slot.center_m)
    return np.asarray(np.all(off <= -(r * stretch[:, None] + CLEARANCE_M), axis=1))


def in_disc(rng: np.random.Generator, radius_m: float, count: int | None = None) -> FloatArray:
    """A place uniform on a disc, shape (2,), or so many of them, shape (count, 2), metres."""
    radius, angle = radius_m * np.sqrt(rng.uniform(size=count)), rng.uniform(0, 2 * np.pi, count)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def _standing(
    rack: RackModel, slot: SlotModel, model: TubeModel, offset_m: FloatArray, slope: FloatArray
) -> FloatArray:
    """Pose of a tube whose lowest point touches the floor; `offset_m` (2,) is where its pivot stands off the centre."""
    axis = np.array([*slope, 1.0]) / np.sqrt(1 + slope @ slope)
    pivot = model.pivot_height_m
    if model.body.bottom == "round":
        height = rack.floor_m + pivot
    else:
        tip_mm = model.body.cone_tip_diameter_mm if model.body.bottom == "conical" else model.body.bottom_diameter_mm
        height = rack.floor_m + tip_mm * 0.5e-3 * float(np.hypot(axis[0], axis[1]))
    return make_transform(axis_rotation(axis), np.array([*(slot.center_m + offset_m), height]) - pivot * axis)


def place_rack(
    rack: RackModel,
    tallest_m: float,
    intrinsics: CameraIntrinsics,
    rng: np.random.Generator,
    scanner_tilt_rad: tuple[float, float] = SCANNER_TILT_RAD,
) -> FloatArray:
    """Random T_camera_rack of shape (4, 4) with the whole rack and its tubes in view.

    Any yaw; the camera's axis tilted from the rack's normal about a random axis; the rack's top 0.60 to 0.70 m away
    and off the image's centre.

    Args:
        rack: The rack.
        tallest_m: Height of the tallest tube's top above the rack's base.
        intrinsics: Of the camera that must see all of it.
        rng: Source of randomness.
        scanner_tilt_rad: Least and most angle between the camera's axis and the rack's normal.

    Raises:
        LabwareError: The rack is too large for the camera's view.
    """
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (0, tallest_m)])
    corners[:, :2] *= rack.outline_m / 2
    size = np.array([intrinsics.width, intrinsics.height])
    facing = np.diag([1.0, -1.0, -1.0])
    for _ in range(_POSE_TRIES):
        yaw, about = rng.uniform(0, 2 * np.pi, 2)
        tilt = rng.uniform(*scanner_tilt_rad)
        shift = rng.uniform(-MAX_RACK_SHIFT_M, MAX_RACK_SHIFT_M, 2)
        tilted = Rotation.from_rotvec(tilt * np.array([np.cos(about), np.sin(about), 0.0])).as_matrix()
        rotation = tilted @ facing @ Rotation.from_euler("z", yaw).as_matrix()
        top_center = np.array([*shift, rng.uniform(*DISTANCE_M)])
        T_camera_rack = make_transform(rotation, top_center - rotation @ [0.0, 0.0, rack.height_m])
        uv = intrinsics.project(transform_points(T_camera_rack, corners))
        if np.all(uv > IMAGE_MARGIN * size) and np.all(uv < (1 - IMAGE_MARGIN) * size):
            return T_camera_rack
    raise LabwareError(
        f"rack '{rack.name}' ({rack.outline_mm[0]:g} x {rack.outline_mm[1]:g} mm) does not fit into the view "
        f"of the simulated camera at {DISTANCE_M[0]:g} to {DISTANCE_M[1]:g} m; choose a smaller rack"
    )
