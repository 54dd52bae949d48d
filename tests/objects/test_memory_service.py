"""MemoryService: edits and areas of a team are durable, attributed, undoable, and made by operators."""

import asyncio
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from threading import Event

import pytest
from certificates import identity, make_certificates
from fusion_running import GRAPH, GRID, MUG, fusion_server
from waiting import wait_until

from gausslite.cli.main import main
from gausslite.domain.errors import InvalidInputError, MismatchError, NotPermittedError
from gausslite.domain.objects import ObjectLandmark, ObjectReport
from gausslite.domain.voxels import AxisAlignedBox
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.v1 import memory_service_pb2 as pb
from gausslite.v1 import memory_service_pb2_grpc as pb_grpc
from gausslite.wire.clients import FusionClient
from gausslite.wire.status import from_rpc_error
from gausslite_objects.areas import Area
from gausslite_objects.edits import EditKind
from gausslite_objects.mapped_objects import query, select
from gausslite_objects.memory_client import ServerMemory

ID = "team/mug-1"
HALL = Area("hall", ((0.0, 0.0, 2.0), (4.0, 0.0, 2.0), (4.0, 4.0, 2.0), (0.0, 4.0, 2.0)))


def _report(client: FusionClient, name: str, *objects: ObjectLandmark) -> None:
    session = client.join(name, GRID, task=GRAPH)
    client.report_objects(session.session_id, ObjectReport(GRAPH, objects))


def test_edits_of_a_team_win_over_later_reports_and_survive_a_restart(tmp_path: Path) -> None:
    with closing(SqliteStore(tmp_path / "team.db")) as store, fusion_server(store) as server:
        memory = ServerMemory(server.client.address)
        _report(server.client, "ant", MUG)
        made = memory.edit(EditKind.RENAME, ID, "vase", "ann")
        assert (made.number, made.author, made.object_id) == (1, "ann", ID)
        memory.edit(EditKind.NOTE, ID, "the blue one", "bob")
        memory.edit(EditKind.PIN, ID, author="bob")
        _report(server.client, "bee", replace(MUG, object_id="mug-9"))
        [vase] = server.client.query_objects("vase")
        assert {seen.agent_id for seen in vase.observers} == {"ant", "bee"}
        assert server.client.query_objects("mug") == ()
    with closing(SqliteStore(tmp_path / "team.db")) as store, fusion_server(store) as server:
        memory = ServerMemory(server.client.address)
        place = query(server.client.address, None)
        assert [found.landmark.noun for found in place.objects] == ["vase"]
        assert (place.edited.notes[ID], place.edited.pinned) == (("bob: the blue one",), frozenset({ID}))
        memory.edit(EditKind.DELETE, ID)
        assert server.client.query_objects() == ()
        memory.edit(EditKind.UNDO, "4")
        assert len(server.client.query_objects("vase")) == 1
        memory.edit(EditKind.UNDO, "1")
        assert len(server.client.query_objects("mug")) == 1
        assert [edit.kind for edit in memory.edits()] == ["rename", "note", "pin", "delete", "undo", "undo"]


def test_merged_and_split_objects_keep_their_observers() -> None:
    beside = replace(MUG, object_id="mug-2", centroid_m=(1.22, 2.0, 3.0))
    beside = replace(beside, extent_m=AxisAlignedBox((1.12, 1.9, 2.9), (1.32, 2.1, 3.1)))
    with fusion_server() as server:
        memory = ServerMemory(server.client.address)
        _report(server.client, "ant", MUG)
        _report(server.client, "bee", beside)
        memory.edit(EditKind.MERGE, ID, "team/mug-2")
        [merged] = server.client.query_objects()
        assert [seen.agent_id for seen in merged.observers] == ["ant", "bee"]
        memory.edit(EditKind.UNDO, "1")
        memory.edit(EditKind.SPLIT, ID)
        parts = server.client.query_objects()
        assert [(part.landmark.object_id, part.observers[0].agent_id) for part in parts] == [
            (ID, "ant"),
            (f"{ID}-half", "ant"),
            ("team/mug-2", "bee"),
        ]


def test_areas_of_a_team_answer_questions_and_the_command_corrects_a_server(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with fusion_server() as server:
        address = server.client.address
        _report(server.client, "ant", MUG)
        memory = ServerMemory(address)
        memory.set_area(HALL)
        assert memory.areas() == (HALL,)
        assert len(select(query(address, None), "what is in the hall")[0]) == 1
        assert len(select(query(address, None), "mugs not in the hall")[0]) == 0
        assert main(["edit", address, "rename", ID, "cup", "--author", "ann"]) == 0
        assert capsys.readouterr().out == f"1: rename \"{ID}\" as 'cup', by ann\n"
        assert main(["edit", address, "list"]) == 0
        assert "area 'hall'" in capsys.readouterr().out
        memory.remove_area("hall")
        assert memory.areas() == ()
        assert main(["edit", address, "no-area", "hall"]) == 2


def test_what_the_service_cannot_do_is_said_in_one_line() -> None:
    with fusion_server() as server:
        memory = ServerMemory(server.client.address)
        with pytest.raises(InvalidInputError, match="object: expected one of none, got 'mug'"):
            memory.edit(EditKind.DELETE, "mug")
        stub = pb_grpc.MemoryServiceStub(server.channel)
        for request, kind in (
            (pb.EditObjectRequest(kind=99), InvalidInputError),  # type: ignore[arg-type]
            (pb.EditObjectRequest(kind=pb.EDIT_KIND_PIN, mission_id="other"), MismatchError),
        ):
            with pytest.raises(Exception) as refused:
                stub.EditObject(request, timeout=20)
            assert isinstance(from_rpc_error(refused.value, "server"), kind)  # type: ignore[arg-type]


def test_operators_edit_under_the_names_of_their_certificates_and_viewers_read(tmp_path: Path) -> None:
    certs = make_certificates(tmp_path, "server:none", "husky-1", "screen:viewer", "control:operator")
    with fusion_server(tls=identity(certs, "server")) as server:
        with FusionClient(server.client.address, tls=identity(certs, "husky-1")) as robot:
            _report(robot, "husky-1", MUG)
        operator, *others = (
            ServerMemory(server.client.address, identity(certs, name)) for name in ("control", "husky-1", "screen")
        )
        assert operator.edit(EditKind.PIN, ID, author="somebody else").author == "control"
        operator.set_area(HALL)
        for memory in others:
            assert (len(memory.edits()), memory.areas()) == (1, (HALL,))
            for change in (lambda: memory.edit(EditKind.DELETE, ID), lambda: memory.remove_area("hall")):  # noqa: B023
                pytest.raises(NotPermittedError, change).match("one of the roles operator")


def test_a_flood_of_readings_is_refused_by_name_and_leaves_the_threads_of_others_free(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with fusion_server() as server:
        store, may_end = server.servicer.engine.store, Event()
        find = store.find_record
        monkeypatch.setattr(store, "find_record", lambda *names: may_end.wait(60) and find(*names))
        stub = pb_grpc.MemoryServiceStub(server.channel)
        calls = [stub.GetMemory.future(pb.GetMemoryRequest(), timeout=60) for _ in range(80)]
        try:
            wait_until(lambda: sum(call.done() for call in calls) == 80 - 65)
            # the event loop's own threads check the disk
            busy = asyncio.run_coroutine_threadsafe(asyncio.to_thread(int), server.loop)
            assert busy.result(20) == 0
        finally:
            may_end.set()
        for refused in (call for call in calls if call.exception()):
            assert "memory: expected at most 64 calls that wait" in refused.details()
