"""The sub-commands of `gausslite` that this package adds."""

from __future__ import annotations

from typing import Final

from gausslite.plugins import Command

BENCH: Final = Command(
    "measure the rasterizer, the mapping loop, the GPU, map quality or a task parser",
    "gausslite_bench.cli.main",
)
