"""The node of ROS 1 publishes messages that rospy can send, and reads those of rospy; it needs rospy."""

from io import BytesIO
from typing import Any

import numpy as np
import pytest
from sample_gaussians import plain_gaussians
from test_robot_session import MUG, NOW_NS, PUBLICATIONS, SNAPSHOT

from gausslite_export.occupancy import FloorGrid
from gausslite_link.agent_link import SentFrames
from gausslite_ros.live_frames import LiveCounters
from gausslite_ros.messages import CompressedImageMessage, stamp_ns
from gausslite_ros.outgoing import correction_transform, diagnostics, object_markers, occupancy_grid, point_cloud
from gausslite_ros.robot_session import DIAGNOSTICS, OBJECTS, OCCUPANCY, REGION, SPLATS, TF

pytest.importorskip("rospy", reason="the node of ROS 1 needs rospy")
node: Any = pytest.importorskip("gausslite_ros.node_ros1")

FIELDS = {
    TF: correction_transform(np.eye(4), ("map", "odom"), NOW_NS),
    OBJECTS: object_markers((MUG,), "map", NOW_NS),
    REGION: point_cloud(plain_gaussians([[1.0, 2.0, 3.0]]), "map", NOW_NS),
    SPLATS: point_cloud(plain_gaussians([[1.0, 2.0, 3.0]]), "map", NOW_NS),
    OCCUPANCY: occupancy_grid(
        FloorGrid(np.array([[-1, 0, 100]], np.int8), np.array([0.5, 1.5]), 0.05, 0.0, np.eye(4)), "map", NOW_NS
    ),
    DIAGNOSTICS: diagnostics(SNAPSHOT, (LiveCounters(), SentFrames()), ("a problem",), NOW_NS, "agent"),
}


@pytest.mark.parametrize("topic", PUBLICATIONS)
def test_messages_survive_a_round_through_rospys_serialisation(topic: str) -> None:
    kind = node._message_class(PUBLICATIONS[topic].message_type)
    message, buffer = node._filled(kind(), FIELDS[topic]), BytesIO()
    message.serialize(buffer)
    read = kind().deserialize(buffer.getvalue())
    again = BytesIO()
    read.serialize(again)
    assert again.getvalue() == buffer.getvalue()
    parts = {OBJECTS: "markers", TF: "transforms"}
    header = getattr(read, parts[topic])[0].header if topic in parts else read.header
    assert stamp_ns(header) == NOW_NS


def test_private_names_are_those_of_ros_1() -> None:
    assert [node._name(topic) for topic in ("~/task", "/tf")] == ["~task", "/tf"]


def test_a_compressed_image_of_rospy_is_known_as_one() -> None:
    kind = node._message_class("sensor_msgs/msg/CompressedImage")
    assert isinstance(kind(), CompressedImageMessage)
    assert not isinstance(node._message_class("sensor_msgs/msg/Image")(), CompressedImageMessage)
