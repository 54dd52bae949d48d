"""The node without rclpy: a bag is replayed to it, a real agent maps the frames, and it publishes valid messages."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from agent_running import TASK, Agent, agent
from robot_bag import COLOUR, COLOUR_INFO, DELAYS_NS, DEPTH, DEPTH_INFO, arrivals, write_robot_bag
from sample_gaussians import random_gaussians
from waiting import wait_until

from gausslite.domain.errors import InvalidInputError
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.domain.voxels import AxisAlignedBox
from gausslite.wire.clients import AgentClient
from gausslite_link.agent_link import AgentLink, AgentSnapshot, SentFrames
from gausslite_ros.bag_file import BagAddress
from gausslite_ros.bag_source import BagSource
from gausslite_ros.live_frames import LiveCounters
from gausslite_ros.outgoing import ERROR, OK, WARN, correction_transform, diagnostics, object_markers, point_cloud
from gausslite_ros.robot_session import (
    DIAGNOSTICS,
    OBJECTS,
    OCCUPANCY,
    REGION,
    SPLATS,
    TF,
    NodeParameters,
    Outgoing,
    RobotSession,
    publications,
)
from gausslite_ros.robot_session import TASK as TASK_TOPIC

NOW_NS = 1_700_000_100_123_456_789
PARAMETERS = NodeParameters(color=COLOUR, depth=DEPTH, period_s=0.05, map_period_s=0.2, lossless=True)
MUG = ObjectLandmark(
    "1", "mug", ObjectRole.TARGET, (1.0, 2.0, 0.5), AxisAlignedBox((0.9, 1.9, 0.4), (1.1, 2.1, 0.6)), 0.8, 0, 1
)
PUBLICATIONS = publications(PARAMETERS)
SNAPSHOT = AgentSnapshot("husky", "mapping", TASK, 10, 3, 0, 0, 0, 4.0, 0.1, 0.2, "", (), np.eye(4), "tracked", (MUG,))


@contextmanager
def opened(running: Agent, parameters: NodeParameters) -> Iterator[tuple[RobotSession, AgentLink]]:
    parameters = replace(parameters, agent=running.client.address)
    link = AgentLink(AgentClient(parameters.agent), parameters.link_settings())
    session = RobotSession(parameters, link)
    yield session, link
    link.close(end_mission=False)


def published(messages: list[Outgoing], topic: str) -> Any:
    """Return a message after a round through ROS's serialisation, as a subscriber would get it."""
    typesys = pytest.importorskip("rosbags.typesys", reason="messages need the extra ros")
    store = typesys.get_typestore(typesys.Stores.ROS2_JAZZY)
    [fields] = [message.fields for message in messages if message.topic == topic]
    name = PUBLICATIONS[topic].message_type
    data = store.serialize_cdr(build(store, name, fields), name)
    return store.deserialize_cdr(data, name)


def build(store: Any, name: str, fields: dict[str, Any]) -> Any:
    """Return a message of these fields; the others have ROS's defaults. Unknown fields and wrong types fail."""
    values, definitions = {}, dict(store.fielddefs[name][1])
    assert set(fields) <= set(definitions), f"{name} has no such fields"
    for field, (kind, detail) in definitions.items():
        value = fields.get(field)
        if kind.name == "NAME":
            values[field] = build(store, detail, value or {})
        elif kind.name == "BASE":
            values[field] = base_value(detail[0], value)
        else:
            (element_kind, element), _ = detail
            if element_kind.name == "NAME":
                values[field] = [build(store, element, each) for each in value or []]
            else:
                values[field] = np.array(
                    [] if value is None else value, element[0] if element[0] != "byte" else np.uint8
                )
    return store.types[name](**values)


def base_value(kind: str, value: Any) -> Any:
    if kind == "string":
        assert value is None or type(value) is str
        return value or ""
    if kind == "byte":
        assert value is None or (type(value) is bytes and len(value) == 1), "rclpy has bytes of length 1"
        return 0 if value is None else value[0]
    if kind.startswith("float"):
        assert value is None or type(value) is float, "rclpy refuses integers in float fields"
    return 0 if value is None else value


@pytest.mark.parametrize("delays_ns", [{}, DELAYS_NS])
def test_a_replayed_bag_is_mapped_as_the_bag_source_gives_it(tmp_path: Path, delays_ns: dict[str, int]) -> None:
    options = write_robot_bag(tmp_path / "b.mcap")
    source = BagSource(BagAddress(tmp_path / "b.mcap", options))
    with agent(queue_frames=16) as running, opened(running, replace(PARAMETERS, task=TASK)) as (session, link):
        wait_until(lambda: link.snapshot is not None and link.snapshot.state == "mapping")
        assert session.transforms(NOW_NS) == []
        readers = {each.topic: each.callback for each in session.subscriptions()}
        assert set(readers) == {COLOUR, DEPTH, COLOUR_INFO, DEPTH_INFO, "/tf", "/tf_static", TASK_TOPIC}
        for topic, message in arrivals(tmp_path / "b.mcap", delays_ns):
            readers[topic](message)
        wait_until(lambda: link.sent_frames.mapped == len(source))
        wait_until(lambda: link.snapshot is not None and link.snapshot.frames_mapped == len(source))
        tf = published(session.transforms(NOW_NS), TF).transforms[0]
        assert (tf.header.frame_id, tf.child_frame_id) == ("map", "odom")
        assert tf.header.stamp.sec * 10**9 + tf.header.stamp.nanosec == NOW_NS + 100_000_000
        assert tf.transform.rotation.w == pytest.approx(1.0)
        status = published(session.status(NOW_NS), DIAGNOSTICS).status[0]
        values = {each.key: each.value for each in status.values}
        # one of six images has no depth; the session states it until the next frame
        assert (values["images received"], values["images converted"], values["images without depth"]) == (
            "6",
            "5",
            "1",
        )
        assert (status.level, status.message, values["frames mapped"]) == (OK[0], "mapping", "5")
        assert len(published(session.status(NOW_NS), OBJECTS).markers) == 1
        maps: list[list[Outgoing]] = []
        session.follow_map(maps.append, lambda: NOW_NS)
        wait_until(lambda: any(maps))
        last = next(filter(None, maps))
        cells = np.array(published(last, OCCUPANCY).data)
        assert {0, 100} <= set(cells.tolist()) <= {-1, 0, 100}
        region, splats = published(last, REGION), published(last, SPLATS)
        assert region.header.frame_id == splats.header.frame_id == "map"
        assert region.width <= splats.width == len(link.map().batch.gaussians)
        assert "5 frames" in session.close()
        assert running.client.status().frames_mapped == len(source)


def test_a_map_that_cannot_be_published_is_reported_and_the_next_one_is_published(robot: Agent) -> None:
    calls: list[list[Outgoing]] = []

    def publish(messages: list[Outgoing]) -> None:
        calls.append(messages)
        if len(calls) == 1:
            raise MemoryError("no room for the grid")

    with opened(robot, PARAMETERS) as (session, _):
        session.follow_map(publish, lambda: NOW_NS)
        wait_until(lambda: "no room for the grid" in str(session.status(NOW_NS)[0].fields))
        wait_until(lambda: len(calls) > 1)
        wait_until(lambda: "no room for the grid" not in str(session.status(NOW_NS)[0].fields))
        session.close()


def test_a_task_topic_assigns_the_task(robot: Agent) -> None:
    with opened(robot, PARAMETERS) as (session, link):
        [assign] = [each.callback for each in session.subscriptions() if each.topic == TASK_TOPIC]
        assign(SimpleNamespace(data="Pick up the mug on the table"))
        wait_until(lambda: link.snapshot is not None and link.snapshot.task == TASK)
        status = published(session.status(NOW_NS), DIAGNOSTICS).status[0]
        assert status.level == WARN[0]
        assert status.message == f"mapping: no colour images on {COLOUR} yet"


def test_a_camera_that_sends_no_more_images_is_a_warning(robot: Agent, tmp_path: Path) -> None:
    write_robot_bag(tmp_path / "b.mcap")
    parameters, now_s = replace(PARAMETERS, agent=robot.client.address), [100.0]
    link = AgentLink(AgentClient(parameters.agent), parameters.link_settings())
    session = RobotSession(parameters, link, lambda: now_s[0])
    readers = {each.topic: each.callback for each in session.subscriptions()}

    def problems(silent_s: float) -> list[str]:
        now_s[0] += silent_s
        values = session.status(NOW_NS)[0].fields["status"][0]["values"]
        return [pair["value"] for pair in values if pair["key"].startswith("problem")]

    messages = list(arrivals(tmp_path / "b.mcap", {}))
    for topic, message in messages:
        readers[topic](message)
    assert not any("no colour images" in text for text in problems(0.0))
    assert f"no colour images on {COLOUR} for 8 s" in problems(8.0)
    readers[COLOUR](next(message for topic, message in messages if topic == COLOUR))
    assert not any("no colour images" in text for text in problems(8.0))
    link.close(end_mission=False)


def test_a_message_that_cannot_be_read_is_reported_and_does_not_stop_the_node(robot: Agent, tmp_path: Path) -> None:
    options = write_robot_bag(tmp_path / "b.mcap")
    with opened(robot, PARAMETERS) as (session, _):
        readers = {each.topic: each.callback for each in session.subscriptions()}
        for topic, message in arrivals(tmp_path / "b.mcap", {}):
            if topic == "/tf":
                message.transforms[0].child_frame_id = "x" * 1000
            readers[topic](message)
        fields = session.status(NOW_NS)[0].fields
        assert any(
            "frame_id: expected at most 256 characters" in each["value"] for each in fields["status"][0]["values"]
        )
        assert options.frame == "odom"


def test_without_an_agent_the_status_is_an_error() -> None:
    address = "127.0.0.1:1"
    fields = diagnostics(None, (LiveCounters(), SentFrames()), (), NOW_NS, address)
    status = published([Outgoing(DIAGNOSTICS, fields)], DIAGNOSTICS).status[0]
    assert (status.level, status.message) == (ERROR[0], f"waiting for the agent at {address}")


def test_an_agent_whose_mission_failed_is_an_error() -> None:
    failed = replace(SNAPSHOT, state="failed")
    fields = diagnostics(failed, (LiveCounters(), SentFrames()), (), NOW_NS, "a:1")
    assert fields["status"][0]["level"] == ERROR


def test_objects_become_a_box_and_a_text_in_the_maps_frame() -> None:
    fields = object_markers((MUG,), "map", NOW_NS)
    removal, box, text = published([Outgoing(OBJECTS, fields)], OBJECTS).markers
    assert removal.action == 3
    assert (box.header.frame_id, box.ns, box.type, box.action) == ("map", "target", 1, 0)
    np.testing.assert_allclose([box.pose.position.x, box.pose.position.y, box.pose.position.z], (1.0, 2.0, 0.5))
    np.testing.assert_allclose([box.scale.x, box.scale.y, box.scale.z], 0.2)
    assert (text.type, text.text, text.id) == (9, "mug 0.80", 1)
    assert text.pose.position.z > 0.6


def test_a_cloud_has_the_columns_of_splats() -> None:
    sent = random_gaussians(5)
    cloud = point_cloud(sent, "map", NOW_NS)
    names = [field["name"] for field in cloud["fields"]]
    assert [field["offset"] for field in cloud["fields"]] == [4 * place for place in range(len(names))]
    rows = np.frombuffer(cloud["data"], np.dtype([(name, "<f4") for name in names]))
    columns = {"means_m": "x y z", "scales_m": "scale_x scale_y scale_z", "quats_wxyz": "rot_w rot_x rot_y rot_z"}
    for column, fields in columns.items():
        np.testing.assert_array_equal(np.stack([rows[name] for name in fields.split()], axis=1), getattr(sent, column))
    np.testing.assert_array_equal(rows["opacity"], sent.opacities)
    np.testing.assert_allclose((rows["rgb"].view("<u4") >> 8 & 255) / 255, np.clip(sent.rgb[:, 1], 0, 1), atol=0.003)


def test_each_range_of_heights_has_a_grid() -> None:
    parameters = replace(PARAMETERS, heights_m="0.1:0.5,0.5:1.8")
    assert [topic for topic in publications(parameters) if topic.startswith(OCCUPANCY)] == [OCCUPANCY, "~/occupancy_2"]


def test_the_correction_is_a_transform_from_map_to_odometry() -> None:
    T = np.array([[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]])
    outgoing = Outgoing(TF, correction_transform(T, ("map", "odom"), NOW_NS))
    transform = published([outgoing], TF).transforms[0].transform
    assert (transform.translation.x, transform.translation.y, transform.translation.z) == (1, 2, 3)
    half = np.sqrt(0.5)
    np.testing.assert_allclose([transform.rotation.z, transform.rotation.w], half)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"agent": ""}, "parameter agent: expected a name"),
        ({"axes": "left"}, "parameter axes: expected optical or body, got 'left'"),
        ({"handover": "maybe"}, "parameter handover: expected agent or yes or no"),
        ({"tolerance_ms": -1}, "parameter tolerance_ms: expected 0 to 10000, got -1.0"),
        ({"period_s": float("nan")}, "parameter period_s: expected 0.05 to 60, got nan"),
        ({"publish_tf": 1}, "parameter publish_tf: expected bool, got 1"),
        ({"heights_m": "1.8:0.1"}, "parameter heights_m: expected ranges such as 0.1:1.8"),
        ({"heights_m": "0.1"}, "parameter heights_m: expected ranges such as 0.1:1.8"),
        ({"task": None}, "parameter task: expected str, got None"),
        ({"frame": "map"}, "parameter map_frame: expected another frame than the poses'"),
    ],
)
def test_wrong_parameters_give_one_line(values: dict[str, Any], message: str) -> None:
    pytest.raises(InvalidInputError, NodeParameters.of, values).match(message)


def test_camera_info_is_looked_for_beside_the_images() -> None:
    parameters = NodeParameters.of({"color": "/cam/rgb/image_raw/compressed", "drain_s": 5, "handover": "yes"})
    assert parameters.color_info_topic == "/cam/rgb/camera_info"
    assert parameters.depth_info_topic == "/camera/aligned_depth_to_color/camera_info"
    assert (parameters.link_settings().drain_s, parameters.link_settings().handover) == (5.0, True)
    assert parameters.topic_options().depth_info == ""
