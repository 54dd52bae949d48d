"""A robot that begins a new map: its former ones stay in the fused map until the new one has outgrown them."""

from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from fusion_running import GRID, keys, make_subset
from opened_stores import OpenStore, opener

from gausslite.domain.errors import InvalidInputError, QuotaError, UnavailableError
from gausslite.domain.pose import transform_of
from gausslite.fusion.alignment import FrameDecisions
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.epochs import MAX_FORMER_MAPS, is_former
from gausslite.fusion.frames import AlignmentState, Segment
from gausslite.fusion.limits import FusionSettings, MissionConfig, Quotas
from gausslite.fusion.sqlite_store import IN_MEMORY, SqliteStore
from gausslite.fusion.store import FusionStore

ANYTHING = MissionConfig("", "", GRID.size_m)
EARLIER = "ant:1"


@pytest.fixture(params=["memory", "sqlite", "postgres"])
def open_store(request: pytest.FixtureRequest) -> OpenStore:
    return opener(request.param, request)


def engine_on(store: FusionStore | None = None, **settings: object) -> FusionEngine:
    return FusionEngine(store or SqliteStore(), FusionSettings(grid=GRID, **settings))


def reboot(engine: FusionEngine, agent_id: str = "ant") -> str:
    """Join as a robot without its spool and its map; returns the session."""
    return engine.join(agent_id, ANYTHING, fresh_map=True).session.session_id


def send(engine: FusionEngine, session: str, seq: int, cells: dict[int, list[int]], agent_id: str = "ant") -> None:
    engine.contribute(session, make_subset(agent_id, seq, cells), GRID)


def fused_kappas(engine: FusionEngine) -> dict[int, int]:
    """Return Σkappa of the fused map by cell, for the cells 0 to 99."""
    fused = engine.maps.voted_map()
    cell_of = {int(key): cell for cell, key in enumerate(keys(*range(100)))}
    return {cell_of[int(key)]: int(total) for key, total in zip(fused.keys, fused.kappa_sums, strict=True)}


def test_an_earlier_map_stays_until_it_is_outgrown_also_after_a_restart(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "store.sqlite")
    engine = engine_on(store)
    send(engine, reboot(engine), 50, {cell: [10, 10] for cell in range(20)})
    session = reboot(engine)
    send(engine, session, 1, {0: [1], 1: [30], 30: [2]})
    expected = {**dict.fromkeys(range(20), 20), 1: 30, 30: 2}
    assert fused_kappas(engine) == expected
    engine.store.close()
    engine = engine_on(SqliteStore(tmp_path / "store.sqlite"))
    assert fused_kappas(engine) == expected
    assert {each.agent_id: each.won_voxels for each in engine.status().agents} == {"ant": 2, EARLIER: 19}
    send(engine, session, 2, {cell: [25] for cell in range(20)})
    assert [each.agent_id for each in engine.status().agents] == ["ant"]
    assert fused_kappas(engine) == {**dict.fromkeys(range(20), 25), 30: 2}
    engine.store.close()


def test_a_tombstone_of_the_new_map_leaves_the_earlier_one() -> None:
    engine = engine_on()
    send(engine, reboot(engine), 50, {0: [5], 1: [5]})
    session = reboot(engine)
    send(engine, session, 1, {0: [9], 2: [9]})
    send(engine, session, 2, {0: [], 1: [], 2: []})
    assert fused_kappas(engine) == {0: 5, 1: 5}


def test_of_many_maps_the_best_of_each_voxel_stays() -> None:
    engine = engine_on()
    for start in range(5):
        send(engine, reboot(engine), 1, {0: [10 - start], start + 1: [7]})
        # an answer that was lost: the robot joins again before it has sent anything
        reboot(engine)
        reboot(engine)
    assert fused_kappas(engine) == {0: 10, **dict.fromkeys(range(1, 6), 7)}
    assert {each.agent_id for each in engine.status().agents if each.voxels} <= {f"ant:{epoch}" for epoch in range(20)}


def test_watchers_get_what_a_new_map_changes() -> None:
    engine = engine_on()
    send(engine, reboot(engine), 1, {0: [5], 1: [5]})
    revision = engine.maps.revision()
    session = reboot(engine)
    send(engine, session, 1, {1: [9]})
    work(engine)
    changes = engine.maps.changes(revision)
    assert {name: sorted(won) for name, won in changes.won.keys_by_winner.items()} == {
        EARLIER: keys(0).tolist(),
        "ant": keys(1).tolist(),
    }
    assert len(changes.removed) == 0


def test_an_earlier_map_is_no_agent_of_its_own() -> None:
    engine = engine_on(quotas=Quotas(agents=2))
    send(engine, reboot(engine), 1, {0: [5]})
    session = reboot(engine)
    send(engine, session, 1, {1: [5]})
    engine.join("bee", ANYTHING)
    pytest.raises(InvalidInputError, engine.join, EARLIER, ANYTHING).match("letters, digits")
    pytest.raises(InvalidInputError, engine.evict, EARLIER, ban=True).match("letters, digits")


def test_operators_delete_an_earlier_map_alone_or_with_its_agent() -> None:
    engine = engine_on()
    for evicted, left in ((EARLIER, {1: 5}), ("ant", {})):
        send(engine, reboot(engine), 1, {0: [5]})
        send(engine, reboot(engine), 1, {1: [5]})
        assert fused_kappas(engine) == {0: 5, 1: 5}
        engine.evict(evicted)
        assert fused_kappas(engine) == left
    send(engine, reboot(engine), 1, {0: [5]})
    engine.leave(reboot(engine), forget=True)
    assert fused_kappas(engine) == {}


def work(engine: FusionEngine) -> None:
    while engine.has_background_work:
        engine.work_in_background()


def test_former_maps_are_few_and_leave_in_slices(open_store: OpenStore) -> None:
    store = open_store()
    engine = engine_on(store)
    for start in range(MAX_FORMER_MAPS + 2):
        send(engine, reboot(engine), 1, {cell: [9] for cell in range(10 * start, 10 * start + start + 1)})
    pytest.raises(UnavailableError, reboot, engine).match("former maps are being deleted")
    work(engine)
    strongest = {cell: 9 for start in range(2, 9) for cell in range(10 * start, 10 * start + start + 1)}
    assert strongest.items() <= fused_kappas(engine).items()
    assert sum(is_former(name) for name in store.agents()) == MAX_FORMER_MAPS
    if not isinstance(store, SqliteStore) or store._path != IN_MEMORY:
        before = fused_kappas(engine)
        store.close()
        engine = engine_on(open_store())
        assert fused_kappas(engine) == before
    engine.evict("ant")
    assert (engine.store.agents(), fused_kappas(engine)) == ((), {})
    engine.store.close()


def test_the_memory_of_an_agents_voxels_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = engine_on(memory_bytes=64 * 7_500)
    send(engine, reboot(engine), 1, {cell: [9] for cell in range(50)})
    with pytest.raises(QuotaError, match=r"at most 7500 bytes of memory \(memory-mb divided by quota-agents\)"):
        send(engine, reboot(engine, "bee"), 1, {cell: [9] for cell in range(300)}, "bee")
    session = reboot(engine)
    # the former map makes room
    with pytest.raises(UnavailableError, match="to make room"):
        send(engine, session, 1, {cell: [1] for cell in range(50, 100)})
    work(engine)
    send(engine, session, 1, {cell: [1] for cell in range(50, 100)})
    assert fused_kappas(engine) == dict.fromkeys(range(50, 100), 1)
    # voxels in another frame take more, where they lie and where they came from
    away = transform_of(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    with pytest.raises(QuotaError, match="a moved map within 7500 bytes"):
        engine.declare_frame("ant", away)
    assert fused_kappas(engine) == dict.fromkeys(range(50, 100), 1)
    engine._aligner = Mock()
    segments = (Segment(0, away, ("bee",)),)
    corrected = replace(engine.frames.get("ant"), state=AlignmentState.CORRECTED, segments=segments)
    engine._aligner.poll.return_value = FrameDecisions({"ant": corrected})
    for _ in range(2):
        assert engine.align_due()
        assert engine.frames.get("ant").state is AlignmentState.QUARANTINED
    assert fused_kappas(engine) == {}
    small = engine_on(memory_bytes=64 * 7_500)
    session = reboot(small, "cat")
    small.declare_frame("cat", away)
    send(small, session, 1, {key: [2] for key in range(30)}, "cat")
    with pytest.raises(QuotaError, match="at most 7500 bytes"):
        send(small, session, 2, {key: [2] for key in range(50, 60)}, "cat")
    monkeypatch.setattr("gausslite.fusion.limits._CONTAINER_LIMITS", ())
    assert FusionSettings(grid=GRID).agent_bytes > 1 << 20
