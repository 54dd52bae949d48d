"""Start the fusion server from the command line and end it cleanly on SIGTERM."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import sys
from collections.abc import Sequence

from gausslite.errors import GaussLiteError
from gausslite.fusion.memory import MemoryStore
from gausslite.fusion.sqlite import SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite.fusion.team import TeamMap
from gausslite.wire.server import serve_until_stopped
from gausslite_fusion_server.refinement import Refinery
from gausslite_fusion_server.servicer import FusionServicer
from gausslite_fusion_server.settings import ServerSettings, parse_arguments


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until stopped. Returns 0, or 2 with one line on stderr when the server cannot start or go on."""
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(name)s %(message)s")
    try:
        settings = parse_arguments(arguments)
        store = _open_store(settings)
        with contextlib.closing(store):
            asyncio.run(_serve(settings, store))
    except GaussLiteError as error:
        print(f"gausslite-fusion-server: {error}", file=sys.stderr)
        return 2
    return 0


def _open_store(settings: ServerSettings) -> FusionStore:
    if settings.store is None:
        return MemoryStore()
    return SqliteStore(settings.store, settings.store_max_bytes)


async def _serve(settings: ServerSettings, store: FusionStore) -> None:
    refinery = Refinery(settings.refine, settings.rasterizer)
    servicer = FusionServicer(TeamMap(store, settings.team), refinery)

    async def drain_when_stopping() -> None:
        try:
            await asyncio.Event().wait()
        finally:
            # reached when the server begins to stop: open streams end with UNAVAILABLE instead of being cut
            servicer.drain()

    try:
        await serve_until_stopped(settings.listen, [servicer.service()], drain_when_stopping)
    finally:
        servicer.close()


if __name__ == "__main__":
    sys.exit(main())
