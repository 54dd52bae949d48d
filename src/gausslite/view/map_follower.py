"""Follow the map of a service on a thread of its own; it keeps the newest state for the page."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from gausslite.domain.errors import GaussLiteError
from gausslite.domain.voxel_batch import VoxelBatch
from gausslite.domain.voxel_operations import empty_batch
from gausslite.view.contents import NO_AGENT, ViewContents
from gausslite.wire.convert import MapUpdate

_RETRY_S = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class FollowedMap:
    """A service's map at one revision. winners: the agent of each voxel, by key; empty for the map of one agent."""

    revision: int
    batch: VoxelBatch
    winners: dict[int, str]

    def contents(self, targets: dict[str, tuple[str, ...]]) -> ViewContents:
        """Return the map for the page. targets: the target nouns of the task of each agent of the mission.

        The `target` of a Gaussian counts within its agent's task; here it gets an index into the nouns of all tasks.
        """
        agents = tuple(sorted({*self.winners.values(), *targets}))
        nouns = tuple(dict.fromkeys(noun for agent in agents for noun in targets.get(agent, ())))
        by_voxel = [
            agents.index(self.winners[key]) if key in self.winners else NO_AGENT for key in self.batch.keys.tolist()
        ]
        agent = np.repeat(np.array(by_voxel, np.int64), self.batch.counts)
        gaussians = self.batch.gaussians
        target = np.full(len(gaussians), -1, np.int16)
        for index, name in enumerate(agents):
            for number, noun in enumerate(targets.get(name, ())):
                target[(agent == index) & (gaussians.target == number)] = nouns.index(noun)
        return ViewContents(replace(gaussians, target=target), agent, agents, nouns)


class MapFollower:
    """Owns the thread that reads a map's updates, and connects again after an error."""

    def __init__(self, watch: Callable[[], Iterator[MapUpdate]]) -> None:
        self._watch = watch
        self._lock = threading.Lock()
        self._newest: FollowedMap | None = None
        self._stopped = threading.Event()
        self._thread = threading.Thread(target=self._run, name="map-follower", daemon=True)
        self._thread.start()

    def newest(self) -> FollowedMap | None:
        """Return the newest complete revision, None before the first."""
        with self._lock:
            return self._newest

    def close(self) -> None:
        """End the thread. Close the client first, which ends its wait for updates."""
        self._stopped.set()
        self._thread.join(_RETRY_S)

    def _run(self) -> None:
        while not self._stopped.is_set():
            try:
                self._follow()
            except (GaussLiteError, ValueError):  # ValueError: the channel has been closed
                self._stopped.wait(_RETRY_S)

    def _follow(self) -> None:
        batch, winners = empty_batch(), dict[int, str]()
        for update in self._watch():
            if update.snapshot and update.first:
                winners = {}
            batch = update.apply_to(batch)
            if update.batch is not None and update.winners:
                winners.update(zip(update.batch.keys.tolist(), update.winners, strict=True))
            if update.last:
                with self._lock:
                    self._newest = FollowedMap(update.revision, batch, dict(winners))
            if self._stopped.is_set():
                return
