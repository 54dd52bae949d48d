"""Start a service as its own process, and read its log, its time to start, its processor time and its memory."""

from __future__ import annotations

import contextlib
import os
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

from gausslite.domain.errors import UnavailableError
from gausslite.wire.channel import UNIX, require_serving

FUSION_SERVER = f"{shlex.quote(sys.executable)} -m gausslite_fusion_server"
_START_LIMIT_S = 300.0
_POLL_S = 0.02


def resident_mib(process_id: int | None = None) -> float:
    """Return the resident memory of a process in MiB, by default of this one.

    Raises UnavailableError if the process has ended, and on systems without /proc.
    """
    path = Path("/proc", "self" if process_id is None else str(process_id), "statm")
    pages = int(path.read_text().split()[1]) if path.exists() else 0
    if pages == 0:
        raise UnavailableError(f"memory: expected a running process and a Linux system with {path}")
    return pages * os.sysconf("SC_PAGE_SIZE") / (1 << 20)


class ServiceProcess:
    """Owns the process of a service with the options of its command, and appends what it logs to a file."""

    def __init__(self, command: str, folder: Path, name: str = "fusion", address: str = "") -> None:
        """Start the service, by default at a unix socket, and wait until it serves. Raises UnavailableError."""
        self._command = command
        self.address, self.log = address or f"unix:{folder}/{name}.sock", folder / f"{name}.log"
        self.start()

    @property
    def pid(self) -> int:
        """The id of the process."""
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """False after the process has ended."""
        return self._process.poll() is None

    @property
    def unexpected_errors(self) -> int:
        """Errors in the log that a method did not expect."""
        return self.log.read_text(errors="replace").count("Traceback (most recent call last)")

    def restart(self) -> float:
        """End the service as a service manager does and start it again; returns the time until it serves."""
        self.close()
        return self.start()

    def kill(self) -> None:
        """End the process at once, as the kernel does when memory runs out."""
        self._process.kill()
        self._process.wait()
        # else a client would find the socket of the dead process and wait before it tries again
        Path(self.address.removeprefix("unix:")).unlink(missing_ok=True)

    def rss_mib(self) -> float:
        """Return the resident memory of the process."""
        return resident_mib(self._process.pid)

    def cpu_s(self) -> float:
        """Return the processor time that the process and its children have used."""
        ticks = 0
        for stat in Path("/proc").glob("[0-9]*/stat"):
            # a process may end between two reads
            with contextlib.suppress(OSError):
                fields = stat.read_text().rpartition(")")[2].split()
                if str(self._process.pid) in (stat.parent.name, fields[1]):
                    ticks += sum(map(int, fields[11:13]))
        return ticks / os.sysconf("SC_CLK_TCK")

    def close(self) -> None:
        """End the process."""
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(60)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def start(self, command: str = "") -> float:
        """Start the service, with another command if one is given; returns the time until it serves.

        Raises UnavailableError.
        """
        begin_s = time.monotonic()
        self._command = command or self._command
        with self.log.open("ab") as log:
            arguments = [*shlex.split(self._command), "--listen", self.address]
            self._process = subprocess.Popen(arguments, stderr=log)  # noqa: S603 - the user's own command
        socket = Path(self.address.removeprefix("unix:"))
        while time.monotonic() - begin_s < _START_LIMIT_S and self.is_running:
            # a call to a socket that does not exist yet would wait for a second before it tries again
            if socket.exists() or not self.address.startswith(UNIX):
                with contextlib.suppress(UnavailableError):
                    require_serving(self.address, None)
                    return time.monotonic() - begin_s
            time.sleep(_POLL_S)
        self.close()
        end = self.log.read_text(errors="replace")[-500:]
        raise UnavailableError(f"{self._command}: expected it to start within {_START_LIMIT_S:g} s, got: {end}")
