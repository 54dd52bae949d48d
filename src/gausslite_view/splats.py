"""Draw the splats: a small set for every new browser, then as many for each browser as it draws fast enough."""

from __future__ import annotations

import statistics
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from jaxtyping import Float32, UInt8
from numpy import ndarray

from gausslite_view.local_server import LocalServer

PREVIEW_COUNT = 2_000
"""Splats that a new browser gets first: in software rendering about 20 frames a second."""
RESPONSE_LIMIT_S = 0.3
"""A browser that takes longer to answer a message gets fewer splats. An answer takes about two frames."""
_STEPS = (PREVIEW_COUNT, 5_000, 10_000, 20_000, 50_000, 100_000, 200_000, 500_000, 1_000_000, 2_000_000)
_OPTIMISM = 2.0
"""An answer takes less than in proportion to the splats: more are tried if the proportion gives twice the limit."""
_REST_S = 0.7
"""A camera that has not moved for this long is at rest; more splats are sent only then."""
_FIRST_PAUSE_S = 2.0
"""A new browser keeps the small set for this long, so that a first move does not wait for the next step."""
_RETRY_S = 30.0
"""A slow browser tries the next step again after this time, then after twice the time, and so on."""
_ANSWERS = 5
_ANSWER_LIMIT_S = 60.0
_STORAGE_KEY = "gausslite-answer"
_SPLATS = "/splats"


@dataclass(frozen=True, slots=True, eq=False)
class Splats:
    """What a browser draws, in the order in which it is added: each prefix is spread evenly over the map."""

    means_m: Float32[ndarray, "n 3"]
    covariances_m2: Float32[ndarray, "n 3 3"]
    rgb: UInt8[ndarray, "n 3"]
    opacities: Float32[ndarray, " n"]

    def __len__(self) -> int:
        return len(self.means_m)

    def add_to(self, scene: Any, count: int) -> Any:
        """Add the first `count` splats to a scene of viser, in place of those of before; return their handle."""
        arrays = (self.means_m, self.covariances_m2, self.rgb, self.opacities[:, None])
        return scene.add_gaussian_splats(_SPLATS, *(array[:count] for array in arrays))


def next_count(shown: int, total: int, response_s: float) -> int:
    """Return how many of `total` splats to try after `shown` with a response of response_s, `shown` if slow."""
    larger = min(total, next((step for step in _STEPS if step > shown), total))
    return larger if response_s * larger <= _OPTIMISM * RESPONSE_LIMIT_S * shown else shown


class BrowserDetail:
    """Owns the splats of one browser and the thread that sends them.

    The thread draws more splats when the camera rests, measures the answers, and goes back one step if they are slow.
    """

    def __init__(self, client: Any, folder: Any, is_adaptive: bool, is_connected: Callable[[], bool]) -> None:
        """client: the browser's handle in viser. folder: where its number of splats is shown if it is slow.

        is_connected: says whether the server still lists the browser.
        """
        self._client, self._is_connected = client, is_connected
        with folder:
            self._note = client.gui.add_html("")
        self._changed = threading.Condition()
        self._is_adaptive, self._is_restarted, self._is_closed = is_adaptive, False, False
        self._splats: Splats | None = None
        self._moved_s = time.monotonic()
        # only the thread uses what follows
        self._drawn: Splats | None = None
        self._handle: Any = None
        self._start_again()
        self._retry_at_s = self._moved_s + _FIRST_PAUSE_S
        client.camera.on_update(lambda _: self._note_motion())
        threading.Thread(target=self._run, name="browser-detail", daemon=True).start()

    def show(self, splats: Splats) -> None:
        """Replace the splats; a slow browser keeps its number of them."""
        with self._changed:
            self._splats = splats
            self._changed.notify_all()

    def restart(self, is_adaptive: bool) -> None:
        """Find the number of splats again, or draw all of them."""
        with self._changed:
            self._is_adaptive, self._is_restarted = is_adaptive, True
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
                    self._draw(splats, self._count if self._is_adaptive else len(splats))
        except (ConnectionError, TimeoutError):
            return
        except RuntimeError:
            # viser removes the handles of a browser that leaves at any moment, and refuses to write to them
            if self._is_connected():
                raise

    def _wait_for_work(self) -> Splats | None:
        """Return splats to draw, or those that are drawn if more of them can be tried; None at the end."""
        with self._changed:
            while not self._is_closed:
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
        self._count, self._usable = PREVIEW_COUNT, 0
        self._retry_at_s, self._retry_pause_s = 0.0, _RETRY_S

    def _grow(self, splats: Splats) -> None:
        """Measure what is drawn; draw one step more, or the last usable number of splats."""
        count, response_s = min(self._count, len(splats)), self._response_s()
        if response_s > RESPONSE_LIMIT_S and 0 < self._usable < count:
            chosen, is_slow = self._usable, True
        else:
            self._usable, chosen = count, next_count(count, len(splats), response_s)
            is_slow = chosen == count < len(splats)
        if chosen != count:
            self._draw(splats, chosen)
        if is_slow:
            self._retry_at_s = time.monotonic() + self._retry_pause_s
            self._retry_pause_s *= 2
        self._note.content = _note_html(self._usable) if is_slow else ""

    def _draw(self, splats: Splats, count: int) -> None:
        if count > PREVIEW_COUNT:
            self._handle = splats.add_to(self._client.scene, count)
        elif self._handle is not None:
            self._handle.remove()
            self._handle = None
        self._drawn, self._count = splats, count

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
        try:
            self._client.local_storage.get_item(_STORAGE_KEY, _ANSWER_LIMIT_S)
        except RuntimeError as error:
            # a browser that refuses to read its storage has answered too
            if "disconnected" in str(error):
                raise ConnectionError("the browser has left") from error


def _note_html(count: int) -> str:
    return (
        f'<div style="padding:0 0.75em;font-size:0.85em">This browser draws {count:,} of them: more would be slow. '
        f"To draw all, clear the box above.</div>"
    )


class SplatLayer:
    """Owns the scene's splats and one BrowserDetail for each browser. Thread-safe.

    The scene that all browsers share has the small set, which a new browser gets with the page's first messages.
    A larger set belongs to one browser's own scene and hides the shared one there.
    """

    def __init__(self, server: LocalServer, folder: Any) -> None:
        """folder: the page's folder in which a slow browser's number of splats is shown."""
        self._server, self._folder = server, folder
        self._lock = threading.Lock()
        self._splats: Splats | None = None
        self._is_adaptive = True
        self._browsers: dict[int, BrowserDetail] = {}
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    def show(self, splats: Splats) -> None:
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
