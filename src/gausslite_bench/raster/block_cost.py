"""Cost of compositing and its backward pass in CPU core cycles."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BlockCost:
    """Core cycles per block evaluation: compositing one splat on a 4x4 pixel block, forward and backward.

    evaluations: block evaluations of one step. cycles: sum over all threads, including sorting, binning and waiting.
    """

    evaluations: int
    clock_ghz: float
    cycles: float

    @classmethod
    def of(cls, evaluations: int, clock_ghz: float, threads: int, stages_ms: Mapping[str, float]) -> BlockCost:
        """Return the cost from the stage times of a step with L1 only.

        That step composites, computes the loss and runs backward in one pass that all threads end together. With SSIM
        the threads share work, so the times of one thread do not represent the others.
        """
        busy_ms = threads * stages_ms["raster"]
        return cls(evaluations, clock_ghz, busy_ms * clock_ghz * 1e6 / max(evaluations, 1))
