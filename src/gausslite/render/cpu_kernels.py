"""Load the compiled kernels, and choose the instruction set and the number of threads."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

from gausslite.domain.errors import KernelError

SIMD_VARIABLE = "GAUSSLITE_SIMD"
MAX_THREADS = 256
_CPU_LIMIT = Path("/sys/fs/cgroup/cpu.max")
"""CPU limit of a control group (version 2): microseconds per period, or `max`."""


def usable_simd() -> tuple[str, ...]:
    """Return the instruction sets of this build that this machine runs, fastest first. Raises KernelError."""
    return tuple(load_kernels().usable_simd())


def core_clock_ghz() -> float:
    """Measure the clock of the current core, in 1 to 2 ms. Raises KernelError."""
    clock_ghz: float = load_kernels().core_clock_ghz()
    return clock_ghz


def load_kernels() -> Any:
    """Return the extension module. Raises KernelError if it is not built for this Python."""
    try:
        from gausslite.render import _kernels
    except ImportError as reason:
        raise KernelError(
            f"native kernels: not built for this Python; install the package again ({reason})"
        ) from reason
    return _kernels


def choose_simd(requested: str | None) -> str:
    """Return the requested instruction set, else the one of the environment, else the fastest. Raises KernelError."""
    usable = usable_simd()
    chosen = requested or os.environ.get(SIMD_VARIABLE) or usable[0]
    if chosen not in usable:
        source = "simd" if requested else SIMD_VARIABLE
        raise KernelError(f"{source}: expected one of {', '.join(usable)} on this machine, got {chosen}")
    return chosen


def cores_allowed(limit: Path = _CPU_LIMIT) -> int:
    """Return the container's CPU limit in cores (`docker run --cpus`), rounded up; MAX_THREADS without a limit."""
    try:
        quota, period = limit.read_text().split()
        return max(1, math.ceil(int(quota) / int(period)))
    except (OSError, ValueError, ZeroDivisionError):
        return MAX_THREADS


def choose_threads(requested: int | None) -> int:
    """Return the requested number of threads, else one per core that the process may use. Raises KernelError.

    More threads than cores slow all stages down: each stage waits for its last thread.
    """
    if requested is None:
        available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        return min(available, cores_allowed(), MAX_THREADS)
    if not 1 <= requested <= MAX_THREADS:
        raise KernelError(f"threads: expected 1 to {MAX_THREADS}, got {requested}")
    return requested
