"""Pose of the rack (paper, section IV-A): by the edges of its ribs, or by the paper's OBB and ICP.

The steps of the method `edges`: `search` lists where the top could be, `looks` takes a rough look at each place, `fit`
refines a pose, `agreement` and `evidence` say whether to believe it. `obb` is the paper's method. `naming` tells which
rack of a catalogue stands there, `grid` finds slots without any rack's definition.
"""

from tubepose.rack.pose import RackPose, RackStatus
from tubepose.rack.registration import register_rack

__all__ = ["RackPose", "RackStatus", "register_rack"]
