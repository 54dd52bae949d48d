"""`gausslite doctor`: check the machine and the installation, one line for each part, without network access."""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import Distribution, PackageNotFoundError, distribution, version
from importlib.util import find_spec
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

import gausslite
from gausslite.config.values import read_path
from gausslite.domain.errors import KernelError, ModelFileError
from gausslite.plugins import Group, find
from gausslite.process import printable
from gausslite.render.choose import choose_with_reason
from gausslite.render.cpu import SIMD_VARIABLE, choose_simd, choose_threads, cores_allowed, usable_simd
from gausslite.wire.channel import AGENT_ADDRESS, FUSION_ADDRESS, PARSER_ADDRESS

if TYPE_CHECKING:
    from gausslite_detectors.models import ModelEntry

Status = Literal["ok", "warning", "error"]


@dataclass(frozen=True, slots=True)
class Check:
    """One line of `gausslite doctor`. advice: one sentence of what to do; empty if nothing needs to be done."""

    name: str
    status: Status
    finding: str
    advice: str = ""

    def line(self) -> str:
        """Return the check as one line of text."""
        return f"{self.status:8} {self.name:18} {self.finding}{f'. {self.advice}' if self.advice else ''}"


_PROJECT = "gausslite"
_REINSTALL = "Install it with `pip install .` in that tree"


def extra_checks() -> Iterator[Check]:
    """Yield one check for the required packages and one for each extra."""
    try:
        installed = distribution(_PROJECT)
    except PackageNotFoundError:
        yield Check("package", "error", "gausslite runs from a source tree that is not installed", _REINSTALL)
        return
    yield _required(installed)
    names = sorted(installed.metadata.get_all("Provides-Extra") or ())
    extras = {name: _requirements(installed, name) for name in names}
    absent = [name for name in names if not all(map(_installed_version, extras[name]))]
    for name in names:
        if name not in absent:
            yield _extra(name, extras[name])
    if absent:
        finding = f"not installed: {', '.join(absent)}"
        yield Check("extras", "ok", finding, f"Each adds a function: pip install '{_PROJECT}[NAME]' adds its packages")


def _required(installed: Distribution) -> Check:
    faulty = [requirement for requirement in _requirements(installed, "") if _fault(requirement)]
    if faulty:
        return Check("package", "error", "; ".join(map(_fault, faulty)), _repair(faulty))
    return Check("package", "ok", f"gausslite {installed.version} with all required packages")


def _extra(extra: str, requirements: list[Requirement]) -> Check:
    name, faulty = f"extra {extra}", [requirement for requirement in requirements if _fault(requirement)]
    if faulty:
        return Check(name, "warning", "; ".join(map(_fault, faulty)), _repair(faulty))
    packages = sorted({f"{requirement.name} {_installed_version(requirement)}" for requirement in requirements})
    return Check(name, "ok", ", ".join(packages))


def _repair(faulty: list[Requirement]) -> str:
    """Return the command that installs what is required; the packages are those of an index, GaussLite is not."""
    wanted = " ".join(f"'{requirement.name}{requirement.specifier}'" for requirement in faulty)
    return f"Repair it with: pip install {wanted}"


def _requirements(installed: Distribution, extra: str) -> list[Requirement]:
    """Return what the extra adds, extras that it contains included; for an empty name what is always required."""
    found = []
    for text in installed.requires or ():
        requirement = Requirement(text)
        is_added = requirement.marker is None or requirement.marker.evaluate({"extra": extra})
        is_always = requirement.marker is None or requirement.marker.evaluate({"extra": ""})
        if not is_added or (extra and is_always):
            continue
        if canonicalize_name(requirement.name) == _PROJECT:
            found += [nested for part in sorted(requirement.extras) for nested in _requirements(installed, part)]
        else:
            found.append(requirement)
    return found


def _installed_version(requirement: Requirement) -> str | None:
    try:
        return version(requirement.name)
    except PackageNotFoundError:
        return None


def _fault(requirement: Requirement) -> str:
    """Return why the installed package does not meet the requirement; empty if it does."""
    found = _installed_version(requirement)
    if found is None:
        return f"{requirement.name} is missing"
    if not requirement.specifier.contains(found, prereleases=True):
        return f"{requirement.name}: expected {requirement.specifier}, got {found}"
    return ""


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
    yield Check("python", "ok", f"{sys.version.split()[0]} at {sys.executable}")
    yield _memory()
    yield from _disk_and_clock(_existing(out))
    for program, address in _SERVICES.items():
        yield check_port(program, address)


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
    return next(parent for parent in (absolute, *absolute.parents) if parent.exists())


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
    yield check_clock(lead_s)


def check_clock(lead_s: float) -> Check:
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


def check_port(program: str, address: str) -> Check:
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


def model_checks(folder: Path) -> Iterator[Check]:
    """Yield a check for each model file in the folder, ONNX files read completely and opened, or one for none."""
    if find_spec("gausslite_detectors") is None:
        yield Check("models", "ok", "the package gausslite_detectors, which reads them, is not installed")
        return
    from gausslite_detectors.models import CATALOGUE, READER

    present = [entry for entry in CATALOGUE if (folder / entry.file_name).exists()]
    for entry in present:
        yield _model(entry, folder / entry.file_name)
    if not present:
        advice = f"For --detector, {READER.advice()}; `gausslite models list` lists others"
        yield Check("models", "ok", f"no model files in {folder}", advice)


def _model(entry: ModelEntry, path: Path) -> Check:
    from gausslite_detectors.model_file import require_listed_checksum
    from gausslite_detectors.models import inspect

    name = f"model {entry.name}"
    try:
        if path.suffix == ".onnx":
            return Check(name, "ok", f"{path}: {inspect(path).family}")
        require_listed_checksum(path)
        return Check(name, "ok", f"{path}: {path.stat().st_size} bytes")
    except ModelFileError as error:
        return Check(name, "error", str(error), f"Make it again: gausslite models source {entry.name}")


_DRIVER_FOLDER = Path("/proc/driver/nvidia")
_RASTERIZER_CHECKS_REINSTALL = "Install GaussLite again with this Python, from its wheel or its folder"


def rasterizer_checks() -> Iterator[Check]:
    """Yield the checks of the rasterizer backends."""
    yield _instruction_sets()
    yield _threads()
    yield _gpu()
    torch = _installed_version(Requirement("torch"))
    yield Check("torch", "ok", torch or "not installed; only the backend cuda needs it")
    yield _backend()


def _instruction_sets() -> Check:
    try:
        usable = usable_simd()
    except KernelError as error:
        return Check("cpu", "error", str(error), _RASTERIZER_CHECKS_REINSTALL)
    try:
        chosen = choose_simd(None)
    except KernelError as error:
        return Check("cpu", "error", str(error), f"Unset {SIMD_VARIABLE}")
    finding = f"the kernels can use {', '.join(usable)}; they use {chosen}"
    if chosen == "portable":
        advice = "Mapping is several times faster on a CPU with AVX2, AVX-512 or NEON"
        return Check("cpu", "warning", finding, advice if usable[0] == chosen else f"Unset {SIMD_VARIABLE}")
    return Check("cpu", "ok", finding)


def _threads() -> Check:
    cores, allowed = os.cpu_count() or 1, cores_allowed()
    threads = choose_threads(None)
    limit = f", container limit {allowed}" if allowed < cores else ""
    finding = f"{threads} by default; the machine has {cores} cores{limit}"
    if threads == 1:
        return Check("threads", "warning", finding, "Give the process at least 2 cores for real-time mapping")
    return Check("threads", "ok", finding)


def _gpu() -> Check:
    models = []
    for information in sorted(_DRIVER_FOLDER.glob("gpus/*/information")):
        lines = information.read_text(errors="replace").splitlines()
        models += [line.partition(":")[2].strip() for line in lines if line.startswith("Model:")]
    if models:
        return Check("gpu", "ok", ", ".join(models))
    cuda = find(Group.RASTERIZERS, "cuda")
    if cuda is not None and cuda.has_driver():
        return Check("gpu", "ok", "an NVIDIA driver is present; it does not state the model")
    return Check("gpu", "ok", "no NVIDIA GPU; none is needed")


def _backend() -> Check:
    try:
        rasterizer, reason = choose_with_reason()
    except KernelError as error:
        return Check("rasterizer", "error", str(error), _RASTERIZER_CHECKS_REINSTALL)
    return Check("rasterizer", "ok", f"backend {rasterizer.name}, because {reason}")


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the options of `gausslite doctor`."""
    parser.epilog = "Exit code: 0 if no line is an error, else 1. No data leaves the machine."
    for flag, default, purpose in (("--folder", "models", "model files"), ("--out", ".", "results of runs")):
        help_text = f"folder of the {purpose} (default: %(default)s)"
        parser.add_argument(flag, metavar="DIR", type=read_path, default=Path(default), help=help_text)
    parser.add_argument("--json", action="store_true", help="print JSON for scripts")
    parser.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the checks. Returns 1 if one is an error, else 0."""
    checks = []
    parts = machine_checks(options.out), rasterizer_checks(), model_checks(options.folder), extra_checks()
    for check in chain(*parts):
        checks.append(check)
        if not options.json:
            print(printable(check.line()), flush=True)
    has_error = any(check.status == "error" for check in checks)
    if options.json:
        print(json.dumps({"ok": not has_error, "checks": [asdict(check) for check in checks]}))
    return int(has_error)
