"""One way to open whatever was recorded: `open_captures`."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, Protocol, TypedDict, Unpack

from tubepose.capture.description import CAPTURE_FILE, Unit, is_depth_scale
from tubepose.capture.folder import FolderCapture, is_capture_folder, is_remains
from tubepose.capture.formats.bop import BopScene, bop_cameras, is_bop_camera
from tubepose.capture.formats.cloud_files import CLOUD_READERS, CloudFileCapture
from tubepose.capture.formats.containers import SUFFIXES, is_recording, recording_suffix
from tubepose.capture.formats.depth_folders import DepthFolder, is_depth_folder
from tubepose.capture.formats.depth_images import DEPTH_SUFFIXES
from tubepose.capture.formats.depth_sequences import GivenScale
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.fusion import Average, AveragedCapture
from tubepose.capture.pairing import PAIRING_TOLERANCE_NS
from tubepose.capture.recorded import RecordedCapture
from tubepose.capture.regular import irregular_words
from tubepose.capture.topics import TopicChoice
from tubepose.errors import CaptureError, readable

# Truth of a simulated session: nothing that an estimator may read.
TRUTH_FOLDER = "simulation_truth"

_CONVERT = {
    ".zdf": "a Zivid frame; save it as PLY in Zivid Studio, or frame.save('cloud.ply') with the Zivid SDK (unit: mm)",
    ".praw": "a PhoXi raw frame; open it in PhoXi Control and save it as PLY, organised, with texture (unit: mm)",
}


class Capture(Protocol):
    """Something recorded: one frame or many.

    Attributes:
        name: As the tables show it.
        path: Where it lies.
    """

    @property
    def name(self) -> str:
        """As the tables show it."""
        ...

    @property
    def path(self) -> Path:
        """Folder or file."""
        ...

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield the frames one by one.

        Raises:
            CaptureError: The content is missing, cut, or not what it claims to be; frames before it were good.
        """
        ...


@dataclass(frozen=True, slots=True)
class UnreadableCapture:
    """A file or folder that is not read: it keeps its row among the captures, with what to do about it.

    Attributes:
        name: As the tables show it.
        path: The file or folder.
        why: What it is, and what to do.
    """

    name: str
    path: Path
    why: str

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield nothing.

        Raises:
            CaptureError: Always; says why.
        """
        raise CaptureError(f"{self.path}: {self.why}")
        yield


class TopicNames(TypedDict, total=False):
    """Topics of recordings, where several would fit.

    Attributes:
        cloud_topic: PointCloud2 topic.
        image_topic: Image or CompressedImage topic.
        depth_topic: Topic of depth images.
        info_topic: CameraInfo topic.
    """

    cloud_topic: str | None
    image_topic: str | None
    depth_topic: str | None
    info_topic: str | None


def open_captures(
    path: Path,
    *,
    name: str | None = None,
    unit: str | None = None,
    depth_scale_m: float | None = None,
    max_stamp_difference_ms: float | None = None,
    average: Average = 1,
    allow_outside: bool = False,
    **topics: Unpack[TopicNames],
) -> list[Capture]:
    """Find the captures at a path; nothing of their content is read yet.

    Args:
        path: A capture folder, a cloud file, a recording (MCAP, ROS 2 SQLite, ROS 1 bag, or the folder of a split one),
            a folder of depth images in the layout of BOP, Open3D or FoundationPose, or a directory that is searched for
            them, in sorted order.
        name: Of a single capture; by default it is named after its folder or file.
        unit: ``m`` or ``mm``, unit of clouds: goes before `capture.yaml`; without either a cloud is in metres. ``mm``
            is the unit of a depth image's counts too where no `depth_scale_m` is given, and in recordings that of depth
            in floats.
        depth_scale_m: Metres per count of depth images, 1 for floats that are metres; it goes before what files say.
        max_stamp_difference_ms: Stamps of a picture and its cloud in a recording differ by no more; 50 by default.
        average: Frames in a row, of a static recording, that are fused into one; ``all`` of a capture.
        allow_outside: Whether the files that a `capture.yaml` names may lie out of its folder.
        **topics: Of recordings, where several would fit; see `TopicNames`.

    Returns:
        Captures in sorted order; those of a directory are named by their path in it.

    Raises:
        CaptureError: No such path, nothing to open there, or a unit, scale or difference that is none.
    """
    name = None if name is None else readable(name)
    choice = TopicChoice(
        topics.get("cloud_topic"), topics.get("image_topic"), topics.get("depth_topic"), topics.get("info_topic")
    )
    given = GivenScale(_unit(unit), _scale(depth_scale_m))
    opener = _Opener(given, choice, _difference_ns(max_stamp_difference_ms), allow_outside)
    if not path.exists():
        raise CaptureError(f"{path}: no such file or folder")
    if not path.is_dir() or _is_closed(path) or _is_capture(path):
        capture = opener.open(path, name or (path.stem if path.is_file() else path.resolve().name))
        if capture is not None:
            return _averaged([capture], average)
        raise CaptureError(f"{path}: {_unknown_words(path)}")
    return _averaged(_search(path, opener), average)


def _averaged(captures: list[Capture], average: Average) -> list[Capture]:
    return captures if average == 1 else [AveragedCapture(capture, average) for capture in captures]


@dataclass(frozen=True, slots=True)
class _Opener:
    given: GivenScale
    topics: TopicChoice
    max_stamp_difference_ns: int
    allow_outside: bool = False

    def open(self, path: Path, name: str) -> Capture | None:
        name = readable(name)
        if not (path.is_file() or path.is_dir()):
            return UnreadableCapture(name, path, f"{irregular_words(path)}; expected a file or a folder")
        if _is_closed(path):
            return UnreadableCapture(name, path, "may not be read by this user; change its permissions")
        if is_recording(path):
            return RecordedCapture(
                name, path, self.given.unit, self.topics, self.given.depth_scale_m, self.max_stamp_difference_ns
            )
        if path.is_dir():
            return self._open_folder(path, name)
        suffix = path.suffix.lower()
        if suffix in CLOUD_READERS:
            return CloudFileCapture(name, path, self.given.unit)
        if is_bop_camera(path):
            return BopScene(name, path, self.given)
        return UnreadableCapture(name, path, _CONVERT[suffix]) if suffix in _CONVERT else None

    def _open_folder(self, path: Path, name: str) -> Capture:
        if not is_capture_folder(path):
            if bop_cameras(path):
                return BopScene(name, path, self.given)
            if is_depth_folder(path):
                return DepthFolder(name, path, self.given)
        return FolderCapture(name, path, self.given.unit, self.given.depth_scale_m, self.allow_outside)


def _is_capture(path: Path) -> bool:
    """True for a folder that is one capture, whatever its layout."""
    return (
        is_recording(path)
        or is_capture_folder(path)
        or (path.is_dir() and (bool(bop_cameras(path)) or is_depth_folder(path)))
    )


def _unknown_words(path: Path) -> str:
    """What to say of a file that is no capture."""
    if path.suffix.lower() in DEPTH_SUFFIXES:
        return (
            f"an image without its camera; put it into a folder of its own as depth{path.suffix.lower()} beside "
            f"{CAPTURE_FILE} with 'unit: mm' (or depth_scale_m) and "
            "'intrinsics: {width: , height: , fx: , fy: , cx: , cy: }', and give that folder"
        )
    known = ", ".join((*CLOUD_READERS, *SUFFIXES))
    return f"expected a capture folder, or a file ending in {known}, found '{path.suffix}'"


def _is_closed(path: Path) -> bool:
    """True for a folder whose content this user may not see."""
    return path.is_dir() and not os.access(path, os.R_OK | os.X_OK)


def _search(path: Path, opener: _Opener) -> list[Capture]:
    places = [place for found in _walk(path) for place in _sensors(found)]
    names = _names(path, places)
    found = [opener.open(place, name) for place, name in zip(places, names, strict=True)]
    captures = [capture for capture in found if capture is not None]
    if not captures:
        raise CaptureError(
            f"{path}: no capture found; looked in it and below for folders with capture.yaml, cloud.ply or depth.png, "
            f"for BOP scenes, for folders with depth/ and a camera file, and for files ending in "
            f"{', '.join((*CLOUD_READERS, *SUFFIXES))}; docs/capture-format.md shows how to record one"
        )
    return captures


def _unit(unit: str | None) -> Unit | None:
    known: dict[str | None, Literal["m", "mm"] | None] = {None: None, "m": "m", "mm": "mm"}
    if unit not in known:
        raise CaptureError(f"unit '{unit}' is not known; expected m or mm")
    return known[unit]


def _scale(depth_scale_m: float | None) -> float | None:
    if depth_scale_m is not None and not is_depth_scale(depth_scale_m):
        raise CaptureError(
            f"depth scale {depth_scale_m:g}: expected the metres of one count, up to 0.01 (0.001 for millimetres), or "
            "1 for floats that are metres"
        )
    return depth_scale_m


def _difference_ns(difference_ms: float | None) -> int:
    if difference_ms is None:
        return PAIRING_TOLERANCE_NS
    if not (math.isfinite(difference_ms) and difference_ms >= 0):
        raise CaptureError(f"a largest difference of stamps of {difference_ms:g} ms is none; expected 0 or more")
    return round(difference_ms * 1e6)


def _sensors(place: Path) -> list[Path]:
    """The place, or the camera files of a BOP scene of several sensors."""
    if not place.is_dir() or _is_closed(place) or is_capture_folder(place):
        return [place]
    cameras = bop_cameras(place)
    return cameras if len(cameras) > 1 else [place]


def _walk(folder: Path, inside: frozenset[Path] = frozenset()) -> Iterator[Path]:
    """Capture folders and files below a folder, sorted; a capture folder is searched no further.

    A folder with nothing below it but some file of a capture is one that has lost the others.

    A link to a folder that it lies in leads nowhere new.
    """
    inside |= {folder.resolve(), *folder.resolve().parents}
    for entry in sorted(folder.iterdir()):
        if entry.name.startswith(".") or entry.name == TRUTH_FOLDER:
            continue
        if not entry.is_dir() and not entry.is_file() and not _is_known(entry):
            continue
        if not entry.is_dir() or _is_closed(entry) or _is_capture(entry):
            yield entry
        elif entry.resolve() not in inside:
            below = list(_walk(entry, inside))
            lost = is_remains(entry) and not any(place.is_dir() or _is_known(place) for place in below)
            yield from [entry] if lost else below


def _is_known(path: Path) -> bool:
    return path.suffix.lower() in (*CLOUD_READERS, *_CONVERT) or recording_suffix(path) in SUFFIXES


def _names(root: Path, places: list[Path]) -> list[str]:
    """Path below the root without ending; with it where two would have the same name."""
    full = [place.relative_to(root).as_posix() for place in places]
    short = [
        place.relative_to(root).with_suffix("").as_posix() if place.is_file() else name
        for place, name in zip(places, full, strict=True)
    ]
    return [name if short.count(name) == 1 else whole for name, whole in zip(short, full, strict=True)]
