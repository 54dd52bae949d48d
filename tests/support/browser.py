"""A headless Chromium of the system, with software rendering; tests that need it skip without one."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

_PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_TIMEOUT_MS = 60_000
_SOFTWARE_RENDERING = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")


@contextmanager
def open_browser() -> Iterator[Any]:
    """Yield a browser context, with patience for a busy machine; skip the test without Playwright or Chromium."""
    sync_api = pytest.importorskip("playwright.sync_api")
    program = next((path for name in _PROGRAMS if (path := shutil.which(name))), None)
    if program is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(_SOFTWARE_RENDERING))
        context = browser.new_context(viewport={"width": 720, "height": 420})
        context.set_default_timeout(_TIMEOUT_MS)
        try:
            yield context
        finally:
            browser.close()
