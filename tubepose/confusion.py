"""Which type of tube is taken for which."""

from __future__ import annotations

import pandas as pd

CONFUSION_COLUMNS = ("method", "tube", "tube_estimated", "n")
NO_TYPE = "none"


def confusion(errors: pd.DataFrame) -> pd.DataFrame:
    """Counts of expected tubes by their true and their estimated type.

    Args:
        errors: Rows of errors.csv; false estimates have no true type and are left out.

    Returns:
        Rows of confusion.csv, first seeds only: accepted and rejected answers by the type that they claim; ``none``
        where there is no answer, or one of unknown type.
    """
    rows = errors[(errors["outcome"] != "false") & (errors["seed"].isna() | (errors["seed"] == 0))]
    told = rows.assign(tube_estimated=rows["tube_estimated"].where(rows["outcome"] != "missed").fillna(NO_TYPE))
    counts = told.groupby(["method", "tube", "tube_estimated"], sort=False).size().rename("n").reset_index()
    order = {method: i for i, method in enumerate(errors["method"].unique())}
    counts = counts.sort_values(["tube", "tube_estimated"], kind="stable")
    counts = counts.sort_values("method", key=lambda names: names.map(order), kind="stable")
    return counts[list(CONFUSION_COLUMNS)].reset_index(drop=True)
