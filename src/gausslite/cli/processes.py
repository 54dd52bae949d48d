"""Start the services as real processes and end every one of them, whatever happens."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

from gausslite.errors import UnavailableError

_GRACE_S = 10.0
_INTERRUPTS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(slots=True)
class ServiceProcess:
    """A running service and the file its words go to."""

    name: str
    process: subprocess.Popen[bytes]
    log: Path

    def require_alive(self) -> None:
        """Raise UnavailableError with the last line of the log when the process has ended badly."""
        code = self.process.poll()
        if code not in (None, 0):
            raise UnavailableError(f"{self.name} ended with code {code}: {self.last_line()} (see {self.log})")

    def wait(self, timeout_s: float) -> None:
        """Give the process this long to end by itself."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(timeout_s)

    def last_line(self) -> str:
        """The last line the service wrote."""
        lines = self.log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "it said nothing"


@dataclass(slots=True)
class ProcessGroup:
    """Owns child processes: leaving the `with` block ends them, gently first, then for certain."""

    log_dir: Path
    services: list[ServiceProcess] = field(default_factory=list)

    def __enter__(self) -> ProcessGroup:
        self.log_dir.mkdir(parents=True, exist_ok=True)
        return self

    def start(self, name: str, module: str, arguments: Sequence[str]) -> ServiceProcess:
        """Start `python -m module arguments…` with its output in `<log_dir>/<name>.log`."""
        log = self.log_dir / f"{name}.log"
        command = [sys.executable, "-m", module, *arguments]
        with log.open("wb") as stream, _interrupts_deferred():
            # A session of its own: Ctrl-C reaches only us, and we end the children in order.
            process = subprocess.Popen(  # noqa: S603 - our own interpreter and modules
                command,
                stdin=subprocess.DEVNULL,
                stdout=stream,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            service = ServiceProcess(name, process, log)
            self.services.append(service)
        return service

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        running = [service.process for service in reversed(self.services) if service.process.poll() is None]
        deadline = time.monotonic() + _GRACE_S
        try:
            for process in running:
                process.send_signal(signal.SIGTERM)
            for process in running:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(timeout=max(0.1, deadline - time.monotonic()))
        finally:
            # reached at once when the user presses Ctrl-C a second time
            for process in running:
                if process.poll() is None:
                    process.kill()
                    process.wait()


@contextlib.contextmanager
def _interrupts_deferred() -> Iterator[None]:
    """Let an interrupt wait until the block is left: between its birth and our note of it a child would be orphaned."""
    if threading.current_thread() is not threading.main_thread():
        yield  # handlers run in the main thread only
        return
    caught: list[int] = []
    handlers = {number: signal.getsignal(number) for number in _INTERRUPTS}
    for number in _INTERRUPTS:
        signal.signal(number, lambda arrived, _frame: caught.append(arrived))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for arrived in caught[:1]:
            signal.raise_signal(arrived)
