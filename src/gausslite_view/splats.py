"""Draw the splats: a coarse level for every new browser, then as fine a level for each as it draws fast enough."""

from __future__ import annotations

import statistics
import threading
import time
from collections.abc import Callable
from typing import Any

from gausslite_view.levels import SplatLevels
from gausslite_view.local_server import LocalServer

PREVIEW_COUNT = 3_000
"""Merged splats that a new browser gets first: in software rendering about 10 frames a second."""
HARDWARE_RESPONSE_S = 0.07
"""A browser that answers faster with the first level has a GPU, and gets all splats at once."""
RESPONSE_LIMIT_S = 0.3
"""A browser that takes longer to answer a message gets fewer splats. An answer takes about two frames."""
_STEPS = (PREVIEW_COUNT, 10_000, 30_000, 100_000, 300_000, 1_000_000, 2_000_000)
_OPTIMISM = 2.0
"""An answer takes less than in proportion to the splats: more are tried if the proportion gives twice the limit."""
_REST_S = 0.7
"""A camera that has not moved for this long is at rest; more splats are sent only then."""
_FIRST_PAUSE_S = 2.0
"""A browser without a GPU keeps the first level for this long, so that a first move does not wait for the next."""
_RETRY_S = 30.0
"""A slow browser tries the next step again after this time, then after twice the time, and so on."""
_ANSWERS = 5
_ANSWER_LIMIT_S = 60.0
_STORAGE_KEY = "gausslite-answer"


def next_limit(limit: int, total: int, response_s: float) -> int:
    """Return the most splats to try after a response of response_s with `limit` of `total`, `limit` if it was slow."""
    larger = next((step for step in _STEPS if step > limit), limit)
    allowed = _OPTIMISM * RESPONSE_LIMIT_S * min(limit, total)
    return larger if response_s * min(larger, total) <= allowed else limit


class BrowserDetail:
    """Owns the splats of one browser and the thread that sends them.

    If the first answers are those of a GPU, the thread draws all splats. Otherwise it draws more when the camera rests,
    measures the answers, and goes back one step if they are slow.
    """

    def __init__(self, client: Any, folder: Any, is_adaptive: bool, is_connected: Callable[[], bool]) -> None:
        """client: the browser's handle in viser. folder: where its number of splats is shown if it is slow.

        is_connected: says whether the server still lists the browser.
        """
        self._client, self._is_connected = client, is_connected
        with folder:
            self._note = client.gui.add_html("")
        self._changed = threading.Condition()
        self._is_adaptive, self._is_restarted, self._is_held, self._is_closed = is_adaptive, False, False, False
        self._splats: SplatLevels | None = None
        self._moved_s = time.monotonic()
        # only the thread uses what follows
        self._drawn: SplatLevels | None = None
        self._handle: Any = None
        self._start_again()
        client.camera.on_update(lambda _: self._note_motion())
        threading.Thread(target=self._run, name="browser-detail", daemon=True).start()

    def show(self, splats: SplatLevels) -> None:
        """Replace the splats; a slow browser keeps its number of them."""
        with self._changed:
            self._splats = splats
            self._changed.notify_all()

    def restart(self, is_adaptive: bool) -> None:
        """Find the number of splats again, or draw all of them."""
        with self._changed:
            self._is_adaptive, self._is_restarted = is_adaptive, True
            self._changed.notify_all()

    def hold(self, is_held: bool) -> None:
        """Draw nothing until this is called with False."""
        with self._changed:
            self._is_held = is_held
            self._changed.notify_all()

    def close(self) -> None:
        """End the thread."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def _note_motion(self) -> None:
        with self._changed:
            self._moved_s = time.monotonic()

    def _run(self) -> None:
        try:
            while (splats := self._wait_for_work()) is not None:
                if splats is self._drawn:
                    self._grow(splats)
                else:
                    self._draw(splats, self._limit if self._is_adaptive else len(splats))
                    if not self._is_adaptive:
                        self._note.content = ""
        except (ConnectionError, TimeoutError):
            return
        except RuntimeError:
            # viser removes the handles of a browser that leaves at any moment, and refuses to write to them
            if self._is_connected():
                raise

    def _wait_for_work(self) -> SplatLevels | None:
        """Return splats to draw, or those that are drawn if more of them can be tried; None at the end."""
        with self._changed:
            while not self._is_closed:
                if self._is_held:
                    self._changed.wait()
                    continue
                if self._is_restarted:
                    self._is_restarted, self._drawn = False, None
                    self._start_again()
                if self._splats is not None and self._splats is not self._drawn:
                    return self._splats
                pause_s = self._pause_s()
                if pause_s is not None and pause_s <= 0:
                    return self._splats
                self._changed.wait(pause_s)
        return None

    def _pause_s(self) -> float | None:
        """Return the time until more splats can be tried; None if all are drawn."""
        if self._splats is None or not self._is_adaptive or self._usable >= len(self._splats):
            return None
        return max(self._moved_s + _REST_S, self._retry_at_s) - time.monotonic()

    def _start_again(self) -> None:
        self._limit, self._usable, self._is_first = PREVIEW_COUNT, 0, True
        self._retry_at_s, self._retry_pause_s = 0.0, _RETRY_S

    def _grow(self, splats: SplatLevels) -> None:
        """Measure what is drawn; draw all, one step more, or the last usable number of splats."""
        limit, response_s, total = self._limit, self._response_s(), len(splats)
        if self._is_first:
            self._is_first = False
            if response_s < HARDWARE_RESPONSE_S:
                self._usable = limit
                self._draw(splats, _STEPS[-1])
            else:
                self._retry_at_s = time.monotonic() + _FIRST_PAUSE_S
            return
        if response_s > RESPONSE_LIMIT_S and 0 < self._usable < limit:
            chosen, is_slow = self._usable, True
        else:
            self._usable, chosen = limit, next_limit(limit, total, response_s)
            is_slow = chosen == limit < total
        if chosen != limit:
            self._draw(splats, chosen)
        if is_slow:
            self._retry_at_s = time.monotonic() + self._retry_pause_s
            self._retry_pause_s *= 2
        self._note.content = _note_html(self._usable) if is_slow else ""

    def _draw(self, splats: SplatLevels, limit: int) -> None:
        if limit > PREVIEW_COUNT:
            self._handle = splats.add_to(self._client.scene, limit)
        elif self._handle is not None:
            self._handle.remove()
            self._handle = None
        self._drawn, self._limit = splats, limit

    def _response_s(self) -> float:
        """Return the median time of an answer: a browser answers a read of its storage between two frames.

        Raises ConnectionError if the browser has left, TimeoutError if it does not answer.
        """
        self._wait_for_answer()  # until it has drawn what was sent
        times_s = []
        for _ in range(_ANSWERS):
            started_s = time.perf_counter()
            self._wait_for_answer()
            times_s.append(time.perf_counter() - started_s)
        return statistics.median(times_s)

    def _wait_for_answer(self) -> None:
        if self._is_closed:
            raise ConnectionError("the page has closed")
        try:
            self._client.local_storage.get_item(_STORAGE_KEY, _ANSWER_LIMIT_S)
        except RuntimeError as error:
            # a browser that refuses to read its storage has answered too
            if "disconnected" in str(error):
                raise ConnectionError("the browser has left") from error


def _note_html(count: int) -> str:
    return (
        f'<div style="padding:0 0.75em;font-size:0.85em">This browser draws them merged to {count:,}: more would be '
        f"slow. To draw all, clear the box above.</div>"
    )


class SplatLayer:
    """Owns the scene's splats and one BrowserDetail for each browser. Thread-safe.

    The scene that all browsers share has the coarsest level, which a new browser gets with the page's first messages.
    A finer level belongs to one browser's own scene and hides the shared one there.
    """

    def __init__(self, server: LocalServer, folder: Any) -> None:
        """folder: the page's folder in which a slow browser's number of splats is shown."""
        self._server, self._folder = server, folder
        self._lock = threading.Lock()
        self._splats: SplatLevels | None = None
        self._is_adaptive = True
        self._browsers: dict[int, BrowserDetail] = {}
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    def show(self, splats: SplatLevels) -> None:
        """Replace the splats in every browser."""
        with self._lock:
            self._splats = splats
            splats.add_to(self._server.scene, PREVIEW_COUNT)
            for browser in self._browsers.values():
                browser.show(splats)

    def set_adaptive(self, is_adaptive: bool) -> None:
        """Adapt the number of splats to each browser again, or draw all in every browser."""
        with self._lock:
            self._is_adaptive = is_adaptive
            for browser in self._browsers.values():
                browser.restart(is_adaptive)

    def set_held(self, is_held: bool) -> None:
        """Draw nothing in any browser until this is called with False."""
        with self._lock:
            for browser in self._browsers.values():
                browser.hold(is_held)

    def close(self) -> None:
        """End the threads of all browsers."""
        with self._lock:
            for browser in self._browsers.values():
                browser.close()
            self._browsers.clear()

    def _connect(self, client: Any) -> None:
        with self._lock:
            browser_id = client.client_id
            browser = BrowserDetail(
                client, self._folder, self._is_adaptive, lambda: browser_id in self._server.get_clients()
            )
            self._browsers[browser_id] = browser
            if self._splats is not None:
                browser.show(self._splats)

    def _disconnect(self, client: Any) -> None:
        with self._lock:
            browser = self._browsers.pop(client.client_id, None)
        if browser is not None:
            browser.close()
