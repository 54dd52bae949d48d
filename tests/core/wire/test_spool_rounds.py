"""A round of the spool: work and reading are bounded by what it sends, and others use the spool meanwhile."""

import heapq
import sqlite3
import threading
from collections.abc import Iterator
from typing import Any

import pytest
from fusion_running import GRID, make_batch

from gausslite.wire.spool import Purpose, Spool, SpooledKeyframe


def steps_of_a_round(voxels: int, monkeypatch: pytest.MonkeyPatch) -> int:
    """Return the steps of SQLite's virtual machine in a round of one voxel, with so many pending."""
    databases: list[sqlite3.Connection] = []
    connect = sqlite3.connect

    def recorded(*arguments: object, **options: object) -> sqlite3.Connection:
        databases.append(connect(*arguments, **options))  # type: ignore[call-overload]
        return databases[-1]

    with monkeypatch.context() as patch:
        patch.setattr(sqlite3, "connect", recorded)
        spool = Spool(None, "robot", GRID)
    spool.enqueue(make_batch({cell: [cell] * 5 for cell in range(1, voxels + 1)}), Purpose.ROI)
    for index in range(3):
        spool.enqueue_keyframe(SpooledKeyframe(index, 0.001, b"", bytes(1000)))
    steps: list[None] = []
    databases[0].set_progress_handler(lambda: steps.append(None), 1)
    due = spool.next_round(1, 0.0)
    databases[0].set_progress_handler(None, 1)
    spool.close()
    assert due is not None
    assert due.voxels is not None
    assert due.voxels.batch.kappa_sums.tolist() == [5 * voxels]
    return len(steps)


def test_a_round_costs_the_same_however_much_is_pending(monkeypatch: pytest.MonkeyPatch) -> None:
    few, many = (steps_of_a_round(voxels, monkeypatch) for voxels in (600, 3000))
    assert many < 1.1 * few


def test_updates_are_enqueued_while_a_round_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    spool, merge = Spool(None, "robot", GRID), heapq.merge
    spool.enqueue(make_batch({cell: [cell] for cell in range(1, 9)}), Purpose.ROI)

    def enqueue_meanwhile(*sources: Any, **options: Any) -> Iterator[Any]:
        for item in merge(*sources, **options):
            thread = threading.Thread(target=spool.enqueue, args=(make_batch({9: [100]}), Purpose.ROI))
            thread.start()
            thread.join(20)
            assert not thread.is_alive(), "the round holds the lock"
            yield item

    monkeypatch.setattr("gausslite.wire.spool.heapq.merge", enqueue_meanwhile)
    due = spool.next_round(1 << 20, 0.0)
    assert due is not None
    assert due.voxels is not None
    assert len(due.voxels.batch) == 8
    spool.mark_done(due.voxels)
    assert spool.pending_voxels == 1
    spool.close()
