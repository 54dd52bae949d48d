"""Wait for a change that another thread makes."""

import threading
from collections.abc import Callable

_PERIOD_S = 0.01
_MAX_CHECKS = 3000


def wait_until(condition: Callable[[], bool]) -> None:
    """Return when the condition is true; fail after about 30 s."""
    pause = threading.Event()
    for _ in range(_MAX_CHECKS):
        if condition():
            return
        pause.wait(_PERIOD_S)
    raise AssertionError("the condition did not become true")
