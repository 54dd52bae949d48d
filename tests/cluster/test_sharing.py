"""Several servers of one database: any accepts any agent, each stores its regions alone, and the map is that of one."""

import asyncio
import random
import signal
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import grpc
import numpy as np
import pytest
from certificates import identity, make_certificates
from fusion_running import CAMERA, COMMAND, GRAPH, GRID, MUG, frame, fusion_server, request
from sample_gaussians import plain_gaussians
from sharing_running import SharingServer, sharing_server, sharing_servers, wait_until_settled
from support.postgres_running import PostgresServer
from waiting import wait_until

from gausslite.codec.ply import gaussians_from_ply, ply_bytes
from gausslite.codec.subset_codec import encode_subset, unpack_subset
from gausslite.domain.errors import (
    CodecError,
    GaussLiteError,
    InvalidInputError,
    MismatchError,
    NameInUseError,
    NotPermittedError,
    RevisionGoneError,
    SessionUnknownError,
    StorageError,
)
from gausslite.domain.objects import ObjectReport
from gausslite.domain.voxel_changes import TileDigests
from gausslite.domain.voxels import (
    AxisAlignedBox,
    RoiSubset,
    VoxelBatch,
    crop_to_box,
    empty_batch,
    group_by_voxel,
    select_keys,
)
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.vote import fuse
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1.fusion_service_pb2_grpc import FusionServiceStub
from gausslite.v1.geometry_pb2 import LOCALISATION_LOST
from gausslite.v1.region_service_pb2 import RemoveAgentRequest, StorePartRequest
from gausslite.v1.region_service_pb2_grpc import RegionServiceStub
from gausslite.wire.channel import open_channel
from gausslite.wire.clients import Export
from gausslite.wire.convert import MapUpdate, frame_to_message
from gausslite.wire.status import from_rpc_error
from gausslite_bench.async_calls import UpdateStreams
from gausslite_cluster.regions import ALL_SLOTS, slots_of, wanted_slots

pytest.importorskip("psycopg", reason="the extra `postgres` is not installed")

pytestmark = pytest.mark.slow

AGENTS = ("ant", "bee", "cat")


@pytest.fixture
def folder() -> Iterator[Path]:
    # a short path, for the sockets
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@pytest.fixture
def servers(postgres: PostgresServer, folder: Path) -> Iterator[list[SharingServer]]:
    with sharing_servers(postgres.new_database(), folder, 3) as running:
        yield running


def scattered(agent_id: str, seq: int, seed: int, count: int = 60) -> RoiSubset:
    """Voxels of many regions; messages with other seeds share some."""
    rng = np.random.default_rng(seed)
    means = (np.random.default_rng(seed % 3).uniform(-40, 40, (count, 3))).astype(np.float32)
    kappa = rng.integers(1, 99, count).tolist()
    gaussians = plain_gaussians(means, rgb=rng.random((count, 3), np.float32), kappa=kappa)
    return RoiSubset(agent_id, "", seq, seq, group_by_voxel(gaussians, GRID))


def latest_of(subsets: list[RoiSubset]) -> VoxelBatch:
    """One agent's latest update of each voxel, as a store has it after these messages."""
    store = SqliteStore()
    for subset in subsets:
        stored = unpack_subset(encode_subset(subset, GRID))[0]
        store.put_all([replace(stored, voxels=stored.voxels.with_computed_sums())])
    return store.batch(subsets[0].agent_id)


def keyframe_request(session_id: str, index: int) -> pb.ContributeKeyframesRequest:
    return pb.ContributeKeyframesRequest(session_id=session_id, keyframe=frame_to_message(frame(index)))


def offline(subsets: dict[str, list[RoiSubset]]) -> bytes:
    """The offline vote of all agents' latest updates, as the bytes of a file."""
    return ply_bytes(fuse({name: latest_of(own) for name, own in subsets.items()}).batch.gaussians)


def watched(updates: Iterator[MapUpdate], snapshot: bool = True) -> VoxelBatch:
    """The map after the first complete state that is sent."""
    batch = empty_batch()
    for update in updates:
        batch = update.apply_to(batch)
        if update.last and update.snapshot is snapshot:
            return batch
    raise AssertionError("the stream has ended")


def same(left: VoxelBatch, right: VoxelBatch) -> bool:
    """Whether two maps are equal but for the precision of the messages to watchers."""
    return (
        np.array_equal(left.keys, right.keys)
        and np.array_equal(left.counts, right.counts)
        and np.array_equal(left.kappa_sums, right.kappa_sums)
    )


def test_shuffled_and_repeated_messages_to_three_servers_give_the_offline_vote_bit_for_bit(
    servers: list[SharingServer],
) -> None:
    subsets = {name: [scattered(name, seq, seq * 7 + i) for seq in range(1, 6)] for i, name in enumerate(AGENTS)}
    rng = random.Random(0)
    sessions = {name: servers[0].client.join(name, GRID).session_id for name in AGENTS}
    messages = [request(sessions[name], subset) for name in AGENTS for subset in subsets[name] * 2]
    rng.shuffle(messages)
    for message in messages:
        # any server, whichever the agent has joined at
        [answer] = rng.choice(servers).client.contribute([message], 20.0)
        assert answer.outcomes[0].status in (pb.SUBSET_STATUS_ACCEPTED, pb.SUBSET_STATUS_STALE)
    expected = offline(subsets)
    assert [server.client.export(Export()) == expected for server in servers] == [True, True, True]
    counts = [server.share.counts() for server in servers]
    assert sum(count.received for count in counts) == len(messages)
    assert sum(count.stored for count in counts) >= len(messages)
    assert all(count.stored and count.sent for count in counts)
    assert [count.foreign for count in counts] == [0, 0, 0]
    slots = [server.share.host.owned.slots for server in servers]
    assert frozenset.union(*slots) == ALL_SLOTS
    assert sum(map(len, slots)) == len(ALL_SLOTS)
    # each server has its part alone
    parts = [server.share.engine().status() for server in servers]
    total = servers[0].client.status()
    assert total.fused_voxels == sum(part.fused_voxels for part in parts) == len(gaussians_from_ply(expected).means_m)
    assert [agent.agent_id for agent in total.agents] == list(AGENTS)
    assert all(agent.joined for agent in total.agents)
    assert sum(agent.subsets_accepted + agent.subsets_stale for agent in total.agents) == len(messages)


def test_an_agent_sends_to_the_owner_of_its_voxels_and_back_to_its_server_when_that_ends(
    postgres: PostgresServer, folder: Path
) -> None:
    with sharing_servers(postgres.new_database(), folder, 2) as (first, second):
        session = first.client.join("ant", GRID).session_id
        wide = scattered("ant", 1, 1, 400)
        keys = wide.batch.keys[np.isin(slots_of(wide.batch.keys), sorted(second.share.host.owned.slots))]
        subsets = [replace(wide, update_seq=seq, batch=select_keys(wide.batch, keys[seq::9])) for seq in range(1, 9)]

        def send(subset: RoiSubset) -> str:
            [answer] = first.client.contribute([request(session, subset)], 30.0)
            assert answer.outcomes[0].status == pb.SUBSET_STATUS_ACCEPTED
            return answer.outcomes[0].owner

        assert [send(subset) for subset in subsets[:4]] == [second.address, "", "", ""]
        assert [server.share.counts().received for server in (first, second)] == [1, 3]
        assert first.share.counts().sent == 1
        assert first.client.keep_session(session).highest_update_seq == 4
        second.stop()
        assert [send(subset) for subset in subsets[4:]] == [""] * 4
        assert first.client.keep_session(session).highest_update_seq == 8
        assert first.share.counts().received == 5
        assert first.client.export(Export()) == offline({"ant": subsets})


def test_a_watcher_of_one_server_sees_the_changes_of_all(servers: list[SharingServer]) -> None:
    ant = servers[0].client.join("ant", GRID).session_id
    first = scattered("ant", 1, 1)
    list(servers[0].client.contribute([request(ant, first)], 20.0))
    watch = servers[1].client.watch()
    batch = empty_batch()
    for update in watch:
        batch = update.apply_to(batch)
        if update.last:
            break
    assert same(batch, latest_of([first]))
    second = scattered("ant", 2, 2)
    list(servers[2].client.contribute([request(ant, second)], 20.0))
    expected = latest_of([first, second])
    while not same(batch, expected):
        update = next(watch)
        assert not update.snapshot
        batch = update.apply_to(batch)
    since = update.revision if update.last else next(seen.revision for seen in watch if seen.last)
    # the number is a vector of that server's: it gives the changes since, and another server does not know it
    third = scattered("ant", 3, 3)
    list(servers[2].client.contribute([request(ant, third)], 20.0))
    expected = latest_of([first, second, third])
    for update in servers[1].client.watch(since_revision=since):
        assert not update.snapshot
        batch = update.apply_to(batch)
        if same(batch, expected):
            break
    with pytest.raises(RevisionGoneError):
        next(servers[0].client.watch(since_revision=since))
    [key] = expected.keys[:1].tolist()
    centre = GRID.centres_m(np.array([key], np.int64))[0]
    box = AxisAlignedBox(tuple((centre - 2).tolist()), tuple((centre + 2).tolist()))
    assert same(watched(servers[0].client.watch(region=box)), crop_to_box(expected, box, GRID))


def test_what_is_known_of_an_agent_is_the_same_at_every_server(servers: list[SharingServer]) -> None:
    one, two, three = (server.client for server in servers)
    session = one.join("ant", GRID, task=GRAPH).session_id
    subsets = [scattered("ant", seq, seq) for seq in (1, 2)]
    list(two.contribute([request(session, subset) for subset in subsets], 20.0))
    pytest.raises(NameInUseError, three.join, "ant", GRID)
    assert [client.keep_session(session, "lost").highest_update_seq for client in (one, two, three)] == [2, 2, 2]
    assert [client.status().agents[0].localisation for client in (one, two, three)] == [LOCALISATION_LOST] * 3
    digests = [client.stored_digests(session) for client in (one, two, three)]
    latest = np.concatenate([np.full(len(own.batch), own.update_seq, np.int64) for own in subsets])
    keys = np.concatenate([own.batch.keys for own in subsets])
    last = dict(zip(keys.tolist(), latest.tolist(), strict=True))
    expected = TileDigests.of(np.array(list(last), np.int64), np.array(list(last.values()), np.int64))
    assert all(len(own.differing(expected)) == len(expected.differing(own)) == 0 for own in digests)
    for client in (one, two, three):
        for objects in ((), (MUG,)):
            client.report_objects(session, ObjectReport(GRAPH, objects))
            assert [len(other.query_objects("mug")) for other in (one, two, three)] == [len(objects)] * 3
    assert three.contribute_keyframes(session, [frame(3), frame(4)]) == 2
    stored = [client.keyframe("ant") for client in (one, two, three)]
    assert [keyframe is not None and keyframe.index for keyframe in stored] == [4, 4, 4]
    mixed = [keyframe_request(name, 4) for name in (session, "another")]
    for server in servers:
        with open_channel(server.address, None) as channel, pytest.raises(grpc.RpcError, match="'another': unknown"):
            FusionServiceStub(channel).ContributeKeyframes(iter(mixed), timeout=20.0)
    assert [(agent.keyframes, list(agent.targets)) for agent in one.status().agents] == [(2, ["mug"])]
    with pytest.raises(MismatchError, match="several share this mission"):
        next(one.refine())
    pytest.raises(MismatchError, one.render, CAMERA, np.eye(4)).match("several share this mission")
    assert two.evict("ant", ban=True) == len(last)
    assert [client.status().fused_voxels for client in (one, two, three)] == [0, 0, 0]
    assert [len(client.query_objects()) for client in (one, two, three)] == [0, 0, 0]
    with pytest.raises(SessionUnknownError):
        list(two.contribute([request(session, subsets[0])], 20.0))
    pytest.raises(NotPermittedError, one.join, "ant", GRID).match("banned")
    assert list(three.status().banned_agents) == ["ant"]
    three.unban("ant")
    pytest.raises(InvalidInputError, one.evict, "nobody")
    assert two.join("ant", GRID).highest_update_seq == 0


def test_a_fresh_map_keeps_the_earlier_one_in_every_region_and_other_frames_are_refused(
    servers: list[SharingServer],
) -> None:
    first, second = scattered("ant", 1, 1), scattered("ant", 1, 2)
    exports = []
    with fusion_server() as alone:
        for client in (alone.client, servers[0].client):
            session = client.join("ant", GRID).session_id
            list(client.contribute([request(session, first)], 20.0))
            session = client.join("ant", GRID, fresh_map=True).session_id
            list(client.contribute([request(session, second)], 20.0))
            exports.append(client.export(Export()))
    assert exports[0] == exports[1]
    # frames are used as they are
    T_fused_agent = np.eye(4)
    servers[0].client.join("bee", GRID, T_fused_agent=T_fused_agent)
    T_fused_agent[0, 3] = 1.0
    with pytest.raises(MismatchError, match="several servers share this mission"):
        servers[0].client.join("bee", GRID, T_fused_agent=T_fused_agent)


def test_a_server_that_ends_or_joins_moves_regions_and_loses_nothing(postgres: PostgresServer, folder: Path) -> None:
    url = postgres.new_database()
    subsets = [scattered("ant", seq, seq) for seq in range(1, 7)]
    with sharing_servers(url, folder, 2) as servers:
        client = servers[0].client
        session = client.join("ant", GRID).session_id
        watch, batch = client.watch(), empty_batch()
        list(client.contribute([request(session, subset) for subset in subsets[:2]], 20.0))
        servers[1].stop()
        list(client.contribute([request(session, subset) for subset in subsets[2:4]], 30.0))
        assert client.export(Export()) == offline({"ant": subsets[:4]})
        with sharing_server(url, f"unix:{folder}/late.sock") as late:
            wait_until_settled([servers[0], late])
            late_client = late.client
            list(late_client.contribute([request(session, subset) for subset in subsets[4:]], 30.0))
            expected = offline({"ant": subsets})
            assert late_client.export(Export()) == client.export(Export()) == expected
            # the watcher that was there all the time has the same map
            final = watched(late_client.watch())
            while not same(batch, final):
                batch = next(watch).apply_to(batch)


def test_a_killed_owner_is_replaced_and_acknowledged_messages_are_in_the_map(
    postgres: PostgresServer, folder: Path
) -> None:
    url = postgres.new_database()
    peer = f"unix:{folder}/killed.sock"
    with sharing_server(url, f"unix:{folder}/own.sock") as own:
        arguments = ["--store", url, "--set", f"peer-address={peer}", "--listen", peer, "--voxel-size", "0.1"]
        with subprocess.Popen([*COMMAND, *arguments], stderr=subprocess.DEVNULL) as process:
            wait_until(lambda: own.share.host.owners.are_complete and peer in own.share.host.owners.server_of.values())
            session = own.client.join("ant", GRID).session_id
            subsets = [scattered("ant", seq, seq) for seq in range(1, 9)]
            for number, subset in enumerate(subsets):
                if number == 4:
                    process.kill()
                    process.wait(20)
                [answer] = own.client.contribute([request(session, subset)], 30.0)
                assert answer.outcomes[0].status == pb.SUBSET_STATUS_ACCEPTED
            assert own.client.export(Export()) == offline({"ant": subsets})
            assert own.share.host.owned.slots == ALL_SLOTS


def test_a_server_refuses_what_an_owner_that_has_stopped_cannot_take(
    postgres: PostgresServer, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # a tenth of the default, so that the owner is stopped for less time than a connection may be silent
    monkeypatch.setattr("gausslite_cluster.peers._OWNER_BYTES", 1_600_000)
    url, peer, address = postgres.new_database(), f"unix:{folder}/stopped.sock", f"unix:{folder}/own.sock"
    with sharing_server(url, address) as own:
        arguments = ["--store", url, "--set", f"peer-address={peer}", "--listen", peer, "--voxel-size", "0.1"]
        with subprocess.Popen([*COMMAND, *arguments], stderr=subprocess.DEVNULL) as process:
            wait_until(lambda: own.share.host.owners.are_complete and peer in own.share.host.owners.server_of.values())
            owned, refusals = sorted(own.share.host.owned.slots), list[str]()
            names = [f"ant-{number}" for number in range(20)]
            sessions = [own.client.join(name, GRID).session_id for name in names]
            large = scattered("ant", 1, 1, 4_000).batch
            foreign = select_keys(large, large.keys[~np.isin(slots_of(large.keys), owned)])
            near = select_keys(large, large.keys[np.isin(slots_of(large.keys), owned)])

            async def send() -> list[bool]:
                async with UpdateStreams(address) as streams:

                    async def is_stored(name: str, session: str) -> bool:
                        try:
                            await streams.open(session).send(encode_subset(RoiSubset(name, "", 1, 1, foreign), GRID))
                        except grpc.aio.AioRpcError as error:
                            refusals.append(str(error.details()))
                            return False
                        return True

                    calls = [asyncio.ensure_future(is_stored(*pair)) for pair in zip(names, sessions, strict=True)]
                    await asyncio.wait(calls, return_when=asyncio.FIRST_COMPLETED)
                    # the regions that have an owner that works are served
                    await streams.open(sessions[0]).send(encode_subset(RoiSubset(names[0], "", 2, 2, near), GRID))
                    process.send_signal(signal.SIGCONT)
                    return await asyncio.gather(*calls)

            process.send_signal(signal.SIGSTOP)
            stored = asyncio.run(send())
            process.kill()
            assert 0 < sum(stored) < len(names)
            assert all(f"MiB wait for {peer}" in refusal for refusal in refusals)


def test_only_the_slots_of_a_server_that_ends_move() -> None:
    names = ("a:1", "b:1", "c:1", "d:1")
    before = {name: wanted_slots(names, name) for name in names}
    assert frozenset.union(*before.values()) == ALL_SLOTS
    assert sum(map(len, before.values())) == len(ALL_SLOTS)
    after = {name: wanted_slots(names[1:], name) for name in names[1:]}
    assert all(before[name] <= after[name] for name in names[1:])
    assert frozenset.union(*after.values()) == ALL_SLOTS


def test_with_certificates_only_servers_call_each_other(postgres: PostgresServer, folder: Path, tmp_path: Path) -> None:
    certs = make_certificates(tmp_path, "one:server", "two:server", "ant:robot")
    url, robot = postgres.new_database(), identity(certs, "ant")
    with (
        sharing_server(url, f"unix:{folder}/1.sock", identity(certs, "one"), robot) as one,
        sharing_server(url, f"unix:{folder}/2.sock", identity(certs, "two"), robot) as two,
    ):
        wait_until_settled([one, two])
        session = one.client.join("ant", GRID).session_id
        subsets = [scattered("ant", seq, seq) for seq in (1, 2)]
        list(two.client.contribute([request(session, subset) for subset in subsets], 20.0))
        assert one.client.export(Export()) == offline({"ant": subsets})
        assert one.share.counts().stored
        assert two.share.counts().stored
        pytest.raises(NotPermittedError, one.client.join, "bee", GRID)
        with open_channel(one.address, robot) as channel, pytest.raises(grpc.RpcError) as refused:
            RegionServiceStub(channel).RemoveAgent(RemoveAgentRequest(agent_id="ant"))
        assert refused.value.code() is grpc.StatusCode.PERMISSION_DENIED
        assert "the roles server" in refused.value.details()


def test_a_part_that_cannot_be_stored_is_refused_without_effect(
    postgres: PostgresServer, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with sharing_servers(postgres.new_database(), folder, 1) as [server]:
        sessions = {name: server.client.join(name, GRID).session_id for name in AGENTS[:2]}
        first, second = scattered("ant", 1, 1), scattered("ant", 2, 2)
        list(server.client.contribute([request(sessions["ant"], first)], 20.0))
        voxels = unpack_subset(encode_subset(second, GRID))[0].voxels
        good, reversed_keys = voxels.to_row(), voxels.take(np.arange(len(voxels))[::-1]).to_row()
        parts = [
            StorePartRequest(session_id=sessions[name], agent_id="ant", update_seq=seq, voxels=row)
            for name, seq, row in [
                ("ant", 2, good[:-1]),
                ("ant", 2, np.float64(np.nan).tobytes() + good[8:]),
                ("ant", 2, np.float64(0.5).tobytes() + good[8:]),
                ("ant", 2, reversed_keys),
                ("bee", 2, good),
                ("ant", 2**64 - 1, good),
            ]
        ]
        with open_channel(server.address, None) as channel:
            stub = RegionServiceStub(channel)

            def refusal(part: StorePartRequest) -> type[GaussLiteError]:
                with pytest.raises(grpc.RpcError) as refused:
                    stub.StorePart(part, timeout=20.0)
                return type(from_rpc_error(refused.value, ""))

            wrong = [StorageError, CodecError, CodecError, CodecError, NotPermittedError, InvalidInputError]
            assert [refusal(part) for part in parts] == wrong
            assert server.client.export(Export()) == offline({"ant": [first]})
            monkeypatch.setattr(server.share.regions, "store_part", None)  # an error that nobody expects
            assert refusal(parts[4]) is GaussLiteError
