"""An uplink to a real fusion server, or to one with scripted answers."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fusion_running import GRID, make_batch
from serving import serving

from gausslite.codec.subset_codec import decode_subset
from gausslite.domain.errors import GaussLiteError
from gausslite.domain.voxels import VoxelBatch, VoxelGrid
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import fusion_service_pb2_grpc as pb_grpc
from gausslite.wire.clients import FusionClient
from gausslite.wire.server import Service
from gausslite.wire.spool import Spool
from gausslite.wire.update_sender import UplinkSettings
from gausslite.wire.uplink import Uplink

EAGER = UplinkSettings(interval_s=0.0, resend_threshold=0.0, first_backoff_s=0.01)
WAIT_S = 20.0


@contextmanager
def uplink(
    address: str,
    options: UplinkSettings = EAGER,
    spool: Path | None = None,
    grid: VoxelGrid = GRID,
    agent_id: str = "robot",
) -> Iterator[Uplink]:
    opened_spool = Spool(spool, agent_id, grid)
    link = Uplink(FusionClient(address, token=opened_spool.token), agent_id, opened_spool, grid, options)
    try:
        yield link
    finally:
        link.close()


def stored_kappas(store: SqliteStore) -> dict[int, list[int]]:
    """Return the kappas that the server stores of the robot, by voxel, ascending: the codec reorders them."""
    table = store.batch("robot")
    return {
        key: sorted(table.gaussians.kappa[start:end].tolist())
        for key, start, end in zip(table.keys.tolist(), table.offsets[:-1], table.offsets[1:], strict=True)
    }


def expected_kappas(*updates: dict[int, list[int]]) -> dict[int, list[int]]:
    """Return the kappas that remain after these updates, by voxel, ascending."""
    last: dict[int, list[int]] = {}
    for update in updates:
        table = make_batch(update)
        for key, start, end in zip(table.keys.tolist(), table.offsets[:-1], table.offsets[1:], strict=True):
            last[key] = sorted(table.gaussians.kappa[start:end].tolist())
    return last


class ScriptedServer(pb_grpc.FusionServiceServicer):
    """Answers each subset as scripted, and records the subsets."""

    def __init__(self, answer: Callable[[int, VoxelBatch], pb.SubsetOutcome | GaussLiteError]) -> None:
        self._answer = answer
        self.joined: list[bool] = []
        self.subsets: list[VoxelBatch] = []
        self.messages: list[bytes] = []
        self.revisions: list[int] = []
        self.received = threading.Event()

    async def JoinSession(self, request: pb.JoinSessionRequest, context: Any) -> pb.JoinSessionResponse:
        self.joined.append(request.fresh_map)
        # a server without a store: every session begins with an empty one
        return pb.JoinSessionResponse(
            session_id=f"s{len(self.joined)}",
            highest_update_seq=max([100, *self.revisions]),
            incarnation_id=f"i{len(self.joined)}",
        )

    async def GetUpdateDigests(self, request: pb.GetUpdateDigestsRequest, context: Any) -> Any:
        for _ in ():
            yield pb.GetUpdateDigestsResponse()

    async def LeaveSession(self, request: pb.LeaveSessionRequest, context: Any) -> pb.LeaveSessionResponse:
        return pb.LeaveSessionResponse()

    async def ContributeSubsets(self, request_iterator: Any, context: Any) -> Any:
        async for request in request_iterator:
            subset, _ = decode_subset(request.subset)
            self.subsets.append(subset.batch)
            self.messages.append(request.subset)
            self.revisions.append(subset.update_seq)
            self.received.set()
            answer = self._answer(len(self.subsets), subset.batch)
            if isinstance(answer, GaussLiteError):
                raise answer
            answer.sequence = request.sequence
            yield pb.ContributeSubsetsResponse(acknowledged=request.sequence, outcomes=[answer])


def accepted() -> pb.SubsetOutcome:
    return pb.SubsetOutcome(status=pb.SUBSET_STATUS_ACCEPTED)


def rejected(reason: str) -> pb.SubsetOutcome:
    return pb.SubsetOutcome(status=pb.SUBSET_STATUS_REJECTED, reason=reason, message="scripted")


@contextmanager
def scripted(
    answer: Callable[[int, VoxelBatch], pb.SubsetOutcome | GaussLiteError],
) -> Iterator[tuple[ScriptedServer, str]]:
    servicer = ScriptedServer(answer)
    service = Service(
        "gausslite.v1.FusionService", lambda server: pb_grpc.add_FusionServiceServicer_to_server(servicer, server)
    )
    with serving([service]) as running:
        yield servicer, running.address
