"""Handle Ctrl-C and SIGTERM: exit at once and without a traceback during start-up, and after the current step later.

Programs call `end_quietly_while_starting` before their other imports, because imports take most of the start-up. The
handler is our own and not the system's default, because process 1 of a container ignores signals without a handler.
"""

from __future__ import annotations

import os
import signal
import threading
from types import FrameType, TracebackType

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


class _QuietEnd:
    """A signal handler that ends the process at once; during start-up nothing is open that needs closing."""

    def __init__(self, program: str) -> None:
        self._program = program

    def __call__(self, number: int, _frame: FrameType | None) -> None:
        os.write(2, f"{self._program}: interrupted while starting\n".encode())
        os._exit(128 + number)


def end_quietly_while_starting(program: str) -> None:
    """End the process with code 130 on SIGINT and 143 on SIGTERM, until `raise_interrupts` is called.

    Call it on the main thread.
    """
    for number in _SIGNALS:
        signal.signal(number, _QuietEnd(program))


def raise_interrupts() -> None:
    """Let SIGINT raise KeyboardInterrupt and SIGTERM raise Terminated, unless another handler has been installed."""
    if isinstance(signal.getsignal(signal.SIGINT), _QuietEnd):
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if isinstance(signal.getsignal(signal.SIGTERM), _QuietEnd):
        signal.signal(signal.SIGTERM, _raise_terminated)


class Terminated(KeyboardInterrupt):
    """SIGTERM, raised as Python raises KeyboardInterrupt for SIGINT."""


def _raise_terminated(_number: int, _frame: FrameType | None) -> None:
    raise Terminated


class DeferredInterrupt:
    """A context that records the first Ctrl-C or SIGTERM, so that the current step can be completed.

    pending_exception: the exception that the signal stands for, None without a signal; the caller raises it after the
    step. A second signal raises it at once. Only the main thread can handle signals; on other threads the context
    changes nothing.
    """

    def __init__(self) -> None:
        self.pending_exception: KeyboardInterrupt | None = None
        self._on_main_thread = threading.current_thread() is threading.main_thread()
        self._previous = {number: signal.getsignal(number) for number in _SIGNALS}

    def __enter__(self) -> DeferredInterrupt:
        if self._on_main_thread:
            for number in _SIGNALS:
                signal.signal(number, self._record)
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._on_main_thread:
            for number, handler in self._previous.items():
                signal.signal(number, handler)

    def _record(self, number: int, _frame: FrameType | None) -> None:
        if self.pending_exception is not None:
            raise self.pending_exception
        self.pending_exception = Terminated() if number == signal.SIGTERM else KeyboardInterrupt()
