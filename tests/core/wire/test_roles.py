"""Roles of certificates: each call needs one, sessions belong to a certificate, and operators evict and ban."""

from pathlib import Path

import pytest
from call_context import Context
from certificates import identity, make_certificates
from fusion_running import GRID, RunningServer, fusion_server, make_subset, request
from serving import serving

from gausslite.domain.errors import InvalidInputError, NotPermittedError
from gausslite.v1 import (
    agent_service_pb2,
    fusion_service_pb2,
    memory_service_pb2,
    parser_service_pb2,
    region_service_pb2,
)
from gausslite.wire.clients import FusionClient, ParserClient
from gausslite.wire.security import ROLES_OF_METHOD, Caller, Role, require_role
from gausslite_language.rules import RuleParser
from gausslite_parser.program import parser_service

OPERATOR_ONLY = "expected a certificate with one of the roles operator, got"


@pytest.fixture(scope="module")
def certs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_certificates(
        tmp_path_factory.mktemp("certs"),
        *("server:none", "husky-1", "husky-2:robot", "screen:viewer", "control:operator"),
    )


def test_every_method_of_the_services_has_its_roles() -> None:
    modules = (parser_service_pb2, agent_service_pb2, fusion_service_pb2, memory_service_pb2, region_service_pb2)
    methods = {
        f"/{service.full_name}/{method.name}"
        for module in modules
        for service in module.DESCRIPTOR.services_by_name.values()
        for method in service.methods
    }
    assert methods == set(ROLES_OF_METHOD)
    nobody = Caller("10.0.0.1", frozenset({"ant"}))
    for method in (*methods, "/gausslite.v1.FusionService/New"):
        pytest.raises(NotPermittedError, require_role, method, nobody).match(r"one of the roles .*, got none")


@pytest.mark.parametrize(("name", "role"), [("husky-1", Role.ROBOT), ("screen", Role.VIEWER), ("server", None)])
def test_a_certificate_gives_the_rights_of_its_role_only(name: str, role: Role | None, certs: Path) -> None:
    with (
        fusion_server(tls=identity(certs, "server")) as fusion,
        FusionClient(fusion.client.address, tls=identity(certs, name)) as client,
    ):
        calls = {
            "JoinSession": lambda: client.join(name, GRID),
            "GetSessionStatus": client.status,
            "QueryObjects": client.query_objects,
            "WatchFusedMap": lambda: next(client.watch()),
            "RefineFusedMap": lambda: next(client.refine()),
            "EvictAgent": lambda: client.evict("ant"),
            "UnbanAgent": lambda: client.unban("ant"),
        }
        for method, call in calls.items():
            if role in ROLES_OF_METHOD[f"/gausslite.v1.FusionService/{method}"]:
                call()
            else:
                pytest.raises(NotPermittedError, call).match(f"{method}: expected a certificate with one of the roles")


def test_an_operator_evicts_and_bans(certs: Path) -> None:
    with (
        fusion_server(tls=identity(certs, "server")) as fusion,
        FusionClient(fusion.client.address, tls=identity(certs, "husky-1")) as robot,
        FusionClient(fusion.client.address, tls=identity(certs, "control")) as operator,
    ):
        session = robot.join("husky-1", GRID).session_id
        list(robot.contribute([request(session, make_subset("husky-1", 1, {0: [1], 1: [1]}))], 20.0))
        assert operator.evict("husky-1", ban=True) == 2
        assert list(operator.status().banned_agents) == ["husky-1"]
        pytest.raises(NotPermittedError, robot.join, "husky-1", GRID).match("banned")
        operator.unban("husky-1")
        assert robot.join("husky-1", GRID).highest_update_seq == 0
        pytest.raises(InvalidInputError, operator.unban, "husky-1").match("expected a banned agent")
        pytest.raises(NotPermittedError, operator.join, "control", GRID).match("one of the roles robot, got operator")


def test_a_session_is_of_use_only_to_the_certificate_that_opened_it(certs: Path) -> None:
    with (
        fusion_server(tls=identity(certs, "server")) as fusion,
        FusionClient(fusion.client.address, tls=identity(certs, "husky-1")) as owner,
        FusionClient(fusion.client.address, tls=identity(certs, "husky-2")) as thief,
    ):
        session = owner.join("husky-1", GRID).session_id
        message = request(session, make_subset("husky-1", 1, {0: [1]}))
        for call in (lambda: list(thief.contribute([message], 20.0)), lambda: thief.leave(session, forget=True)):
            pytest.raises(NotPermittedError, call).match("'husky-1': expected a certificate that names it")
        assert len(list(owner.contribute([message], 20.0))) == 1


def test_a_name_that_all_certificates_share_names_no_agent(certs: Path) -> None:
    with (
        fusion_server(tls=identity(certs, "server")) as fusion,
        FusionClient(fusion.client.address, tls=identity(certs, "husky-1")) as client,
        pytest.raises(NotPermittedError, match="'localhost': expected a certificate that names it"),
    ):
        client.join("localhost", GRID)


def test_a_parser_serves_every_role_and_no_certificate_without_one(certs: Path) -> None:
    with serving([parser_service(RuleParser())], tls=identity(certs, "server")) as server:
        for name in ("husky-1", "screen", "control"):
            with ParserClient(server.address, tls=identity(certs, name)) as client:
                assert client.parse("Pick up the mug").targets == ("mug",)
        with ParserClient(server.address, tls=identity(certs, "server")) as client, pytest.raises(NotPermittedError):
            client.parse("Pick up the mug")


def test_without_certificates_only_this_machine_evicts(fusion: RunningServer) -> None:
    method = "/gausslite.v1.FusionService/EvictAgent"
    for host in ("127.0.0.1", "::1", "unix"):
        require_role(method, Caller(host))
    for host in ("10.0.0.1", "fe80::1", ""):
        with pytest.raises(NotPermittedError, match="expected a caller on the server's machine"):
            require_role(method, Caller(host))
        require_role("/gausslite.v1.FusionService/JoinSession", Caller(host))
    fusion.client.join("ant", GRID)
    assert fusion.client.evict("ant", ban=True) == 0


@pytest.mark.parametrize(
    ("peer", "host"),
    [("ipv4:10.0.0.7:5001", "10.0.0.7"), ("ipv6:%5B::1%5D:54026", "::1"), ("ipv6:%5B::ffff:10.0.0.7%5D:1", "10.0.0.7"),
     ("ipv6:%5Bfe80::1%25eth0%5D:1", "fe80::1"), ("unix:/tmp/x", "unix"), ("unix:", "unix")],
)  # fmt: skip
def test_the_host_of_a_caller(peer: str, host: str) -> None:
    assert Caller.of(Context(peer)).host == host


def test_only_the_roles_uri_gives_a_role() -> None:
    caller = Caller.of(Context("ipv4:1.2.3.4:5", x509_pem_cert=b"x", x509_common_name=b"gausslite:role:operator"))
    assert caller.roles == frozenset()
