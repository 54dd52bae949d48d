"""What the node does with messages, without rclpy: which topics it reads and writes, and what goes through them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from gausslite.datasets.ros.live_frames import LiveFrames
from gausslite.domain.errors import InvalidInputError
from gausslite.wire.agent_link import AgentLink
from gausslite_ros.outgoing_messages import Fields, correction_transform, diagnostics, object_markers
from gausslite_ros.parameters import NodeParameters

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

    def __init__(self, parameters: NodeParameters, link: AgentLink) -> None:
        self._parameters, self._link = parameters, link
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
        silent = "" if self._live.counters.received else f"no colour images on {self._parameters.color} yet"
        return (*self._link.problems, silent, self._live.problem, self._message_problem)


def _image_type(topic: str) -> str:
    return _COMPRESSED if topic.endswith(_TRANSPORTS) else _IMAGE
