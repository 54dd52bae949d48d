"""The rclpy shell of the node: subscriptions, publishers and timers around RobotSession, which does all work."""

from __future__ import annotations

import sys
from typing import Any

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosidl_runtime_py.set_message import set_message_fields
from rosidl_runtime_py.utilities import get_message

from gausslite.domain.errors import GaussLiteError
from gausslite.wire.clients import AgentClient
from gausslite_link.agent_link import AgentLink
from gausslite_ros.robot_session import Delivery, NodeParameters, Outgoing, RobotSession, publications

_QOS = {
    # a best-effort reader also receives from reliable writers
    Delivery.IMAGES: QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT),
    Delivery.TRANSFORMS: QoSProfile(depth=100),
    Delivery.LATCHED: QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL),
    Delivery.RELIABLE: QoSProfile(depth=10),
}


class GaussliteNode(Node):  # type: ignore[misc]
    """Owns the session. Parameters are read once, at the start."""

    def __init__(self) -> None:
        super().__init__("gausslite")
        names = NodeParameters.defaults().items()
        parameters = NodeParameters.of({name: self.declare_parameter(name, value).value for name, value in names})
        client = AgentClient(parameters.agent, tls=parameters.tls())
        self.session = RobotSession(parameters, AgentLink(client, parameters.link_settings()))
        for wanted in self.session.subscriptions():
            message_type = get_message(wanted.message_type)
            self.create_subscription(message_type, wanted.topic, wanted.callback, _QOS[wanted.delivery])
        self._writers = {
            topic: self.create_publisher(get_message(written.message_type), topic, _QOS[written.delivery])
            for topic, written in publications(parameters).items()
        }
        self.create_timer(parameters.tf_period_s, lambda: self._publish(self.session.transforms(self._now_ns())))
        self.create_timer(parameters.period_s, lambda: self._publish(self.session.status(self._now_ns())))
        self.session.follow_map(self._publish, self._now_ns)

    def _publish(self, messages: list[Outgoing]) -> None:
        for outgoing in messages:
            writer = self._writers[outgoing.topic]
            message: Any = writer.msg_type()
            set_message_fields(message, outgoing.fields)
            writer.publish(message)

    def _now_ns(self) -> int:
        return int(self.get_clock().now().nanoseconds)


def main() -> None:
    """Run the node until it is shut down, then end the mission."""
    rclpy.init()
    try:
        node = GaussliteNode()
    except GaussLiteError as error:
        sys.exit(f"gausslite: {error}")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        try:
            print(node.session.close() or "no mission was ended", file=sys.stderr)
        except GaussLiteError as error:
            sys.exit(f"gausslite: the mission was not ended: {error}")
        finally:
            node.destroy_node()
            rclpy.try_shutdown()


if __name__ == "__main__":
    main()
