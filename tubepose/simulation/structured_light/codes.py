"""What a ray can hit, and what it can hit it on: the codes that kernels and their callers share."""

NOTHING, TABLE, RACK_TOP, RACK_SIDE, WELL_WALL, WELL_FLOOR, REVOLVED, BOX, LIQUID = range(9)
"""What a ray meets first. REVOLVED is a segment of a solid of revolution, BOX a face of a printed cap's plate."""
OPAQUE, OUTSIDE, CAVITY = range(3)
"""Kinds of segments: opaque, or the interface of plastic on the outside or in the cavity of a body."""
LINE, FLAT, SPHERE = range(3)
"""Shapes of segments: cone or cylinder, flat ring, sphere."""
