"""Say what drawing and walking back cost in cycles of the core."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BlockCost:
    """Core cycles for each time that a splat is composited on a 4x4 block of pixels and walked back over.

    evaluations: of one step. cycles: of all threads together, sorting and binning and waiting for each other included.
    """

    evaluations: int
    clock_ghz: float
    cycles: float

    @classmethod
    def of(cls, evaluations: int, clock_ghz: float, threads: int, stages_ms: Mapping[str, float]) -> BlockCost:
        """From the stages of a step with L1 alone: one pass draws, compares and walks back, and all threads end it
        together. With SSIM the threads do each other's work, and one thread's times tell nothing of the others'.
        """
        busy_ms = threads * stages_ms["raster"]
        return cls(evaluations, clock_ghz, busy_ms * clock_ghz * 1e6 / max(evaluations, 1))
