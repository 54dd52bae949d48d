"""A headless Chromium; tests that need it skip without one."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any

import pytest

from gausslite.domain.errors import InvalidInputError
from gausslite_bench.browser import open_browser as open_installed_browser


@contextmanager
def open_browser(size: tuple[int, int] = (720, 420)) -> Iterator[Any]:
    """Yield a browser context with windows of this size in pixels; skip the test without Playwright or Chromium."""
    with ExitStack() as stack:
        try:
            context = stack.enter_context(open_installed_browser(size))
        except InvalidInputError as error:
            pytest.skip(str(error))
        yield context


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
