"""One server with several missions: each has its own agents, map, store and limits."""

from __future__ import annotations

from pathlib import Path

import pytest
from fusion_running import GRID, make_subset, request, server_process

from gausslite.domain.errors import InvalidInputError, MismatchError, QuotaError, SessionUnknownError
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.clients import FusionClient
from gausslite_fusion_server.settings import parse_arguments


def contribute(client: FusionClient, mission_id: str, agent_id: str, cells: dict[int, list[int]]) -> str:
    """Join a mission and send one message; returns the session."""
    with FusionClient(client.address, mission_id=mission_id, deadline_s=20.0) as own:
        session_id = own.join(agent_id, GRID).session_id
        answers = list(own.contribute([request(session_id, make_subset(agent_id, 1, cells))], 20.0))
        assert [outcome.status for answer in answers for outcome in answer.outcomes] == [pb.SUBSET_STATUS_ACCEPTED]
        return session_id


def gaussians_of(client: FusionClient, mission_id: str) -> int:
    with FusionClient(client.address, mission_id=mission_id, deadline_s=20.0) as own:
        return int(own.status().fused_gaussians)


def test_missions_share_nothing_and_survive_a_restart(tmp_path: Path) -> None:
    arguments = ("--max-missions", "3", "--store", str(tmp_path / "missions"))
    with server_process(*arguments) as (_, client):
        with pytest.raises(MismatchError, match="none before an agent has joined"):
            client.status()
        session_id = contribute(client, "attic", "ant", {0: [1], 1: [2, 3]})
        contribute(client, "cellar", "ant", {5: [4]})
        assert (gaussians_of(client, "attic"), gaussians_of(client, "cellar")) == (3, 1)
        with pytest.raises(MismatchError, match=r"expected one of this server's \(attic, cellar\), got none"):
            client.status()
        with pytest.raises(MismatchError, match="got 'roof'"):
            gaussians_of(client, "roof")
        # a session belongs to one mission, whatever the client names
        assert client.keep_session(session_id).highest_update_seq == 1
        with pytest.raises(SessionUnknownError):
            client.keep_session("unknown")
        with FusionClient(client.address, mission_id="cellar", deadline_s=20.0) as operator:
            operator.evict("ant")
        assert (gaussians_of(client, "attic"), gaussians_of(client, "cellar")) == (3, 0)
    with server_process(*arguments) as (_, client):
        assert (gaussians_of(client, "attic"), gaussians_of(client, "cellar")) == (3, 0)
    assert sorted(path.name for path in (tmp_path / "missions").glob("*.sqlite")) == ["attic.sqlite", "cellar.sqlite"]


def test_the_number_of_missions_is_limited_and_an_unused_one_makes_room() -> None:
    with server_process("--max-missions", "2") as (_, client):
        contribute(client, "attic", "ant", {0: [1]})
        with FusionClient(client.address, mission_id="cellar", deadline_s=20.0) as own:
            session_id = own.join("bee", GRID).session_id
            with pytest.raises(QuotaError, match="expected at most 2 on this server, 'roof' exceeds it"):
                contribute(client, "roof", "cat", {0: [1]})
            own.leave(session_id)
        contribute(client, "roof", "cat", {0: [1]})
        assert gaussians_of(client, "attic") == 1
        with pytest.raises(MismatchError, match=r"\(attic, roof\)"):
            gaussians_of(client, "cellar")
        with pytest.raises(InvalidInputError, match="mission_id"):
            contribute(client, "../etc", "dog", {0: [1]})


def test_missions_that_made_room_leave_no_file_and_no_limit_at_the_next_start(tmp_path: Path) -> None:
    arguments = ("--max-missions", "2", "--store", str(tmp_path))
    with server_process(*arguments) as (_, client):
        contribute(client, "attic", "ant", {0: [1]})
        for name in ("one", "two", "three"):
            with FusionClient(client.address, mission_id=name, deadline_s=20.0) as own:
                own.leave(own.join("bee", GRID).session_id)
    assert sorted(path.stem for path in tmp_path.glob("*.sqlite")) == ["attic", "three"]
    with server_process(*arguments) as (_, client):
        assert gaussians_of(client, "attic") == 1


def test_every_method_names_a_mission_or_a_session() -> None:
    for method in pb.DESCRIPTOR.services_by_name["FusionService"].methods:
        fields = method.input_type.fields_by_name
        assert ("mission_id" in fields) != ("session_id" in fields), method.name


@pytest.mark.parametrize("option", [("--mission", "attic"), ("--shards", "2"), ("--view", "8099")])
def test_what_several_missions_cannot_share_is_refused(option: tuple[str, str], tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match=f"{option[0]}: expected a server of one mission"):
        parse_arguments(["--max-missions", "2", "--store", str(tmp_path), *option])
