"""Start a fusion server as its own process, and read its time to start and its memory."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

from gausslite.domain.errors import UnavailableError
from gausslite.wire.clients import FusionClient
from gausslite_bench.loop.memory import resident_mib

DEFAULT_COMMAND = f"{shlex.quote(sys.executable)} -m gausslite_fusion_server"
_START_LIMIT_S = 300.0
_POLL_S = 0.02


def process_cpu_s(pid: int) -> float:
    """Return the processor time that a process has used."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return sum(map(int, fields[11:13])) / os.sysconf("SC_CLK_TCK")


class ServerProcess:
    """Owns the process of a server on a store, and appends what it logs to a file.

    The server runs with its default options, but for those in the command.
    """

    def __init__(self, command: str, folder: Path, store: str, shares: bool = False, peer: str = "") -> None:
        """store: sqlite, memory, or the address of a database, which the server may share with others.

        peer: where the others reach it, by default at its address.
        """
        self._command, self._store = command, str(folder / "store.sqlite") if store == "sqlite" else store
        self.address = f"unix:{folder}/fusion.sock"
        peer = peer or (self.address if shares else "")
        self._more = ["--set", f"peer-address={peer}", "--metrics", "127.0.0.1:0"] if peer else []
        self.log = folder / "fusion.log"
        self.start()

    @property
    def pid(self) -> int:
        """The id of the process."""
        return self._process.pid

    @property
    def is_running(self) -> bool:
        """False after the process has ended."""
        return self._process.poll() is None

    def restart(self) -> float:
        """End the server as a service manager does and start it again; returns the time until it is ready."""
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

    def counters(self) -> dict[str, int]:
        """Return the counters of a server that shares a mission, by name."""
        url = re.findall(r"metrics on (\S+)", self.log.read_text())[-1]
        with urllib.request.urlopen(url, timeout=60) as page:  # noqa: S310 - the server's own address
            found = re.findall(r"^gausslite_fusion_(\w+)_total{.*} (\S+)$", page.read().decode(), re.MULTILINE)
        return {name: int(float(value)) for name, value in found}

    def close(self) -> None:
        """End the process."""
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(60)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def start(self, command: str = "") -> float:
        """Start the server, with another command if one is given; returns the time until it is ready.

        Raises UnavailableError.
        """
        begin_s = time.monotonic()
        self._command = command or self._command
        arguments = [*shlex.split(self._command), "--listen", self.address, "--store", self._store, *self._more]
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(arguments, stderr=log)  # noqa: S603 - the user's own command
        socket = Path(self.address.removeprefix("unix:"))
        while time.monotonic() - begin_s < _START_LIMIT_S and self._process.poll() is None:
            # a call to a socket that does not exist yet would wait for a second before it tries again
            if socket.exists():
                try:
                    with FusionClient(self.address, deadline_s=5.0) as client:
                        client.status()
                except UnavailableError:
                    pass
                else:
                    return time.monotonic() - begin_s
            time.sleep(_POLL_S)
        self.close()
        raise UnavailableError(f"server: expected it to start within {_START_LIMIT_S:g} s ({self._command})")
