"""ReportObjects and QueryObjects over gRPC: the contract, and hostile input."""

from dataclasses import replace

import grpc
import pytest
from absent_package import remove_package
from fusion_running import GRAPH, GRID, MUG, RunningServer, fusion_server

from gausslite.domain.errors import InvalidInputError, MissingPluginError, SessionUnknownError, TaskError
from gausslite.domain.objects import ObjectReport, ObjectRole
from gausslite.domain.task import TaskGraph
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import task_pb2
from gausslite.wire.convert_task import object_from_message, object_to_message, report_to_message


@pytest.mark.parametrize("role", ObjectRole)
def test_every_role_is_on_the_wire(role: ObjectRole) -> None:
    mug = replace(MUG, role=role)
    assert object_from_message(object_to_message(mug)) == mug


def test_where_is_the_mug(fusion: RunningServer) -> None:
    for name in ("ant", "bee"):
        session = fusion.client.join(name, GRID, task=GRAPH)
        fusion.client.report_objects(session.session_id, ObjectReport(GRAPH, (MUG,)))
    [mug] = fusion.client.query_objects("mug")
    assert mug.landmark.centroid_m == pytest.approx((1.0, 2.0, 3.0))
    assert mug.landmark.size_m == pytest.approx((0.2, 0.2, 0.2))
    assert mug.landmark.confidence == pytest.approx(0.75)
    assert [(each.agent_id, each.target, each.last_seen_ns) for each in mug.observers] == [("ant", 0, 9), ("bee", 0, 9)]
    assert fusion.client.query_objects("sofa") == ()
    assert [list(each.targets) for each in fusion.client.status().agents] == [["mug"], ["mug"]]
    # a later report replaces the earlier one
    fusion.client.report_objects(session.session_id, ObjectReport(GRAPH))
    assert len(fusion.client.query_objects()[0].observers) == 1


def test_hostile_reports_and_queries_are_refused_and_change_nothing(fusion: RunningServer) -> None:
    session = fusion.client.join("ant", GRID).session_id
    fusion.client.report_objects(session, ObjectReport(GRAPH, (MUG,)))
    pytest.raises(SessionUnknownError, fusion.client.report_objects, "nobody", ObjectReport(GRAPH))
    many = report_to_message(session, ObjectReport(GRAPH))
    many.objects.extend([object_to_message(MUG)] * 5000)
    no_role, no_box, nan = (report_to_message(session, ObjectReport(GRAPH, (MUG,))) for _ in range(3))
    no_role.objects[0].role = 99
    no_box.objects[0].extent_m.min_m.x = 5.0
    nan.objects[0].confidence = float("nan")
    no_task = report_to_message(session, ObjectReport(GRAPH))
    no_task.ClearField("task")
    # refused before they are made: they would hold the event loop
    relations = report_to_message(session, ObjectReport(GRAPH))
    relations.task.relations.extend([task_pb2.Relation(predicate=task_pb2.PREDICATE_ON)] * 100_000)
    for request in (many, no_role, no_box, nan, no_task, relations):
        with pytest.raises(grpc.RpcError) as refused:
            fusion.stub.ReportObjects(request)
        assert refused.value.code() is grpc.StatusCode.INVALID_ARGUMENT
    for noun in ("\x00", "x" * 1000):
        pytest.raises(InvalidInputError, fusion.client.query_objects, noun).match("noun")
    with pytest.raises(grpc.RpcError) as refused:
        fusion.stub.QueryObjects(pb.QueryObjectsRequest(mission_id="another"))
    assert refused.value.code() is grpc.StatusCode.FAILED_PRECONDITION
    pytest.raises(TaskError, fusion.client.join, "bee", GRID, task=TaskGraph("", "", (), (), ()))
    assert len(fusion.client.query_objects()) == 1


def test_a_server_without_the_package_keeps_reports_and_a_query_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    remove_package(monkeypatch, "gausslite_objects")
    with fusion_server() as t:
        session = t.client.join("ant", GRID).session_id
        t.client.report_objects(session, ObjectReport(GRAPH, (MUG,)))
        assert [list(agent.targets) for agent in t.client.status().agents] == [["mug"]]
        with pytest.raises(MissingPluginError, match="objects of a team: needs the package gausslite_objects"):
            t.client.query_objects()
