"""Calls to the other servers of a mission end, whatever these do."""

import asyncio
from pathlib import Path
from typing import Any

import grpc
import pytest
from fusion_running import make_subset

from gausslite.codec.encoded_voxels import EncodedSubset
from gausslite.domain.errors import UnavailableError
from gausslite.v1 import region_service_pb2_grpc as region_pb_grpc

pytest.importorskip("psycopg", reason="the extra `postgres` is not installed")
from gausslite_cluster.peers import Peers


class SilentServer(region_pb_grpc.RegionServiceServicer):
    async def StorePart(self, request: Any, context: Any) -> Any:
        await asyncio.sleep(600)


def test_a_server_that_never_answers_does_not_hold_a_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gausslite_cluster.peers.CALL_S", 0.2)

    async def send() -> None:
        server, peers, address = grpc.aio.server(), Peers(None), f"unix:{tmp_path}/peer.sock"
        region_pb_grpc.add_RegionServiceServicer_to_server(SilentServer(), server)
        server.add_insecure_port(address)
        await server.start()
        part = EncodedSubset.exact(make_subset("ant", 1, {11: [1]}))
        try:
            with pytest.raises(UnavailableError):
                await asyncio.wait_for(peers.send_part(address, "session", part), 20)
        finally:
            await peers.close()
            await server.stop(None)

    asyncio.run(send())
