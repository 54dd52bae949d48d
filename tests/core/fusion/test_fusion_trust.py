"""What a hostile or faulty agent can do to a mission: nothing beyond its own name and a plausible kappa."""

import logging
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
from fusion_running import GRID, keys, make_subset

from gausslite.codec.encoded_voxels import EncodedSubset
from gausslite.codec.subset_codec import encode_subset
from gausslite.domain.errors import (
    InvalidInputError,
    MismatchError,
    NameInUseError,
    NotPermittedError,
    QuotaError,
    SessionUnknownError,
)
from gausslite.domain.objects import ObjectReport
from gausslite.domain.pose import transform_of
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import RoiSubset
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.keyframe_pool import ORDER_RECORD, EncodedKeyframe
from gausslite.fusion.limits import FusionSettings, MissionConfig, Quotas, SessionRecord
from gausslite.fusion.membership import TOKEN_RECORD, SessionRegistry
from gausslite.fusion.objects import RECORD
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite.fusion.updates import MAX_SEQ_STEP, MissionClock, UpdateChecks

ANYTHING = MissionConfig("", "", GRID.size_m)
LARGEST = (1 << 63) - 1


class Clock:
    """A time that the test sets."""

    now_s = 1000.0

    def __call__(self) -> float:
        return self.now_s


def new_engine(store: FusionStore | None = None, **settings: object) -> FusionEngine:
    return FusionEngine(store or SqliteStore(), FusionSettings(grid=GRID, **settings))


def join(engine: FusionEngine, agent_id: str, token: str = "own") -> str:
    return engine.join(agent_id, ANYTHING, token=token).session.session_id


def with_declared_sum(subset: RoiSubset, kappa_sum: int) -> RoiSubset:
    sums = np.full(len(subset.batch), kappa_sum, np.uint64)
    return replace(subset, batch=replace(subset.batch, kappa_sums=sums))


@pytest.mark.parametrize("encoded", [False, True])
@pytest.mark.parametrize("declared", [LARGEST, (1 << 64) - 1, 0])
def test_a_declared_kappa_sum_wins_no_voxel(declared: int, encoded: bool) -> None:
    engine = new_engine()
    cells = {cell: [3, 4] for cell in range(1000)}
    engine.contribute(join(engine, "good"), make_subset("good", 1, cells), GRID)
    liar = with_declared_sum(make_subset("liar", 1, {cell: [0] for cell in cells}), declared)
    session_id = join(engine, "liar")
    if encoded:
        put = engine.enqueue_update(engine.members.sessions.get(session_id), encode_subset(liar, GRID))
        engine.commit_updates()
        assert len(put.result().accepted) == 1000
    else:
        engine.contribute(session_id, liar, GRID)
    won = {agent.agent_id: (agent.won_voxels, agent.kappa_sum) for agent in engine.status().agents}
    assert won == {"good": (1000, 7000), "liar": (0, 0)}


def received(cells: dict[int, list[int]]) -> EncodedSubset:
    return EncodedSubset.exact(make_subset("ant", 1, cells))


def test_the_kappa_of_a_gaussian_is_bounded_by_the_time_since_the_first_join() -> None:
    store, clock = SqliteStore(), Clock()
    quotas = Quotas(kappa_at_join=100, kappa_per_second=10)
    checks = UpdateChecks(store, quotas, clock)
    checks.record_join("ant")
    checks.require_permitted(received({0: [100], 1: []}))
    with pytest.raises(QuotaError, match="'ant': expected a kappa of at most 100 this long after its first join"):
        checks.require_permitted(received({0: [101]}))
    clock.now_s += 5
    checks.record_join("ant")
    checks.require_permitted(received({0: [150]}))
    # a restarted server does not start again
    UpdateChecks(store, quotas, clock).require_permitted(received({0: [150]}))


def test_a_wrong_wall_clock_neither_sets_the_mission_back_nor_far_ahead() -> None:
    store, wall, monotonic = SqliteStore(), Clock(), Clock()
    # of a computer without a battery for its clock, before it finds a time server
    wall.now_s, monotonic.now_s = 0.0, 7.0
    clock = MissionClock(store, wall, monotonic)
    assert clock() == 0.0
    wall.now_s, monotonic.now_s = 1.7e9, 107.0
    assert clock() == 100.0
    # after a restart, the time without a server counts up to a day
    wall.now_s, monotonic.now_s = 1.8e9, 1.0
    assert MissionClock(store, wall, monotonic)() == 100.0 + 86400.0
    wall.now_s = -5.0
    assert MissionClock(store, wall, monotonic)() == 100.0 + 86400.0
    wall.now_s = 100.0 + 86400.0 + 30.0
    restarted = MissionClock(store, wall, monotonic)
    monotonic.now_s += 2.0
    wall.now_s -= 5000.0
    assert restarted() == 100.0 + 86400.0 + 32.0


def test_a_sequence_number_cannot_use_up_all_later_ones() -> None:
    engine = new_engine()
    ant = join(engine, "ant")
    for poison in (LARGEST, MAX_SEQ_STEP + 1):
        with pytest.raises(InvalidInputError, match="expected an update_seq of at most"):
            engine.contribute(ant, make_subset("ant", poison, {0: [1]}), GRID)
    assert engine.join("ant", ANYTHING, token="own").highest_update_seq == 0
    ant = join(engine, "ant")
    assert len(engine.contribute(ant, make_subset("ant", MAX_SEQ_STEP, {0: [1]}), GRID).accepted) == 1
    assert len(engine.contribute(ant, make_subset("ant", MAX_SEQ_STEP + 7, {0: [1]}), GRID).accepted) == 1


def test_an_evicted_agent_leaves_no_data_and_a_banned_one_stays_out_after_a_restart(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "store.sqlite")
    engine = new_engine(store)
    ant, bee = join(engine, "ant"), join(engine, "bee")
    engine.contribute(ant, make_subset("ant", 1, {0: [9], 1: [9]}), GRID)
    engine.contribute(bee, make_subset("bee", 1, {1: [1]}), GRID)
    assert engine.evict("ant", ban=True) == 2
    assert [agent.agent_id for agent in engine.status().agents] == ["bee"]
    assert engine.maps.voted_map().gaussians.kappa.tolist() == [1]
    pytest.raises(SessionUnknownError, engine.contribute, ant, make_subset("ant", 2, {0: [9]}), GRID)
    store.close()
    store = SqliteStore(tmp_path / "store.sqlite")
    engine = new_engine(store)
    assert engine.status().banned_agents == ("ant",)
    pytest.raises(NotPermittedError, join, engine, "ant").match("'ant': banned by an operator")
    engine.unban("ant")
    assert join(engine, "ant")
    assert engine.evict("ant") == 0
    assert join(engine, "ant")
    with pytest.raises(InvalidInputError, match=r"expected an agent of the mission \(ant, bee\), got 'cat'"):
        engine.evict("cat")
    pytest.raises(InvalidInputError, engine.unban, "ant").match(r"expected a banned agent \(none is banned\)")
    assert engine.evict("cat", ban=True) == 0
    assert engine.status().banned_agents == ("cat",)
    store.close()


@pytest.mark.parametrize("kind", ["keyframe", "report"])
def test_what_is_being_written_when_its_agent_is_evicted_is_deleted_too(
    kind: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, begun, ended = SqliteStore(), Event(), Event()
    engine = new_engine(store)
    session, end_session = join(engine, "ant"), store.end_session
    name = "save_keyframe" if kind == "keyframe" else "save_record"
    save = getattr(store, name)

    def save_late(*arguments: Any) -> None:
        begun.set()
        assert ended.wait(60)
        save(*arguments)

    def write() -> None:
        if kind == "keyframe":
            engine.keyframes.add(EncodedKeyframe("ant", 0, 1, 1, b"image"), session_id=session)
        else:
            report = ObjectReport(TaskGraph("mug", "mug", ("mug",), (), ()), ())
            engine.objects.report(SessionRecord(session, "ant"), report)

    monkeypatch.setattr(store, name, save_late)
    monkeypatch.setattr(store, "end_session", lambda session_id: (end_session(session_id), ended.set()))
    with ThreadPoolExecutor(1) as threads:
        writing = threads.submit(write)
        assert begun.wait(60)
        assert engine.evict("ant") == 0
        with suppress(SessionUnknownError):
            writing.result(60)
    assert store.keyframe_sizes() == {}
    assert not any(store.find_record("ant", record) for record in (RECORD, ORDER_RECORD, TOKEN_RECORD))
    assert engine.status().agents == ()
    pytest.raises(SessionUnknownError, write)


def test_the_name_of_a_live_robot_is_taken_over_only_with_its_token_or_after_its_lease() -> None:
    store, clock = SqliteStore(), Clock()
    sessions = SessionRegistry(store, 60.0, clock)
    first = sessions.open("ant", "token").session_id
    clock.now_s += 59
    with pytest.raises(NameInUseError, match="wait 1 s for the end of its lease") as refused:
        sessions.open("ant", "thief")
    assert refused.value.retry_after_s == pytest.approx(1)
    assert sessions.get(first).agent_id == "ant"
    clock.now_s += 59
    pytest.raises(NameInUseError, sessions.open, "ant", "")
    # also after a restart of the server, which has no token in clear
    assert b"token" not in b"".join(store.records("join-token").values())
    restarted = SessionRegistry(store, 60.0, clock)
    pytest.raises(NameInUseError, restarted.open, "ant", "thief")
    second = restarted.open("ant", "token").session_id
    pytest.raises(MismatchError, restarted.get, first).match("another robot uses this name")
    clock.now_s += 61
    third = restarted.open("ant", "thief").session_id
    with pytest.raises(NameInUseError) as replaced:
        restarted.get(second)
    assert replaced.value.retry_after_s == 60
    clock.now_s += 61
    assert restarted.open("ant", "token").session_id != third


def test_a_session_that_ends_during_a_message_leaves_no_lease() -> None:
    clock = Clock()

    def end_meanwhile() -> float:
        if clock.now_s == 1001.0:
            clock.now_s += 1
            sessions.end_agent("ant")
        return clock()

    sessions = SessionRegistry(SqliteStore(), 60.0, end_meanwhile)
    session = sessions.open("ant", "token")
    clock.now_s = 1001.0
    sessions.known(session.session_id)
    sessions.require_free("ant", "another robot's")


def test_names_that_never_contributed_do_not_fill_a_mission() -> None:
    store = SqliteStore()
    engine = new_engine(store, quotas=Quotas(agents=3), lease_s=0.0)
    engine.contribute(join(engine, "good"), make_subset("good", 1, {0: [1]}), GRID)
    for number in range(10):
        join(engine, f"junk-{number}")
    late = join(engine, "late")
    assert {agent.agent_id for agent in engine.status().agents} >= {"good", "late"}
    assert not any("junk-0" in records for records in all_records(store).values())
    engine.contribute(late, make_subset("late", 1, {1: [1]}), GRID)
    engine.contribute(join(engine, "last"), make_subset("last", 1, {2: [1]}), GRID)
    pytest.raises(QuotaError, join, engine, "later").match("at most 3 in this mission")


def test_no_flood_of_names_ends_a_live_lease() -> None:
    crowded = new_engine(quotas=Quotas(agents=3))
    join(crowded, "honest")
    crowded.contribute(join(crowded, "with-data"), make_subset("with-data", 1, {0: [1]}), GRID)
    join(crowded, "junk-0")
    for number in range(1, 9):
        pytest.raises(QuotaError, join, crowded, f"junk-{number}").match(r"at most 3 in this mission.*gausslite evict")
    # it can still join again, and contribute
    honest = join(crowded, "honest")
    assert len(crowded.contribute(honest, make_subset("honest", 1, {1: [1]}), GRID).accepted)
    # an operator ends what is live
    crowded.evict("junk-0")
    join(crowded, "late")
    assert {agent.agent_id for agent in crowded.status().agents} == {"honest", "with-data", "late"}


def test_new_names_are_logged_and_names_that_come_and_go_fill_no_log(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "gausslite.fusion.membership")
    engine = new_engine(quotas=Quotas(agents=3))
    for _ in range(5):
        for number in range(3):
            engine.leave(join(engine, f"junk-{number}"))
    sessions = [join(engine, f"name-{number}") for number in range(3)]
    assert len(sessions) == 3
    assert [record.getMessage() for record in caplog.records] == [
        "agent 'junk-0' has joined; 1 of at most 3 names are in use",
        "agent 'name-1' has joined; 2 of at most 3 names are in use",
        "agent 'name-2' has joined; 3 of at most 3 names are in use",
    ]


@pytest.mark.parametrize("how", ["leave", "evict", "unban"])
def test_an_agent_that_is_gone_leaves_no_record(how: str) -> None:
    store = SqliteStore()
    engine = new_engine(store)
    session = join(engine, "ant")
    engine.contribute(session, make_subset("ant", 1, {0: [1]}), GRID)
    engine.objects.report(SessionRecord(session, "ant"), ObjectReport(TaskGraph("mug", "mug", ("mug",), (), ()), ()))
    assert {"objects", "join-token", "first-joined"} <= {
        name for name, records in all_records(store).items() if "ant" in records
    }
    if how == "leave":
        engine.leave(session, forget=True)
    else:
        engine.evict("ant", ban=how == "unban")
    if how == "unban":
        engine.unban("ant")
    assert not any("ant" in records for records in all_records(store).values())
    # another robot can take the name
    assert join(engine, "ant", token="another")


def all_records(store: SqliteStore) -> dict[str, dict[str, bytes]]:
    names = ("alignment", "ban", "first-joined", "join-token", "objects", "session")
    return {name: store.records(name) for name in names}


def test_a_joiner_that_is_gone_and_never_contributed_fixes_nothing() -> None:
    engine = new_engine(lease_s=0.0)
    engine.join("junk", MissionConfig("wrong", "wrong", GRID.size_m))
    session = engine.join("ant", MissionConfig("rescue", "map", GRID.size_m)).session.session_id
    assert engine.members.mission_config.mission_id == "rescue"
    engine.contribute(session, make_subset("ant", 1, {0: [1]}), GRID)
    with pytest.raises(MismatchError, match="expected 'map' as agreed here, got 'odom'"):
        engine.join("bee", MissionConfig("", "odom", GRID.size_m))


def test_ever_new_frames_cost_a_slice_at_a_time_and_the_last_one_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gausslite.fusion.engine.SLICE_VOXELS", 10)
    store = SqliteStore()
    engine, up = new_engine(store), np.array([0.0, 0.0, GRID.size_m, 0.0, 0.0, 0.0])
    for name, start in (("bad", 0), ("good", 1000)):
        engine.contribute(join(engine, name), make_subset(name, 1, {start + i: [3] for i in range(50)}), GRID)
    with monkeypatch.context() as patched:
        patched.setattr(store, "batch", lambda *_: pytest.fail("a call that reads a map"))
        for turns in (1, 2, 3):
            engine.declare_frame("bad", transform_of(turns * up))
        engine.declare_frame("good", transform_of(up))
    # a message counts in the new frame at once
    engine.contribute(join(engine, "good"), make_subset("good", 2, {2000: [3]}), GRID)
    assert engine.maps.voted_map("good").keys.max() == keys(2000).max() + heights(1)
    # the turns are fair, also for one that begins again and again
    for _ in range(12):
        engine.declare_frame("bad", transform_of(up))
        engine.declare_frame("bad", transform_of(2 * up))
        engine.work_in_background()
    assert sorted(engine.maps.voted_map("good").keys) == sorted(keys(*range(1000, 1050), 2000) + heights(1))
    # the move goes on under the name of a former map
    engine.join("bad", ANYTHING, fresh_map=True, token="own")
    while engine.has_background_work:
        engine.work_in_background()
    assert sorted(engine.maps.voted_map("bad:0").keys) == sorted(keys(*range(50)) + heights(2))


def heights(voxels: int) -> int:
    """Return what so many voxels of height add to a key."""
    above, below = (GRID.keys(np.array([[0.0, 0.0, z * GRID.size_m + 1e-3]], np.float32))[0] for z in (voxels, 0))
    return int(above - below)
