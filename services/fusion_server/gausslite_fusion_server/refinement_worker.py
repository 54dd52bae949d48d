"""Run a joint refinement in a thread of its own, and tell how far it is."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from threading import Event

from gausslite.errors import QuotaError
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.joint_refinement import RefineProgress, RefineSettings, refine
from gausslite.fusion.limits import MAX_REFINE_ITERATIONS
from gausslite.render.rasterizer import Rasterizer
from gausslite.wire.change_notifier import ChangeNotifier


@dataclass(frozen=True, slots=True)
class RefineRequest:
    """What a client asked for; 0 = the server's own setting."""

    iterations: int = 0
    max_gaussians: int = 0
    seed: int = 0


class RefinementWorker:
    """Refines one map at a time. A rasterizer is chosen when a refinement starts, so that others need none."""

    def __init__(self, settings: RefineSettings, choose_rasterizer: Callable[[], Rasterizer]) -> None:
        self._settings = settings
        self._choose_rasterizer = choose_rasterizer
        self._worker = ThreadPoolExecutor(1, "refine")
        self._busy = False

    async def run(self, team: FusionEngine, order: RefineRequest) -> AsyncIterator[RefineProgress]:
        """Refine, yielding the latest progress; the refined map is kept once this ends. Closing it cancels.

        A slow reader misses steps, never the end. Raises QuotaError when one is running, and what `refine` raises.
        """
        settings = self._settings_for(order)
        if self._busy:
            raise QuotaError("refinement: expected one at a time, got a second while one is running")
        self._busy = True
        loop, bell, cancelled = asyncio.get_running_loop(), ChangeNotifier(), Event()
        latest: list[RefineProgress] = []

        def publish(progress: RefineProgress) -> None:
            latest[:] = [progress]
            bell.notify()

        def go_on(progress: RefineProgress) -> bool:
            loop.call_soon_threadsafe(publish, progress)
            return not cancelled.is_set()

        def work() -> None:
            gaussians, keyframes, revision = team.to_refine()
            refined = refine(gaussians, keyframes, self._choose_rasterizer(), settings, go_on)
            if not cancelled.is_set():
                team.keep_refined(refined, revision)

        future = loop.run_in_executor(self._worker, work)
        future.add_done_callback(lambda _: self._rest(bell))
        try:
            while not future.done():
                ticket = bell.subscribe()
                while latest:
                    yield latest.pop()
                if not future.done():
                    await ticket.wait()
            future.result()
            while latest:
                yield latest.pop()
        finally:
            cancelled.set()

    def close(self) -> None:
        """Wait for the last refinement to notice that it was cancelled."""
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _settings_for(self, order: RefineRequest) -> RefineSettings:
        if order.iterations > MAX_REFINE_ITERATIONS:
            raise QuotaError(f"refine iterations: expected at most {MAX_REFINE_ITERATIONS}, got {order.iterations}")
        own = self._settings
        return replace(
            own,
            iterations=order.iterations or own.iterations,
            max_gaussians=min(order.max_gaussians or own.max_gaussians, own.max_gaussians),
            seed=order.seed,
        )

    def _rest(self, bell: ChangeNotifier) -> None:
        self._busy = False
        bell.notify()
