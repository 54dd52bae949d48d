"""Draw the splats: a small set for every new browser, then as many for each browser as it draws fast enough."""

from __future__ import annotations

import threading
from typing import Any

from gausslite.view.browser_detail import PREVIEW_COUNT, BrowserDetail, Splats
from gausslite.view.local_server import LocalServer


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
