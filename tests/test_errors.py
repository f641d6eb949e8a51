from __future__ import annotations

import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tubepose.errors import CaptureError, TubePoseError


@given(st.text())
def test_any_text_is_one_line(text):
    told = str(TubePoseError(text))
    assert told.isprintable()
    assert len(told.splitlines()) <= 1


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("/two  spaces/a.mcap: \u00b5m", "/two  spaces/a.mcap: \u00b5m"),
        ("not valid YAML: a\n  in line 1\n\tcolumn 2\n", "not valid YAML: a in line 1 column 2"),
        ("encoding 'mono\x1b[2J\x00'", "encoding 'mono\\x1b[2J\\x00'"),
    ],
)
def test_what_prints_stays(text, told):
    assert str(CaptureError(text)) == told


def test_an_error_comes_back_from_another_process():
    assert str(pickle.loads(pickle.dumps(CaptureError("a: b")))) == "a: b"
