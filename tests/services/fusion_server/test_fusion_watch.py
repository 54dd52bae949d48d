"""A slow watcher gets the sum of the changes it missed: nothing is queued or lost."""

import asyncio
from collections.abc import AsyncIterator, Callable
from unittest.mock import Mock

import numpy as np
import pytest
from call_context import Context
from fusion_running import GRID, keys, make_subset
from torch_oracle.rasterizer import ReferenceRasterizer

from gausslite.codec.subset_codec import decode_subset
from gausslite.domain.pose import transform_of
from gausslite.domain.voxels import VoxelBatch
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.fused_map import FusedMapLayers, MapLayer
from gausslite.fusion.limits import FusionSettings, MissionConfig
from gausslite.fusion.refinement import RefineSettings
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.v1.gaussians_pb2 import MapBlock
from gausslite.wire.map_changes import EncodedPartCache
from gausslite.wire.views import ChangeNotifier
from gausslite_fusion_server.servicer import FusionServicer
from gausslite_fusion_server.watch import FusedMapReader, WatchFilter

Contribute = Callable[[int, dict[int, list[int]]], None]


def watching(settings: FusionSettings, body: Callable[[AsyncIterator[MapBlock], Contribute], object]) -> None:
    """Run `body` with the blocks of a watcher and a way to contribute while it sleeps."""

    async def run() -> None:
        engine = FusionEngine(SqliteStore(), settings, first_revision=1)
        servicer = FusionServicer(engine, RefineSettings(), ReferenceRasterizer)
        session = engine.join("ant", MissionConfig("", "", GRID.size_m)).session.session_id
        responses = servicer.WatchFusedMap(pb.WatchFusedMapRequest(), Context("unix:"))

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


def test_a_change_is_read_once_for_all_watchers(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = FusionEngine(SqliteStore(), FusionSettings(grid=GRID), first_revision=1)
    session = engine.join("ant", MissionConfig("", "", GRID.size_m)).session.session_id
    cache = EncodedPartCache()
    # those that exclude an agent without voxels share with the others
    excluded = [f"bee-{number}" for number in range(19)]
    readers = [FusedMapReader(engine, WatchFilter(MapLayer.VOTE, None, name), cache) for name in ("", *excluded)]
    before, _ = readers[0].snapshot()
    engine.contribute(session, make_subset("ant", 1, {0: [1]}), GRID)
    monkeypatch.setattr(FusedMapLayers, "changes", Mock(wraps=engine.maps.changes))
    answers = [reader.changes(before) for reader in readers]
    assert all(answer == answers[0] and answer[1] for answer in answers)
    assert FusedMapLayers.changes.call_count == 1


def test_watchers_that_follow_closely_share_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    engine = FusionEngine(SqliteStore(), FusionSettings(grid=GRID), first_revision=1)
    session = engine.join("ant", MissionConfig("", "", GRID.size_m)).session.session_id
    cache = EncodedPartCache()
    early, late = (FusedMapReader(engine, WatchFilter(MapLayer.VOTE, None, name), cache) for name in ("", "bee"))
    before, _ = early.snapshot()
    monkeypatch.setattr(FusedMapLayers, "changes", Mock(wraps=engine.maps.changes))
    engine.contribute(session, make_subset("ant", 1, {0: [1]}), GRID)
    revision, parts = early.changes(before)
    engine.contribute(session, make_subset("ant", 2, {1: [1]}), GRID)
    assert late.changes(before) == (revision, parts)
    assert late.changes(revision) == early.changes(revision)
    assert FusedMapLayers.changes.call_count == 2


def test_work_in_the_background_wakes_the_watchers() -> None:
    async def run() -> None:
        engine = FusionEngine(SqliteStore(), FusionSettings(grid=GRID), first_revision=1)
        servicer = FusionServicer(engine, RefineSettings(), ReferenceRasterizer)
        session = engine.join("ant", MissionConfig("", "", GRID.size_m)).session.session_id
        engine.contribute(session, make_subset("ant", 1, {0: [1]}), GRID)
        responses = servicer.WatchFusedMap(pb.WatchFusedMapRequest(), Context("unix:"))
        assert (await anext(responses)).block.snapshot
        engine.declare_frame("ant", transform_of(np.array([1.0, 0, 0, 0, 0, 0])))
        servicer._slices.wake()
        assert not (await asyncio.wait_for(anext(responses), 10)).block.snapshot
        await responses.aclose()
        servicer.close()

    asyncio.run(run())


def test_watchers_wake_together_after_many_changes() -> None:
    async def run() -> None:
        changes, woken = ChangeNotifier(), []

        async def watch(number: int) -> None:
            while True:
                await changes.subscribe().wait()
                woken.append(number)

        watchers = [asyncio.ensure_future(watch(number)) for number in range(3)]
        await asyncio.sleep(0)
        for _ in range(20):
            changes.notify()
            await asyncio.sleep(0)
        # the first change wakes them at once, the others together
        await asyncio.wait_for(changes.subscribe().wait(), 30)
        await asyncio.sleep(0)
        assert sorted(woken) == [0, 0, 1, 1, 2, 2]
        for watcher in watchers:
            watcher.cancel()

    asyncio.run(run())
