"""The same function on many items in parallel processes that end with the one that started them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing.connection import wait
from typing import TypeVar

from tubepose.errors import CaptureError

_T = TypeVar("_T")


def in_processes(
    do: Callable[[_T, int], object], items: Sequence[_T], threads: int, on_done: Callable[[int], None]
) -> None:
    """Call `do(item, threads of its own)` for every item, several at once; what it returns is dropped.

    One thread, or one item, is done in this process. New processes are spawned, so `do` and the items must be
    picklable, and a script that calls this needs its ``if __name__ == "__main__"``.

    Args:
        do: The work.
        items: What it is done to.
        threads: Threads in all: as many processes as there are items or threads, the rest shared out among them.
        on_done: Called in this process with the number of items done, after each.

    Raises:
        CaptureError: A process died.
        BaseException: What `do` raised first. The other processes have ended then.
    """
    processes = min(threads, len(items))
    if processes <= 1:
        for done, item in enumerate(items, 1):
            do(item, threads)
            on_done(done)
        return
    others = set(multiprocessing.active_children())
    each = threads // processes
    pool = ProcessPoolExecutor(processes, multiprocessing.get_context("spawn"), _start, (each,))
    finished = False
    try:
        futures = [pool.submit(do, item, each) for item in items]
        # A pool does not notice the death of the process that it started last until something else happens.
        pool.submit(int).cancel()
        for done, future in enumerate(as_completed(futures), 1):
            future.result()
            on_done(done)
        finished = True
    except BrokenProcessPool:
        raise CaptureError(
            f"one of {processes} processes died, killed from outside or out of memory; expected all to finish; try "
            "fewer threads"
        ) from None
    finally:
        # Nobody waits for captures that are not wanted any more.
        for child in () if finished else set(multiprocessing.active_children()) - others:
            child.kill()
        pool.shutdown(cancel_futures=True)


def _start(threads: int) -> None:
    """First act of a process: it leaves Ctrl-C to its parent, and ends when that is gone."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if "numba" not in sys.modules:
        os.environ["NUMBA_NUM_THREADS"] = str(threads)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os.kill(os.getpid(), signal.SIGTERM)
