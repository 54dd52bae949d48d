"""Check what a run takes from the machine: memory, disk, clock and ports."""

from __future__ import annotations

import math
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import gausslite
from gausslite.cli.doctor.check import Check, Status
from gausslite.wire.address import AGENT_ADDRESS, FUSION_ADDRESS, PARSER_ADDRESS

_GIB = 1 << 30
_MEMORY_LOW_BYTES, _MEMORY_TOO_LOW_BYTES = 2 * _GIB, _GIB // 2
_DISK_LOW_BYTES, _DISK_TOO_LOW_BYTES = 2 * _GIB, _GIB // 10
_CLOCK_TOLERANCE_S = 2.0
_CONTROL_GROUP = Path("/sys/fs/cgroup")
_SERVICES = {
    "gausslite-parser": PARSER_ADDRESS,
    "gausslite-fusion-server": FUSION_ADDRESS,
    "gausslite-agent": AGENT_ADDRESS,
}


def machine_checks(out: Path) -> Iterator[Check]:
    """Yield the checks of the machine. out: the folder in which runs write; it need not exist."""
    yield _python()
    yield _memory()
    yield from _disk_and_clock(_existing(out))
    for program, address in _SERVICES.items():
        yield _port(program, address)


def _python() -> Check:
    return Check("python", "ok", f"{sys.version.split()[0]} at {sys.executable}")


def _memory() -> Check:
    available = _available_memory_bytes()
    if available is None:
        return Check("memory", "warning", "the system does not state it", "Check that 2 GiB are free")
    advice = "End other programs, or map with a smaller --size and --max-gaussians"
    status = _level(available, _MEMORY_LOW_BYTES, _MEMORY_TOO_LOW_BYTES)
    return Check("memory", status, f"{available / _GIB:.1f} GiB available", advice if status != "ok" else "")


def _available_memory_bytes() -> int | None:
    """Return what the process can still allocate: of the machine, and of its control group (version 2)."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
        [available_kib] = [int(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    except (OSError, ValueError):
        return None
    try:
        limit, used = ((_CONTROL_GROUP / name).read_text().strip() for name in ("memory.max", "memory.current"))
        remaining = math.inf if limit == "max" else int(limit) - int(used)
    except (OSError, ValueError):
        remaining = math.inf
    return int(max(0, min(available_kib << 10, remaining)))


def _existing(folder: Path) -> Path:
    """Return the folder or its nearest existing parent, in which it would be created."""
    absolute = folder.absolute()
    return next(each for each in (absolute, *absolute.parents) if each.exists())


def _disk_and_clock(folder: Path) -> Iterator[Check]:
    advice = "Free some space, or choose another folder with --out"
    if not folder.is_dir():
        yield Check("disk", "error", f"{folder} is not a folder", advice)
        return
    free = shutil.disk_usage(folder).free
    status = _level(free, _DISK_LOW_BYTES, _DISK_TOO_LOW_BYTES)
    try:
        with tempfile.NamedTemporaryFile(dir=folder, prefix=".gausslite-doctor-") as file:
            file.write(b"\0")
            file.flush()
            lead_s = time.time() - Path(file.name).stat().st_mtime
    except OSError as error:
        yield Check("disk", "error", f"{folder}: {error.strerror}", advice)
        return
    yield Check("disk", status, f"{free / _GIB:.1f} GiB free in {folder}", advice if status != "ok" else "")
    yield _clock(lead_s)


def _clock(lead_s: float) -> Check:
    """Compare the clock with the time stamps of files. lead_s: clock minus the stamp of a file just written."""
    installed_s = Path(gausslite.__file__).stat().st_mtime
    if time.time() < installed_s - _CLOCK_TOLERANCE_S:
        finding = "the clock is earlier than the installation of GaussLite"
        return Check("clock", "error", finding, "Set the clock, for example with: timedatectl set-ntp true")
    if abs(lead_s) > _CLOCK_TOLERANCE_S:
        finding = f"the clock and the file system differ by {abs(lead_s):.1f} s"
        return Check("clock", "warning", finding, "Synchronise the clocks of this machine and of its file server")
    if not time.get_clock_info("monotonic").monotonic:
        return Check("clock", "error", "the system has no monotonic clock", "Deadlines cannot be kept on this system")
    return Check("clock", "ok", time.strftime("%Y-%m-%d %H:%M:%S UTC, as the file system", time.gmtime()))


def _port(program: str, address: str) -> Check:
    """Check that the default port is free, by taking it for a moment; nothing is sent."""
    host, _, port = address.rpartition(":")
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, int(port)))
        except OSError as error:
            advice = f"Another program listens there, perhaps a {program}; start a further one with --listen HOST:PORT"
            return Check(f"port {port}", "warning", f"{program}: {error.strerror}", advice)
    return Check(f"port {port}", "ok", f"free for {program}")


def _level(amount: float, low: float, too_low: float) -> Status:
    return "ok" if amount >= low else "warning" if amount >= too_low else "error"
