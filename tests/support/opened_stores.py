"""Stores of each kind, which a test opens again after it closed them."""

from collections.abc import Callable

import pytest

from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore

OpenStore = Callable[[], FusionStore]


def opener(kind: str, request: pytest.FixtureRequest) -> OpenStore:
    """Return a function that opens the test's store of this kind, again after it was closed."""
    match kind:
        case "memory":
            return SqliteStore
        case "sqlite":
            path = request.getfixturevalue("tmp_path") / "store.sqlite"
            return lambda: SqliteStore(path)
        case _:
            url = request.getfixturevalue("postgres").new_database()
            from gausslite_cluster.postgres_store import PostgresStore

            return lambda: PostgresStore(url)
