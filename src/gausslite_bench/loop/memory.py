"""Tell whether a long run needs ever more memory: what the process holds, sampled along the way."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gausslite.errors import InvalidInputError

_STATM = Path("/proc/self/statm")


@dataclass(frozen=True, slots=True)
class MemoryTrend:
    """Resident memory after the first, the middle and the last frame, and how it grows.

    The slope is a straight line's through the second half of the run, when keyframe buffers are full.
    """

    start_mib: float
    middle_mib: float
    end_mib: float
    mib_per_1000_frames: float

    @classmethod
    def of(cls, samples_mib: Sequence[float], frames_apart: int) -> MemoryTrend:
        """From samples taken every so many frames. Raises InvalidInputError for fewer than two."""
        if len(samples_mib) < 2:
            raise InvalidInputError(f"memory samples: expected at least 2, got {len(samples_mib)}")
        middle = len(samples_mib) // 2
        half = np.asarray(samples_mib[-max(2, len(samples_mib) - middle) :])
        slope = float(np.polyfit(np.arange(len(half)), half, 1)[0]) / frames_apart
        return cls(samples_mib[0], samples_mib[middle], samples_mib[-1], 1000.0 * slope)


def resident_mib() -> float:
    """What the process holds in memory now, in MiB. Raises InvalidInputError where the system does not tell."""
    try:
        pages = int(_STATM.read_text().split()[1])
    except OSError as error:
        raise InvalidInputError(f"memory: expected a Linux system with {_STATM}, got {error.strerror}") from error
    return pages * os.sysconf("SC_PAGE_SIZE") / (1 << 20)


def back_and_forth(frames: int, wanted: int) -> list[int]:
    """Positions of `wanted` frames of a sequence, played forward and backward in turns so that motion goes on."""
    if frames < 2:
        return [0] * wanted
    turn = 2 * (frames - 1)
    return [min(step % turn, turn - step % turn) for step in range(wanted)]
