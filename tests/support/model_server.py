"""An HTTP server of one model file for tests, with adjustable behaviour."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

DATA = bytes(range(256)) * 3000
DIGEST = hashlib.sha256(DATA).hexdigest()


class ServedModel:
    """The served file, the server's behaviour, and the ranges that clients requested."""

    def __init__(self) -> None:
        self.data, self.tag = DATA, '"v1"'
        self.stop_at: int | None = None
        self.redirect: str | None = None
        self.states_length = True
        self.requested_ranges: list[str | None] = []


@contextmanager
def serving(served: ServedModel) -> Iterator[str]:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            requested = self.headers.get("Range")
            served.requested_ranges.append(requested)
            if served.redirect is not None:
                self.send_response(302)
                self.send_header("Location", served.redirect)
                self.end_headers()
                return
            if not self.path.endswith("/thing.bin") and not self.path.endswith(".onnx"):
                self.send_error(404)
                return
            start = int(requested[6:-1]) if requested and self.headers.get("If-Range") == served.tag else 0
            if start >= len(served.data):
                self.send_response(416)
                self.send_header("Content-Range", f"bytes */{len(served.data)}")
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            self.send_response(206 if start else 200)
            if start:
                self.send_header("Content-Range", f"bytes {start}-{len(served.data) - 1}/{len(served.data)}")
            if served.states_length:
                self.send_header("Content-Length", str(len(served.data) - start))
            self.send_header("ETag", served.tag)
            self.end_headers()
            self.wfile.write(served.data[start : served.stop_at])

        def log_message(self, *_: object) -> None:
            """Log nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01})
    thread.start()
    try:
        yield f"http://127.0.0.1:{server.server_port}/files"
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


def no_progress(have: int, total: int | None) -> None:
    """Show no progress bar."""


def files_in(folder) -> list[str]:
    return sorted(path.name for path in folder.iterdir())
