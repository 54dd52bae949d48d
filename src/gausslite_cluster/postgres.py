"""The plug-in of gausslite.stores for URLs of PostgreSQL; it is imported before psycopg, which may be missing."""

from __future__ import annotations

from contextlib import AbstractAsyncContextManager
from typing import TYPE_CHECKING, Final

from gausslite.fusion.store import FusionStore
from gausslite.process import import_extra
from gausslite_fusion_server.settings import ServerSettings

if TYPE_CHECKING:
    from gausslite_cluster.shared_servicer import Share


class Postgres:
    """Opens PostgreSQL databases. Raises InvalidInputError without psycopg or for another URL, StorageError."""

    def open_store(self, url: str) -> FusionStore:
        """Return the store of a database for one server."""
        _require_psycopg()
        from gausslite_cluster.postgres_store import PostgresStore

        return PostgresStore(url)

    def open_share(self, settings: ServerSettings, url: str, peer_address: str) -> AbstractAsyncContextManager[Share]:
        """Take part in the mission of a database, together with other servers, while the context is open."""
        _require_psycopg()
        from gausslite_cluster.shared_servicer import open_share

        return open_share(settings, url, peer_address)


def _require_psycopg() -> None:
    import_extra("psycopg", "postgres", "--store postgresql://...")


POSTGRES: Final = Postgres()
