"""Captures that are one cloud in a file of its own: PLY, PCD, PTX."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

from tubepose.capture.description import Unit
from tubepose.capture.formats.cloud import CloudFile
from tubepose.capture.formats.pcd import read_pcd
from tubepose.capture.formats.ptx import read_ptx
from tubepose.capture.frame import RgbdFrame
from tubepose.capture.ply import read_ply
from tubepose.capture.registration import METRES_PER_UNIT, clean_cloud
from tubepose.errors import CaptureError

CLOUD_READERS: dict[str, Callable[[Path], CloudFile]] = {".ply": read_ply, ".pcd": read_pcd, ".ptx": read_ptx}
"""Readers of clouds by the end of a file's name."""


def read_cloud(path: Path) -> CloudFile:
    """Read a cloud by the end of its name.

    Raises:
        CaptureError: Missing, cut, or of no format that is read.
    """
    reader = CLOUD_READERS.get(path.suffix.lower())
    if reader is None:
        raise CaptureError(f"{path}: expected a cloud ending in {', '.join(CLOUD_READERS)}, found '{path.suffix}'")
    return reader(path)


def unit_of(path: Path, cloud: CloudFile, unit: Unit | None) -> Unit:
    """Unit of a cloud: as the user says, as the file says, else metres.

    Raises:
        CaptureError: Nobody says it, and the format is as usual in millimetres as in metres.
    """
    known = unit or cloud.unit
    if known is None and cloud.asks_unit:
        raise CaptureError(
            f"{path}: a {path.suffix[1:].upper()} file does not say its unit; add --unit mm (PhoXi Control writes "
            "millimetres) or --unit m; in a session write 'unit:' into session.yaml"
        )
    return known or "m"


@dataclass(frozen=True, slots=True)
class CloudFileCapture:
    """One frame in a cloud file of its own.

    Attributes:
        name: As the tables show it.
        path: The file.
        unit: Unit of the coordinates as the user gave it; None leaves it to the file, and else means metres.
    """

    name: str
    path: Path
    unit: Unit | None = None

    def frames(self) -> Iterator[RgbdFrame]:
        """Yield the one frame; its picture comes from the colours of an organised cloud.

        Raises:
            CaptureError: The file is missing, cut, of another format, or its unit is not known.
        """
        found = read_cloud(self.path)
        cloud = clean_cloud(found.xyz, METRES_PER_UNIT[unit_of(self.path, found, self.unit)])
        width, height = found.size or (len(cloud), 1)
        organised = found.size is not None
        colours = found.colours if organised else None
        yield RgbdFrame(
            cloud_m=cloud.reshape(height, width, 3),
            image=None if colours is None else colours.reshape(height, width, *colours.shape[1:]),
            intrinsics=None,
            timestamp_ns=None,
            capture=self.name,
            organised=organised,
        )
