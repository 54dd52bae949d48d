"""Growth of the process's memory over a long run."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gausslite.domain.errors import InvalidInputError, UnavailableError


@dataclass(frozen=True, slots=True)
class MemoryTrend:
    """Resident memory after the first, the middle and the last frame, and its growth.

    The growth is the slope of a line fitted to the second half of the run, when the keyframe buffers are full.
    """

    start_mib: float
    middle_mib: float
    end_mib: float
    mib_per_1000_frames: float

    @classmethod
    def of(cls, samples_mib: Sequence[float], sample_interval_frames: int) -> MemoryTrend:
        """Return the trend of samples at this interval. Raises InvalidInputError for fewer than two."""
        if len(samples_mib) < 2:
            raise InvalidInputError(f"memory samples: expected at least 2, got {len(samples_mib)}")
        middle = len(samples_mib) // 2
        half = np.asarray(samples_mib[-max(2, len(samples_mib) - middle) :])
        slope = float(np.polyfit(np.arange(len(half)), half, 1)[0]) / sample_interval_frames
        return cls(samples_mib[0], samples_mib[middle], samples_mib[-1], 1000.0 * slope)


def resident_mib(process_id: int | None = None) -> float:
    """Return the resident memory of a process in MiB, by default of this one.

    Raises UnavailableError if the process has ended, and on systems without /proc.
    """
    path = Path("/proc", "self" if process_id is None else str(process_id), "statm")
    pages = int(path.read_text().split()[1]) if path.exists() else 0
    if pages == 0:
        raise UnavailableError(f"memory: expected a running process and a Linux system with {path}")
    return pages * os.sysconf("SC_PAGE_SIZE") / (1 << 20)


def back_and_forth(frames: int, count: int) -> list[int]:
    """Return `count` positions that traverse a sequence forward and backward, so that the motion is continuous."""
    if frames < 2:
        return [0] * count
    period = 2 * (frames - 1)
    return [min(step % period, period - step % period) for step in range(count)]
