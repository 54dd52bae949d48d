"""A slow watcher gets the sum of the changes it missed: nothing is queued or lost."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable

from fusion_running import GRID, keys, make_subset

from gausslite.codec.subset_codec import decode_subset
from gausslite.domain.voxels import VoxelBatch
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.limits import FusionSettings
from gausslite.fusion.memory_store import MemoryStore
from gausslite.fusion.refinement import RefineSettings
from gausslite.fusion.store import MissionConfig
from gausslite.render.reference import ReferenceRasterizer
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1.gaussians_pb2 import MapBlock
from gausslite_fusion_server.refinement_worker import RefinementWorker
from gausslite_fusion_server.servicer import FusionServicer

Contribute = Callable[[int, dict[int, list[int]]], None]


def watching(settings: FusionSettings, body: Callable[[AsyncIterator[MapBlock], Contribute], object]) -> None:
    """Run `body` with the blocks of a watcher and a way to contribute while it sleeps."""

    async def run() -> None:
        engine = FusionEngine(MemoryStore(), settings, first_revision=1)
        servicer = FusionServicer(engine, RefinementWorker(RefineSettings(), ReferenceRasterizer))
        session = engine.join("ant", MissionConfig("", "", GRID.size_m)).session.session_id
        responses = servicer.WatchFusedMap(pb.WatchFusedMapRequest(), None)

        async def blocks() -> AsyncIterator[MapBlock]:
            async for response in responses:
                yield response.block

        def contribute(revision: int, cells: dict[int, list[int]]) -> None:
            engine.contribute(session, make_subset("ant", revision, cells), GRID)

        await body(blocks(), contribute)
        await responses.aclose()
        servicer.close()

    asyncio.run(run())


def group_by_voxel(block: MapBlock) -> VoxelBatch:
    return decode_subset(block.subset)[0].batch


def test_many_changes_become_one_with_each_voxel_once() -> None:
    async def body(blocks: AsyncIterator[MapBlock], contribute: Contribute) -> None:
        assert (await anext(blocks)).snapshot
        for revision in range(1, 31):
            contribute(revision, {0: [revision], 1: [1] if revision % 2 else []})
        block = await anext(blocks)
        assert (block.snapshot, block.last) == (False, True)
        batch = group_by_voxel(block)
        assert batch.keys.tolist() == keys(0, 1).tolist()
        assert batch.kappa_sums.tolist() == [30, 0]
        assert batch.counts.tolist() == [1, 0]

    watching(FusionSettings(grid=GRID), body)


def test_a_watcher_that_missed_too_much_gets_a_snapshot() -> None:
    async def body(blocks: AsyncIterator[MapBlock], contribute: Contribute) -> None:
        await anext(blocks)
        contribute(1, {cell: [1] for cell in range(4)})
        for revision, cell in enumerate(range(3), start=2):
            contribute(revision, {cell: []})
        block = await anext(blocks)
        assert block.snapshot
        assert group_by_voxel(block).keys.tolist() == keys(3).tolist()

    watching(FusionSettings(grid=GRID, max_removed_voxels=1), body)
