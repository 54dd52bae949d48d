"""Run a joint refinement on its own thread, and report its progress; judge voxels by the agents' keyframes.

`RefinementWorker` is the default plug-in of the group `gausslite.refiners`; the protocol is `Refiner` of the server.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from threading import Event

from gausslite.domain.errors import QuotaError
from gausslite.fusion.engine import FusionEngine, WorkDone
from gausslite.fusion.refinement import CreateRasterizer, RefineProgress, RefineSettings
from gausslite.process import return_free_memory
from gausslite.wire.views import ChangeNotifier
from gausslite_refinement.refine_input import RefineInput
from gausslite_refinement.refinement import Refinement
from gausslite_refinement.residual_vote import ResidualVote, reduced, spread_of

_log = logging.getLogger(__name__)
_MAX_JUDGED = 300_000  # Gaussians of all maps, which are in memory while they are judged


class RefinementWorker:
    """Runs one refinement at a time. A rasterizer is created when one is needed, since other calls need none."""

    def __init__(self, create_rasterizer: CreateRasterizer) -> None:
        self._create_rasterizer = cache(create_rasterizer)
        self._worker = ThreadPoolExecutor(1, "refine")
        self._busy = False
        self._is_closed = Event()

    def judge(self, engine: FusionEngine) -> WorkDone:
        """Let maps win by their error in the keyframes, if there are any; it waits for a refinement that runs."""
        return self._worker.submit(self._judge, engine, self._is_closed).result()

    def _judge(self, engine: FusionEngine, cancelled: Event) -> WorkDone:
        revision, sources = engine.maps.revision(), engine.store.agents()
        if engine.has_background_work:
            return WorkDone(is_changed=False, is_due=True)
        if engine.store.is_shared or sum(engine.store.totals(name).gaussians for name in sources) > _MAX_JUDGED:
            return WorkDone(is_changed=False, is_due=False)
        names = spread_of(engine.keyframes.pixels())
        vote = ResidualVote({name: engine.maps.union_map(name) for name in sources if names and len(sources) > 1})
        if vote.is_contested:
            frames = [reduced(own.frame) for own in engine.decoded_keyframes(names)]
            for _ in vote.steps(frames, self._create_rasterizer()):
                if cancelled.is_set() or self._is_closed.is_set():
                    return WorkDone(is_changed=False, is_due=True)
        engine.maps.prefer(vote.result())
        return_free_memory()
        return WorkDone(engine.maps.revision() != revision, is_due=False)

    async def run(self, engine: FusionEngine, settings: RefineSettings) -> AsyncIterator[RefineProgress]:
        """Refine the engine's map, yield the latest progress, and store the result. Closing the iterator cancels.

        A slow reader misses some progress, but never the last one. Raises QuotaError if another refinement runs, and
        those of Refinement.
        """
        if self._busy:
            raise QuotaError("refinement: expected one at a time, got a second while one is running")
        self._busy = True
        loop, progress_notifier, cancelled = asyncio.get_running_loop(), ChangeNotifier(), Event()
        latest: list[RefineProgress] = []

        def publish(progress: RefineProgress) -> None:
            latest[:] = [progress]
            progress_notifier.notify()

        def work() -> None:
            self._judge(engine, cancelled)
            if cancelled.is_set():
                return
            vote = RefineInput.of(engine)
            if cancelled.is_set():
                return
            refinement = Refinement(vote, self._create_rasterizer(), settings)
            for line in refinement.left_out:
                _log.warning("refinement: left out, because they disagree with the vote: %s", line)
            for progress in refinement.steps():
                loop.call_soon_threadsafe(publish, progress)
                if cancelled.is_set():
                    return
            engine.store_refined(refinement.result(), vote.revision, refinement.sources)

        future = loop.run_in_executor(self._worker, work)
        future.add_done_callback(lambda _: self._finish(progress_notifier))
        try:
            while not future.done():
                changed = progress_notifier.subscribe()
                while latest:
                    yield latest.pop()
                if not future.done():
                    await changed.wait()
            future.result()
            while latest:
                yield latest.pop()
        finally:
            cancelled.set()

    def close(self) -> None:
        """Wait until the last refinement has ended after its cancellation; end a judgement."""
        self._is_closed.set()
        self._worker.shutdown(wait=True, cancel_futures=True)

    def _finish(self, progress_notifier: ChangeNotifier) -> None:
        self._busy = False
        progress_notifier.notify()
