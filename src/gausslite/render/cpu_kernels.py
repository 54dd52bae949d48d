"""The compiled kernels: found when first needed, and what of the machine they shall use."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

from gausslite.errors import KernelError

SIMD_VARIABLE = "GAUSSLITE_SIMD"
MAX_THREADS = 256
_CPU_LIMIT = Path("/sys/fs/cgroup/cpu.max")
"""Of control groups, version 2: microseconds in a period, or `max`."""


def usable_simd() -> tuple[str, ...]:
    """Instruction sets this build has and this machine runs, fastest first. Raises KernelError."""
    return tuple(load_kernels().usable_simd())


def core_clock_ghz() -> float:
    """The clock of the core that this runs on, measured in a millisecond or two. Raises KernelError."""
    clock_ghz: float = load_kernels().core_clock_ghz()
    return clock_ghz


def load_kernels() -> Any:
    """The extension module. Raises KernelError when it is not built for this Python."""
    try:
        from gausslite.render import _kernels
    except ImportError as reason:
        raise KernelError(
            f"native kernels: not built for this Python; install the package again ({reason})"
        ) from reason
    return _kernels


def choose_simd(asked: str | None) -> str:
    """The instruction set asked for here or in the environment, else the fastest. Raises KernelError."""
    usable = usable_simd()
    chosen = asked or os.environ.get(SIMD_VARIABLE) or usable[0]
    if chosen not in usable:
        source = "simd" if asked else SIMD_VARIABLE
        raise KernelError(f"{source}: expected one of {', '.join(usable)} on this machine, got {chosen}")
    return chosen


def cores_allowed(limit: Path = _CPU_LIMIT) -> int:
    """How many cores' time a container may spend (`docker run --cpus`), rounded up; MAX_THREADS where none is told."""
    try:
        quota, period = limit.read_text().split()
        return max(1, math.ceil(int(quota) / int(period)))
    except (OSError, ValueError, ZeroDivisionError):
        return MAX_THREADS


def choose_threads(asked: int | None) -> int:
    """How many threads: as asked, else one per core this process may use. Raises KernelError.

    Threads beyond the cores would cost far more than they bring: each stage waits for the last of them.
    """
    if asked is None:
        available = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        return min(available, cores_allowed(), MAX_THREADS)
    if not 1 <= asked <= MAX_THREADS:
        raise KernelError(f"threads: expected 1 to {MAX_THREADS}, got {asked}")
    return asked
