"""What a run needs to be run again: versions, threads, configuration, and hashes of what went in."""

from __future__ import annotations

import hashlib
import os
import platform
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import cv2
import open3d as o3d
from threadpoolctl import threadpool_limits

from tubepose import __version__
from tubepose.capture.manifest import file_sha256, tree_sha256
from tubepose.config import Config
from tubepose.labware import Labware, labware_sha256

PACKAGES = (
    "numpy", "scipy", "numba", "llvmlite", "open3d", "open3d-cpu", "onnxruntime", "opencv-python-headless", "pandas",
    "mcap", "rosbags", "kiss-matcher", "small_gicp",
)  # fmt: skip


@contextmanager
def pinned_threads(count: int = 1) -> Iterator[None]:
    """Bound the threads of BLAS, OpenCV and Open3D: one makes results the same in every run.

    Open3D's warnings, which it prints to stdout, are held back meanwhile: what they tell is checked where it is used.
    """
    opencv_before, open3d_before = cv2.getNumThreads(), o3d.utility.get_max_threads()
    cv2.setNumThreads(count)
    o3d.utility.set_max_threads(count)
    try:
        quiet = o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)
        with threadpool_limits(count), quiet:
            yield
    finally:
        cv2.setNumThreads(opencv_before)
        o3d.utility.set_max_threads(open3d_before)


def inputs_sha256(paths: Iterable[Path], out: Path) -> dict[str, str]:
    """SHA-256 of files; of folders, of the listing of their files, as in `data_manifest.yaml`.

    Args:
        paths: Files and folders; what lies in a folder that is among them counts with that folder alone.
        out: Where results go; nothing in it counts. Take the digests before anything is written there.
    """
    given = dict.fromkeys(paths)
    return {str(path): _sha256(path, out) for path in given if not any(folder in given for folder in path.parents)}


def _sha256(path: Path, out: Path) -> str:
    try:
        return file_sha256(path) if path.is_file() else tree_sha256(path, out)
    except OSError as problem:
        return f"cannot be read: {problem.strerror}"


def content_sha256(path: Path, out: Path) -> str:
    """Digest of a file or folder, as `inputs_sha256` takes it."""
    return _sha256(path, out)


@cache
def code_sha256() -> str:
    """Digest of the package's own sources, which a version number between two releases does not tell apart."""
    root = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def run_record(
    command: Sequence[str],
    config: Config,
    labware: Sequence[Labware],
    inputs: Mapping[str, str],
    **more: Any,
) -> dict[str, Any]:
    """Contents of `run.json`.

    Args:
        command: The command line.
        config: The resolved configuration.
        labware: Every definition that was used.
        inputs: Digests of captures, sessions and model files, as `inputs_sha256` takes them.
        more: What else the command wants to keep (methods, seeds, threads, detector).
    """
    return {
        "tubepose": __version__,
        "command": list(command),
        "config": config.model_dump(),
        "versions": {"python": platform.python_version(), **_versions()},
        "machine": machine(),
        "labware_sha256": {item.name: labware_sha256(item) for item in labware},
        "inputs_sha256": dict(inputs),
        **more,
    }


def machine() -> dict[str, Any]:
    """System, processor and number of cores."""
    return {"system": platform.platform(), "cpu": _cpu(), "cores": os.cpu_count()}


def _versions() -> dict[str, str]:
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def _cpu() -> str:
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
