"""Agents, voxel updates and a fusion server in process, for the tests of the service."""

import asyncio
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import grpc
import numpy as np
from sample_gaussians import plain_gaussians
from serving import serving
from torch_oracle.rasterizer import ReferenceRasterizer

from gausslite.codec.subset_codec import encode_subset
from gausslite.domain.camera import Camera
from gausslite.domain.frame import Frame
from gausslite.domain.objects import ObjectLandmark, ObjectRole
from gausslite.domain.task import TaskGraph
from gausslite.domain.voxels import (
    AxisAlignedBox,
    RoiSubset,
    VoxelBatch,
    VoxelGrid,
    group_by_voxel,
    merge_batches,
    tombstones,
)
from gausslite.fusion.alignment import FrameAligner
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.refinement import RefineSettings
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite.render.rasterizer import gaussians_to_rows
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1 import fusion_service_pb2_grpc as pb_grpc
from gausslite.wire.clients import FusionClient
from gausslite.wire.convert import decode_frame
from gausslite.wire.security import Tls
from gausslite_fusion_server.plugins import added_services
from gausslite_fusion_server.servicer import FusionServicer

GRID = VoxelGrid(0.10)
COMMAND = [sys.executable, "-m", "gausslite_fusion_server"]
CAMERA = Camera(40.0, 40.0, 16.0, 12.0, 32, 24)
GRAPH = TaskGraph("t", "Pick up the mug", ("mug",), (), ())
MUG = ObjectLandmark(
    "mug-1", "mug", ObjectRole.TARGET, (1.0, 2.0, 3.0), AxisAlignedBox((0.9, 1.9, 2.9), (1.1, 2.1, 3.1)), 0.5, 7, 9
)


@dataclass(frozen=True)
class RunningServer:
    """A running server and its clients."""

    servicer: FusionServicer
    client: FusionClient
    stub: pb_grpc.FusionServiceStub
    channel: grpc.Channel
    loop: asyncio.AbstractEventLoop

    def drain(self) -> None:
        """Drain the server, as on SIGTERM."""
        self.loop.call_soon_threadsafe(self.servicer.drain)

    def contribute_subsets(
        self, session_id: str, *subsets: RoiSubset, grid: VoxelGrid = GRID
    ) -> list[pb.SubsetOutcome]:
        """Send these subsets on one stream and return their outcomes."""
        return self.send(*(request(session_id, subset, grid) for subset in subsets))

    def send(self, *requests: pb.ContributeSubsetsRequest) -> list[pb.SubsetOutcome]:
        return [outcome for answer in self.client.contribute(requests, 20.0) for outcome in answer.outcomes]


def request(session_id: str, subset: RoiSubset, grid: VoxelGrid = GRID) -> pb.ContributeSubsetsRequest:
    return pb.ContributeSubsetsRequest(
        session_id=session_id, sequence=subset.message_seq, purpose=pb.PURPOSE_ROI, subset=encode_subset(subset, grid)
    )


@contextmanager
def fusion_server(
    store: FusionStore | None = None,
    settings: FusionSettings | None = None,
    refine: RefineSettings | None = None,
    tls: Tls | None = None,
    address: str | None = None,
    aligner: FrameAligner | None = None,
) -> Iterator[RunningServer]:
    """Start a fusion server as `serving` does, with the reference rasterizer; the caller owns the store.

    With tls the client uses the server's certificate; the stub and the channel do not work then.
    """
    settings = settings or FusionSettings(grid=GRID)
    engine = FusionEngine(store or SqliteStore(), settings, decode_keyframe=decode_frame, aligner=aligner)
    settings_of_refinement = refine or RefineSettings(iterations=3, report_every=1)
    servicer = FusionServicer(engine, settings_of_refinement, ReferenceRasterizer)
    loops, others = [], added_services(lambda: engine)

    def register(server: grpc.aio.Server) -> None:
        loops.append(asyncio.get_running_loop())
        servicer.service().register(server)

    try:
        with (
            serving([replace(servicer.service(), register=register), *others], address, tls=tls) as running,
            FusionClient(running.address, tls=tls) as client,
            grpc.insecure_channel(running.address) as channel,
        ):
            yield RunningServer(servicer, client, pb_grpc.FusionServiceStub(channel), channel, loops[0])
            loops[0].call_soon_threadsafe(servicer.drain)
    finally:
        servicer.close()


@contextmanager
def server_process(
    *arguments: str, log: Path = Path(os.devnull), ready_s: float = 30, command: Sequence[str] = COMMAND
) -> Iterator[tuple[subprocess.Popen[bytes], FusionClient]]:
    """Start a server in another process and wait until it is ready; it is killed at the end."""
    with tempfile.TemporaryDirectory() as folder, log.open("wb") as stderr:
        address = f"unix:{folder}/fusion.sock"
        process = subprocess.Popen([*command, "--listen", address, *arguments], stderr=stderr)
        try:
            options = [("grpc.initial_reconnect_backoff_ms", 100), ("grpc.max_reconnect_backoff_ms", 200)]
            with grpc.insecure_channel(address, options) as channel:
                grpc.channel_ready_future(channel).result(ready_s)
            with FusionClient(address, deadline_s=20.0) as client:
                yield process, client
        finally:
            process.kill()
            process.wait(20)


def make_batch(cells: dict[int, Sequence[int]]) -> VoxelBatch:
    """Make updates from the kappas of the Gaussians in each cell along x; an empty list is a tombstone."""
    kappas = [(cell, kappa) for cell in sorted(cells) for kappa in cells[cell]]
    n = len(kappas)
    numbers = np.random.default_rng(n).random((n, 3), np.float32)
    corners = np.array([[0.1 * cell, 0, 1.0] for cell, _ in kappas] or np.zeros((0, 3)))
    means = numbers * 0.08 + 0.01 + corners
    gaussians = plain_gaussians(means, rgb=numbers, kappa=[kappa for _, kappa in kappas])
    return merge_batches(
        group_by_voxel(gaussians, GRID), tombstones(keys(*(cell for cell in cells if not cells[cell])))
    )


def keys(*cells: int) -> np.ndarray:
    centres = np.array([(0.1 * cell + 0.05, 0.05, 1.05) for cell in sorted(cells)], np.float32).reshape(-1, 3)
    return GRID.keys(centres)


def make_subset(agent_id: str, revision: int, cells: dict[int, Sequence[int]]) -> RoiSubset:
    return RoiSubset(agent_id, "", revision, revision, make_batch(cells))


def frame(index: int, camera: Camera = CAMERA, T_world_camera: np.ndarray | None = None) -> Frame:
    """A view from the origin along z, a shaded grey wall 1.2 m away."""
    size = (camera.height_px, camera.width_px)
    shade = np.linspace(100, 140, camera.width_px).astype(np.uint8)
    return Frame(
        index,
        index * 1_000_000,
        np.broadcast_to(shade[None, :, None], (*size, 3)).copy(),
        np.full(size, 1.2, np.float32),
        camera,
        np.eye(4) if T_world_camera is None else T_world_camera,
    )


def photograph(index: int, cells: dict[int, Sequence[int]]) -> Frame:
    """A view of the map of these cells, a little brighter than the map."""
    rendering = ReferenceRasterizer().forward(gaussians_to_rows(make_batch(cells).gaussians), CAMERA, np.eye(4))
    rgb = np.clip(np.rint(rendering.rgb * 255) + 9, 0, 255).astype(np.uint8)
    return replace(frame(index), rgb=rgb, depth_m=rendering.expected_depth_m())


def red_frame(index: int) -> Frame:
    """A view whose middle the tiny detector takes for a cup."""
    plain = frame(index)
    rgb = np.zeros_like(plain.rgb)
    rgb[6:18, 8:24, 0] = 255
    return replace(plain, rgb=rgb)
