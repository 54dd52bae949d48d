"""What every program of the package shares: messages, signals and optional packages.

Programs call `run_program`, which handles signals before the other imports: those take most of the start-up. The
handler is our own and not the system's default, because process 1 of a container ignores signals without a handler.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import threading
import time
from contextlib import suppress
from importlib import import_module
from types import FrameType, TracebackType
from typing import Any, Final

from gausslite.domain.errors import MissingPluginError

# exit code of a command that did its work, while nothing of its task was found
TASK_NOT_FOUND: Final = 3
# exit code of a mission that does not know the robot's place at its end
ROBOT_LOST: Final = 4
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_IMPATIENCE_S = 1.0
"""Launchers repeat a signal within this, or follow with another one: only a later same one is a user's."""
_OF_LIBRARIES = {"OPENBLAS_NUM_THREADS": "1", "GRPC_VERBOSITY": "NONE"}
"""Variables that NumPy and gRPC read when they are loaded, unless the user sets them.

Products of many points and a small matrix would only wait for further threads. Errors of connections are exceptions,
which the programs report; gRPC would log them once more.
"""
_SWITCHES = {"ORT_DISABLE_TELEMETRY": "1"}
"""Variables that ONNX Runtime reads when it is loaded, also as a part of onnxruntime-genai."""


def installed_version() -> str:
    """Return the version of the installed distribution, which is looked up only on request."""
    from importlib import metadata

    try:
        return metadata.version("gausslite")
    except metadata.PackageNotFoundError:
        return "of a source tree that is not installed"


def printable(text: str) -> str:
    """Return the text with control characters and bytes of other encodings escaped.

    File names and texts of users can contain them; a terminal would execute escape sequences.
    """
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode() for character in text
    )


def print_message(text: str) -> None:
    """Print one line on stderr; without effect after the terminal has gone."""
    with suppress(OSError):
        print(printable(text), file=sys.stderr)


def handled_signals() -> tuple[signal.Signals, ...]:
    """Return the signals that end a program; not those that its caller ignores, as `nohup` does with SIGHUP."""
    return tuple(number for number in _SIGNALS if signal.getsignal(number) is not signal.SIG_IGN)


class _QuietEnd:
    """A signal handler that ends the process at once; during start-up nothing is open that needs closing."""

    def __init__(self, program: str) -> None:
        self._program = program

    def __call__(self, number: int, _frame: FrameType | None) -> None:
        os.write(2, f"{self._program}: interrupted while starting\n".encode())
        os._exit(128 + number)


def end_quietly_while_starting(program: str) -> None:
    """End the process with code 130 on SIGINT, 143 on SIGTERM and 129 on SIGHUP, until `raise_interrupts` is called.

    Call it on the main thread, before NumPy and gRPC are loaded: it sets their variables.
    """
    for name, value in _OF_LIBRARIES.items():
        os.environ.setdefault(name, value)
    for number in handled_signals():
        signal.signal(number, _QuietEnd(program))


def raise_interrupts() -> None:
    """Let SIGINT raise KeyboardInterrupt and the others Terminated, unless another handler has been installed."""
    for number in _SIGNALS:
        if isinstance(signal.getsignal(number), _QuietEnd):
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else _raise_terminated)


def run_program(program: str, module: str, function: str = "run") -> int:
    """Import the module, call its function and return the exit code; signals are handled from the start.

    A library older than its generated code, and modules that were not compiled, give one line and exit code 2.
    """
    end_quietly_while_starting(program)
    try:
        return int(getattr(import_module(module), function)())
    except Exception as error:
        advice = _installation_advice(error)
        if advice is None:
            raise
        reason = " ".join(str(error).split()).partition(". ")[0]
        print_message(f"{program}: {advice} ({reason})")
        return 2


def _installation_advice(error: Exception) -> str | None:
    """Return how to mend an installation that causes an import to fail; None for other errors."""
    if isinstance(error, ImportError) and (error.name or "").startswith("gausslite."):
        return "its compiled modules are not built for this Python; install GaussLite again with it"
    package = _outdated_package(error)
    if package is None:
        return None
    return (
        f"the installed {package} is too old, perhaps because another package has pinned it; "
        f"run pip install --upgrade {package}"
    )


def _outdated_package(error: Exception) -> str | None:
    """Return the package whose version causes an import to fail; None for other errors."""
    if type(error).__module__ == "google.protobuf.runtime_version":
        return "protobuf"
    if isinstance(error, ImportError) and (error.name or "").startswith("google.protobuf"):
        return "protobuf"
    is_generated = isinstance(error, RuntimeError) and "generated code" in str(error)
    return "grpcio" if is_generated and "grpc package installed" in str(error) else None


class Terminated(KeyboardInterrupt):
    """SIGTERM or SIGHUP, raised as Python raises KeyboardInterrupt for SIGINT."""


def _raise_terminated(_number: int, _frame: FrameType | None) -> None:
    raise Terminated


class DeferredInterrupt:
    """A context that records the first Ctrl-C, SIGTERM or SIGHUP, so that the current step can be completed.

    pending_exception: the exception that the signal stands for, None without a signal; the caller raises it after the
    step. The same signal raises it at once if it comes again a second later. Only the main thread can handle signals;
    on other threads the context changes nothing.
    """

    def __init__(self) -> None:
        self.pending_exception: KeyboardInterrupt | None = None
        self._on_main_thread = threading.current_thread() is threading.main_thread()
        self._previous = {number: signal.getsignal(number) for number in handled_signals()}
        self._first, self._since_s = 0, 0.0

    def __enter__(self) -> DeferredInterrupt:
        if self._on_main_thread:
            for number in self._previous:
                signal.signal(number, self._record)
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _: TracebackType | None
    ) -> None:
        if self._on_main_thread:
            for number, handler in self._previous.items():
                signal.signal(number, handler)

    def _record(self, number: int, _frame: FrameType | None) -> None:
        if self.pending_exception is None:
            self._first, self._since_s = number, time.monotonic()
            self.pending_exception = KeyboardInterrupt() if number == signal.SIGINT else Terminated()
        elif number == self._first and time.monotonic() - self._since_s > _IMPATIENCE_S:
            raise self.pending_exception


def disable_telemetry() -> None:
    """Set the variables for this process and its children."""
    os.environ.update(_SWITCHES)


def return_free_memory() -> None:
    """Give memory that was freed back to the system, where its C library can."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def size_text(count: float) -> str:
    """Return a number of bytes with the unit that fits."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= factor:
            return f"{count / factor:.3g} {unit}"
    return f"{count:.0f} B"


def import_extra(package: str, extra: str, purpose: str) -> Any:
    """Import a package of an extra. Raises MissingPluginError, which names the command that installs it."""
    try:
        return import_module(package)
    except ImportError as error:
        raise MissingPluginError(
            f"{purpose}: expected the package {package!r}; install it with: pip install 'gausslite[{extra}]'"
        ) from error
