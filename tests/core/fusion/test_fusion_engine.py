"""The fusion engine without a network: figures, mission configuration, quotas and short error messages."""

from concurrent.futures import ThreadPoolExecutor
from threading import Event
from typing import Any

import numpy as np
import pytest
from sample_gaussians import plain_gaussians

from gausslite.codec.encoded_voxels import EncodedSubset
from gausslite.domain.errors import (
    GaussLiteError,
    MismatchError,
    QuotaError,
    SessionUnknownError,
    StorageError,
)
from gausslite.domain.objects import ObjectReport
from gausslite.domain.pose import transform_of
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import RoiSubset, VoxelBatch, VoxelGrid, group_by_voxel, merge_batches, tombstones
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings, MissionConfig, Quotas, reconcile
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.traffic import TrafficCounters

GRID = VoxelGrid(0.10)
ANYTHING = MissionConfig("", "", 0.10)
LONG = "x" * 1_000_000


def make_subset(
    agent_id: str, update_seq: int, cells: list[tuple[int, int]], removed: tuple[int, ...] = ()
) -> RoiSubset:
    """Voxel updates with one Gaussian for each (cell along x, kappa), and tombstones of removed cells."""
    means = [(0.1 * cell + 0.05, 0.05, 0.05) for cell, _ in cells]
    gaussians = plain_gaussians(means, kappa=[kappa for _, kappa in cells])
    removed_m = np.array([(0.1 * cell + 0.05, 0.05, 0.05) for cell in sorted(removed)], np.float32).reshape(-1, 3)
    return RoiSubset(
        agent_id,
        "",
        update_seq,
        update_seq,
        merge_batches(group_by_voxel(gaussians, GRID), tombstones(GRID.keys(removed_m))),
    )


def test_status_counts_each_agents_contribution() -> None:
    engine = FusionEngine(SqliteStore(), FusionSettings(grid=GRID, mission_id="rescue"), first_revision=10)
    ant, bee = (engine.join(name, ANYTHING).session.session_id for name in ("ant", "bee"))
    engine.contribute(ant, make_subset("ant", 3, [(0, 5), (1, 1), (1, 1)], removed=(4,)), GRID)
    engine.contribute(bee, make_subset("bee", 8, [(1, 9), (2, 0)]), GRID)
    engine.traffic.record("ant", TrafficCounters(roi_bytes=100, subsets_accepted=1))
    engine.traffic.record("ant", TrafficCounters(handover_bytes=7, subsets_stale=1))
    engine.leave(bee)
    status = engine.status()
    assert status.mission_config == MissionConfig("rescue", "world", 0.10)
    assert (status.revision, status.fused_voxels, status.fused_gaussians) == (12, 3, 3)
    assert (status.keyframes, status.refined) == (0, False)
    first, second = status.agents
    assert (first.agent_id, first.joined, first.voxels, first.gaussians) == ("ant", True, 2, 3)
    assert (first.kappa_sum, first.won_voxels, first.last_update_seq) == (7, 1, 3)
    assert (first.traffic.roi_bytes, first.traffic.handover_bytes, first.traffic.subsets_stale) == (100, 7, 1)
    assert first.traffic.last_seen_ns > 0
    assert (second.agent_id, second.joined, second.won_voxels, second.kappa_sum) == ("bee", False, 2, 9)


def test_a_mission_without_updates_has_an_empty_map() -> None:
    engine = FusionEngine(SqliteStore(), FusionSettings(grid=GRID))
    assert len(engine.maps.voted_map()) == len(engine.maps.union_map()) == 0
    assert engine.status().agents == ()
    assert len(engine.maps.changes().won.batch) == 0
    engine.store.close()


def test_the_first_agent_that_names_the_mission_fixes_it() -> None:
    engine = FusionEngine(SqliteStore(), FusionSettings(grid=GRID))
    engine.join("ant", ANYTHING)
    assert engine.members.mission_config == MissionConfig("mission", "world", 0.10)
    with pytest.raises(MismatchError, match="'world' as agreed here, got 'odom'"):
        engine.join("bee", MissionConfig("", "odom", 0.10))
    assert reconcile(MissionConfig("", "", 0.1), MissionConfig("a", "b", 0.1)) == MissionConfig("a", "b", 0.1)


def test_a_store_of_another_mission_is_refused() -> None:
    store = SqliteStore()
    FusionEngine(store, FusionSettings(grid=GRID)).join("ant", MissionConfig("m", "w", 0.10))
    for settings in (FusionSettings(grid=VoxelGrid(0.2)), FusionSettings(grid=GRID, mission_id="other")):
        pytest.raises(MismatchError, FusionEngine, store, settings).match(r"got (0\.2 m|'other')")


def test_quotas_apply_per_agent_and_a_resend_does_not_count() -> None:
    engine = FusionEngine(
        SqliteStore(), FusionSettings(grid=GRID, quotas=Quotas(voxels_per_agent=2, gaussians_per_agent=2))
    )
    ant = engine.join("ant", ANYTHING).session.session_id
    engine.contribute(ant, make_subset("ant", 1, [(0, 1), (1, 1)]), GRID)
    assert engine.contribute(ant, make_subset("ant", 1, [(0, 1), (1, 1)]), GRID).stale.size == 2
    engine.contribute(ant, make_subset("ant", 2, [(0, 2)], removed=(1,)), GRID)
    with pytest.raises(QuotaError, match="at most 2 Gaussians in all, got 3"):
        engine.contribute(ant, make_subset("ant", 3, [(0, 1), (0, 1), (0, 1)]), GRID)
    with pytest.raises(QuotaError, match="at most 2 voxels in all, got 3"):
        engine.contribute(ant, make_subset("ant", 3, [], removed=(2,)), GRID)
    assert engine.status().agents[0].gaussians == 1


def test_every_error_message_is_one_short_line() -> None:
    engine = FusionEngine(SqliteStore(), FusionSettings(grid=GRID))
    ant = engine.join("ant", MissionConfig("m", "w", 0.10)).session.session_id
    attempts = [
        lambda: engine.join(LONG, ANYTHING),
        lambda: engine.join("", ANYTHING),
        lambda: engine.join("bee", MissionConfig(LONG, "", 0.10)),
        lambda: engine.join("bee", MissionConfig("", "line\nbreak", 0.10)),
        lambda: engine.members.require_mission(LONG),
        lambda: engine.members.sessions.get(LONG),
        lambda: engine.maps.voted_map(LONG),
        lambda: engine.maps.union_map("line\nbreak"),
        lambda: engine.contribute(ant, make_subset(LONG, 1, []), GRID),
    ]
    for attempt in attempts:
        with pytest.raises(GaussLiteError) as caught:
            attempt()
        assert len(str(caught.value)) < 300
        assert "\n" not in str(caught.value)
    pytest.raises(SessionUnknownError, engine.members.sessions.get, "gone").match("join again")


def test_a_slow_disk_delays_no_question_about_a_session(monkeypatch: pytest.MonkeyPatch) -> None:
    store, begun, released = SqliteStore(), Event(), Event()
    engine = FusionEngine(store, FusionSettings(grid=GRID, mission_id="rescue"))
    session = engine.join("ant", ANYTHING).session
    save = store.save_record

    def save_slowly(*arguments: Any) -> None:
        begun.set()
        assert released.wait(60)
        save(*arguments)

    monkeypatch.setattr(store, "save_record", save_slowly)
    report = ObjectReport(TaskGraph("mug", "mug", ("mug",), (), ()), ())
    with ThreadPoolExecutor(2) as threads:
        reported = threads.submit(engine.objects.report, session, report)
        assert begun.wait(60)
        try:
            found = threads.submit(
                lambda: (engine.members.sessions.get(session.session_id), engine.members.mission_config.mission_id)
            )
            assert found.result(30) == (session, "rescue")
        finally:
            released.set()
        reported.result(60)


class FailingStore(SqliteStore):
    """Refuses to read voxels while `is_failing`."""

    is_failing = False

    def batch(self, agent_id: str, keys: np.ndarray | None = None) -> VoxelBatch:
        if self.is_failing:
            raise StorageError("damaged")
        return super().batch(agent_id, keys)


def test_encoded_voxels_that_could_not_be_voted_on_are_in_the_map_after_the_next_commit() -> None:
    store = FailingStore()
    engine = FusionEngine(store, FusionSettings(grid=GRID))
    sessions = {name: engine.join(name, ANYTHING).session for name in ("ant", "bee")}
    # the vote reads the voxels of an agent in another frame
    engine.declare_frame("ant", transform_of(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])))
    engine.contribute(sessions["ant"].session_id, make_subset("ant", 1, [(0, 5)]), GRID)
    store.is_failing = True
    message = {name: EncodedSubset.exact(make_subset(name, 2, [(5, 5)])) for name in sessions}
    futures = {name: engine.enqueue_update(sessions[name], message[name]) for name in sessions}
    engine.commit_updates()
    assert isinstance(futures["ant"].exception(), StorageError)
    assert len(futures["bee"].result().accepted) == 1
    store.is_failing = False
    # the robot sends it again, and it is in the store already
    assert len(engine.contribute(sessions["ant"].session_id, make_subset("ant", 2, [(5, 5)]), GRID).stale) == 1
    assert engine.maps.size() == (3, 3)
    again = FusionEngine(store, FusionSettings(grid=GRID))
    assert np.array_equal(engine.maps.voted_map().keys, again.maps.voted_map().keys)
