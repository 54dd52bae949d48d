"""The http backend against a local server that is correct, slow, hostile or broken."""

import json
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import pytest

from gausslite.domain.errors import LanguageModelError
from gausslite.domain.task import TargetRole
from gausslite_language.backends import HttpBackend, ModelSettings
from gausslite_language.models.http import HttpLanguageModel, HttpSettings, ResponseFormat
from gausslite_language.models.parsers import ANSWER_SCHEMA, messages_for

GOOD = json.dumps(
    {
        "targets": ["mug"],
        "anchors": ["table"],
        "relations": [{"predicate": "on", "target": "mug", "anchor": "table"}],
    }
)
MESSAGES = messages_for("Pick up the mug on the table")
ENDED = threading.Event()
Act = Callable[[BaseHTTPRequestHandler], None]


def completion(content: object, **choice: object) -> bytes:
    return json.dumps({"choices": [{"message": {"content": content}, **choice}]}).encode()


def send_response(body: bytes, status: int = 200, **headers: str) -> Act:
    def act(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(status)
        for name, value in {"Content-Length": str(len(body)), **headers}.items():
            handler.send_header(name, value)
        handler.end_headers()
        handler.wfile.write(body)

    return act


def sends_slowly(handler: BaseHTTPRequestHandler) -> None:
    handler.send_response(200)
    handler.send_header("Content-Length", "60000")
    handler.end_headers()
    while not ENDED.wait(0.02):
        handler.wfile.write(b" ")
        handler.wfile.flush()


def is_silent(handler: BaseHTTPRequestHandler) -> None:
    ENDED.wait(20)


def sends_without_end(handler: BaseHTTPRequestHandler) -> None:
    handler.send_response(200)
    handler.end_headers()
    while not ENDED.is_set():
        handler.wfile.write(b"x" * 65536)


@contextmanager
def server(act: Act) -> Iterator[tuple[str, list[tuple[str, dict[str, str], dict[str, object]]]]]:
    """Yield the base URL of a server that responds by `act`, and its requests: path, headers, body."""
    requests: list[tuple[str, dict[str, str], dict[str, object]]] = []

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            requests.append((self.path, dict(self.headers), body))
            try:
                act(self)
            except OSError:
                self.close_connection = True  # the client has gone

        def log_message(self, format: str, *args: object) -> None:
            return

    ENDED.clear()
    serving = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=serving.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"http://127.0.0.1:{serving.server_address[1]}/v1", requests
    finally:
        ENDED.set()
        serving.shutdown()
        thread.join()
        serving.server_close()


@pytest.mark.parametrize("response_format", list(ResponseFormat))
def test_the_request_uses_the_chosen_response_format(response_format: ResponseFormat) -> None:
    with server(send_response(completion(GOOD))) as (url, requests):
        assert HttpLanguageModel(HttpSettings(url, "phi", response_format)).complete(MESSAGES) == GOOD
    [(path, headers, body)] = requests
    assert path == "/v1/chat/completions"
    assert body["model"] == "phi"
    assert body["messages"][-1] == {"role": "user", "content": "Pick up the mug on the table"}
    assert "Authorization" not in headers
    expected = {
        ResponseFormat.NONE: None,
        ResponseFormat.JSON_OBJECT: {"type": "json_object"},
        ResponseFormat.JSON_SCHEMA: {
            "type": "json_schema",
            "json_schema": {"name": "task_graph", "strict": True, "schema": ANSWER_SCHEMA},
        },
    }
    assert body.get("response_format") == expected[response_format]


@pytest.mark.parametrize(
    ("act", "expected"),
    [
        (is_silent, "no answer within 0.3 s"),
        (sends_slowly, "no answer within 0.3 s"),
        (sends_without_end, "up to 65536 bytes, got more"),
        (send_response(b"", 500), "expected status 200, got 500"),
        (send_response(b"", 302, Location="http://127.0.0.1:1/"), "expected status 200, got 302"),
        (send_response(completion(GOOD), 401), "expected status 200, got 401"),
        (lambda handler: handler.wfile.write(b"SSH-2.0-what\r\n"), "failed with BadStatusLine"),
        (lambda handler: handler.wfile.write(b"HTTP/1.1 200 OK\r\n" + b"A: b\r\n" * 200), "failed with HTTPException"),
        (send_response(completion(GOOD), 200, **{"Content-Length": "9000"}), "failed with IncompleteRead"),
        (send_response(b"[" * 60_000), "choices"),
        (send_response(b"\xff\xfe"), "choices"),
        (send_response(b"{}"), "choices"),
        (send_response(completion(None)), "expected text as the answer"),
        (send_response(completion(GOOD[:20], finish_reason="length")), "cut off"),
    ],
)  # fmt: skip
def test_a_slow_hostile_or_broken_server_fails_in_one_line_and_in_time(act: Act, expected: str) -> None:
    with server(act) as (url, _):
        model = HttpLanguageModel(
            HttpSettings(url, "phi", timeout_s=0.3 if "within" in expected else 20.0, api_key="secret")
        )
        with pytest.raises(LanguageModelError, match=expected) as caught:
            model.complete(MESSAGES)
    assert "secret" not in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_key_is_sent_to_the_server_only(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("KEY", "secret")
    caplog.set_level(0)
    with server(send_response(b"secret", 403)) as (url, requests):
        backend = HttpBackend(ModelSettings("phi", url, key_variable="KEY"))
        graph = backend.open().parse("Pick up the mug on the table")
    assert requests[0][1]["Authorization"] == "Bearer secret"
    assert "secret" not in caplog.text
    assert "secret" not in repr(graph)


def test_answers_are_cached_and_failures_are_warnings() -> None:
    with server(send_response(completion(GOOD))) as (url, requests):
        parser = HttpBackend(ModelSettings("phi", url)).open()
        graphs = [parser.parse("Pick up the mug on the table") for _ in range(2)]
        assert graphs[0].warnings == ()
        assert graphs[0] == graphs[1]
        assert len(requests) == 1
        assert parser.parse("Find the vase").warnings[0].startswith("backend http failed")
    assert parser.parse("Find the lamp").warnings[0].startswith("backend http failed (language model: the call failed")


@pytest.mark.parametrize(
    ("task", "added", "warnings"),
    [
        (
            "There is a red victim behind me. Go to the door.",
            ("victim",),
            ("'victim' was added by the language model",),
        ),
        ("There is a herd behind me. Go to the door.", (), ("'herd' is not part of the task",)),
        ("Go to the door.", (), ()),
    ],
)
def test_mode_add_asks_only_for_nouns_that_the_rules_lost(task, added, warnings):
    answer = json.dumps({"targets": ["red victim", "dragon", "door"], "anchors": [], "relations": []})
    with server(send_response(completion(answer))) as (url, requests):
        graph = HttpBackend(ModelSettings(model="phi", url=url, mode="add")).open().parse(task)
    assert graph.targets == ("door", *added)
    assert graph.roles[0] is TargetRole.DESTINATION  # that of the rules
    assert [(each.name, each.colour) for each in graph.attributes] == [(name, "red") for name in added]
    assert graph.warnings == warnings
    assert len(requests) == len(warnings)


def test_mode_add_keeps_the_graph_of_the_rules_if_the_model_fails():
    task = "There is a victim behind me. Go to the door."
    with server(send_response(b"", 500)) as (url, _):
        graph = HttpBackend(ModelSettings(model="phi", url=url, mode="add")).open().parse(task)
    assert graph.targets == ("door",)
    assert graph.warnings[0].startswith("backend http failed")
    assert graph.warnings[1:] == ("'victim' is not part of the task",)
