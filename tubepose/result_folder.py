"""The folder of results: made, probed and held by one run; its files are written aside and then renamed."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tubepose.errors import OutputError

_PROBE_BYTES = 1 << 16


def make_folder(path: Path) -> None:
    """Make a folder for results before any work is done.

    Raises:
        OutputError: It cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as problem:
        raise OutputError(
            f"{path}: cannot be a folder for results ({problem.strerror}); choose another place"
        ) from None


@contextmanager
def held_folder(path: Path) -> Iterator[None]:
    """Make a folder for results, see that it can be written, and hold it against other runs meanwhile.

    The system lets go of it when the process ends, however that is; a folder that was made and stays empty is removed.

    Raises:
        OutputError: It cannot be made or written, or another run holds it.
    """
    made = not path.exists()
    make_folder(path)
    with _locked(path):
        probe = path / f".probe-{os.getpid()}"
        try:
            probe.write_bytes(bytes(_PROBE_BYTES))
        except OSError as problem:
            raise OutputError(
                f"{path}: cannot be written ({problem.strerror}); expected a folder to write in, choose another one"
            ) from None
        finally:
            with suppress(OSError):
                probe.unlink()
        try:
            yield
        finally:
            if made:
                with suppress(OSError):  # only if it is empty
                    path.rmdir()


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    try:
        import fcntl
    except ImportError:  # not on Windows
        yield
        return
    handle = os.open(path, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise OutputError(
            f"{path}: another run is writing its results there; wait for its end, or choose another folder"
        ) from None
    except OSError:  # a file system without locks
        pass
    try:
        yield
    finally:
        os.close(handle)


def remove_files(folder: Path, names: Iterable[str]) -> None:
    """Remove results of an earlier run that this one has none of: they would lie beside results they do not belong to.

    Raises:
        OutputError: One of them cannot be removed.
    """
    for name in names:
        try:
            (folder / name).unlink(missing_ok=True)
        except OSError as problem:
            raise OutputError(
                f"{folder / name}: of an earlier run, and cannot be removed ({problem.strerror}); choose another folder"
            ) from None


@contextmanager
def write_aside(path: Path, *, make: bool = True) -> Iterator[Path]:
    """Give a path beside `path` to write to, and rename it to `path` when the block ends well.

    The path aside keeps the suffix, for writers that choose their format by it. Folders are made as needed, or with
    `make` false expected. A reader never sees half a file, and an earlier one stays if the block fails.

    Raises:
        OutputError: The place cannot be written.
    """
    aside = path.with_name(f".{path.stem}.part{path.suffix}")
    try:
        if make:
            path.parent.mkdir(parents=True, exist_ok=True)
        yield aside
        os.replace(aside, path)
    except OSError as problem:
        why = problem.strerror or str(problem)
        raise OutputError(
            f"{path}: cannot be written ({why}); expected a folder to write in, choose another one"
        ) from None
    finally:
        with suppress(OSError):
            aside.unlink()
