"""The process of one agent of the chaos run: a map that changes at random, and the agent's own spool and uplink.

It reports each message before it is sent, and each outcome when it arrives, through a pipe to the run: what is in the
pipe survives the end of the process.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from enum import StrEnum
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gausslite.domain.voxels import VoxelBatch, merge_batches, select_voxels, tombstones
from gausslite.wire.clients import FusionClient
from gausslite.wire.spool import Spool
from gausslite.wire.update_sender import UplinkSettings
from gausslite.wire.uplink import Uplink
from gausslite_bench.async_calls import is_stored
from gausslite_bench.server.synthetic_updates import GRID, voxels_batch

_PERIOD_S = 0.05
_AREA_VOXELS = 300
_STEP_VOXELS = 12
_TOMBSTONE_SHARE = 0.1
DRAIN_S = 240.0
_UPLINK = UplinkSettings(interval_s=0.05, deadline_s=20.0, first_backoff_s=0.05, check_interval_s=1.0)
LOG = "agents.log"


class RecordKind(StrEnum):
    """SENT precedes the outcome, which is STORED or REFUSED."""

    SENT = "sent"
    STORED = "stored"
    REFUSED = "refused"


class Record(NamedTuple):
    """A message, or the outcome of the latest message with this sequence number."""

    kind: RecordKind
    sequence: int
    subset: bytes = b""


class _ReportingClient(FusionClient):
    """A fusion client that reports every message before it is sent, and every outcome when it arrives."""

    def __init__(self, address: str, token: str, pipe: Connection) -> None:
        super().__init__(address, token=token)
        self._pipe = pipe

    def contribute(self, requests: Sequence[Any], deadline_s: float) -> Iterator[Any]:
        """Send these subsets, see FusionClient."""
        for request in requests:
            self._pipe.send(Record(RecordKind.SENT, request.sequence, request.subset))
        for response in super().contribute(requests, deadline_s):
            for outcome in response.outcomes:
                kind = RecordKind.STORED if is_stored(outcome) else RecordKind.REFUSED
                self._pipe.send(Record(kind, outcome.sequence))
            yield response


def changed_voxels(rng: np.random.Generator) -> VoxelBatch:
    """Return new content of some neighbouring voxels of the area that all agents share; some of them are empty now."""
    first = int(rng.integers(_AREA_VOXELS - _STEP_VOXELS))
    batch = voxels_batch(range(first, first + _STEP_VOXELS), int(rng.integers(1 << 31)))
    removed = rng.random(len(batch)) < _TOMBSTONE_SHARE
    return merge_batches(select_voxels(batch, ~removed), tombstones(batch.keys[removed]))


def run(agent_id: str, address: str, folder: Path, seed: int, pipe: Connection) -> None:
    """Send changes of this seed until something comes through the pipe; exit with an error if not all is acknowledged.

    The spool and the log of all agents are files in the folder.
    """
    os.dup2(os.open(folder / LOG, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644), 2)
    spool = Spool(folder / f"{agent_id}.spool", agent_id, GRID)
    uplink = Uplink(_ReportingClient(address, spool.token, pipe), agent_id, spool, GRID, _UPLINK)
    rng = np.random.default_rng(seed)
    while not pipe.poll(_PERIOD_S):
        uplink.enqueue(changed_voxels(rng))
    drained, reason = uplink.drain(DRAIN_S), uplink.counters().stopped_because
    uplink.close()
    if not drained:
        raise SystemExit(reason or f"not everything was acknowledged within {DRAIN_S:.0f} s")
