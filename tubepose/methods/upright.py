"""Method `upright`: the baseline that looks at no point of the tube."""

from __future__ import annotations

from tubepose.config import Config
from tubepose.labware import RackModel, SlotModel, TubeModel
from tubepose.methods.method import EachTube
from tubepose.transforms import FloatArray, translation
from tubepose.tube import TubePose, TubeStatus


def fit_upright(
    points_m: FloatArray, slot: SlotModel, tube: TubeModel, rack: RackModel, config: Config, seed: int = 0
) -> TubePose:
    """Bottom at the slot's centre, axis along the rack's normal."""
    del config, seed, tube
    T_rack_tube = translation(rack.bottom_center_m(slot))
    return TubePose(TubeStatus.OK, "", T_rack_tube, n_points=len(points_m))


UPRIGHT = EachTube("upright", fit_upright)
