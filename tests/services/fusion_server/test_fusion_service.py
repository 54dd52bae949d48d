"""Joining, contributing and exporting on a real fusion server in process, and every error code."""

import threading
from pathlib import Path

import grpc
import pytest
from fusion_running import GRID, RunningServer, frame, fusion_server, make_batch, make_subset, request

from gausslite.codec.ply import gaussians_from_ply
from gausslite.domain.errors import (
    InvalidInputError,
    MismatchError,
    NameInUseError,
    RevisionGoneError,
    SessionUnknownError,
    UnavailableError,
)
from gausslite.domain.voxels import RoiSubset, VoxelGrid
from gausslite.fusion.limits import FusionSettings, Quotas
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1.geometry_pb2 import LOCALISATION_DOUBTFUL
from gausslite.wire.clients import Export, FusionClient

ACCEPTED, STALE, REJECTED = pb.SUBSET_STATUS_ACCEPTED, pb.SUBSET_STATUS_STALE, pb.SUBSET_STATUS_REJECTED


def test_of_two_agents_the_one_with_the_higher_kappa_sum_wins(fusion: RunningServer) -> None:
    ant, bee = fusion.client.join("ant", GRID), fusion.client.join("bee", GRID)
    assert ant.highest_update_seq == 0
    assert [o.status for o in fusion.contribute_subsets(ant.session_id, make_subset("ant", 1, {0: [5], 1: [1]}))] == [
        ACCEPTED
    ]
    assert [
        o.status for o in fusion.contribute_subsets(bee.session_id, make_subset("bee", 1, {1: [2, 2], 2: [0]}))
    ] == [ACCEPTED]
    fused = gaussians_from_ply(fusion.client.export(Export("vote")))
    assert sorted(fused.kappa.tolist()) == [0, 2, 2, 5]
    assert len(gaussians_from_ply(fusion.client.export(Export("concatenation")))) == 5
    assert gaussians_from_ply(fusion.client.export(Export("vote", "ant"))).kappa.tolist() == [5]
    assert sorted(gaussians_from_ply(fusion.client.export(Export("concatenation", "ant"))).kappa.tolist()) == [1, 5]
    assert fusion.client.join("ant", GRID).highest_update_seq == 1


def test_a_duplicate_is_stale_and_acks_are_cumulative(fusion: RunningServer) -> None:
    session = fusion.client.join("ant", GRID).session_id
    subsets = [make_subset("ant", revision, {0: [revision]}) for revision in (1, 2, 3)]
    sent = [request(session, subset) for subset in (*subsets, subsets[0])]
    answers = list(fusion.client.contribute(sent, 20.0))
    assert [answer.acknowledged for answer in answers] == [1, 2, 3, 3]
    assert [answer.outcomes[0].status for answer in answers] == [ACCEPTED] * 3 + [STALE]
    assert answers[0].outcomes[0].accepted_voxels == answers[3].outcomes[0].stale_voxels == 1
    assert gaussians_from_ply(fusion.client.export(Export())).kappa.tolist() == [3]


def test_an_invalid_subset_does_not_end_the_stream() -> None:
    with fusion_server(settings=FusionSettings(grid=GRID, quotas=Quotas(gaussians_per_agent=3))) as t:
        session = t.client.join("ant", GRID).session_id
        good = request(session, make_subset("ant", 1, {0: [1]}))
        flipped = bytearray(good.subset)
        flipped[-20] ^= 1
        bad = [
            pb.ContributeSubsetsRequest(session_id=session, sequence=2, subset=bytes(flipped)),
            pb.ContributeSubsetsRequest(session_id=session, sequence=3, subset=b"no subset at all" * 9),
            pb.ContributeSubsetsRequest(session_id=session, sequence=4, subset=bytes(3 << 20)),
            request(session, make_subset("bee", 5, {0: [1]})),
            request(session, make_subset("ant", 6, {1: [1, 1, 1]})),
        ]
        last = request(session, make_subset("ant", 7, {1: [1, 1]}))
        outcomes = t.send(good, *bad, last)
        assert [o.status for o in outcomes] == [ACCEPTED] + [REJECTED] * 5 + [ACCEPTED]
        assert [o.reason for o in outcomes[1:-1]] == ["CHECKSUM", "CODEC", "CODEC", "NOT_PERMITTED", "QUOTA"]
        assert all(o.message and "\n" not in o.message for o in outcomes[1:-1])
        [ant] = t.client.status().agents
        assert (ant.subsets_accepted, ant.subsets_rejected, ant.gaussians, ant.voxels) == (2, 5, 3, 2)
        assert (ant.kappa_sum, ant.last_update_seq) == (3, 7)
        assert ant.last_seen_ns > 0
        session = t.client.join("bee", GRID).session_id
        assert t.client.status().agents[-1].last_seen_ns == 0
        t.client.keep_session(session, "doubtful")
        t.client.keep_session(session)
        [_, bee] = t.client.status().agents
        assert bee.last_seen_ns > 0
        assert bee.localisation == LOCALISATION_DOUBTFUL


def test_a_robot_whose_agent_id_another_one_uses_is_refused(fusion: RunningServer) -> None:
    first, second = (fusion.client.join("ant", GRID).session_id for _ in range(2))
    with pytest.raises(MismatchError, match="another robot uses this name"):
        fusion.contribute_subsets(first, make_subset("ant", 1, {0: [1]}))
    pytest.raises(MismatchError, fusion.client.leave, first)
    other = FusionClient(fusion.client.address)
    with other, pytest.raises(NameInUseError, match="end of its lease") as refused:
        other.join("ant", GRID)
    assert 0 < refused.value.retry_after_s <= 60
    assert fusion.contribute_subsets(second, make_subset("ant", 1, {0: [1]}))[0].status == ACCEPTED


def test_the_error_of_an_unknown_session_asks_to_join_again(fusion: RunningServer) -> None:
    pytest.raises(SessionUnknownError, fusion.contribute_subsets, "never given", make_subset("ant", 1, {0: [1]}))
    pytest.raises(SessionUnknownError, fusion.client.contribute_keyframes, "never given", [frame(0)])
    pytest.raises(SessionUnknownError, fusion.client.leave, "never given")
    with pytest.raises(grpc.RpcError) as caught:
        fusion.stub.LeaveSession(pb.LeaveSessionRequest(session_id="x"))
    assert caught.value.code() is grpc.StatusCode.NOT_FOUND


def test_another_mission_config_is_a_mismatch_that_names_both_values(fusion: RunningServer) -> None:
    pytest.raises(MismatchError, fusion.client.join, "ant", VoxelGrid(0.2)).match(r"0\.1 m, got 0\.2 m")
    session = fusion.client.join("ant", GRID, world_frame="map").session_id
    fusion.client.join("bee", GRID)
    with pytest.raises(MismatchError, match="world frame: expected 'map' as agreed here, got 'odom'"):
        fusion.client.join("cat", GRID, world_frame="odom")
    fusion.client.mission_id = "other"
    for call in (lambda: fusion.client.join("cat", GRID), fusion.client.status, lambda: fusion.client.export(Export()),
                 lambda: next(fusion.client.watch()), lambda: next(fusion.client.refine())):  # fmt: skip
        pytest.raises(MismatchError, call).match("mission: expected 'mission' as agreed here, got 'other'")
    coarse = VoxelGrid(1.0)
    subset = RoiSubset("ant", "", 1, 1, make_batch({}))
    pytest.raises(MismatchError, fusion.contribute_subsets, session, subset, grid=coarse).match("voxel size")


def test_names_of_agents_and_missions_have_a_safe_alphabet(fusion: RunningServer) -> None:
    for name in ("", "x" * 65, "-rf", "a b", "a\nb", "a/b", "\x1b[31m", "Ünal"):
        fusion.client.mission_id = ""
        with pytest.raises(InvalidInputError, match=r"agent_id: expected 1 to 64 letters, digits and \. _ -"):
            fusion.client.join(name, GRID)
        fusion.client.mission_id = name
        if name:
            with pytest.raises(InvalidInputError, match="mission_id: expected 1 to 64 letters"):
                fusion.client.join("ant", GRID)


def test_a_grid_is_required(fusion: RunningServer) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        fusion.stub.JoinSession(pb.JoinSessionRequest(agent_id="ant"))
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT


def test_a_fresh_map_begins_at_zero_and_a_forgotten_agent_leaves_no_updates(fusion: RunningServer) -> None:
    fusion.contribute_subsets(fusion.client.join("ant", GRID).session_id, make_subset("ant", 7, {0: [1]}))
    session = fusion.client.join("ant", GRID, fresh_map=True)
    assert session.highest_update_seq == 0
    assert fusion.client.status().fused_voxels == 1
    assert fusion.contribute_subsets(session.session_id, make_subset("ant", 1, {1: [1]}))[0].status == ACCEPTED
    fusion.client.leave(session.session_id)
    assert fusion.client.status().fused_voxels == 2
    assert not fusion.client.status().agents[0].joined
    fusion.client.leave(fusion.client.join("ant", GRID).session_id, forget=True)
    assert fusion.client.status().fused_voxels == 0
    assert len(fusion.client.status().agents) == 0
    assert len(gaussians_from_ply(fusion.client.export(Export()))) == 0


def test_an_export_of_an_unknown_agent_or_strategy_is_invalid(fusion: RunningServer) -> None:
    pytest.raises(InvalidInputError, fusion.client.export, Export("vote", "ant")).match("no agents yet")
    pytest.raises(InvalidInputError, fusion.client.export, Export("unspecified")).match("strategy")


def test_a_full_store_ends_the_stream_and_the_server_keeps_serving(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "store.sqlite", max_bytes=200_000)
    with fusion_server(store) as t:
        session = t.client.join("ant", GRID).session_id
        with pytest.raises(grpc.RpcError) as caught:
            list(
                t.stub.ContributeSubsets(
                    iter([request(session, make_subset("ant", 1, {c: [1] * 200 for c in range(100)}))])
                )
            )
        assert caught.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert "no space left" in caught.value.details()
        assert t.contribute_subsets(session, make_subset("ant", 2, {0: [1]}))[0].status == ACCEPTED
    store.close()


def test_a_restarted_server_keeps_its_sessions_only_with_a_file(tmp_path: Path) -> None:
    first_life, second_life = SqliteStore(), SqliteStore()
    with fusion_server(first_life) as t:
        session = t.client.join("ant", GRID).session_id
        t.contribute_subsets(session, make_subset("ant", 1, {0: [1]}))
    with fusion_server(second_life) as t, pytest.raises(SessionUnknownError):
        t.contribute_subsets(session, make_subset("ant", 1, {0: [1]}))

    store = SqliteStore(tmp_path / "store.sqlite")
    with fusion_server(store) as t:
        session = t.client.join("ant", GRID, world_frame="map").session_id
        t.contribute_subsets(session, make_subset("ant", 1, {0: [1], 1: [1]}))
        before, seen = t.client.export(Export()), t.client.status().fused_revision
    store.close()
    store = SqliteStore(tmp_path / "store.sqlite")
    with fusion_server(store) as t:
        assert t.contribute_subsets(session, make_subset("ant", 1, {0: [1], 1: [1]}))[0].status == STALE
        assert t.client.export(Export()) == before
        with pytest.raises(RevisionGoneError):
            next(t.client.watch(seen))
        assert t.contribute_subsets(session, make_subset("ant", 2, {2: [1]}))[0].status == ACCEPTED
        pytest.raises(MismatchError, t.client.join, "bee", GRID, world_frame="odom").match("'map'")
    with pytest.raises(MismatchError, match="voxel size"), fusion_server(store, FusionSettings(grid=VoxelGrid(0.2))):
        pass
    store.close()


def test_a_draining_server_ends_open_streams_and_refuses_new_calls(fusion: RunningServer) -> None:
    session = fusion.client.join("ant", GRID).session_id
    watch = fusion.client.watch()
    next(watch)
    silent = threading.Event()

    def one_and_then_silence():
        yield request(session, make_subset("ant", 1, {0: [1]}))
        silent.wait(20)

    stream = fusion.stub.ContributeSubsets(one_and_then_silence())
    assert next(stream).acknowledged == 1
    next(watch)
    fusion.drain()
    pytest.raises(UnavailableError, next, watch).match("draining")
    with pytest.raises(grpc.RpcError) as caught:
        next(stream)
    assert caught.value.code() is grpc.StatusCode.UNAVAILABLE
    silent.set()
    with pytest.raises(grpc.RpcError) as caught:
        fusion.stub.GetSessionStatus(pb.GetSessionStatusRequest())
    assert caught.value.code() is grpc.StatusCode.UNAVAILABLE
