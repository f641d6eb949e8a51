"""Which type is taken for which: counted by hand."""

import pandas as pd

from tubepose.confusion import CONFUSION_COLUMNS, confusion

ERRORS = pd.DataFrame(
    [
        ("profile", None, "a", "a", "ok"),
        ("profile", None, "a", "b", "rejected"),
        ("profile", None, "b", None, "rejected"),
        ("profile", None, "b", "b", "missed"),
        ("profile", None, None, "b", "false"),
        ("icp", 0, "a", "a", "ok"),
        ("icp", 1, "a", "b", "ok"),
    ],
    columns=["method", "seed", "tube", "tube_estimated", "outcome"],
).astype({"seed": "Int64"})


def test_types_are_counted_once_per_tube_in_the_order_of_the_methods():
    assert list(confusion(ERRORS)) == list(CONFUSION_COLUMNS)
    assert list(confusion(ERRORS).itertuples(index=False, name=None)) == [
        ("profile", "a", "a", 1),
        ("profile", "a", "b", 1),
        ("profile", "b", "none", 2),
        ("icp", "a", "a", 1),
    ]


def test_every_expected_tube_of_the_first_seed_is_counted():
    expected = ERRORS[(ERRORS["outcome"] != "false") & (ERRORS["seed"].fillna(0) == 0)]
    assert confusion(ERRORS)["n"].sum() == len(expected)


def test_nothing_expected_gives_an_empty_table():
    assert len(confusion(ERRORS[ERRORS["outcome"] == "false"])) == 0
