"""Work in several processes: done whole, and ended at once when one of them fails."""

import os
import signal
import time

import pytest

from tubepose.errors import CaptureError, LabwareError
from tubepose.simulation.parallel import in_processes


def note(item, threads):
    """Leave a file, or stop in the way that the item says. Spawned processes find it under this module's name."""
    place, word = item
    if word == "die":
        os.kill(os.getpid(), signal.SIGKILL)
    while word == "refuse after another is done":
        if any(place.iterdir()):
            raise LabwareError("one line")
        time.sleep(0.05)
    if word == "sleep":
        time.sleep(300)
    (place / f"{word}-{threads}").touch()


def test_one_thread_or_one_item_needs_no_other_process(tmp_path, monkeypatch):
    monkeypatch.setattr("tubepose.simulation.parallel.ProcessPoolExecutor", None)
    calls = []
    in_processes(note, [(tmp_path, "a"), (tmp_path, "b")], 1, calls.append)
    in_processes(note, [(tmp_path, "c")], 5, calls.append)
    in_processes(note, [], 5, calls.append)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a-1", "b-1", "c-5"]
    assert calls == [1, 2, 1]


@pytest.mark.parametrize(
    ("words", "error", "message"),
    [
        (["done", "refuse after another is done", "sleep"], LabwareError, "^one line$"),
        (["die", "sleep"], CaptureError, "one of 2 processes died.*try fewer threads"),
    ],
)
def test_a_failure_ends_the_others_at_once(words, error, message, tmp_path):
    begun = time.monotonic()
    with pytest.raises(error, match=message):
        in_processes(note, [(tmp_path, word) for word in words], 2 * len(words), lambda _done: None)
    assert time.monotonic() - begun < 120
    # Each process has its share of the threads.
    assert [path.name for path in tmp_path.iterdir()] == [f"{word}-2" for word in words if word == "done"]
