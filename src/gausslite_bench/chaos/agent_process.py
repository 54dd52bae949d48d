"""The process of one agent: a map that changes at random, and the agent's own spool and uplink.

`python -m gausslite_bench.chaos.agent_process ARGUMENTS`, those of `run` as JSON. The process sends until its standard
input ends. Then it drains the uplink and prints one line of JSON.
"""

from __future__ import annotations

import json
import sys
import threading
from pathlib import Path
from typing import TextIO

import numpy as np

from gausslite.domain.voxels import VoxelBatch, merge_batches, select_voxels, tombstones
from gausslite.wire.spool import Spool
from gausslite.wire.update_sender import UplinkSettings
from gausslite.wire.uplink import Uplink
from gausslite_bench.chaos.journal import Journal, JournalingClient
from gausslite_bench.server.synthetic_updates import GRID, voxels_batch

_PERIOD_S = 0.05
_AREA_VOXELS = 300
_STEP_VOXELS = 12
_TOMBSTONE_SHARE = 0.1
DRAIN_S = 240.0
_UPLINK = UplinkSettings(interval_s=0.05, deadline_s=20.0, first_backoff_s=0.05, check_interval_s=1.0)


def changed_voxels(rng: np.random.Generator) -> VoxelBatch:
    """Return new content of some neighbouring voxels of the area that all agents share; some of them are empty now."""
    first = int(rng.integers(_AREA_VOXELS - _STEP_VOXELS))
    batch = voxels_batch(range(first, first + _STEP_VOXELS), int(rng.integers(1 << 31)))
    removed = rng.random(len(batch)) < _TOMBSTONE_SHARE
    return merge_batches(select_voxels(batch, ~removed), tombstones(batch.keys[removed]))


def run(agent_id: str, address: str, spool_file: str, journal: str, seed: int) -> dict[str, object]:
    """Send changes of this seed until the standard input ends; returns whether everything was acknowledged."""
    spool = Spool(Path(spool_file), agent_id, GRID)
    client = JournalingClient(address, spool.token, Journal(Path(journal)))
    uplink = Uplink(client, agent_id, spool, GRID, _UPLINK)
    stopping = threading.Event()
    threading.Thread(target=_set_at_end, args=(sys.stdin, stopping), daemon=True).start()
    rng = np.random.default_rng(seed)
    while not stopping.wait(_PERIOD_S):
        uplink.enqueue(changed_voxels(rng))
    drained = uplink.drain(DRAIN_S)
    counters = uplink.counters()
    uplink.close()
    return {"drained": drained, "stopped_because": counters.stopped_because}


def _set_at_end(stream: TextIO, stopping: threading.Event) -> None:
    stream.read()
    stopping.set()


if __name__ == "__main__":
    sys.stdout.write(json.dumps(run(*json.loads(sys.argv[1]))) + "\n")
