"""Which topics of a recording make its frames: by schema, then by name, else the user is asked in one line."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import takewhile
from typing import Any

from tubepose.capture.compressed_depth import is_compressed_depth
from tubepose.capture.images import is_depth_png
from tubepose.capture.message_types import CAMERA_INFO, COMPRESSED_IMAGE, IMAGE, POINT_CLOUD
from tubepose.capture.ros import DEPTH_ENCODINGS, is_calibrated, same_camera
from tubepose.errors import CaptureError

# What image_transport adds to a topic's name for its compressed twin.
_TWINS = ("/compressedDepth", "/compressed")
# Words in the names of pictures that no detector is made for, and of those that it is.
_NO_PICTURE = ("depth", "snr", "infra", "confidence", "normal", "disparity", "mask")
_PICTURE = ("color", "colour", "rgb", "texture")
# Words of pictures whose encoding could be depth, too; whole words, as "ir" is part of many.
_GRAY_WORDS = {"texture", "ir", "infra", "intensity", "amplitude", "gray", "grey", "mono", "color", "colour", "rgb"}
# Encodings of depth, if the name says so.
_COUNTS = ("mono16", "16SC1", "64FC1")
# Words of types that hold pictures, whether they are read or not.
_PICTURE_TYPES = ("image", "video", "ffmpeg")
_MOST_TOLD = 8


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
        log_times_ns: When each of them was recorded; 0 where that is not known.
        infos: Of a CameraInfo topic: stamp and message wherever the message differs from the one before; those that
            are not calibrated (zeros) are left out.
    """

    name: str
    schema: str
    first: Any
    stamps_ns: list[int | None] = field(default_factory=list)
    log_times_ns: list[int] = field(default_factory=list)
    infos: list[tuple[int, Any]] = field(default_factory=list)

    def note_info(self, stamp_ns: int | None, info: Any) -> None:
        """Keep a CameraInfo with its stamp where it tells something new; one that is not calibrated says nothing."""
        if is_calibrated(info) and not (self.infos and same_camera(self.infos[-1][1], info)):
            self.infos.append((stamp_ns or 0, info))

    @property
    def is_depth(self) -> bool:
        """True for an image that holds depth by its encoding, or by its name if its encoding is a 16-bit picture's."""
        if self.schema == COMPRESSED_IMAGE:
            told = self.first.format.startswith(DEPTH_ENCODINGS) or is_depth_png(self.first.data)
            return self.is_compressed_depth or (self._says_depth and told)
        if self.schema != IMAGE:
            return False
        return self.first.encoding in DEPTH_ENCODINGS or (self.first.encoding in _COUNTS and self._says_depth)

    @property
    def is_compressed_depth(self) -> bool:
        """True for depth of ROS's `compressedDepth`."""
        return self.schema == COMPRESSED_IMAGE and is_compressed_depth(self.first.format)

    @property
    def may_be_depth(self) -> bool:
        """True for an image that could hold depth if the user says so."""
        if self.schema == COMPRESSED_IMAGE:
            return self.is_depth or is_depth_png(self.first.data)
        return self.is_depth or (self.schema == IMAGE and self.first.encoding in _COUNTS)

    @property
    def is_image(self) -> bool:
        """True for an image of any kind."""
        return self.schema in (IMAGE, COMPRESSED_IMAGE)

    @property
    def is_gray_by_name(self) -> bool:
        """True where the name says that the image is what a camera sees, whatever its encoding."""
        return bool(_words(self.base_name) & _GRAY_WORDS) and not self._says_depth

    @property
    def base_name(self) -> str:
        """The name without what image_transport adds for a compressed image."""
        for twin in _TWINS:
            if self.schema == COMPRESSED_IMAGE and self.name.endswith(twin):
                return self.name.removesuffix(twin)
        return self.name

    @property
    def frame_id(self) -> str:
        """Coordinate frame of its first message."""
        return str(self.first.header.frame_id)

    @property
    def _says_depth(self) -> bool:
        return "depth" in self.base_name.lower()


@dataclass(frozen=True, slots=True)
class Chosen:
    """Topics that make the frames.

    Attributes:
        source: Point cloud or depth.
        image: Picture, if there is one.
        source_info: CameraInfo of the source, if there is one.
        image_info: CameraInfo of the picture, if there is one.
        notes: What was passed over, in words.
    """

    source: Topic
    image: Topic | None
    source_info: Topic | None
    image_info: Topic | None
    notes: tuple[str, ...] = ()


def choose_topics(
    topics: Iterable[Topic], asked: TopicChoice, where: str, unread: Mapping[str, str] | None = None
) -> Chosen:
    """Choose the topics of a recording.

    Args:
        topics: Of the types that are read.
        asked: What the user named.
        where: Start of error messages.
        unread: Types of all other topics, by topic; named where nothing fits.

    Raises:
        CaptureError: Several fit (listed as options to paste), none fits, or one that was asked for is not there.
    """
    found = {topic.name: topic for topic in topics}
    source = _source(found, asked, where, unread or {})
    image = _pick(found, asked.image, lambda t: _may_be_picture(t, source), "image", where, _best_pictures)
    if image is not None and image is not source and image.schema == COMPRESSED_IMAGE and image.is_compressed_depth:
        raise CaptureError(
            f"{where}: {image.name} is a compressed depth image, no picture; choose another --image-topic"
        )
    if image is source:
        raise CaptureError(
            f"{where}: --image-topic {image.name} is the depth that the frames are made of; name a picture instead"
        )
    info = _pick(found, asked.info, lambda t: t.schema == CAMERA_INFO, "info", where) if asked.info else None
    notes = () if image is not None else _passed_over(found, source, unread or {})
    return Chosen(
        source, image, info or _info_of(source, found), (info or _info_of(image, found)) if image else None, notes
    )


def told_types(types: Mapping[str, str]) -> str:
    """Topics with their types in words, the first ones of many."""
    told = [f"{topic} ({name or 'no type'})" for topic, name in types.items()]
    more = f" and {len(told) - _MOST_TOLD} more" if len(told) > _MOST_TOLD else ""
    return ", ".join(told[:_MOST_TOLD]) + more


def _may_be_picture(topic: Topic, source: Topic) -> bool:
    """Beside a point cloud an image of floats or 16 bits named texture, ir or the like is a picture."""
    if topic is source or not topic.is_image:
        return False
    return not topic.is_depth or (source.schema == POINT_CLOUD and topic.is_gray_by_name)


def _passed_over(found: dict[str, Topic], source: Topic, unread: Mapping[str, str]) -> tuple[str, ...]:
    """What to tell of a recording without a picture: images that were not taken for one, and videos."""
    others = {t.name: getattr(t.first, "encoding", "") or t.first.format for t in found.values() if t.is_image}
    others = {name: form for name, form in others.items() if found[name].base_name != source.base_name}
    videos = {name: kind for name, kind in unread.items() if any(word in kind.lower() for word in _PICTURE_TYPES)}
    told = [f"passed over {told_types(others)}; --image-topic names one"] if others else []
    told += [f"not read: {told_types(videos)}"] if videos else []
    return (f"no picture: {'; '.join(told)}",) if told else ()


def _source(found: dict[str, Topic], asked: TopicChoice, where: str, unread: Mapping[str, str]) -> Topic:
    if asked.cloud is not None and asked.depth is not None:
        raise CaptureError(
            f"{where}: --cloud-topic and --depth-topic are both given; give the one that frames are made of"
        )
    source = None
    if asked.depth is None:
        source = _pick(found, asked.cloud, lambda t: t.schema == POINT_CLOUD, "cloud", where)
    if source is None:
        fits: Callable[[Topic], bool] = lambda t: t.is_depth  # noqa: E731
        source = _pick(found, asked.depth, fits, "depth", where, _best_depths)
    if source is None:
        there = told_types({t.name: t.schema for t in found.values()}) or "no message of a type that is read"
        others = f"; not read: {told_types(unread)}" if unread else ""
        counts = [t.name for t in found.values() if t.may_be_depth and not t.is_gray_by_name]
        hint = f"; if {counts[0]} holds depth, add --depth-topic {counts[0]}" if counts else ""
        raise CaptureError(
            f"{where}: expected a PointCloud2, or 16UC1 or 32FC1 depth as Image or compressedDepth, found {there}"
            f"{others}{hint}"
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
        other = asked in found and (
            (kind == "image" and found[asked].is_image) or (kind == "depth" and found[asked].may_be_depth)
        )
        if asked in found and (asked in names or other):
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
    pictures = [topic for topic in candidates if topic.is_depth or not _named(topic, _NO_PICTURE)]
    plain = [topic for topic in pictures if not topic.is_depth] or pictures
    named = [topic for topic in plain if _named(topic, _PICTURE)] or plain
    return _without_twins(named)


def _best_depths(candidates: list[Topic]) -> list[Topic]:
    likely = [topic for topic in candidates if not topic.is_gray_by_name]
    return _without_twins(
        [topic for topic in likely if _named(topic, ("aligned",))]
        or [topic for topic in likely if not _named(topic, ("snr", "confidence"))]
    )


def _without_twins(candidates: list[Topic]) -> list[Topic]:
    """An image recorded both raw and compressed is one image: the raw one."""
    raw = {topic.name for topic in candidates if topic.name == topic.base_name}
    return [topic for topic in candidates if topic.name == topic.base_name or topic.base_name not in raw]


def _named(topic: Topic, words: tuple[str, ...]) -> bool:
    return any(word in topic.name.lower() for word in words)


def _shared_folders(one: str, other: str) -> list[str]:
    pairs = takewhile(lambda pair: pair[0] == pair[1], zip(one.split("/"), other.split("/"), strict=False))
    return [first for first, _ in pairs]


def _words(name: str) -> set[str]:
    return set(re.findall(r"[a-z]+", name.lower()))


def _info_of(topic: Topic, found: dict[str, Topic]) -> Topic | None:
    """The CameraInfo of a topic: beside it by its name (ROS, Foxglove, RealSense), else the nearest of its frame."""
    infos = [other for other in found.values() if other.schema == CAMERA_INFO]
    folder = topic.base_name.rsplit("/", 1)[0]
    usual = [f"{folder}/camera_info", f"{topic.base_name}/camera_info", f"{folder}/calibration"]
    usual.append(f"{folder.rsplit('/', 1)[0]}/info/camera_info")
    for name in usual:
        if name in found and found[name] in infos:
            return found[name]
    same = [info for info in infos if topic.frame_id and info.frame_id == topic.frame_id]
    if same:
        shared = [len(_shared_folders(info.name, topic.name)) for info in same]
        nearest = [info for info, share in zip(same, shared, strict=True) if share == max(shared)]
        if len(nearest) == 1:
            return nearest[0]
    return infos[0] if len(infos) == 1 else None
