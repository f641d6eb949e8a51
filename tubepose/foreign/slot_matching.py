"""Estimates that name no slot: linear assignment to the true tubes of their trial."""

from __future__ import annotations

import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment

from tubepose.records import POSE_COLUMNS, transform_of
from tubepose.transforms import FloatArray

MATCH_MM = 20.0
"""An estimate this far from every true tube claims none of them."""
_MIDDLE_M = 0.05


def with_slots(estimates: pd.DataFrame, truth: pd.DataFrame, match_mm: float = MATCH_MM) -> pd.DataFrame:
    """Give estimates without a slot the slot of a true tube, so that the sum of distances is least (Kuhn, 1955).

    The distance is between the points 50 mm up the two axes. Pairs farther apart than `match_mm` are none: such an
    estimate stays without a slot and counts as false, and the tube as missed. Estimates that name a slot keep it, and
    nothing else is assigned to it.

    Args:
        estimates: Rows of estimates.csv; several frames, methods and seeds are matched apart.
        truth: Rows of ground_truth.csv; those that are not ok are no candidates.
        match_mm: Largest distance, mm.
    """
    slots = estimates["slot"].astype("object").copy()
    keys = [*(estimates[name] for name in ("session", "trial", "method")), estimates["seed"].astype("Int64").fillna(-1)]
    known = dict(list(truth[truth["status"] == "ok"].groupby(["session", "trial"])))
    posed = estimates[list(POSE_COLUMNS)].notna().all(axis=1)
    for key, rows in estimates.groupby([*keys, estimates["frame"]], sort=False):
        tubes = known.get((key[0], key[1]))
        open_rows = rows[rows["slot"].isna() & posed[rows.index]]
        if tubes is None or open_rows.empty:
            continue
        tubes = tubes[~tubes["slot"].isin(rows["slot"].dropna())]
        distance_mm = np.linalg.norm(_middles_m(open_rows)[:, None] - _middles_m(tubes)[None], axis=2) * 1e3
        # A pair too far apart costs the same wherever it is, so it never displaces a pair that is near.
        for i, j in zip(*linear_sum_assignment(np.minimum(distance_mm, match_mm)), strict=True):
            if distance_mm[i, j] < match_mm:
                slots[open_rows.index[int(i)]] = tubes["slot"].iloc[j]
    return estimates.assign(slot=slots.astype("str").mask(slots.isna()))


def _middles_m(rows: pd.DataFrame) -> FloatArray:
    T = [transform_of({str(name): value for name, value in row.items()}) for row in rows.to_dict("records")]
    return np.array([one[:3, 3] + _MIDDLE_M * one[:3, 2] for one in T]).reshape(-1, 3)
