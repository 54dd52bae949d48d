"""Open a headless Chromium of the system, with software rendering."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gausslite.domain.errors import InvalidInputError
from gausslite.process import import_extra

_PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_TIMEOUT_MS = 60_000
_SOFTWARE_RENDERING = ("--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader")
"""As Chromium does it on a machine without a GPU: the page's text on the processor, WebGL through SwiftShader."""


@contextmanager
def open_browser(size: tuple[int, int] = (720, 420)) -> Iterator[Any]:
    """Yield a browser context of Playwright with windows of this size in pixels, and patience for a busy machine.

    Raises InvalidInputError without Playwright or Chromium.
    """
    sync_api = import_extra("playwright.sync_api", "test", "the browser")
    program = next((path for name in _PROGRAMS if (path := shutil.which(name))), None)
    if program is None:
        raise InvalidInputError("the browser: expected Chromium on the path; install it, e.g. apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(_SOFTWARE_RENDERING))
        context = browser.new_context(viewport={"width": size[0], "height": size[1]})
        context.set_default_timeout(_TIMEOUT_MS)
        try:
            yield context
        finally:
            browser.close()
