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


def write(tab: Any, number: int, text: str) -> None:
    """Write into a field until the text stays, as a page that is still being built ignores it."""
    field = tab.get_by_role("textbox").nth(number)
    for _ in range(60):
        field.fill(text)
        tab.wait_for_timeout(500)
        if field.input_value() == text:
            break
