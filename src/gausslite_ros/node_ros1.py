"""The rospy shell of the node: subscribers, publishers and a loop around RobotSession, which does all work."""

from __future__ import annotations

import sys
import threading
import time
from array import array
from collections.abc import Callable
from typing import Any

import rospy
from genpy import Time
from rosgraph import Master, MasterException
from roslib.message import get_message_class

from gausslite.domain.errors import GaussLiteError
from gausslite.wire.clients import AgentClient
from gausslite_link.agent_link import AgentLink
from gausslite_ros.outgoing import Fields
from gausslite_ros.robot_session import Delivery, NodeParameters, Outgoing, RobotSession, publications

_QUEUE_SIZE = 100
_BUFFER_BYTES = 1 << 26
"""A smaller one than the waiting images makes rospy deliver old images late."""
_MASTER_PERIOD_S = 2.0


class GaussliteNode:
    """Owns the session. Parameters (~name) are read once, at the start.

    rospy calls back in a thread for each connection, so that a lock guards the session. The loop runs by the machine's
    clock: timers of rospy end when a playback sets the simulated time back.
    """

    def __init__(self) -> None:
        names = NodeParameters.defaults().items()
        parameters = NodeParameters.of({name: rospy.get_param(f"~{name}", value) for name, value in names})
        self._parameters = parameters
        client = AgentClient(parameters.agent, tls=parameters.tls())
        self.session = RobotSession(parameters, AgentLink(client, parameters.link_settings()))
        self._periods_s = parameters.tf_period_s, parameters.period_s
        self._lock = threading.Lock()
        self._topics: list[Any] = []
        self._writers: dict[str, Any] = {}
        self._master = Master(rospy.get_name())
        self._register()
        self.session.follow_map(self._send, lambda: int(rospy.get_rostime().to_nsec()))

    def run(self) -> None:
        """Publish transforms and status until the node is shut down."""
        due_s = [0.0, 0.0, time.monotonic() + _MASTER_PERIOD_S]
        steps: tuple[tuple[float, Callable[[], None]], ...] = (
            (self._periods_s[0], lambda: self._publish(self.session.transforms)),
            (self._periods_s[1], lambda: self._publish(self.session.status)),
            (_MASTER_PERIOD_S, self._register_again),
        )
        while not rospy.is_shutdown():
            for i, (period_s, step) in enumerate(steps):
                if time.monotonic() >= due_s[i]:
                    due_s[i] = time.monotonic() + period_s
                    step()
            time.sleep(max(min(due_s) - time.monotonic(), 0.0))

    def _register(self) -> None:
        for topic in self._topics:
            topic.unregister()
        self._topics = [
            rospy.Subscriber(
                _name(wanted.topic),
                _message_class(wanted.message_type),
                self._locked(wanted.callback),
                buff_size=_BUFFER_BYTES,
            )
            for wanted in self.session.subscriptions()
        ]
        self._writers = {
            topic: rospy.Publisher(
                _name(topic),
                _message_class(written.message_type),
                queue_size=_QUEUE_SIZE,
                latch=written.delivery is Delivery.LATCHED,
            )
            for topic, written in publications(self._parameters).items()
        }
        self._topics += self._writers.values()

    def _register_again(self) -> None:
        """Register all topics with a master that does not know the node: one that was restarted."""
        try:
            known = [node for _, nodes in self._master.getSystemState()[1] for node in nodes]
        except (MasterException, OSError):
            return
        if rospy.get_name() not in known:
            rospy.logwarn("the master was restarted: all topics are registered again")
            self._register()

    def _locked(self, callback: Callable[[Any], None]) -> Callable[[Any], None]:
        def handle(message: Any) -> None:
            with self._lock:
                callback(message)

        return handle

    def _publish(self, messages: Callable[[int], list[Outgoing]]) -> None:
        with self._lock:
            found = messages(rospy.get_rostime().to_nsec())
        self._send(found)

    def _send(self, messages: list[Outgoing]) -> None:
        for outgoing in messages:
            writer = self._writers[outgoing.topic]
            writer.publish(_filled(writer.data_class(), outgoing.fields))


def _name(ros2_topic: str) -> str:
    """Return a topic with the private names of ROS 1: ~/task would be /task."""
    return ros2_topic.replace("~/", "~")


def _message_class(ros2_name: str) -> Any:
    return get_message_class(ros2_name.replace("/msg/", "/"))


def _filled(message: Any, fields: Fields) -> Any:
    """Return the message with these fields, whose names are those of ROS 2."""
    kinds = dict(zip(message.__slots__, message._slot_types, strict=True))
    for name, value in fields.items():
        setattr(message, name, _value(kinds[name], value))
    return message


def _value(kind: str, value: Any) -> Any:
    if isinstance(value, array):
        return value.tobytes() if kind == "uint8[]" else value.tolist()
    if kind.endswith("[]"):
        return [_value(kind.removesuffix("[]"), element) for element in value]
    if kind == "time":
        return Time(value["sec"], value["nanosec"])
    if kind == "byte":
        return value[0]
    return _filled(get_message_class(kind)(), value) if isinstance(value, dict) else value


def main() -> None:
    """Run the node until it is shut down, then end the mission."""
    rospy.init_node("gausslite")
    try:
        node = GaussliteNode()
    except GaussLiteError as error:
        sys.exit(f"gausslite: {error}")
    try:
        node.run()
    except KeyboardInterrupt:
        pass
    finally:
        try:
            print(node.session.close() or "no mission was ended", file=sys.stderr)
        except GaussLiteError as error:
            sys.exit(f"gausslite: the mission was not ended: {error}")


if __name__ == "__main__":
    main()
