"""Settings and progress of what refines the fused map, a plug-in of `gausslite.refiners`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from gausslite.config.option import option
from gausslite.fusion.limits import MAX_REFINE_ITERATIONS
from gausslite.render.rasterizer import Rasterizer

CreateRasterizer = Callable[[], Rasterizer]
"""Creates the rasterizer when it is needed: most servers need no kernels."""


@dataclass(frozen=True, slots=True)
class RefineSettings:
    """Length and limits of a refinement. It keeps the map's Gaussians, at most max_gaussians.

    Every check_every iterations, held-out keyframes judge the map.
    """

    iterations: int = option(
        0,
        "most iterations of joint refinement if a request states none; 0: by the map's size",
        key="refine-iterations",
        low=0,
        high=MAX_REFINE_ITERATIONS,
    )
    max_gaussians: int = 3_000_000
    seed: int = 0
    report_every: int = 10
    check_every: int = 50
    max_prepared_views: int = 96  # views in memory at a time


@dataclass(frozen=True, slots=True)
class RefineProgress:
    """The state of a refinement after `iteration` of `iterations`."""

    iteration: int
    iterations: int
    loss: float
    gaussians: int
    left_out: tuple[str, ...]  # agents whose keyframes disagree with the vote, and how many of them
