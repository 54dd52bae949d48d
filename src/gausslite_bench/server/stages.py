"""Split the processor time of a message by stage: messages of a load, one after the other, in this process."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
from numpy import ndarray

from gausslite.codec.encoded_voxels import EncodedSubset
from gausslite.codec.subset_codec import unpack_subset
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings, MissionConfig, Quotas
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.update_log import PutOutcome
from gausslite.fusion.updates import MissionClock, UpdateChecks
from gausslite_bench.async_calls import update_request
from gausslite_bench.server.synthetic_updates import GRID, PATCHES, delta_messages


class _TimedStore(SqliteStore):
    cpu_s = 0.0  # of its transactions

    def put_all(self, updates: Sequence[EncodedSubset]) -> list[PutOutcome]:
        begin_s = time.thread_time()
        try:
            return super().put_all(updates)
        finally:
            self.cpu_s += time.thread_time() - begin_s


def stages_ms(agents: int) -> dict[str, float]:
    """Return the processor time of a message in each stage; vote: with the layers of the map, and the queue.

    Each message is committed alone, into a file, when all voxels of all agents are stored.
    """
    names = [f"load-{number}" for number in range(agents)]
    messages = [delta_messages(name, number, 2 * PATCHES, 1) for number, name in enumerate(names)]
    with tempfile.TemporaryDirectory() as folder, closing(_TimedStore(Path(folder) / "store.sqlite")) as store:
        settings = FusionSettings(grid=GRID, quotas=Quotas(agents=agents))
        engine, checks = FusionEngine(store, settings), UpdateChecks(store, settings.quotas, MissionClock(store))
        sessions = [engine.join(name, MissionConfig("", "", GRID.size_m)).session for name in names]
        sent = [own for subsets in zip(*messages, strict=True) for own in zip(sessions, subsets, strict=True)]
        times_s: list[ndarray] = []
        for number, (session, data) in enumerate(sent):
            if 2 * number == len(sent):
                store.cpu_s, times_s = 0.0, []
            request = update_request(session.session_id, number, data)
            received, stamps_s = request.SerializeToString(), [time.thread_time()]
            subset = unpack_subset(request.FromString(received).subset)[0]
            stamps_s.append(time.thread_time())
            checks.require_permitted(subset)
            stamps_s.append(time.thread_time())
            put = engine.enqueue_update(session, subset)
            engine.commit_updates()
            assert len(put.result().accepted)
            times_s.append(np.diff([*stamps_s, time.thread_time()]))
        decode, check, commit = (1000 * np.mean(times_s, axis=0)).tolist()
        in_store = 1000 * store.cpu_s / len(times_s)
    return {"decode": decode, "check": check, "store": in_store, "vote": commit - check - in_store}
