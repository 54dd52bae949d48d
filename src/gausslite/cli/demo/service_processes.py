"""Run services as child processes, and end every one of them under all circumstances."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from gausslite.config.program import without_options
from gausslite.domain.errors import UnavailableError

_TERMINATION_TIMEOUT_S = 10.0
_INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(slots=True)
class ServiceProcess:
    """A child process and the file that holds its output."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def require_alive(self) -> None:
        """Raise UnavailableError with the last line of the log if the process has failed."""
        code = self.process.poll()
        if code not in (None, 0):
            raise UnavailableError(f"{self.name} ended with code {code}: {self.last_line()} (see {self.log})")

    def wait(self, timeout_s: float) -> None:
        """Wait until the process ends, at most this long."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout_s)

    def last_line(self) -> str:
        """Return the last line of the log."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "its log is empty"


@dataclass(slots=True)
class ProcessGroup:
    """Owns child processes; leaving the `with` block terminates them, and kills those that do not end in time."""

    log_dir: Path
    services: list[ServiceProcess] = field(default_factory=list)

    def __enter__(self) -> ProcessGroup:
        self.log_dir.mkdir(parents=True, exist_ok=True)
        return self

    def start(self, name: str, module: str, arguments: Sequence[str]) -> ServiceProcess:
        """Start `python -m module arguments…` with its output in `<log_dir>/<name>.log`.

        The process does not inherit variables that set options: its arguments alone configure it.
        """
        log = self.log_dir / f"{name}.log"
        command = [sys.executable, "-m", module, *arguments]
        with log.open("wb") as stream, _interrupts_deferred():
            # In a session of its own, Ctrl-C reaches only this process, which ends its children in order.
            process = subprocess.Popen(  # noqa: S603 - our own interpreter and modules
                command,
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                env=without_options(os.environ),
            )
            service = ServiceProcess(name, process, log)
            self.services.append(service)
        return service

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        running = [service.process for service in reversed(self.services) if service.process.poll() is None]
        deadline = time.monotonic() + _TERMINATION_TIMEOUT_S
        try:
            for process in running:
                process.send_signal(signal.SIGTERM)
            for process in running:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=max(0.1, deadline - time.monotonic()))
        finally:
            # a second Ctrl-C during the wait leads here immediately
            for process in running:
                if process.poll() is None:
                    process.kill()
                    process.wait()


@contextlib.contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Defer interrupts to the end of the block: one between start and registration of a child would orphan it."""
    if threading.current_thread() is not threading.main_thread():
        yield  # handlers run in the main thread only
        return
    received: list[int] = []
    handlers = {number: signal.getsignal(number) for number in _INTERRUPTS}
    for number in _INTERRUPTS:
        signal.signal(number, lambda number, _frame: received.append(number))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        if received:
            signal.raise_signal(received[0])
