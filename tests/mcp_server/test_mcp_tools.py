"""The MCP server, called by the client of the package `mcp`: in process, over stdio and over HTTP with tokens."""

import asyncio
import base64
import json
import os
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from agent_running import Agent
from fusion_running import GRAPH, GRID, MUG, RunningServer, make_subset
from small_room import write_room

from gausslite.cli.main import main
from gausslite.domain.objects import ObjectReport
from gausslite.wire.security import Role

pytest.importorskip("mcp", reason="the server needs the extra `mcp`")
import httpx2
from mcp import Client, StdioServerParameters, stdio_client
from mcp.client.streamable_http import streamable_http_client

from gausslite_mcp.command import read_tokens
from gausslite_mcp.place import open_place
from gausslite_mcp.server import build_server
from gausslite_mcp.tools import PlaceTools
from gausslite_objects.areas import Area
from gausslite_objects.edits import EditKind
from gausslite_objects.object_memory import RunMemory

EYES_M = [(1.0, -1.6, 1.0), (2.2, 0.8, 1.6)]
URL = "http://127.0.0.1:8000"
VIEWER, OPERATOR = "v" * 20, "o" * 20


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_room(tmp_path_factory.mktemp("mcp") / "run", EYES_M)


def answers(server: Any, *calls: tuple[str, dict[str, Any]], **client: Any) -> list[Any]:
    """Return the results of tool calls."""

    async def ask() -> list[Any]:
        async with Client(server, **client) as connected:
            return [await connected.call_tool(name, arguments) for name, arguments in calls]

    return asyncio.run(ask())


def values(result: Any) -> dict[str, Any]:
    assert not result.is_error, result.content
    return dict(json.loads(result.content[0].text))


def test_a_model_lists_objects_asks_and_looks(folder: Path) -> None:
    server = build_server(PlaceTools(open_place(str(folder), threads=1)))
    listed, asked, context, best, view, goal, clearance = answers(
        server,
        ("list_objects", {}),
        ("list_objects", {"question": "what is on the table"}),
        ("object_context", {"object": "cube"}),
        ("best_view", {"object": "cube-1"}),
        ("render_view", {"position_m": [1, -1.5, 1], "look_at_m": [1, 0, 0.6], "fov_deg": 40}),
        ("goal_near", {"object": "cube", "distance_m": 0.6, "robot_radius_m": 0.1}),
        ("clearance", {"points_m": [[0.3, -0.3, 0.0], [1.0, 0.3, 0.0], [-2.5, -1.9, 0.0], [50, 0, 0]]}),
    )
    assert [found["id"] for found in values(listed)["objects"]] == ["cube-1", "lamp-3", "table-2"]
    assert [found["id"] for found in values(asked)["objects"]] == ["cube-1"]
    assert values(context)["on"] == ["table-2"]
    assert [found["id"] for found in values(context)["near"]] == ["table-2"]
    for result in (best, view):
        assert values(result)["T_world_camera"][3] == [0, 0, 0, 1]
        assert result.content[1].mime_type == "image/jpeg"
        pixels = np.frombuffer(base64.b64decode(result.content[1].data), np.uint8)
        blue, green, red = cv2.imdecode(pixels, cv2.IMREAD_COLOR)[240, 320].tolist()
        assert red > 2 * max(blue, green)
    assert values(goal)["object"] == "cube-1"
    assert values(goal)["visible"] > 0.5
    assert values(clearance)["cells"] == ["free", "occupied", "unknown", "unknown"]
    assert values(clearance)["distances_m"][0] == pytest.approx(0.35, abs=0.1)
    assert (values(clearance)["distances_m"][1] <= 0, values(clearance)["distances_m"][3]) == (True, None)


def test_errors_are_those_of_the_library(folder: Path) -> None:
    server = build_server(PlaceTools(open_place(str(folder), threads=1)))
    calls = [
        ("best_view", {"object": "sofa"}, "expected the id or the noun of an object, got 'sofa'"),
        ("list_objects", {"question": "the the"}, "QUESTION: "),
        ("render_view", {"position_m": [1, 1, 1], "look_at_m": [1, 1, 1]}, "away from what it looks at"),
        ("render_view", {"position_m": [1, 1], "look_at_m": [1, 1, 1]}, "at least 3 items"),
        ("clearance", {"points_m": []}, "points_m: expected 1 to 1000 points, got 0"),
        ("goal_near", {"object": "cube", "distance_m": 99}, "distance_m: expected 0 to 5, got 99"),
        ("goal_near", {"object": "cube", "from_m": [1e9, 0, 0]}, "from_m: expected three numbers in metres"),
        ("assign_task", {"task": "Find the mug"}, "expected a server that was started with --agent HOST:PORT"),
    ]
    results = answers(server, *((name, arguments) for name, arguments, _ in calls))
    for (_, _, message), result in zip(calls, results, strict=True):
        assert result.is_error
        assert message in result.content[0].text
        assert "Traceback" not in result.content[0].text


def test_a_model_lists_areas_and_corrects_objects_for_everybody(tmp_path: Path) -> None:
    room = write_room(tmp_path / "run", EYES_M)
    corners = ((0.5, -1.0, 0.0), (2.0, -1.0, 0.0), (2.0, 1.0, 0.0), (0.5, 1.0, 0.0))
    RunMemory(room).set_area(Area("dining corner", corners))
    server = build_server(PlaceTools(open_place(str(room), threads=1)))
    areas, inside, made, listed, undone, wrong = answers(
        server,
        ("list_areas", {}),
        ("list_objects", {"question": "what is outside the dining corner"}),
        ("edit_object", {"kind": "rename", "object": "cube", "value": "box"}),
        ("list_objects", {}),
        ("edit_object", {"kind": "undo", "object": "1"}),
        ("edit_object", {"kind": "explode", "object": "cube"}),
    )
    assert [(area["name"], area["objects"]) for area in values(areas)["areas"]] == [
        ("dining corner", ["cube-1", "table-2"])
    ]
    assert [found["id"] for found in values(inside)["objects"]] == ["lamp-3"]
    assert (values(made)["edit"], values(undone)["edit"]) == (1, 2)
    assert {found["noun"] for found in values(listed)["objects"]} == {"box", "table", "lamp"}
    assert wrong.content[0].text.endswith(f"expected one of {', '.join(EditKind)}, got 'explode'")
    assert all(entry.author.endswith(" by MCP") for entry in RunMemory(room).edits())
    read_only = build_server(PlaceTools(open_place(str(room), threads=1)), may_change=False)
    [refusal] = answers(read_only, ("edit_object", {"kind": "delete", "object": "cube"}))
    assert "edit_object: expected the role operator, got viewer" in refusal.content[0].text
    assert len(RunMemory(room).edits()) == 2


def test_the_objects_and_the_map_of_a_server_are_those_of_now(fusion: RunningServer) -> None:
    tools = PlaceTools(open_place(fusion.client.address))
    assert tools.list_objects("")["count"] == 0
    session = fusion.client.join("a", GRID)
    fusion.client.report_objects(session.session_id, ObjectReport(GRAPH, (MUG,)))
    fusion.contribute_subsets(session.session_id, make_subset("a", 1, {0: [1, 1]}))
    assert [found["noun"] for found in tools.list_objects("mug")["objects"]] == ["mug"]
    first = tools.place.scene()
    assert tools.place.scene() is first
    fusion.contribute_subsets(session.session_id, make_subset("a", 2, {1: [1, 1]}))
    assert len(tools.place.scene().splats.gaussians) > len(first.splats.gaussians)


def over_http(server: Any, token: str | None, call: tuple[str, dict[str, Any]]) -> Any:
    """Return the result of a tool call over HTTP, without a socket."""

    async def ask() -> Any:
        app = server.streamable_http_app()
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        http = httpx2.AsyncClient(transport=httpx2.ASGITransport(app=app), headers=headers, base_url=URL)
        transport = streamable_http_client(f"{URL}/mcp", http_client=http)
        async with server.session_manager.run(), http, Client(transport) as client:
            return await client.call_tool(*call)

    return asyncio.run(ask())


def refused(server: Any, token: str | None) -> int:
    """Return the status of a request with this token."""

    async def ask() -> int:
        headers = {} if token is None else {"Authorization": f"Bearer {token}"}
        transport = httpx2.ASGITransport(app=server.streamable_http_app())
        async with httpx2.AsyncClient(transport=transport, headers=headers) as http:
            return int((await http.post(f"{URL}/mcp", json={})).status_code)

    return asyncio.run(ask())


def test_over_http_a_token_gives_its_role_and_none_gives_nothing(folder: Path) -> None:
    tools = PlaceTools(open_place(str(folder), threads=1), agent="127.0.0.1:1")
    roles = {VIEWER: Role.VIEWER, OPERATOR: Role.OPERATOR}
    task, listing = ("assign_task", {"task": "Find the mug"}), ("list_objects", {})
    for token in (VIEWER, OPERATOR):
        assert values(over_http(build_server(tools, roles, URL), token, listing))["count"] == 3
    for token, message in ((VIEWER, "expected the role operator, got viewer"), (OPERATOR, "127.0.0.1:1")):
        result = over_http(build_server(tools, roles, URL), token, task)
        assert result.is_error
        assert message in result.content[0].text
    for wrong in (None, "x" * 20):
        assert refused(build_server(tools, roles, URL), wrong) == 401
    result = over_http(build_server(tools, may_change=False), None, task)
    assert "expected the role operator, got viewer" in result.content[0].text


def test_an_operator_assigns_a_task_to_the_agent(robot: Agent, folder: Path) -> None:
    tools = PlaceTools(open_place(str(folder), threads=1), agent=robot.client.address)
    [result] = answers(build_server(tools), ("assign_task", {"task": "Find the cup on the table"}))
    assert values(result)["targets"] == ["cup"]
    assert "cup" in str(robot.client.status())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "cannot be read"),
        ("", "expected lines ROLE TOKEN with viewer or operator and at least 16 characters, got none"),
        ("robot 0123456789abcdef", "entry 1: expected lines ROLE TOKEN"),
        ("# a comment\nviewer 0123456789abcdef\noperator secret\n", "entry 2: expected lines ROLE TOKEN"),
    ],
)
def test_a_damaged_file_of_tokens_is_refused_without_its_tokens(
    tmp_path: Path, content: str | None, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "tokens"
    if content is not None:
        path.write_text(content)
    assert main(["mcp", "run", "--http", "127.0.0.1:0", "--tokens", str(path)]) == 2
    said = capsys.readouterr().err
    assert message in said
    assert "secret" not in said
    path.write_text(f"viewer {VIEWER}\noperator {OPERATOR}\n")
    assert read_tokens(path) == {VIEWER: Role.VIEWER, OPERATOR: Role.OPERATOR}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--http", "0.0.0.0:0"), "expected an address of this machine, or --tokens FILE for callers elsewhere"),
        (("--http", "9000"), "--http: expected HOST:PORT"),
        (("--tokens", "t"), "--tokens: expected with --http"),
        (("--agent", "nowhere"), "--agent: expected HOST:PORT"),
        ((), "expected HOST:PORT"),
    ],
)
def test_wrong_options_are_refused(
    tmp_path: Path, options: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str], monkeypatch: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("t").write_text(f"viewer {VIEWER}\n")
    assert main(["mcp", "missing", *options]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.slow
def test_a_client_starts_the_command_over_stdio(folder: Path) -> None:
    arguments = ["-m", "gausslite", "mcp", str(folder)]
    command = StdioServerParameters(command=sys.executable, args=arguments, env=dict(os.environ))
    listed, best = answers(stdio_client(command), ("list_objects", {}), ("best_view", {"object": "cube"}))
    assert values(listed)["count"] == 3
    assert best.content[1].mime_type == "image/jpeg"
