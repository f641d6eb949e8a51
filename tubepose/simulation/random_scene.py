"""Random scenes as they are made: where tubes stand, then what light and manufacture make of them.

Every concern draws from a stream of its own, and draws the same numbers whether or not it needs them. So the poses of
tubes and rack depend on the generator's seed, the rack, the types, the printed cap, the camera's view, the fill and the
scanner's tilt alone: crooked caps, finishes, walls, liquids and labels can be switched on and off under them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from tubepose.capture.frame import CameraIntrinsics
from tubepose.labware import CapModel, RackModel, TubeModel, WallOptics
from tubepose.simulation.bow import Bow
from tubepose.simulation.collision import CLEARANCE_M, collide, solid_of
from tubepose.simulation.placement import DISTANCE_M, place_rack, place_tubes
from tubepose.simulation.scene import CapFit, Finishes, Label, Liquid, PlacedTube, Scene
from tubepose.simulation.variation import SceneVariation, Tolerances

DEFAULT_VARIATION = SceneVariation()
LIQUID_LEVEL = (0.2, 0.8)
"""Least and most height of a liquid's surface, as a share of the cavity's."""
LABEL_HEIGHT_M = (0.020, 0.050)
MIN_LABEL_HEIGHT_M = 0.005
"""A tube with less straight wall wears no label."""
LABEL_SPAN_RAD = (float(np.deg2rad(200.0)), float(np.deg2rad(360.0)))
LABEL_MARGIN_M = 2e-3
"""A label stays this far from the bottom and from the cap, flange or rim above it."""

_FIT_TRIES = 30


class SeeingCamera(Protocol):
    """A camera of any kind, by what it can see."""

    @property
    def intrinsics(self) -> CameraIntrinsics:
        """Pinhole of its image."""
        ...


def random_scene(
    rack: RackModel,
    types: Sequence[TubeModel],
    cap: CapModel,
    camera: SeeingCamera,
    rng: np.random.Generator,
    variation: SceneVariation = DEFAULT_VARIATION,
    distance_m: tuple[float, float] = DISTANCE_M,
) -> Scene:
    """Draw a scene; the tubes wear their own caps.

    Args:
        rack: The rack.
        types: Tube types; any of them stands in each slot.
        cap: The printed cap that there must be room for.
        camera: The camera that must see all of the rack.
        rng: Source of randomness. Streams are spawned from it, so a second scene from the same generator differs.
        variation: Ranges to draw from.
        distance_m: Depth of the middle of the rack's face where `variation` does not say.

    Raises:
        LabwareError: A tube cannot stand in the rack, or the rack does not fit into the view.
    """
    look_rng, wall_rng, fit_rng, liquid_rng, label_rng = rng.spawn(5)
    # A grandchild, so that the streams of the next scene from the same generator stay what they were.
    bow = _bow(variation, look_rng.spawn(1)[0])
    count = max(1, round(_uniform(rng, variation.fill) * len(rack.all_slots)))
    tubes = place_tubes(rack, types, count, cap, rng, variation.cap_albedo, bow)
    tallest = rack.floor_m + max(max(model.height_m, cap.offset_m(model)) for model in types)
    low_deg, high_deg = variation.scanner_tilt_deg
    tilt_rad = (float(np.deg2rad(low_deg)), float(np.deg2rad(high_deg)))
    T_camera_rack = place_rack(rack, tallest, camera.intrinsics, rng, tilt_rad, variation.distance_m or distance_m)
    tubes = fit_caps(tubes, cap, variation.tolerances, fit_rng)
    plastic = _drawn_plastic(variation, wall_rng)
    tubes = tuple(
        dataclasses.replace(
            tube,
            optics=_optics(tube.model, plastic),
            liquid=_liquid(tube.model, variation, liquid_rng),
            label=_label(tube.model, variation, label_rng),
        )
        for tube in tubes
    )
    return Scene(rack, T_camera_rack, tubes, finishes=_finishes(variation, look_rng), bow=bow)


def _bow(variation: SceneVariation, rng: np.random.Generator) -> Bow:
    along_x_mm, along_y_mm = (_uniform(rng, variation.rack_bow_mm) for _ in range(2))
    return Bow(along_x_mm * 1e-3, along_y_mm * 1e-3)


def fit_caps(
    tubes: Sequence[PlacedTube], cap: CapModel, tolerances: Tolerances, rng: np.random.Generator
) -> tuple[PlacedTube, ...]:
    """Seat the caps, own and printed, as they are made; the tubes do not move.

    Errors are normal. Those with which a cap would cut into a neighbour, or leave its own tube's rim uncovered, are
    drawn again; where no draw of a bounded number fits, the caps stay perfect. So caps that nearly touch have smaller
    errors than the standard deviations say.

    Args:
        tubes: Tubes that do not collide as they are.
        cap: The printed cap.
        tolerances: Standard deviations.
        rng: Source of randomness.
    """
    seated = list(tubes)
    solids = [solid_of(tube, cap) for tube in seated]
    for i, tube in enumerate(tubes):
        others = solids[:i] + solids[i + 1 :]
        for _ in range(_FIT_TRIES):
            candidate = _seated(tube, tolerances, rng)
            solid = solid_of(candidate, cap)
            if _covers_rim(candidate) and not any(collide(solid, other, cap) for other in others):
                seated[i], solids[i] = candidate, solid
                break
    return tuple(seated)


def _seated(tube: PlacedTube, tolerances: Tolerances, rng: np.random.Generator) -> PlacedTube:
    tilt = rng.normal(0.0, np.deg2rad(tolerances.cap_tilt_deg), 2)
    radius_m, height_m = rng.normal(0.0, [tolerances.cap_radius_mm * 1e-3, tolerances.cap_height_mm * 1e-3])
    printed = rng.normal(0.0, np.deg2rad(tolerances.printed_cap_tilt_deg), 2)
    fit = CapFit((float(tilt[0]), float(tilt[1])), float(radius_m), float(height_m))
    return dataclasses.replace(
        tube,
        cap_fit=CapFit() if tube.model.is_open else fit,
        printed_tilt_rad=(float(printed[0]), float(printed[1])),
    )


def _covers_rim(tube: PlacedTube) -> bool:
    """Whether its own closed cap hides the wall that it sits on."""
    model, fit = tube.model, tube.cap_fit
    if model.is_open:
        return True
    (skirt, _), (_, radius), (top, _), _ = model.cap_profile_m()
    rim, sine = model.rim_height_m, float(np.sin(np.hypot(*fit.tilt_rad)))
    body = max(float(model.body_radius_m(z)) for z in (skirt, rim))
    around = radius + fit.radius_error_m - body - abs(rim - skirt) * sine
    above = top + fit.height_error_m - rim - body * sine
    return bool(min(around, above) > CLEARANCE_M)


def _drawn_plastic(variation: SceneVariation, rng: np.random.Generator) -> dict[str, float]:
    """What the walls of this trial do to light, by the field of `WallOptics`; without those that stay as defined."""
    ranges = {
        "scattering_per_mm": variation.scattering_per_mm,
        "absorption_per_mm": variation.absorption_per_mm,
        "refractive_index": variation.refractive_index,
    }
    drawn = {key: _uniform(rng, bounds or (0.0, 0.0)) for key, bounds in ranges.items()}
    return {key: value for key, value in drawn.items() if ranges[key] is not None}


def _optics(model: TubeModel, plastic: dict[str, float]) -> WallOptics | None:
    own = model.body.wall_optics
    return None if own is None or not plastic else WallOptics(**(own.model_dump() | plastic))


def _liquid(model: TubeModel, variation: SceneVariation, rng: np.random.Generator) -> Liquid | None:
    chance, share = rng.uniform(), _uniform(rng, LIQUID_LEVEL)
    absorption_per_m = _uniform(rng, variation.liquid_absorption_per_m)
    bottom = float(model.cavity_profile_m()[-1, 0])
    level_m = bottom + share * (model.rim_height_m - bottom)
    return Liquid(level_m, absorption_per_m=absorption_per_m) if chance < variation.liquid_share else None


def straight_wall_m(model: TubeModel) -> tuple[float, float]:
    """Heights above a tube's origin between which its outside is bare wall: over the bottom, under cap or flange."""
    high = model.rim_height_m if model.cap is None else float(model.cap_profile_m()[0, 0])
    return model.body.bottom_height_mm * 1e-3, min(high, model.rim_height_m)


def _label(model: TubeModel, variation: SceneVariation, rng: np.random.Generator) -> Label | None:
    chance, wanted_m, place = rng.uniform(), _uniform(rng, LABEL_HEIGHT_M), rng.uniform()
    start, span = _uniform(rng, (0.0, 2 * np.pi)), _uniform(rng, LABEL_SPAN_RAD)
    albedo = _uniform(rng, variation.label_albedo)
    low, high = straight_wall_m(model)
    room = high - low - 2 * LABEL_MARGIN_M
    if chance >= variation.label_share or room < MIN_LABEL_HEIGHT_M:
        return None
    height = min(wanted_m, room)
    low += LABEL_MARGIN_M + place * (room - height)
    return Label(low, low + height, start, span, albedo)


def _finishes(variation: SceneVariation, rng: np.random.Generator) -> Finishes:
    usual = Finishes()
    return Finishes(
        table=dataclasses.replace(usual.table, albedo=_uniform(rng, variation.table_albedo)),
        rack=dataclasses.replace(
            usual.rack,
            albedo=_uniform(rng, variation.rack_albedo),
            roughness=_uniform(rng, variation.gloss_roughness),
        ),
        printed_cap=dataclasses.replace(usual.printed_cap, albedo=_uniform(rng, variation.printed_cap_albedo)),
        cap_roughness=_uniform(rng, variation.gloss_roughness),
        wall_roughness=_uniform(rng, variation.wall_roughness),
    )


def _uniform(rng: np.random.Generator, bounds: tuple[float, float]) -> float:
    return float(rng.uniform(*bounds))
