"""What the node does without rclpy: its parameters, the topics it reads, and the messages it publishes."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Any

from gausslite.domain.errors import InvalidInputError, MissingPluginError
from gausslite.wire.security import Tls
from gausslite_link.agent_link import AgentLink, LinkSettings
from gausslite_ros.bag_file import BagOptions
from gausslite_ros.live_frames import LiveFrames
from gausslite_ros.outgoing import (
    Fields,
    correction_transform,
    diagnostics,
    object_markers,
    occupancy_grid,
    point_cloud,
)
from gausslite_ros.topics import camera_name

if TYPE_CHECKING:
    from gausslite_ros.live_map import LiveMap

_AXES = ("optical", "body")
_LIMITS = (
    ("tolerance_ms", 0.0, 1e4),
    ("depth_unit_mm", 0.0, 1e4),
    ("max_wait_s", 0.0, 60.0),
    ("transform_tolerance_s", 0.0, 10.0),
    ("tf_period_s", 0.01, 10.0),
    ("period_s", 0.05, 60.0),
    ("map_period_s", 0.2, 3600.0),
    ("cell_m", 0.01, 1.0),
    ("drain_s", 0.0, 86400.0),
)
_ALIGNED = {"auto": "", "yes": "yes", "no": "no"}
_HANDOVER = {"agent": None, "yes": True, "no": False}


@dataclass(frozen=True, slots=True)
class NodeParameters:
    """Parameters by their names in ROS; docs/guides/bag.md lists them.

    color_info, depth_info "": the camera_info beside the images. camera "": the frame of the colour images.
    aligned "auto": by frame and topic of depth. depth_unit_mm 0: as its encoding. transform_tolerance_s: added to the
    time of the published tf. drain_s 0: as the agent's options. heights_m: the lowest and highest obstacle above the
    floor of each occupancy grid, as low:high, separated by commas. Raises InvalidInputError.
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
    map_period_s: float = 2.0
    cell_m: float = 0.05
    heights_m: str = "0.1:1.8"
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
        self.heights()
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

    def heights(self) -> tuple[tuple[float, float], ...]:
        """Return the range of heights of each occupancy grid, in metres above the floor. Raises InvalidInputError."""
        try:
            ranges = [tuple(map(float, part.split(":"))) for part in self.heights_m.split(",")]
            found = tuple((low, high) for low, high in ranges)
        except ValueError:
            found = ()
        if not found or not all(0 <= low < high for low, high in found):
            raise InvalidInputError(
                f"parameter heights_m: expected ranges such as 0.1:1.8 or 0.1:0.5,0.5:1.8, got {self.heights_m!r}"
            )
        return found

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
            follow_map=True,
        )

    def tls(self) -> Tls | None:
        """Return the encryption of the connection; None without files. Raises InvalidInputError."""
        ca, certificate, key = (Path(name) if name else None for name in (self.tls_ca, self.tls_cert, self.tls_key))
        return None if ca is certificate is key is None else Tls.read(certificate, key, ca)


def _beside(image_topic: str) -> str:
    """Return the camera_info topic beside an image topic, as image_transport names it."""
    return f"{camera_name(image_topic).rpartition('/')[0]}/camera_info"


TF, DIAGNOSTICS, OBJECTS, TASK = "/tf", "/diagnostics", "~/objects", "~/task"
REGION, SPLATS, OCCUPANCY = "~/region", "~/splats", "~/occupancy"
_MAX_SILENCE_S = 3.0
_CLOSE_S = 10.0
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


@dataclass(frozen=True, slots=True)
class Publication:
    """A topic that the node writes."""

    message_type: str
    delivery: Delivery


def publications(parameters: NodeParameters) -> dict[str, Publication]:
    """Return the topics to write. Each range of heights has a grid of its own, the first one without a number."""
    grid = Publication("nav_msgs/msg/OccupancyGrid", Delivery.LATCHED)
    cloud = Publication("sensor_msgs/msg/PointCloud2", Delivery.LATCHED)
    return {
        TF: Publication(_TF_MESSAGE, Delivery.TRANSFORMS),
        OBJECTS: Publication("visualization_msgs/msg/MarkerArray", Delivery.TRANSFORMS),
        DIAGNOSTICS: Publication("diagnostic_msgs/msg/DiagnosticArray", Delivery.TRANSFORMS),
        REGION: cloud,
        SPLATS: cloud,
    } | {_grid_topic(number): grid for number in range(len(parameters.heights()))}


def _grid_topic(number: int) -> str:
    return OCCUPANCY if number == 0 else f"{OCCUPANCY}_{number + 1}"


def _live_map(link: AgentLink, parameters: NodeParameters) -> LiveMap:
    """Return the grids of the agent's map. Raises MissingPluginError without the package that computes them."""
    try:
        from gausslite_export.occupancy import OccupancySettings
        from gausslite_ros.live_map import LiveMap
    except ModuleNotFoundError as error:
        raise MissingPluginError(
            "the occupancy grids of the node need the package gausslite_export, which is not installed"
        ) from error
    return LiveMap(link.map, OccupancySettings(parameters.cell_m), parameters.heights())


class RobotSession:
    """Converts the robot's messages to frames for the agent, and the agent's status to messages. Not thread-safe."""

    def __init__(
        self, parameters: NodeParameters, link: AgentLink, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._parameters, self._link, self._clock = parameters, link, clock
        self._seen_images, self._seen_at_s = 0, clock()
        self._live = LiveFrames(parameters.topic_options(), parameters.max_wait_s)
        self._message_problem = ""
        self._live_map = _live_map(link, parameters)
        self._map_problem = ""
        self._map_thread: threading.Thread | None = None
        self._closing = threading.Event()
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

    def follow_map(self, publish: Callable[[list[Outgoing]], None], now_ns: Callable[[], int]) -> None:
        """Publish the map, the task's region and the occupancy grids until `close`, on a thread of its own.

        A large map takes about a second, in which images must not wait.
        """

        def run() -> None:
            while not self._closing.wait(self._parameters.map_period_s):
                try:
                    publish(self._map_messages(now_ns()))
                    self._map_problem = ""
                except InvalidInputError as error:
                    self._map_problem = str(error)
                except Exception as error:
                    # the diagnostics say so; a later map may be published
                    self._map_problem = f"map: not published, {type(error).__name__}: {error}"

        self._map_thread = threading.Thread(target=run, name="map", daemon=True)
        self._map_thread.start()

    def _map_messages(self, stamp_ns: int) -> list[Outgoing]:
        """Return nothing before the agent has a map. Raises InvalidInputError for too large grids."""
        frame, contents = self._parameters.map_frame, self._live_map.update()
        if contents is None:
            return []
        grids = [
            Outgoing(_grid_topic(number), occupancy_grid(grid, frame, stamp_ns))
            for number, grid in enumerate(contents.grids)
        ]
        clouds = ((REGION, contents.region), (SPLATS, contents.gaussians))
        return [*(Outgoing(topic, point_cloud(found, frame, stamp_ns)) for topic, found in clouds), *grids]

    def close(self) -> str:
        """Send the waiting frames, end the mission unless end_mission is false; return its summary.

        Raises GaussLiteError if the mission could not be ended.
        """
        self._closing.set()
        if self._map_thread is not None:
            self._map_thread.join(_CLOSE_S)
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
                if self._link.snapshot is not None:
                    self._live_map.see(frame, self._link.snapshot.T_map_odometry)

        return handle

    def _add_transforms(self, message: Any) -> None:
        self._live.add_transforms(message.transforms, static=False)

    def _add_static_transforms(self, message: Any) -> None:
        self._live.add_transforms(message.transforms, static=True)

    def _assign_task(self, message: Any) -> None:
        self._link.assign_task(str(message.data))

    def _problems(self) -> tuple[str, ...]:
        return (*self._link.problems, self._silence(), self._live.problem, self._message_problem, self._map_problem)

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
