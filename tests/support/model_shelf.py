"""A server of model files in this process, for tests: what it has and how it behaves can be changed on the way."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

DATA = bytes(range(256)) * 3000
DIGEST = hashlib.sha256(DATA).hexdigest()


class Shelf:
    """What the server has, how it behaves, and what it was asked for."""

    def __init__(self) -> None:
        self.data, self.tag = DATA, '"v1"'
        self.cut_at: int | None = None
        self.redirect: str | None = None
        self.says_length = True
        self.asked: list[str | None] = []


@contextmanager
def serving(shelf: Shelf) -> Iterator[str]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            wanted = self.headers.get("Range")
            shelf.asked.append(wanted)
            if shelf.redirect is not None:
                self.send_response(302)
                self.send_header("Location", shelf.redirect)
                self.end_headers()
                return
            if not self.path.endswith("/thing.bin") and not self.path.endswith(".onnx"):
                self.send_error(404)
                return
            start = int(wanted[6:-1]) if wanted and self.headers.get("If-Range") == shelf.tag else 0
            self.send_response(206 if start else 200)
            if start:
                self.send_header("Content-Range", f"bytes {start}-{len(shelf.data) - 1}/{len(shelf.data)}")
            if shelf.says_length:
                self.send_header("Content-Length", str(len(shelf.data) - start))
            self.send_header("ETag", shelf.tag)
            self.end_headers()
            self.wfile.write(shelf.data[start : shelf.cut_at])

        def log_message(self, *_: object) -> None:
            """Quiet."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/files"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def nothing_shown(have: int, total: int | None) -> None:
    """No bar in tests."""


def left_in(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())
