"""Which topics of a recording make its frames: by schema, then by name, else the user is asked in one line."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

from tubepose.capture.compressed_depth import is_compressed_depth
from tubepose.capture.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POINT_CLOUD
from tubepose.capture.ros import DEPTH_ENCODINGS
from tubepose.errors import CaptureError

# What image_transport adds to a topic's name for its compressed twin.
_TWINS = ("/compressedDepth", "/compressed")
# Words in the names of pictures that no detector is made for, and of those that it is.
_NO_PICTURE = ("depth", "snr", "infra", "confidence", "normal", "disparity", "mask")
_PICTURE = ("color", "colour", "rgb", "texture")


@dataclass(frozen=True, slots=True)
class TopicChoice:
    """Topics that the user names; None means: find it.

    Attributes:
        cloud: Of PointCloud2 messages.
        image: Of Image or CompressedImage messages.
        depth: Of Image or CompressedImage messages that hold depth.
        info: Of CameraInfo messages.
    """

    cloud: str | None = None
    image: str | None = None
    depth: str | None = None
    info: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Topic:
    """One topic as a recording has it.

    Attributes:
        name: Its name.
        schema: Name of its message type.
        first: Its first message, decoded.
        stamps_ns: Stamp of each of its messages in file order; None where there is none.
    """

    name: str
    schema: str
    first: Any
    stamps_ns: list[int | None] = field(default_factory=list)

    @property
    def is_depth(self) -> bool:
        """True for an image that holds depth: compressedDepth, 32FC1, or 16UC1 (a 16-bit gray picture is mono16)."""
        if self.schema == COMPRESSED_IMAGE:
            return is_compressed_depth(self.first.format)
        return self.schema == IMAGE and self.first.encoding in DEPTH_ENCODINGS

    @property
    def is_picture(self) -> bool:
        """True for any other image."""
        return self.schema in (IMAGE, COMPRESSED_IMAGE) and not self.is_depth

    @property
    def base_name(self) -> str:
        """The name without what image_transport adds for a compressed image."""
        for twin in _TWINS:
            if self.schema == COMPRESSED_IMAGE and self.name.endswith(twin):
                return self.name.removesuffix(twin)
        return self.name


@dataclass(frozen=True, slots=True)
class Chosen:
    """The topics that make the frames.

    Attributes:
        source: PointCloud2 or depth image.
        image: The picture, if there is one.
        source_info: CameraInfo of the depth image (or of the cloud), if there is one.
        image_info: CameraInfo of the picture, if there is one.
    """

    source: Topic
    image: Topic | None
    source_info: Topic | None
    image_info: Topic | None


def choose_topics(topics: Iterable[Topic], asked: TopicChoice, where: str) -> Chosen:
    """Choose the topics of a recording.

    Raises:
        CaptureError: Several fit (listed as options to paste), none fits, or one that was asked for is not there.
    """
    found = {topic.name: topic for topic in topics}
    source = _source(found, asked, where)
    image = _pick(found, asked.image, lambda t: t.is_picture, "image", where, _best_pictures)
    if image is source:
        raise CaptureError(
            f"{where}: --image-topic {image.name} is the depth that the frames are made of; name a picture instead"
        )
    info = _pick(found, asked.info, lambda t: t.schema == CAMERA_INFO, "info", where) if asked.info else None
    return Chosen(source, image, info or _info_of(source, found), (info or _info_of(image, found)) if image else None)


def _source(found: dict[str, Topic], asked: TopicChoice, where: str) -> Topic:
    if asked.cloud is not None and asked.depth is not None:
        raise CaptureError(
            f"{where}: --cloud-topic and --depth-topic are both given; give the one that frames are made of"
        )
    source = None
    if asked.depth is None:
        source = _pick(found, asked.cloud, lambda t: t.schema == POINT_CLOUD, "cloud", where)
    if source is None:
        source = _pick(found, asked.depth, lambda t: t.is_depth, "depth", where, _best_depths)
    if source is None:
        there = ", ".join(f"{t.name} ({t.schema})" for t in found.values()) or "no message of a type that is read"
        raise CaptureError(
            f"{where}: expected a PointCloud2, or 16UC1 or 32FC1 depth as Image or compressedDepth, found {there}"
        )
    return source


def _pick(
    found: dict[str, Topic],
    asked: str | None,
    fits: Callable[[Topic], bool],
    kind: str,
    where: str,
    best: Callable[[list[Topic]], list[Topic]] = list,
) -> Topic | None:
    candidates = [topic for topic in found.values() if fits(topic)]
    names = [topic.name for topic in candidates]
    if asked is not None:
        if asked in found and (asked in names or (kind == "image" and found[asked].is_depth)):
            return found[asked]
        raise CaptureError(
            f"{where}: no topic {asked} that can be the {kind} topic; found {', '.join(names) or 'none'}"
        )
    candidates = best(candidates)
    if len(candidates) > 1:
        options = " or ".join(f"--{kind}-topic {topic.name}" for topic in sorted(candidates, key=lambda t: t.name))
        raise CaptureError(f"{where}: {len(candidates)} topics can be the {kind} topic; add {options}")
    return candidates[0] if candidates else None


def _best_pictures(candidates: list[Topic]) -> list[Topic]:
    pictures = [topic for topic in candidates if not _named(topic, _NO_PICTURE)]
    named = [topic for topic in pictures if _named(topic, _PICTURE)] or pictures
    return _without_twins(named)


def _best_depths(candidates: list[Topic]) -> list[Topic]:
    return _without_twins(
        [topic for topic in candidates if _named(topic, ("aligned",))]
        or [topic for topic in candidates if not _named(topic, ("snr", "confidence"))]
    )


def _without_twins(candidates: list[Topic]) -> list[Topic]:
    """An image recorded both raw and compressed is one image: the raw one."""
    raw = {topic.name for topic in candidates if topic.name == topic.base_name}
    return [topic for topic in candidates if topic.name == topic.base_name or topic.base_name not in raw]


def _named(topic: Topic, words: tuple[str, ...]) -> bool:
    return any(word in topic.name.lower() for word in words)


def _info_of(topic: Topic, found: dict[str, Topic]) -> Topic | None:
    """The CameraInfo beside a topic, by ROS's rule of names; else the only one there is."""
    infos = [other for other in found.values() if other.schema == CAMERA_INFO]
    base = topic.base_name.rsplit("/", 1)[0]
    beside = [info for info in infos if info.name == f"{base}/camera_info"]
    if beside:
        return beside[0]
    return infos[0] if len(infos) == 1 else None
