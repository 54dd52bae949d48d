"""The change log: a watcher that applies the named changes has the fused map."""

import numpy as np
import pytest
from few_examples import few_examples
from hypothesis import given
from hypothesis import strategies as st
from sample_gaussians import plain_gaussians
from test_fusion_properties import assert_same_batch, votes_of

from gausslite.domain.errors import RevisionGoneError
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid, empty_batch, merge_batches, select_voxels
from gausslite.fusion.change_log import ChangeLog
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings, MissionConfig
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.vote import FusedMap, fuse, rank_voxels

GRID = VoxelGrid(0.10)
STEPS = st.lists(
    st.tuples(
        st.sampled_from(["ant", "bee", "cat"]),
        st.one_of(st.none(), st.dictionaries(st.integers(0, 4), st.integers(0, 3), max_size=4)),
        st.booleans(),
    ),
    max_size=12,
)
"""(agent, Gaussians per voxel or None = is removed, whether the watcher reads changes afterwards)."""


def make_batch(counts: dict[int, int]) -> VoxelBatch:
    gaussians = plain_gaussians(np.zeros((sum(counts.values()), 3)), kappa=1)
    per_voxel = np.array([counts[key] for key in sorted(counts)], np.uint32)
    return VoxelBatch(np.array(sorted(counts), np.int64), per_voxel.astype(np.uint64), per_voxel, gaussians)


@few_examples
@given(STEPS)
def test_a_watcher_that_applies_the_changes_has_the_fused_map(steps) -> None:
    store = SqliteStore()
    engine = FusionEngine(store, FusionSettings(grid=GRID), first_revision=1)
    sessions = {
        name: engine.join(name, MissionConfig("", "", 0.10)).session.session_id for name in ("ant", "bee", "cat")
    }
    known, watched, winners = 0, empty_batch(), {}
    for revision, (agent_id, counts, looks) in enumerate(steps, start=1):
        if counts is None:
            engine.leave(sessions[agent_id], forget=True)
            sessions[agent_id] = engine.join(agent_id, MissionConfig("", "", 0.10)).session.session_id
        else:
            engine.contribute(sessions[agent_id], RoiSubset(agent_id, "", revision, revision, make_batch(counts)), GRID)
        if looks:
            changes = engine.maps.changes(known)
            changed = np.union1d(changes.won.batch.keys, changes.removed)
            kept = select_voxels(watched, ~np.isin(watched.keys, changed))
            watched = merge_batches(kept, changes.won.batch)
            for key in changes.removed.tolist():
                winners.pop(key, None)
            winners.update({key: name for name, keys in changes.won.keys_by_winner.items() for key in keys})
            known = changes.revision
            fused = fuse(store.batches())
            assert_same_batch(watched, fused.batch)
            assert winners == {key: best[0] for key, (best, *_) in votes_of(fused.vote).items()}
            assert_status_is_counted_from_the_map(engine, fused)


def assert_status_is_counted_from_the_map(engine: FusionEngine, fused: FusedMap) -> None:
    status = engine.status()
    winners = [best[0] for best, *_ in votes_of(fused.vote).values()]
    assert (status.fused_voxels, status.fused_gaussians) == (len(fused.batch), len(fused.batch.gaussians))
    for agent in status.agents:
        assert agent.won_voxels == winners.count(agent.agent_id)


def record(change_log: ChangeLog, store: SqliteStore, subset: RoiSubset) -> list[int]:
    accepted = store.put(subset).accepted
    return change_log.record({subset.agent_id: accepted}, rank_voxels(store.scores(accepted))).tolist()


def test_only_a_change_of_the_fused_map_is_recorded() -> None:
    change_log, store = ChangeLog(first_revision=100), SqliteStore()
    assert record(change_log, store, RoiSubset("ant", "", 1, 1, make_batch({1: 3, 2: 1}))) == [1, 2]
    assert change_log.voxels.revision == 101
    assert record(change_log, store, RoiSubset("bee", "", 1, 1, make_batch({1: 2}))) == []
    assert change_log.voxels.revision == 101
    assert record(change_log, store, RoiSubset("bee", "", 2, 2, make_batch({1: 5, 2: 0, 3: 0}))) == [1]
    assert change_log.voxels.changed_since(101).tolist() == [1]
    assert change_log.voxels.changed_since(100).tolist() == [1, 2]
    assert change_log.voxels.changed_since(102).tolist() == []


@pytest.mark.parametrize("revision", [0, 99, 103, 10**18])
def test_a_revision_from_before_a_restart_is_gone(revision: int) -> None:
    change_log, store = ChangeLog(first_revision=100), SqliteStore()
    record(change_log, store, RoiSubset("ant", "", 1, 1, make_batch({1: 3})))
    pytest.raises(RevisionGoneError, change_log.voxels.changed_since, revision).match("expected 100 to 101")


def test_the_number_of_recorded_removals_is_limited() -> None:
    change_log, store = ChangeLog(first_revision=1, max_removed=2), SqliteStore()
    record(change_log, store, RoiSubset("ant", "", 1, 1, make_batch({1: 1, 2: 1, 3: 1})))
    for revision, key in enumerate((1, 2, 3), start=2):
        record(change_log, store, RoiSubset("ant", "", revision, revision, make_batch({key: 0})))
    assert change_log.voxels.revision == 5
    pytest.raises(RevisionGoneError, change_log.voxels.changed_since, 2)
    assert change_log.voxels.changed_since(3).tolist() == [2, 3]
    record(change_log, store, RoiSubset("ant", "", 9, 9, make_batch({3: 1})))
    assert change_log.voxels.changed_since(3).tolist() == [2, 3]
