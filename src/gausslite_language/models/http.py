"""A language model behind OpenAI's chat completions API: one POST, one total deadline, one bounded answer."""

from __future__ import annotations

import http.client
import json
import math
import socket
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, Final
from urllib.parse import urlsplit

from gausslite.domain.errors import InvalidInputError, LanguageModelError
from gausslite_language.models.parsers import ANSWER_SCHEMA, MAX_ANSWER_BYTES, Message

_MAX_ANSWER_TOKENS: Final = 1024


class ResponseFormat(StrEnum):
    """The response_format of the request; not every server supports all of them."""

    JSON_SCHEMA = "json_schema"
    JSON_OBJECT = "json_object"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class HttpSettings:
    """url: the server's base, such as http://localhost:8000/v1; the key is never logged."""

    url: str
    model: str
    response_format: ResponseFormat = ResponseFormat.JSON_SCHEMA
    timeout_s: float = 10.0
    api_key: str | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        try:
            parts = urlsplit(self.url)
            is_valid = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
        except ValueError:
            is_valid = False
        if not is_valid or not self.url.isascii() or any(character.isspace() for character in self.url):
            raise InvalidInputError("backend http url: expected a URL like http://localhost:8000/v1, got another text")
        if parts.username is not None or parts.password is not None or parts.query or parts.fragment:
            raise InvalidInputError("backend http url: expected no user, password, query or fragment, got one")
        if not self.model.strip():
            raise InvalidInputError("backend http model: expected the name of a model, got none")
        if not (math.isfinite(self.timeout_s) and 0 < self.timeout_s <= 600):
            raise InvalidInputError(f"backend http timeout: expected up to 600 seconds, got {self.timeout_s}")
        if self.api_key is not None and not (self.api_key.isascii() and self.api_key.isprintable()):
            raise InvalidInputError("backend http key: expected printable ASCII, got other characters")


class HttpLanguageModel:
    """A LanguageModel behind a URL. Redirects are not followed, so that the key stays with this server."""

    def __init__(self, settings: HttpSettings) -> None:
        self._settings = settings
        self._parts = urlsplit(settings.url)

    @property
    def version(self) -> str:
        """The server, the model's name and the response format."""
        return f"{self._settings.url} {self._settings.model} {self._settings.response_format}"

    def complete(self, messages: Sequence[Message]) -> str:
        """Return the text of the first choice. Raises LanguageModelError."""
        connection = self._connection()
        deadline_s = time.monotonic() + self._settings.timeout_s
        try:
            with _close_sockets_at(deadline_s) as (expired, sockets):
                try:
                    connection.connect()
                    sockets.append(connection.sock)
                    status, body = self._exchange(connection, messages)
                except (OSError, http.client.HTTPException, ValueError) as error:
                    if expired.is_set() or isinstance(error, TimeoutError):
                        raise LanguageModelError(self._timeout_message()) from None
                    raise LanguageModelError(f"language model: the call failed with {type(error).__name__}") from None
        finally:
            connection.close()
        if expired.is_set():
            raise LanguageModelError(self._timeout_message())
        if status != http.client.OK:
            raise LanguageModelError(f"language model: expected status 200, got {status}")
        return _content_of(body)

    def _timeout_message(self) -> str:
        return f"language model: no answer within {self._settings.timeout_s:g} s"

    def _connection(self) -> http.client.HTTPConnection:
        secure = self._parts.scheme == "https"
        connection_type = http.client.HTTPSConnection if secure else http.client.HTTPConnection
        return connection_type(self._parts.hostname or "", self._parts.port, timeout=self._settings.timeout_s)

    def _exchange(self, connection: http.client.HTTPConnection, messages: Sequence[Message]) -> tuple[int, bytes]:
        headers = {"Content-Type": "application/json", "Accept": "application/json"}
        if self._settings.api_key:
            headers["Authorization"] = f"Bearer {self._settings.api_key}"
        body = json.dumps(self._request(messages)).encode()
        connection.request("POST", f"{self._parts.path.rstrip('/')}/chat/completions", body, headers)
        with connection.getresponse() as response:
            answer = response.read(MAX_ANSWER_BYTES + 1)
            if len(answer) > MAX_ANSWER_BYTES:
                raise LanguageModelError(f"language model: expected up to {MAX_ANSWER_BYTES} bytes, got more")
            if response.length:
                raise http.client.IncompleteRead(answer, response.length)
            return response.status, answer

    def _request(self, messages: Sequence[Message]) -> dict[str, Any]:
        request: dict[str, Any] = {
            "model": self._settings.model,
            "messages": [{"role": str(message.role), "content": message.text} for message in messages],
            "temperature": 0,
            "max_tokens": _MAX_ANSWER_TOKENS,
        }
        if self._settings.response_format is ResponseFormat.JSON_SCHEMA:
            schema = {"name": "task_graph", "strict": True, "schema": ANSWER_SCHEMA}
            request["response_format"] = {"type": "json_schema", "json_schema": schema}
        elif self._settings.response_format is ResponseFormat.JSON_OBJECT:
            request["response_format"] = {"type": "json_object"}
        return request


@contextmanager
def _close_sockets_at(deadline_s: float) -> Iterator[tuple[threading.Event, list[socket.socket]]]:
    """Shut down the listed sockets at the deadline; a socket's own timeout restarts with every received byte.

    The caller appends its socket to the list, because a connection drops its socket once the response owns it.
    """
    expired = threading.Event()
    sockets: list[socket.socket] = []

    def shut_down() -> None:
        expired.set()
        for open_socket in sockets:
            with suppress(OSError):  # already closed
                open_socket.shutdown(socket.SHUT_RDWR)

    timer = threading.Timer(max(0.0, deadline_s - time.monotonic()), shut_down)
    timer.daemon = True
    timer.start()
    try:
        yield expired, sockets
    finally:
        timer.cancel()


def _content_of(body: bytes) -> str:
    try:
        choice = json.loads(body)["choices"][0]
        content, finish_reason = choice["message"]["content"], choice.get("finish_reason")
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError):
        raise LanguageModelError("language model: expected choices[0].message.content, got something else") from None
    if finish_reason == "length":
        raise LanguageModelError(f"language model: an answer within {_MAX_ANSWER_TOKENS} tokens was cut off")
    if not isinstance(content, str):
        raise LanguageModelError("language model: expected text as the answer, got something else")
    return content
