"""The store in PostgreSQL: what is acknowledged survives lost connections and a killed database."""

import time
from collections.abc import Callable
from threading import Thread

import numpy as np
import pytest
from support.postgres_running import PASSWORD, PostgresServer, postgres_server
from support.sample_batches import random_subset

from gausslite.codec.encoded_voxels import EncodedSubset
from gausslite.domain.errors import InvalidInputError, StorageError, UnavailableError
from gausslite_cluster.regions import slots_of

psycopg = pytest.importorskip("psycopg", reason="the extra `postgres` is not installed")

from gausslite_cluster.postgres_regions import SharedSlots  # noqa: E402
from gausslite_cluster.postgres_store import SCHEMA_VERSION, PostgresStore  # noqa: E402

pytestmark = pytest.mark.slow


def execute(url: str, *statements: str) -> None:
    with psycopg.connect(url, autocommit=True) as db:
        for statement in statements:
            db.execute(statement)


def end_connections(url: str) -> None:
    """End all connections of stores to this database, and wait until they are gone."""
    others = "FROM pg_stat_activity WHERE datname = current_database() AND pid <> pg_backend_pid()"
    with psycopg.connect(url, autocommit=True) as db:
        db.execute(f"SELECT pg_terminate_backend(pid, 5000) {others}")
        assert db.execute(f"SELECT count(*) {others}").fetchone() == (0,)


def one_line(act: Callable[[], object]) -> str:
    """The message of the StorageError or InvalidInputError that this raises; it never has the password."""
    with pytest.raises((StorageError, InvalidInputError)) as caught:
        act()
    text = str(caught.value)
    assert "\n" not in text
    assert PASSWORD not in text
    return text


def test_a_lost_connection_is_opened_again_without_an_error(postgres: PostgresServer) -> None:
    url = postgres.new_database()
    store = PostgresStore(url)
    store.put(random_subset("ant", 1, {11: 2}))
    end_connections(url)
    assert store.put(random_subset("ant", 2, {11: 3, 22: 1})).accepted.tolist() == [11, 22]
    end_connections(url)
    assert store.batch("ant").counts.tolist() == [3, 1]
    store.save_record("ant", "objects", b"mug")
    assert "in use by another server" in one_line(lambda: PostgresStore(url))
    store.close()


def test_a_store_that_another_server_used_meanwhile_refuses_to_go_on(postgres: PostgresServer) -> None:
    url = postgres.new_database()
    store = PostgresStore(url)
    store.put(random_subset("ant", 1, {11: 2}))
    end_connections(url)
    other = PostgresStore(url)
    assert "in use by another server" in one_line(lambda: store.put(random_subset("ant", 2, {11: 3})))
    other.put(random_subset("ant", 5, {11: 4}))
    other.close()
    # the pause after the failed attempt
    time.sleep(0.2)
    assert "changed by another server" in one_line(lambda: store.put(random_subset("ant", 2, {11: 3})))
    store.close()
    again = PostgresStore(url)
    assert again.batch("ant").counts.tolist() == [4]
    again.close()


def test_a_database_is_used_by_one_server_alone_or_shared_with_one_owner_of_each_slot(postgres: PostgresServer) -> None:
    url = postgres.new_database()
    one, two = SharedSlots(url, "one:1"), SharedSlots(url, "two:1")
    assert "share it: set peer-address of both" in one_line(lambda: PostgresStore(url))
    assert "another server has the peer-address two:1" in one_line(lambda: SharedSlots(url, "two:1"))
    assert one.take({1, 2, 3}) == {1, 2, 3}
    assert two.take({3, 4}) == {4}
    assert two.owners().server_of == {1: "one:1", 2: "one:1", 3: "one:1", 4: "two:1"}
    store = one.open_store()
    key = next(key for key in range(0, 1 << 40, 1 << 26) if slots_of(np.array([key]))[0] == 1)
    store.put(random_subset("ant", 1, {key: 2}))
    one.release({2, 3})
    assert two.take({2, 3}) == {2, 3}
    end_connections(url)
    # the locks are gone, so its rows are not its own any more
    pytest.raises(UnavailableError, store.put, random_subset("ant", 2, {key: 3})).match("was lost")
    store.close()
    assert two.owners().servers == ("one:1", "two:1")
    assert two.take({1, 2, 3, 4}) == {1, 2, 3, 4}
    other = two.open_store()
    assert other.batch("ant").counts.tolist() == [2]
    other.close()
    one.close()
    two.close()
    alone = PostgresStore(url)
    assert alone.batch("ant").counts.tolist() == [2]
    assert "in use by another server" in one_line(lambda: SharedSlots(url, "one:1"))
    alone.close()


def test_a_killed_database_loses_nothing_acknowledged(postgres: PostgresServer) -> None:
    url = postgres.new_database()
    store = PostgresStore(url)
    acknowledged: list[int] = []
    errors: list[str] = []

    def put_updates() -> None:
        deadline_s = time.monotonic() + 60
        update_seq = 0
        # until it has gone on for a while after the last failure
        while time.monotonic() < deadline_s and not (errors and len(acknowledged) >= 60):
            update_seq += 1
            try:
                store.put(random_subset("ant", update_seq, {11: 2, 1000 + update_seq: 1}))
                acknowledged.append(update_seq)
            except StorageError as error:
                errors.append(str(error))
                time.sleep(0.02)

    sender = Thread(target=put_updates)
    sender.start()
    while len(acknowledged) < 20:
        time.sleep(0.005)
    postgres.kill()
    while not errors:
        time.sleep(0.005)
    postgres.start()
    sender.join()
    assert len(acknowledged) >= 60
    assert all("not reachable" in text or "lost" in text or "refused" in text for text in errors)
    assert not any(PASSWORD in text for text in errors)
    store.close()
    again = PostgresStore(url)
    assert {1000 + update_seq for update_seq in acknowledged} <= set(again.batch("ant").keys.tolist())
    assert again.totals("ant").highest_update_seq >= acknowledged[-1]
    again.close()


@pytest.mark.parametrize("is_synchronous", [True, False])
def test_a_standby_that_takes_over_is_used_only_if_it_has_all_commits(is_synchronous: bool) -> None:
    with postgres_server() as primary:
        url = primary.new_database()
        PostgresStore(url).close()
        with primary.standby(is_synchronous) as standby:
            url = f"{url},{standby.socket_folder}&target_session_attrs=read-write"
            store = PostgresStore(url)
            store.put(random_subset("ant", 1, {11: 2}))
            incarnation_id = store.incarnation_id
            primary.kill()
            standby.promote()
            if is_synchronous:
                store.put(random_subset("ant", 2, {22: 3}))
                assert store.batch("ant").counts.tolist() == [2, 3]
            else:
                assert "acknowledged data is missing" in one_line(lambda: store.put(random_subset("ant", 2, {22: 3})))
            store.close()
            again = PostgresStore(url)
            assert again.batch("ant").counts.tolist() == ([2, 3] if is_synchronous else [])
            # so that agents compare digests
            assert again.incarnation_id != incarnation_id
            again.close()


def test_a_refused_message_changes_nothing_and_later_ones_are_stored(postgres: PostgresServer) -> None:
    url = postgres.new_database()
    store = PostgresStore(url)
    store.put(random_subset("ant", 1, {11: 3}))
    execute(url, "ALTER TABLE gausslite.voxel_updates ADD CONSTRAINT few CHECK (octet_length(voxels) < 4000)")
    group = [EncodedSubset.exact(random_subset(*own)) for own in (("bee", 2, {11: 5}), ("ant", 2, {11: 1, 22: 100}))]
    assert 'violates check constraint "few"' in one_line(lambda: store.put_all(group))
    assert {name: batch.counts.tolist() for name, batch in store.batches().items()} == {"ant": [3]}
    store.put(random_subset("ant", 3, {11: 2}))
    assert store.batch("ant").counts.tolist() == [2]
    store.close()


def test_damaged_rows_are_one_clear_error(postgres: PostgresServer) -> None:
    url = postgres.new_database()
    store = PostgresStore(url)
    store.put(random_subset("ant", 1, {11: 2}))
    store.save_keyframe("ant", 3, b"image")
    store.save_record("ant", "objects", b"mug")
    execute(url, "UPDATE gausslite.keyframes SET data = 'other'", "UPDATE gausslite.records SET data = 'other'")
    assert "keyframe 3 of agent 'ant' is damaged" in one_line(lambda: store.keyframe("ant", 3))
    assert "record 'objects' of agent 'ant' is damaged" in one_line(lambda: store.records("objects"))
    execute(url, "UPDATE gausslite.voxel_updates SET voxels = set_byte(voxels, 30, 7)")
    assert "of agent 'ant' is damaged" in one_line(lambda: store.batch("ant"))
    store.close()
    assert "of agent 'ant' is damaged" in one_line(lambda: PostgresStore(url))


def test_a_database_without_an_encoding_keeps_names_as_text(postgres: PostgresServer) -> None:
    url = postgres.new_database("ENCODING 'SQL_ASCII' TEMPLATE template0 LOCALE 'C'")
    for sequence in (1, 2):
        store = PostgresStore(url)
        assert store.put(random_subset("ant", sequence, {11: sequence})).accepted.tolist() == [11]
        assert store.batch("ant").counts.tolist() == [sequence]
        store.close()


def test_another_schema_and_missing_rights_are_one_clear_error(postgres: PostgresServer) -> None:
    url = postgres.new_database()
    PostgresStore(url).close()
    execute(url, "UPDATE gausslite.properties SET value = '77' WHERE name = 'schema_version'")
    assert f"to {SCHEMA_VERSION}, got 77" in one_line(lambda: PostgresStore(url))
    guest = postgres.new_database().replace("postgres:", "guest:", 1)
    execute(guest.replace("guest:", "postgres:", 1), "DROP ROLE IF EXISTS guest", "CREATE ROLE guest LOGIN")
    assert "permission denied" in one_line(lambda: PostgresStore(guest))


@pytest.mark.parametrize(
    ("url", "expected"),
    [
        (f"postgresql://ant:{PASSWORD}@127.0.0.1:1/team", "ant@127.0.0.1:1/team: not reachable"),
        (f"postgresql://ant:{PASSWORD}@/team?host=/no/such/folder", "not reachable"),
        (f"postgresql://ant:a@b:{PASSWORD}@c/team", "expected postgresql://USER@HOST/DATABASE"),
        (f"postgresql://ant:a@{PASSWORD}@c/team", "expected postgresql://USER@HOST/DATABASE"),
        (f"postgresql://ant:1/{PASSWORD}@c/team", "expected postgresql://USER@HOST/DATABASE"),
        (f"postgresql://ant@db/team?passwort={PASSWORD}", "expected postgresql://USER@HOST/DATABASE"),
    ],
)
def test_an_address_without_a_database_is_one_line_without_the_password(url: str, expected: str) -> None:
    assert expected in one_line(lambda: PostgresStore(url))
