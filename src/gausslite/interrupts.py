"""End a program that is still starting: one line and a known exit code for Ctrl-C and SIGTERM, no traceback.

Programs call this before they import anything else, because most of a start is imports. A handler of our own and not
the system's, because the first process of a container ignores signals it has no handler for.
"""

import os
import signal
from types import FrameType


class _QuietEnd:
    """A signal handler that ends the process at once; nothing that would need closing has been opened yet."""

    def __init__(self, program: str) -> None:
        self._program = program

    def __call__(self, number: int, _frame: FrameType | None) -> None:
        os.write(2, f"{self._program}: interrupted while starting\n".encode())
        os._exit(128 + number)


def end_quietly_while_starting(program: str) -> None:
    """From now on SIGINT and SIGTERM end the process with code 130 or 143. Call it on the main thread."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _QuietEnd(program))


def started() -> None:
    """Give both signals back Python's own meaning, unless somebody else has taken them since."""
    if isinstance(signal.getsignal(signal.SIGINT), _QuietEnd):
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if isinstance(signal.getsignal(signal.SIGTERM), _QuietEnd):
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
