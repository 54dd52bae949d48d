"""A headless Chromium of the system with software rendering; tests that need it skip without one."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

_PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "chrome")
_TIMEOUT_MS = 60_000
_SOFTWARE_RENDERING = ("--no-sandbox", "--disable-gpu", "--enable-unsafe-swiftshader")
"""As Chromium does it on a machine without a GPU: the page's text on the processor, WebGL through SwiftShader."""


@contextmanager
def open_browser(size: tuple[int, int] = (720, 420)) -> Iterator[Any]:
    """Yield a browser context with windows of this size in pixels, and patience for a busy machine."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="the browser comes with the extra test")
    program = next((path for name in _PROGRAMS if (path := shutil.which(name))), None)
    if program is None:
        pytest.skip("no Chromium on the path")
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(_SOFTWARE_RENDERING))
        context = browser.new_context(viewport={"width": size[0], "height": size[1]})
        context.set_default_timeout(_TIMEOUT_MS)
        try:
            yield context
        finally:
            browser.close()


def point(tab: Any, button: str, noun: str, *places: tuple[float, float]) -> None:
    """Press a button of a page and click its image, or drag a box on it; places: in shares of the image."""
    tab.get_by_role("button", name=button).click()
    dialog = tab.locator("dialog[open]")
    dialog.get_by_placeholder("noun").fill(noun)
    shown = dialog.locator("img").bounding_box()
    pixels = [(shown["x"] + x * shown["width"], shown["y"] + y * shown["height"]) for x, y in places]
    tab.mouse.move(*pixels[0])
    tab.mouse.down()
    tab.mouse.move(*pixels[-1], steps=4)
    tab.mouse.up()
