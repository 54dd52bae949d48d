"""What the node does without rclpy: its parameters, the topics it reads, and the messages it publishes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from pathlib import Path
from typing import Any

from jaxtyping import Float64
from numpy import ndarray

from gausslite.datasets.folder import quat_xyzw
from gausslite.domain.errors import InvalidInputError
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.wire.robot import AgentLink, AgentSnapshot, LinkSettings, SentFrames
from gausslite.wire.security import Tls
from gausslite_ros.bag_file import BagOptions
from gausslite_ros.live_frames import LiveCounters, LiveFrames
from gausslite_ros.topics import camera_name

_AXES = ("optical", "body")
_LIMITS = (
    ("tolerance_ms", 0.0, 1e4),
    ("depth_unit_mm", 0.0, 1e4),
    ("max_wait_s", 0.0, 60.0),
    ("transform_tolerance_s", 0.0, 10.0),
    ("tf_period_s", 0.01, 10.0),
    ("period_s", 0.05, 60.0),
    ("drain_s", 0.0, 86400.0),
)
_ALIGNED = {"auto": "", "yes": "yes", "no": "no"}
_HANDOVER = {"agent": None, "yes": True, "no": False}


@dataclass(frozen=True, slots=True)
class NodeParameters:
    """Parameters by their names in ROS; docs/guides/bag.md lists them.

    color_info, depth_info "": the camera_info beside the images. camera "": the frame of the colour images.
    aligned "auto": by frame and topic of depth. depth_unit_mm 0: as its encoding. transform_tolerance_s: added to the
    time of the published tf. drain_s 0: as the agent's options. Raises InvalidInputError.
    """

    agent: str = "127.0.0.1:50053"
    color: str = "/camera/color/image_raw"
    depth: str = "/camera/aligned_depth_to_color/image_raw"
    color_info: str = ""
    depth_info: str = ""
    frame: str = "odom"
    camera: str = ""
    aligned: str = "auto"
    depth_unit_mm: float = 0.0
    axes: str = "optical"
    tolerance_ms: float = 20.0
    max_wait_s: float = 1.5
    reliable: bool = False
    task: str = ""
    map_frame: str = "map"
    publish_tf: bool = True
    tf_period_s: float = 0.05
    transform_tolerance_s: float = 0.1
    lossless: bool = False
    end_mission: bool = True
    handover: str = "agent"
    drain_s: float = 0.0
    period_s: float = 1.0
    tls_ca: str = ""
    tls_cert: str = ""
    tls_key: str = ""

    def __post_init__(self) -> None:
        for name in ("agent", "color", "depth", "frame", "map_frame"):
            if not getattr(self, name):
                raise InvalidInputError(f"parameter {name}: expected a name, got an empty text")
        for name, choices in (("aligned", tuple(_ALIGNED)), ("axes", _AXES), ("handover", tuple(_HANDOVER))):
            if getattr(self, name) not in choices:
                expected = " or ".join(choices)
                raise InvalidInputError(f"parameter {name}: expected {expected}, got {getattr(self, name)!r}")
        for name, low, high in _LIMITS:
            if not low <= getattr(self, name) <= high:
                raise InvalidInputError(f"parameter {name}: expected {low:g} to {high:g}, got {getattr(self, name)}")
        if self.publish_tf and self.map_frame == self.frame:
            raise InvalidInputError(
                f"parameter map_frame: expected another frame than the poses', got {self.frame!r} for both; "
                "rename it or set publish_tf to false"
            )

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> NodeParameters:
        """Return the parameters of these values by name; whole numbers are accepted where a number is expected."""
        chosen: dict[str, Any] = {}
        for field in fields(cls):
            value, default = values.get(field.name, field.default), field.default
            if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
                value = float(value)
            if type(value) is not type(default):
                expected = type(default).__name__
                raise InvalidInputError(f"parameter {field.name}: expected {expected}, got {value!r}")
            chosen[field.name] = value
        return cls(**chosen)

    @classmethod
    def defaults(cls) -> dict[str, Any]:
        """Return the defaults by name."""
        return asdict(cls())

    @property
    def color_info_topic(self) -> str:
        """Topic of colour's camera_info."""
        return self.color_info or _beside(self.color)

    @property
    def depth_info_topic(self) -> str:
        """Topic of depth's camera_info, which is used unless depth is aligned to colour."""
        return self.depth_info or _beside(self.depth)

    def topic_options(self) -> BagOptions:
        """Return what the conversion of messages needs."""
        return BagOptions(
            color=self.color,
            depth=self.depth,
            color_info=self.color_info_topic,
            depth_info=self.depth_info,
            frame=self.frame.removeprefix("/"),
            camera=self.camera.removeprefix("/"),
            aligned=_ALIGNED[self.aligned],
            depth_unit_m=self.depth_unit_mm / 1000,
            axes=self.axes,
            tolerance_s=self.tolerance_ms / 1000,
        )

    def link_settings(self) -> LinkSettings:
        """Return what the link to the agent needs."""
        return LinkSettings(
            poll_s=self.period_s,
            lossless=self.lossless,
            handover=_HANDOVER[self.handover],
            drain_s=self.drain_s or None,
        )

    def tls(self) -> Tls | None:
        """Return the encryption of the connection; None without files. Raises InvalidInputError."""
        ca, certificate, key = (Path(name) if name else None for name in (self.tls_ca, self.tls_cert, self.tls_key))
        return None if ca is certificate is key is None else Tls.read(certificate, key, ca)


def _beside(image_topic: str) -> str:
    """Return the camera_info topic beside an image topic, as image_transport names it."""
    return f"{camera_name(image_topic).rpartition('/')[0]}/camera_info"


Fields = dict[str, Any]
OK, WARN, ERROR = b"\x00", b"\x01", b"\x02"
"""Levels of diagnostic_msgs/DiagnosticStatus, whose field is a byte."""
_ADD, _DELETE_ALL = 0, 3
_CUBE, _TEXT = 1, 9
_COLOURS = {ObjectRole.TARGET: (0.1, 0.8, 0.2), ObjectRole.ANCHOR: (0.2, 0.5, 1.0)}
_MIN_SIDE_M = 0.01
_TEXT_HEIGHT_M = 0.08
_MAX_SILENCE_S = 3.0


def correction_transform(T_map_odometry: Float64[ndarray, "4 4"], frames: tuple[str, str], stamp_ns: int) -> Fields:
    """Return a tf2_msgs/TFMessage with the transform from the map's frame (parent) to the odometry's (child)."""
    x, y, z, w = quat_xyzw(T_map_odometry[:3, :3]).tolist()
    transform = {
        "translation": _vector(T_map_odometry[:3, 3].tolist()),
        "rotation": {"x": x, "y": y, "z": z, "w": w},
    }
    return {
        "transforms": [{"header": _header(frames[0], stamp_ns), "child_frame_id": frames[1], "transform": transform}]
    }


def object_markers(objects: Sequence[ObjectLandmark], frame: str, stamp_ns: int) -> Fields:
    """Return a visualization_msgs/MarkerArray: a box and a text for each object, after the removal of earlier ones."""
    markers: list[Fields] = [{"header": _header(frame, stamp_ns), "action": _DELETE_ALL}]
    for number, landmark in enumerate(objects):
        low, high = landmark.extent_m.min_m, landmark.extent_m.max_m
        centre = [(a + b) / 2 for a, b in zip(low, high, strict=True)]
        shared = {"header": _header(frame, stamp_ns), "ns": landmark.role.value, "action": _ADD}
        red, green, blue = _COLOURS[landmark.role]
        sides = [max(side, _MIN_SIDE_M) for side in landmark.size_m]
        markers += [
            shared
            | {
                "id": 2 * number,
                "type": _CUBE,
                "pose": _pose(centre),
                "scale": _vector(sides),
                "color": {"r": red, "g": green, "b": blue, "a": 0.35},
            },
            shared
            | {
                "id": 2 * number + 1,
                "type": _TEXT,
                "pose": _pose([centre[0], centre[1], high[2] + _TEXT_HEIGHT_M]),
                "scale": _vector([0.0, 0.0, _TEXT_HEIGHT_M]),
                "color": {"r": 1.0, "g": 1.0, "b": 1.0, "a": 1.0},
                "text": f"{landmark.noun} {landmark.confidence:.2f}",
            },
        ]
    return {"markers": markers}


def diagnostics(
    snapshot: AgentSnapshot | None,
    counters: tuple[LiveCounters, SentFrames],
    problems: Iterable[str],
    stamp_ns: int,
    address: str,
) -> Fields:
    """Return a diagnostic_msgs/DiagnosticArray: ERROR without an agent or after a failure, WARN for other problems."""
    problems = [problem for problem in problems if problem]
    values: dict[str, Any] = {}
    if snapshot is None:
        level, message = ERROR, problems[0] if problems else f"waiting for the agent at {address}"
    else:
        failed = snapshot.state == "failed" or bool(snapshot.problem)
        problems += [snapshot.problem] if snapshot.problem else []
        level = ERROR if failed else WARN if problems else OK
        message = f"{snapshot.state}: {problems[0]}" if problems else snapshot.state
        values = {
            "agent": snapshot.agent_id,
            "task": snapshot.task,
            "gaussians": snapshot.gaussians,
            "frames mapped": snapshot.frames_mapped,
            "frames per second": f"{snapshot.hz:.1f}",
            "share of the region": f"{snapshot.roi_share:.3f}",
            "median age of frames (s)": f"{snapshot.age_p50_s:.2f}",
            "notes": "; ".join(snapshot.notes),
        }
    received, sent = counters
    values |= {f"images {name.replace('_', ' ')}": number for name, number in asdict(received).items()}
    values |= {f"sent frames {name.replace('_', ' ')}": number for name, number in asdict(sent).items()}
    values |= {f"problem {i}": problem for i, problem in enumerate(problems, start=1)}
    status = {
        "level": level,
        "name": "gausslite: mapping",
        "message": message,
        "hardware_id": address,
        "values": [{"key": key, "value": str(value)} for key, value in values.items()],
    }
    return {"header": _header("", stamp_ns), "status": [status]}


def _header(frame: str, stamp_ns: int) -> Fields:
    return {"stamp": {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}, "frame_id": frame}


def _vector(values: Sequence[float]) -> Fields:
    return dict(zip("xyz", map(float, values), strict=True))


def _pose(position_m: Sequence[float]) -> Fields:
    return {"position": _vector(position_m), "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


TF, DIAGNOSTICS, OBJECTS, TASK = "/tf", "/diagnostics", "~/objects", "~/task"
_IMAGE, _COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
_CAMERA_INFO, _TF_MESSAGE = "sensor_msgs/msg/CameraInfo", "tf2_msgs/msg/TFMessage"
_TRANSPORTS = ("/compressed", "/compressedDepth")


class Delivery(StrEnum):
    """How a topic's messages are delivered; the node has a quality of service for each."""

    IMAGES = "images"
    TRANSFORMS = "transforms"
    LATCHED = "latched"
    RELIABLE = "reliable"


@dataclass(frozen=True, slots=True)
class Subscription:
    """A topic to read. The callback never raises and returns within the time that it takes to decode two images."""

    topic: str
    message_type: str
    delivery: Delivery
    callback: Callable[[Any], None]


@dataclass(frozen=True, slots=True)
class Outgoing:
    """A message to publish: its topic and its fields by name."""

    topic: str
    fields: Fields


PUBLICATIONS = {
    TF: _TF_MESSAGE,
    OBJECTS: "visualization_msgs/msg/MarkerArray",
    DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
}
"""Message type of each topic that the node writes."""


class RobotSession:
    """Converts the robot's messages to frames for the agent, and the agent's status to messages. Not thread-safe."""

    def __init__(
        self, parameters: NodeParameters, link: AgentLink, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._parameters, self._link, self._clock = parameters, link, clock
        self._seen_images, self._seen_at_s = 0, clock()
        self._live = LiveFrames(parameters.topic_options(), parameters.max_wait_s)
        self._message_problem = ""
        if parameters.task:
            link.assign_task(parameters.task)

    def subscriptions(self) -> tuple[Subscription, ...]:
        """Return the topics to read."""
        p, live = self._parameters, self._live
        images = Delivery.RELIABLE if p.reliable else Delivery.IMAGES
        return (
            Subscription("/tf_static", _TF_MESSAGE, Delivery.LATCHED, self._handler(self._add_static_transforms)),
            Subscription(TF, _TF_MESSAGE, Delivery.TRANSFORMS, self._handler(self._add_transforms)),
            Subscription(p.color_info_topic, _CAMERA_INFO, images, self._handler(live.add_colour_info)),
            Subscription(p.depth_info_topic, _CAMERA_INFO, images, self._handler(live.add_depth_info)),
            Subscription(p.color, _image_type(p.color), images, self._handler(live.add_colour)),
            Subscription(p.depth, _image_type(p.depth), images, self._handler(live.add_depth)),
            Subscription(TASK, "std_msgs/msg/String", Delivery.RELIABLE, self._assign_task),
        )

    def transforms(self, now_ns: int) -> list[Outgoing]:
        """Return the correction of the odometry; nothing before the first mapped frame, or if it is not published."""
        p, snapshot = self._parameters, self._link.snapshot
        if not p.publish_tf or snapshot is None or snapshot.T_map_odometry is None:
            return []
        stamp_ns = now_ns + round(1e9 * p.transform_tolerance_s)
        return [Outgoing(TF, correction_transform(snapshot.T_map_odometry, (p.map_frame, p.frame), stamp_ns))]

    def status(self, now_ns: int) -> list[Outgoing]:
        """Return the objects that the agent has confirmed, and diagnostics."""
        snapshot, counters = self._link.snapshot, (self._live.counters, self._link.sent_frames)
        fields = diagnostics(snapshot, counters, self._problems(), now_ns, self._parameters.agent)
        found = [Outgoing(DIAGNOSTICS, fields)]
        if snapshot is not None:
            found.append(Outgoing(OBJECTS, object_markers(snapshot.objects, self._parameters.map_frame, now_ns)))
        return found

    def close(self) -> str:
        """Send the waiting frames, end the mission unless end_mission is false; return its summary.

        Raises GaussLiteError if the mission could not be ended.
        """
        return self._link.close(self._parameters.end_mission)

    def _handler(self, add: Callable[[Any], None]) -> Callable[[Any], None]:
        def handle(message: Any) -> None:
            try:
                add(message)
            except InvalidInputError as error:
                self._message_problem = str(error)
            for frame in self._live.take():
                self._message_problem = ""
                self._link.send(frame, self._live.lens)

        return handle

    def _add_transforms(self, message: Any) -> None:
        self._live.add_transforms(message.transforms, static=False)

    def _add_static_transforms(self, message: Any) -> None:
        self._live.add_transforms(message.transforms, static=True)

    def _assign_task(self, message: Any) -> None:
        self._link.assign_task(str(message.data))

    def _problems(self) -> tuple[str, ...]:
        return (*self._link.problems, self._silence(), self._live.problem, self._message_problem)

    def _silence(self) -> str:
        """Return the problem of a camera that sends no images, or no more; empty without it."""
        received, topic = self._live.counters.received, self._parameters.color
        if received != self._seen_images:
            self._seen_images, self._seen_at_s = received, self._clock()
        silent_s = self._clock() - self._seen_at_s
        if received == 0:
            return f"no colour images on {topic} yet"
        return f"no colour images on {topic} for {silent_s:.0f} s" if silent_s > _MAX_SILENCE_S else ""


def _image_type(topic: str) -> str:
    return _COMPRESSED if topic.endswith(_TRANSPORTS) else _IMAGE
