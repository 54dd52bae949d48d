"""Follow what the server has acknowledged to each agent, and compare a store and a fused map with it."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import astuple, dataclass, field
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np

from gausslite.codec.encoded_voxels import from_records
from gausslite.codec.subset_codec import decode_subset
from gausslite.domain.voxels import VoxelBatch
from gausslite.fusion.score_index import voxel_records
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.vote import FusedMap, fuse
from gausslite_bench.chaos.agent import Record, RecordKind


@dataclass(frozen=True, slots=True)
class StoredVoxel:
    """The content of a voxel after its latest acknowledged update."""

    update_seq: int
    kappa_sum: int
    records: bytes


@dataclass(frozen=True, slots=True)
class StoreComparison:
    """Voxels of all agents: those acknowledged, and of them those that a store has lost or holds with other content.

    extra: voxels of a store that hold another update than the latest acknowledged one, or none was acknowledged.
    """

    voxels: int = 0
    lost: int = 0
    wrong: int = 0
    extra: int = 0


@dataclass(slots=True)
class AgentAcknowledgements:
    """What one agent has sent, and the latest acknowledged content of each voxel."""

    voxels: dict[int, StoredVoxel] = field(default_factory=dict)
    messages: int = 0
    updates: int = 0
    _records: Connection | None = None
    _waiting: dict[int, bytes] = field(default_factory=dict)

    def follow(self, records: Connection) -> None:
        """Follow the records of a new process of this agent, after the last ones of the process before."""
        self.read()
        self._waiting.clear()
        self._records = records

    def read(self) -> None:
        """Note the records that have arrived."""
        # of the last one, a killed process may have written a part only
        with suppress(EOFError, OSError):
            while self._records is not None and self._records.poll():
                self.note(self._records.recv())

    def note(self, record: Record) -> None:
        """Count a message as sent, acknowledged or refused."""
        if record.kind is RecordKind.SENT:
            self._waiting[record.sequence] = record.subset
            return
        # the agent sends what was refused again, in a new message
        message = self._waiting.pop(record.sequence)
        if record.kind is RecordKind.STORED:
            self._acknowledge(message)

    def batch(self) -> VoxelBatch:
        """Return the latest acknowledged content, with tombstones."""
        keys = sorted(self.voxels)
        voxels = [self.voxels[key] for key in keys]
        parts = [from_records(voxel.records) for voxel in voxels]
        return VoxelBatch(
            np.array(keys, np.int64),
            np.array([voxel.kappa_sum for voxel in voxels], np.uint64),
            np.array([len(part) for part in parts], np.uint32),
            from_records(b"".join(voxel.records for voxel in voxels)),
        )

    def _acknowledge(self, message: bytes) -> None:
        subset, _ = decode_subset(message)
        self.messages += 1
        self.updates += len(subset.batch)
        offsets, kappa = subset.batch.offsets, subset.batch.gaussians.kappa
        for i, (key, records) in enumerate(zip(subset.batch.keys.tolist(), voxel_records(subset.batch), strict=True)):
            earlier = self.voxels.get(key)
            if earlier is None or earlier.update_seq < subset.update_seq:
                kappa_sum = int(kappa[offsets[i] : offsets[i + 1]].sum(dtype=np.uint64))
                self.voxels[key] = StoredVoxel(subset.update_seq, kappa_sum, records)


def offline_map(agents: Mapping[str, AgentAcknowledgements]) -> FusedMap:
    """Return the vote over the latest acknowledged content of every agent, without a server or a store."""
    return fuse({agent_id: agent.batch() for agent_id, agent in agents.items() if agent.voxels})


def compare_store(agents: Mapping[str, AgentAcknowledgements], store: Path) -> StoreComparison:
    """Compare a store whose server was killed with what it had acknowledged; the files are copied and not changed."""
    with tempfile.TemporaryDirectory() as folder:
        for path in (store, store.with_name(f"{store.name}-wal")):
            if path.exists():
                shutil.copy(path, folder)
        with closing(SqliteStore(Path(folder) / store.name)) as opened:
            parts = [_compare_agent(agent_id, agent, opened) for agent_id, agent in agents.items()]
    return StoreComparison(*(sum(counts) for counts in zip(*map(astuple, parts), strict=True)))


def _compare_agent(agent_id: str, acknowledged: AgentAcknowledgements, store: SqliteStore) -> StoreComparison:
    batch = store.batch(agent_id)
    seqs = store.scores_of(agent_id, batch.keys)["update_seqs"].tolist()
    held = {
        key: StoredVoxel(seq, kappa_sum, records)
        for key, seq, kappa_sum, records in zip(
            batch.keys.tolist(), seqs, batch.kappa_sums.tolist(), voxel_records(batch), strict=True
        )
    }
    lost = wrong = 0
    for key, expected in acknowledged.voxels.items():
        got = held.get(key)
        if got is None or got.update_seq < expected.update_seq:
            lost += 1
        elif got.update_seq == expected.update_seq and got != expected:
            wrong += 1
    same = sum(held[key].update_seq == voxel.update_seq for key, voxel in acknowledged.voxels.items() if key in held)
    return StoreComparison(len(acknowledged.voxels), lost, wrong, len(held) - same)
