"""Several servers on one store have the same mission, whichever of them an agent talks to."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_gaussians import plain_gaussians
from support.local_replicas import LocalHosts
from test_shard_failover import settle
from test_sharded_store import GRID, assert_same_batch

from gausslite.cluster.journal import Journal, JournalEntry, JournalGapError
from gausslite.cluster.leadership import LEADERSHIP_S, Leadership
from gausslite.cluster.remote_store import RemoteStore
from gausslite.domain.errors import (
    GaussLiteError,
    MismatchError,
    NameInUseError,
    NotPermittedError,
    RevisionGoneError,
    SessionUnknownError,
)
from gausslite.domain.objects import ObjectReport
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxel_batch import RoiSubset
from gausslite.domain.voxel_operations import group_by_voxel, merge_batches, tombstones
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.frame_alignment import FrameAlignment
from gausslite.fusion.keyframes import EncodedKeyframe
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.mission_config import MissionConfig
from gausslite.fusion.store_changes import RecordSaved
from gausslite.fusion.store_values import SessionRecord
from gausslite.fusion.traffic import MissionStatus, TrafficCounters

SHARDS, SERVERS = 2, 3
AGENTS = ("ant", "bee")
SETTINGS = FusionSettings(grid=GRID, mission_id="rescue", world_frame="map")
CONFIG = MissionConfig("rescue", "map", GRID.size_m)
ALIGNMENT = FrameAlignment(0)
# metres apart, so that both shards have some
SPACING_M = 1.7


def message(agent_id: str, session_id: str, update_seq: int, kappas: dict[int, int]) -> RoiSubset:
    """One Gaussian of this kappa in each numbered place; 0 is a tombstone."""
    occupied = {place: kappa for place, kappa in sorted(kappas.items()) if kappa}
    means = [(SPACING_M * place + 0.05, 0.05, 0.05) for place in occupied]
    empty = np.array([(SPACING_M * place + 0.05, 0.05, 0.05) for place in kappas if not kappas[place]], np.float32)
    batch = group_by_voxel(plain_gaussians(means, kappa=list(occupied.values())), GRID)
    batch = merge_batches(batch, tombstones(np.sort(GRID.keys(empty.reshape(-1, 3)))))
    return RoiSubset(agent_id, session_id, update_seq, update_seq, batch)


@dataclass
class Team:
    """Servers on one store, and the agents' sessions, as each robot knows its own."""

    hosts: LocalHosts
    engines: list[FusionEngine]
    sessions: dict[str, str] = field(default_factory=dict)
    ended: list[tuple[str, str]] = field(default_factory=list)
    seqs: dict[str, int] = field(default_factory=dict)

    @classmethod
    def start(cls, folder: Path, servers: int = SERVERS) -> Team:
        hosts = LocalHosts(folder)
        stores = [hosts.open_store(SHARDS), *(hosts.share_store(SHARDS) for _ in range(servers - 1))]
        return cls(hosts, [FusionEngine(store, SETTINGS, leads=lambda: False) for store in stores])

    def join(self, agent_id: str, server: int, fresh_map: bool = False) -> None:
        """A robot joins; its numbers continue above those that the server has."""
        joined = self.engines[server].join(agent_id, CONFIG, fresh_map, token=agent_id)
        if agent_id in self.sessions:
            self.ended.append((agent_id, self.sessions[agent_id]))
        self.sessions[agent_id] = joined.session.session_id
        self.seqs[agent_id] = joined.highest_update_seq

    def send(self, agent_id: str, server: int, kappas: dict[int, int]) -> None:
        """A robot sends to a server, and joins there if the server does not know its session."""
        for _ in range(2):
            seq = self.seqs.get(agent_id, 0) + 1
            subset = message(agent_id, self.sessions.get(agent_id, "none"), seq, kappas)
            try:
                self.engines[server].contribute(subset.session_id, subset, GRID)
                self.seqs[agent_id] = seq
                return
            except SessionUnknownError:
                self.join(agent_id, server)
        raise AssertionError("the session is unknown after a join")

    def follow(self) -> None:
        """All servers follow until nothing is new."""
        while sum(engine.follow() for engine in self.engines):
            pass

    def close(self) -> None:
        for engine in self.engines:
            engine.close()
        self.hosts.close()


def figures(engine: FusionEngine) -> MissionStatus:
    """The status without what differs between servers."""
    status = engine.status()
    agents = [replace(agent, traffic=TrafficCounters(), alignment=ALIGNMENT) for agent in status.agents]
    return replace(status, revision=0, agents=tuple(agents))


def assert_same_mission(team: Team) -> None:
    first = team.engines[0]
    voted = first.maps.voted_map()
    for engine in team.engines:
        assert figures(engine) == figures(first)
        assert_same_batch(engine.maps.voted_map(), voted)
        watched = engine.maps.changes()
        assert_same_batch(watched.won.batch, voted)
        assert engine.query_objects() == first.query_objects()
        for agent_id in AGENTS:
            assert engine.encoded_keyframe(agent_id) == first.encoded_keyframe(agent_id)


SERVER, AGENT = st.integers(0, SERVERS - 1), st.sampled_from(AGENTS)
SENDS = st.tuples(
    st.just("send"), AGENT, SERVER, st.dictionaries(st.integers(0, 7), st.integers(0, 9), min_size=1, max_size=4)
)
STEPS = st.one_of(
    SENDS,
    SENDS,
    st.tuples(st.just("join"), AGENT, SERVER, st.booleans()),
    st.tuples(st.just("forget"), AGENT, SERVER, st.none()),
    st.tuples(st.just("evict"), AGENT, SERVER, st.none()),
    st.tuples(st.just("report"), AGENT, SERVER, st.integers(0, 3)),
    st.tuples(st.just("keyframe"), AGENT, SERVER, st.integers(0, 3)),
    st.tuples(st.just("follow"), AGENT, SERVER, st.none()),
    st.tuples(st.just("late"), AGENT, SERVER, st.dictionaries(st.integers(0, 7), st.integers(1, 9), min_size=1)),
    st.tuples(st.just("kill"), AGENT, SERVER, st.integers(0, SHARDS - 1)),
)


def take_step(team: Team, step: tuple[str, str, int, object]) -> None:
    kind, agent_id, server, value = step
    engine, session_id = team.engines[server], team.sessions.get(agent_id, "none")
    match kind, value:
        case "send", dict(kappas):
            team.send(agent_id, server, kappas)
        case "join", bool(fresh_map):
            team.join(agent_id, server, fresh_map)
        case "forget", _:
            engine.leave(session_id, forget=True)
        case "evict", _:
            engine.evict(agent_id)
        case "report", int(number):
            graph = TaskGraph("task", f"find {number}", (f"mug {number}",), (), ())
            engine.report_objects(session_id, ObjectReport(graph))
        case "keyframe", int(number):
            engine.add_keyframe(EncodedKeyframe(engine.session(session_id).agent_id, number, 4, bytes(number + 1)))
        case "follow", _:
            engine.follow()
        case "late", dict(kappas):
            # a message that a server had received from the robot's earlier session
            for agent_id, ended in team.ended[-1:]:
                subset = message(agent_id, ended, 1 << 20, kappas)
                with pytest.raises((SessionUnknownError, MismatchError, NameInUseError)):
                    engine.contribute(ended, subset, GRID)
        case "kill", int(shard):
            assert team.hosts.directory is not None
            team.hosts.stop(team.hosts.directory.states()[shard].primary)


@settings(max_examples=40, deadline=None)
@given(st.lists(STEPS, max_size=14))
def test_all_servers_have_the_same_mission_after_any_steps(steps: list[tuple[str, str, int, object]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        team = Team.start(Path(folder))
        try:
            for agent_id, server in zip(AGENTS, range(SERVERS), strict=False):
                team.join(agent_id, server)
            for step in steps:
                try:
                    take_step(team, step)
                except GaussLiteError:
                    # a robot whose session has ended; what counts is that the servers agree
                    continue
            team.follow()
            assert_same_mission(team)
        finally:
            team.close()


@pytest.fixture
def team(tmp_path: Path):  # type: ignore[no-untyped-def]
    team = Team.start(tmp_path, servers=2)
    yield team
    team.close()


def test_an_agent_continues_at_another_server_with_the_same_session(team: Team) -> None:
    team.join("ant", 0)
    team.send("ant", 0, {0: 3, 5: 4})
    team.follow()
    session_id = team.sessions["ant"]
    team.send("ant", 1, {0: 7})
    assert team.sessions["ant"] == session_id
    team.follow()
    assert_same_mission(team)
    assert team.engines[0].status().fused_gaussians == 2


def test_a_join_continues_above_the_numbers_that_another_server_has_stored(team: Team) -> None:
    team.join("ant", 0)
    for _ in range(5):
        team.send("ant", 0, {0: 3})
    assert team.engines[1].join("ant", CONFIG, token="ant").highest_update_seq == 5


def test_a_session_that_is_saved_twice_after_a_lost_reply_stays_open(team: Team) -> None:
    team.join("ant", 0)
    for shard in (0, 1):
        remote = RemoteStore(shard, team.hosts.directory, team.hosts.call)  # type: ignore[arg-type]
        remote.save_session(SessionRecord(team.sessions["ant"], "ant"))
    session_id = team.sessions["ant"]
    team.send("ant", 0, {0: 3, 5: 4})
    assert team.sessions["ant"] == session_id


def test_a_lease_renewed_at_one_server_protects_the_name_at_the_others(team: Team) -> None:
    team.join("ant", 0)
    team.follow()
    with pytest.raises(NameInUseError):
        team.engines[1].join("ant", CONFIG, token="another robot")


def test_after_an_eviction_no_server_stores_the_agents_messages(team: Team) -> None:
    team.join("ant", 0)
    team.send("ant", 0, {0: 3, 5: 4})
    team.engines[1].evict("ant", ban=True)
    # server 0 has not followed yet
    with pytest.raises(SessionUnknownError):
        team.engines[0].contribute(team.sessions["ant"], message("ant", team.sessions["ant"], 9, {1: 1}), GRID)
    with pytest.raises(NotPermittedError):
        team.join("ant", 0)
    team.follow()
    assert_same_mission(team)
    assert team.engines[0].status().fused_voxels == 0


def test_a_second_robot_with_the_same_token_at_another_server_stops_the_first(team: Team) -> None:
    team.join("ant", 0)
    first = team.sessions["ant"]
    team.join("ant", 1)
    team.follow()
    with pytest.raises(MismatchError, match="another robot"):
        team.engines[0].session(first)


def test_a_refined_map_is_the_same_at_every_server(team: Team) -> None:
    team.join("ant", 0)
    team.send("ant", 0, dict.fromkeys(range(8), 5))
    team.follow()
    refined = team.engines[0].maps.voted_map().gaussians
    revision = team.engines[0].revision
    # stored after the refinement began, and fetched by the other server together with the refinement
    team.send("ant", 0, {0: 9})
    team.engines[0].store_refined(replace(refined, opacities=refined.opacities * 0.5), revision)
    team.follow()
    maps = [engine.maps.refined_map() for engine in team.engines]
    assert_same_batch(maps[0], maps[1])
    assert np.count_nonzero(maps[0].gaussians.opacities < 0.5) == 7


def test_counters_and_the_mission_of_other_servers_are_known(team: Team) -> None:
    team.join("ant", 0)
    team.engines[0].record_traffic("ant", TrafficCounters(roi_bytes=100))
    team.engines[0].save_counters()
    team.engines[1].follow()
    assert team.engines[1].status().agents[0].traffic.roi_bytes == 100
    assert team.engines[1].mission_config == CONFIG


def test_a_server_that_missed_changes_reads_the_store_again(team: Team) -> None:
    team.join("ant", 0)
    team.send("ant", 0, {0: 3, 5: 4})
    team.engines[1].follow()
    watched = team.engines[1].revision
    team.send("ant", 0, {1: 3, 6: 4})
    team.join("bee", 0)
    settle(team.hosts)
    assert team.hosts.directory is not None
    for state in team.hosts.directory.states():
        # a new replica opens the file, with an empty journal
        team.hosts.stop(state.standby)
        team.hosts.stop(state.primary)
    team.send("bee", 1, {1: 9})
    team.follow()
    assert_same_mission(team)
    with pytest.raises(RevisionGoneError):
        team.engines[1].maps.changes(watched)


def test_a_journal_says_if_it_does_not_reach_back() -> None:
    journal = Journal(start=10, budget_bytes=1000)
    for number in range(11, 21):
        journal.record(JournalEntry(number, "a server", (RecordSaved("ant", "name", bytes(100)),)))
    assert [entry.transactions for entry in journal.after(19)] == [20]
    assert journal.after(20) == ()
    for position in (10, 21):
        with pytest.raises(JournalGapError, match=f"got {position}"):
            journal.after(position)


def test_checks_of_the_storage_are_sent_to_no_other_server(team: Team) -> None:
    other = team.hosts.share_store(SHARDS)
    team.engines[0].storage.check()
    assert other.fetch_changes()
    assert other.take_changes() == []
    other.close()


def test_one_server_leads_until_it_stops_asking() -> None:
    now_s = [0.0]
    leadership = Leadership(lambda: now_s[0])
    assert leadership.ask("a")
    assert not leadership.ask("b")
    now_s[0] += 0.9 * LEADERSHIP_S
    assert leadership.ask("a")
    now_s[0] += 0.9 * LEADERSHIP_S
    assert not leadership.ask("b")
    now_s[0] += 0.2 * LEADERSHIP_S
    assert leadership.ask("b")
    assert not leadership.ask("a")
