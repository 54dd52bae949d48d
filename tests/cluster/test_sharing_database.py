"""Servers that share a database which fails: what they have acknowledged is in the map, and they go on with it."""

from pathlib import Path

import pytest
from fusion_running import GRID, request
from sharing_running import SharingServer, sharing_servers, wait_until_settled
from support.postgres_running import PostgresServer
from test_sharing import folder, offline, scattered
from waiting import wait_until

from gausslite.domain.errors import StorageError, UnavailableError
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.clients import Export

pytestmark = pytest.mark.slow

psycopg = pytest.importorskip("psycopg", reason="the extra `postgres` is not installed")

__all__ = ["folder"]


def is_acknowledged(server: SharingServer, message: pb.ContributeSubsetsRequest) -> bool:
    try:
        return len(list(server.client.contribute([message], 20.0))) == 1
    except (StorageError, UnavailableError):
        return False


def test_after_a_killed_database_the_servers_own_their_regions_again(postgres: PostgresServer, folder: Path) -> None:
    subsets = [scattered("ant", seq, seq) for seq in range(1, 7)]
    with sharing_servers(postgres.new_database(), folder, 2) as servers:
        session = servers[0].client.join("ant", GRID).session_id
        before = [server.share.host.owned.slots for server in servers]
        list(servers[0].client.contribute([request(session, subset) for subset in subsets[:3]], 20.0))
        postgres.kill()
        with pytest.raises((StorageError, UnavailableError)):
            list(servers[0].client.contribute([request(session, subsets[3])], 20.0))
        postgres.start()
        # an agent tries again
        for subset in subsets[3:]:
            wait_until(lambda subset=subset: is_acknowledged(servers[1], request(session, subset)))
        wait_until_settled(servers)
        assert [server.share.host.owned.slots for server in servers] == before
        assert servers[0].client.export(Export()) == offline({"ant": subsets})


def test_while_the_database_has_no_space_nothing_is_acknowledged_and_then_all_is_stored(
    postgres: PostgresServer, folder: Path
) -> None:
    url, subsets = postgres.new_database(), [scattered("ant", seq, seq) for seq in (1, 2, 3)]
    with sharing_servers(url, folder, 2) as servers, psycopg.connect(url, autocommit=True) as db:
        session = servers[0].client.join("ant", GRID).session_id
        list(servers[0].client.contribute([request(session, subsets[0])], 20.0))
        db.execute("""
            CREATE FUNCTION fill() RETURNS trigger LANGUAGE plpgsql AS
                $$ BEGIN RAISE SQLSTATE '53100' USING MESSAGE = 'No space left on device'; END $$;
            CREATE TRIGGER full_disk BEFORE INSERT ON gausslite.voxel_updates EXECUTE FUNCTION fill()
        """)
        for server in servers:
            with pytest.raises(StorageError, match="no space left"):
                list(server.client.contribute([request(session, subsets[1])], 20.0))
        assert servers[0].client.export(Export()) == offline({"ant": subsets[:1]})
        db.execute("DROP TRIGGER full_disk ON gausslite.voxel_updates")
        for server, subset in zip(servers, subsets[1:], strict=True):
            list(server.client.contribute([request(session, subset)], 20.0))
        assert servers[0].client.export(Export()) == offline({"ant": subsets})
