"""Say what drawing and walking back cost in cycles of the core, beside what their arithmetic alone must take."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

FLOOR_CYCLES = 34.0
"""Cycles that the arithmetic of one block evaluation keeps an AVX-512 core busy: 14 to draw, 20 to walk back."""

_PASSES = ("raster", "backward")
"""The stages that evaluate blocks; sorting and binning are inside the first."""


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
        """From the times of a step's stages."""
        busy_ms = threads * sum(stages_ms[name] for name in _PASSES)
        return cls(evaluations, clock_ghz, busy_ms * clock_ghz * 1e6 / max(evaluations, 1))

    @property
    def floor_share(self) -> float:
        """The arithmetic floor as a fraction of what it took: 1 would be arithmetic and nothing else."""
        return FLOOR_CYCLES / self.cycles if self.cycles > 0 else 0.0
