"""A known end for Ctrl-C and SIGTERM: without a traceback while a program starts, between two steps of its work later.

Programs call `end_quietly_while_starting` before they import anything else, because most of a start is imports. A
handler of our own and not the system's, because the first process of a container ignores signals it has no handler for.
"""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType, TracebackType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class _QuietEnd:
    """A signal handler that ends the process at once; nothing that would need closing has been opened yet."""

    def __init__(self, program: str) -> None:
        self._program = program

    def __call__(self, number: int, _frame: FrameType | None) -> None:
        os.write(2, f"{self._program}: interrupted while starting\n".encode())
        os._exit(128 + number)


def end_quietly_while_starting(program: str) -> None:
    """From now on SIGINT and SIGTERM end the process with code 130 or 143. Call it on the main thread."""
    for number in _SIGNALS:
        signal.signal(number, _QuietEnd(program))


def started() -> None:
    """Give both signals back Python's own meaning, unless somebody else has taken them since."""
    if isinstance(signal.getsignal(signal.SIGINT), _QuietEnd):
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if isinstance(signal.getsignal(signal.SIGTERM), _QuietEnd):
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


class Terminated(KeyboardInterrupt):
    """SIGTERM, as what Ctrl-C is to Python."""


class DeferredInterrupt:
    """Within it the first Ctrl-C or SIGTERM is only noted, so that the step at hand is finished and kept.

    asked is then what to raise in the end; a second signal raises it at once. Away from the main thread, which alone
    may take signals, nothing changes.
    """

    def __init__(self) -> None:
        self.asked: KeyboardInterrupt | None = None
        self._takes_signals = threading.current_thread() is threading.main_thread()
        self._before = {number: signal.getsignal(number) for number in _SIGNALS}

    def __enter__(self) -> DeferredInterrupt:
        if self._takes_signals:
            for number in _SIGNALS:
                signal.signal(number, self._note)
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._takes_signals:
            for number, handler in self._before.items():
                signal.signal(number, handler)

    def _note(self, number: int, _frame: FrameType | None) -> None:
        if self.asked is not None:
            raise self.asked
        self.asked = Terminated() if number == signal.SIGTERM else KeyboardInterrupt()
