"""ReportObjects and QueryObjects over gRPC: the contract, and hostile input."""

from __future__ import annotations

from dataclasses import replace

import grpc
import pytest
from absent_package import remove_package
from fusion_running import GRAPH, GRID, MUG, fusion_server

from gausslite.domain.errors import InvalidInputError, MissingPluginError, SessionUnknownError, TaskError
from gausslite.domain.objects import ObjectReport, ObjectRole
from gausslite.domain.task import TaskGraph
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.convert_task import object_from_message, object_to_message, report_to_message


@pytest.mark.parametrize("role", ObjectRole)
def test_every_role_is_on_the_wire(role: ObjectRole) -> None:
    mug = replace(MUG, role=role)
    assert object_from_message(object_to_message(mug)) == mug


def test_where_is_the_mug() -> None:
    with fusion_server() as server:
        for name in ("ant", "bee"):
            session = server.client.join(name, GRID, task=GRAPH)
            server.client.report_objects(session.session_id, ObjectReport(GRAPH, (MUG,)))
        [mug] = server.client.query_objects("mug")
        assert mug.landmark.centroid_m == pytest.approx((1.0, 2.0, 3.0))
        assert mug.landmark.size_m == pytest.approx((0.2, 0.2, 0.2))
        assert mug.landmark.confidence == pytest.approx(0.75)
        assert [(each.agent_id, each.target, each.last_seen_ns) for each in mug.observers] == [
            ("ant", 0, 9),
            ("bee", 0, 9),
        ]
        assert server.client.query_objects("sofa") == ()
        assert [list(each.targets) for each in server.client.status().agents] == [["mug"], ["mug"]]
        # a later report replaces the earlier one
        server.client.report_objects(session.session_id, ObjectReport(GRAPH))
        assert len(server.client.query_objects()[0].observers) == 1


def test_hostile_reports_and_queries_are_refused_and_change_nothing() -> None:
    with fusion_server() as server:
        session = server.client.join("ant", GRID).session_id
        server.client.report_objects(session, ObjectReport(GRAPH, (MUG,)))
        with pytest.raises(SessionUnknownError):
            server.client.report_objects("nobody", ObjectReport(GRAPH))
        many = report_to_message(session, ObjectReport(GRAPH))
        many.objects.extend([object_to_message(MUG)] * 5000)
        no_role, no_box, nan = (report_to_message(session, ObjectReport(GRAPH, (MUG,))) for _ in range(3))
        no_role.objects[0].role = 99
        no_box.objects[0].extent_m.min_m.x = 5.0
        nan.objects[0].confidence = float("nan")
        no_task = report_to_message(session, ObjectReport(GRAPH))
        no_task.ClearField("task")
        for request in (many, no_role, no_box, nan, no_task):
            with pytest.raises(grpc.RpcError) as refused:
                server.stub.ReportObjects(request)
            assert refused.value.code() is grpc.StatusCode.INVALID_ARGUMENT
        for noun in ("\x00", "x" * 1000):
            with pytest.raises(InvalidInputError, match="noun"):
                server.client.query_objects(noun)
        with pytest.raises(grpc.RpcError) as refused:
            server.stub.QueryObjects(pb.QueryObjectsRequest(mission_id="another"))
        assert refused.value.code() is grpc.StatusCode.FAILED_PRECONDITION
        with pytest.raises(TaskError):
            server.client.join("bee", GRID, task=TaskGraph("", "", (), (), ()))
        assert len(server.client.query_objects()) == 1


def test_a_server_without_the_package_keeps_reports_and_a_query_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    remove_package(monkeypatch, "gausslite_objects")
    with fusion_server() as server:
        session = server.client.join("ant", GRID).session_id
        server.client.report_objects(session, ObjectReport(GRAPH, (MUG,)))
        assert [list(agent.targets) for agent in server.client.status().agents] == [["mug"]]
        with pytest.raises(MissingPluginError, match="objects of a team: needs the package gausslite_objects"):
            server.client.query_objects()
