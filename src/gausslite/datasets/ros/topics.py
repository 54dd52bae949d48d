"""Choose the topics of colour, depth and cameras in a bag by their types; ask where several would do."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from gausslite.datasets.ros.address import BagOptions
from gausslite.datasets.ros.bag_file import BagFile
from gausslite.datasets.ros.image_messages import ImageKind, kind_of_encoding, kind_of_format
from gausslite.datasets.ros.messages import frame_name
from gausslite.datasets.ros.realsense_recording import INFO_END, stream_of
from gausslite.domain.errors import DatasetError

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_TRANSPORTS = ("/compressed", "/compressedDepth")
_MAX_LISTED = 20


@dataclass(frozen=True, slots=True)
class ImageTopic:
    """A topic of images, as its first message describes it."""

    name: str
    compressed: bool
    kind: ImageKind
    encoding: str
    frame: str

    @property
    def camera_name(self) -> str:
        """The topic without the transport that compresses it."""
        return camera_name(self.name)

    def __str__(self) -> str:
        """Return the name with the encoding, for messages."""
        return f"{self.name} ({self.encoding})"


def camera_name(image_topic: str) -> str:
    """Return an image topic without the transport that compresses it."""
    for transport in _TRANSPORTS:
        if image_topic.endswith(transport):
            return image_topic.removesuffix(transport)
    return image_topic


def image_topics(bag: BagFile) -> list[ImageTopic]:
    """Return the image topics that have messages. Raises DatasetError."""
    found = []
    for name, message_type in bag.types.items():
        if message_type not in (IMAGE, COMPRESSED):
            continue
        message = bag.first(name)
        if message is None:
            continue
        compressed = message_type == COMPRESSED
        encoding = str(message.format if compressed else message.encoding)[:60]
        kind = kind_of_format(encoding) if compressed else kind_of_encoding(encoding)
        stream = stream_of(name)
        if stream is not None and encoding == "mono16":
            # the RealSense SDK names the encoding of its depth so
            kind = ImageKind.DEPTH
        frame = stream or frame_name(message.header.frame_id)
        found.append(ImageTopic(name, compressed, kind, encoding, frame))
    return found


def choose_colour(bag: BagFile, topics: Sequence[ImageTopic], options: BagOptions) -> ImageTopic:
    """Return the topic of color=, else the only one with colour images, else the only one with grey images.

    A raw topic goes before its compressed copy. Raises DatasetError with a list if the choice is not clear.
    """
    if options.color:
        return _named(bag, topics, options.color, "color")
    for kind in (ImageKind.COLOUR, ImageKind.GREY):
        candidates = _without_copies(topic for topic in topics if topic.kind is kind)
        if candidates:
            return _only(bag, candidates, "colour", "color")
    raise DatasetError(f"{bag.path}: expected a topic with colour images (sensor_msgs/Image), got {_listed(bag)}")


def choose_depth(bag: BagFile, topics: Sequence[ImageTopic], colour: ImageTopic, options: BagOptions) -> ImageTopic:
    """Return the topic of depth=, else the only one with depth, or the only one that is aligned to colour.

    Depth is aligned if it has the colour camera's frame. Raises DatasetError with a list if the choice is not clear.
    """
    if options.depth:
        return _named(bag, topics, options.depth, "depth")
    candidates = _without_copies(topic for topic in topics if topic.kind is ImageKind.DEPTH)
    if not candidates:
        raise DatasetError(f"{bag.path}: expected a topic with depth (16UC1 or 32FC1), got {_listed(bag)}")
    aligned = [topic for topic in candidates if topic.frame == colour.frame]
    return _only(bag, aligned or candidates, "depth", "depth")


def choose_info(bag: BagFile, image: ImageTopic, named: str, option: str) -> str:
    """Return the camera_info topic of an image topic: the named one, its neighbour, or the only one of its frame.

    Raises DatasetError with a list if there is none.
    """
    infos = [name for name, message_type in bag.types.items() if message_type == CAMERA_INFO]
    if named:
        if named not in infos:
            raise DatasetError(f"{bag.path}: {option}={named}: expected a camera_info topic of {infos or 'none'}")
        return named
    name = image.camera_name
    neighbours = [f"{name.rpartition('/')[0]}/camera_info", f"{name}/camera_info"]
    stream = stream_of(name)
    if stream is not None:
        neighbours.insert(0, stream + INFO_END)
    for neighbour in neighbours:
        if neighbour in infos:
            return neighbour
    same_frame = [info for info in infos if _frame_of(bag, info) == image.frame]
    if len(same_frame) == 1:
        return same_frame[0]
    got = ", ".join(infos) or "no camera_info topic"
    raise DatasetError(
        f"{bag.path}: {image.name}: expected its camera in {neighbours[0]}, got {got}; choose one with {option}=TOPIC"
    )


def _frame_of(bag: BagFile, topic: str) -> str | None:
    message = bag.first(topic)
    return None if message is None else frame_name(message.header.frame_id)


def _named(bag: BagFile, topics: Sequence[ImageTopic], name: str, option: str) -> ImageTopic:
    for topic in topics:
        if topic.name == name:
            return topic
    got = ", ".join(map(str, topics)) or "no image topic with messages"
    raise DatasetError(f"{bag.path}: {option}={name}: expected an image topic of the bag, got one of: {got}")


def _only(bag: BagFile, candidates: Sequence[ImageTopic], kind: str, option: str) -> ImageTopic:
    if len(candidates) == 1:
        return candidates[0]
    listed = ", ".join(map(str, candidates))
    raise DatasetError(
        f"{bag.path}: {len(candidates)} topics have {kind} images: {listed}; choose one with {option}=TOPIC, "
        f"as in 'bag:{bag.path.name}?{option}={candidates[0].name}'"
    )


def _without_copies(topics: Iterable[ImageTopic]) -> list[ImageTopic]:
    """Return the topics without the compressed copies of raw ones."""
    found = list(topics)
    raw = {topic.name for topic in found if not topic.compressed}
    return [topic for topic in found if not topic.compressed or topic.camera_name not in raw]


def _listed(bag: BagFile) -> str:
    types = bag.types
    names = [f"{name} ({message_type})" for name, message_type in types.items()][:_MAX_LISTED]
    return ", ".join(names) + (" ..." if len(types) > _MAX_LISTED else "") or "an empty bag"
