"""Measure where the processor time and the written bytes of a message go, in this process and without gRPC."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gausslite.codec.stored_voxels import StoredSubset
from gausslite.codec.subset_codec import decode_stored, encode_subset
from gausslite.domain.voxels import RoiSubset, VoxelBatch
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store_values import MissionConfig, PutOutcome
from gausslite_bench.server.synthetic_updates import DELTA_VOXELS, GRID, delta_messages, voxels_batch

_AGENTS = 8
_SCATTERED_CELLS = 20_000


@dataclass(frozen=True, slots=True)
class StageResult:
    """Processor time of a message in ms by stage, and its bytes as received and as written, log and file together."""

    group: int
    message_bytes: int
    decode_ms: float
    store_ms: float
    other_ms: float
    written_bytes: int


class _TimedStore(SqliteStore):
    """Adds up the processor time of its transactions."""

    cpu_s = 0.0

    def put_all(self, updates: Sequence[StoredSubset]) -> list[PutOutcome]:
        begin_s = time.process_time()
        try:
            return super().put_all(updates)
        finally:
            self.cpu_s += time.process_time() - begin_s


def measure_stages(group: int, scattered: bool, count: int) -> StageResult:
    """Commit `count` messages of each of 8 agents in groups; scattered: their voxels are anywhere in a large room."""
    names = [f"load-{number}" for number in range(_AGENTS)]
    make = _scattered_messages if scattered else _near_messages
    messages = [make(name, number, count) for number, name in enumerate(names)]
    in_order = [(agent, messages[agent][index]) for index in range(count) for agent in range(_AGENTS)]
    decode_s = -time.process_time()
    for _, message in in_order:
        decode_stored(message)
    decode_s += time.process_time()
    with tempfile.TemporaryDirectory() as folder, closing(_TimedStore(Path(folder) / "store.sqlite")) as store:
        engine = FusionEngine(store, FusionSettings(grid=GRID))
        sessions = [engine.join(name, MissionConfig("", "", GRID.size_m)).session for name in names]
        store.cpu_s, begin_s, begin_bytes = 0.0, time.process_time(), _written_bytes()
        for start in range(0, len(in_order), group):
            puts = [engine.enqueue_update(sessions[agent], data) for agent, data in in_order[start : start + group]]
            engine.commit_updates()
            for put in puts:
                put.result()
        total_s = time.process_time() - begin_s
        written = _written_bytes() - begin_bytes
    total = len(in_order)
    return StageResult(
        group=group,
        message_bytes=len(in_order[0][1]),
        decode_ms=1000 * decode_s / total,
        store_ms=1000 * store.cpu_s / total,
        other_ms=1000 * (total_s - decode_s - store.cpu_s) / total,
        written_bytes=written // total,
    )


def _near_messages(agent_id: str, number: int, count: int) -> list[bytes]:
    return delta_messages(agent_id, number, count, 1)


def _scattered_messages(agent_id: str, number: int, count: int) -> list[bytes]:
    rng = np.random.default_rng(number)
    return [
        encode_subset(RoiSubset(agent_id, "", seq, seq, _scattered_batch(rng)), GRID) for seq in range(1, count + 1)
    ]


def _scattered_batch(rng: np.random.Generator) -> VoxelBatch:
    cells = np.sort(rng.choice(_SCATTERED_CELLS, DELTA_VOXELS, replace=False))
    return voxels_batch(cells, seed=int(rng.integers(1 << 30)))


def _written_bytes() -> int:
    """Return the bytes that this process has written by system calls."""
    lines = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(lines["wchar"])
