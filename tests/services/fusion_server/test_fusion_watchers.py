"""Watchers of the fused map on a real server in process: a snapshot, then changes."""

from collections.abc import Iterator

import grpc
import numpy as np
import pytest
from fusion_running import GRID, RunningServer, keys, make_subset

from gausslite.domain.errors import RevisionGoneError
from gausslite.domain.voxels import AxisAlignedBox, VoxelBatch, empty_batch
from gausslite.v1 import fusion_service_pb2 as pb
from gausslite.wire.convert import MapUpdate


def test_a_watcher_gets_the_snapshot_and_then_the_changes(fusion: RunningServer) -> None:
    ant, bee = (fusion.client.join(name, GRID).session_id for name in ("ant", "bee"))
    fusion.contribute_subsets(ant, make_subset("ant", 1, {0: [5], 1: [1]}))
    watch = fusion.client.watch()
    first = next(watch)
    assert first.snapshot
    assert first.last
    assert first.batch.keys.tolist() == keys(0, 1).tolist()
    assert first.winners == ("ant", "ant")
    fusion.contribute_subsets(bee, make_subset("bee", 1, {0: [1], 1: [2]}))
    second = next(watch)
    assert not second.snapshot
    assert second.batch.keys.tolist() == keys(1).tolist()
    assert second.winners == ("bee",)
    fusion.contribute_subsets(ant, make_subset("ant", 2, {0: []}))
    assert next(watch).winners == ("bee",)
    fusion.client.leave(bee, forget=True)
    third = next(watch)
    assert dict(zip(third.batch.keys.tolist(), third.batch.counts.tolist(), strict=True)) == {
        keys(0)[0]: 0,
        keys(1)[0]: 1,
    }
    watch.close()
    late = fusion.client.watch(first.revision)
    summed_up = next(late)
    assert not summed_up.snapshot
    assert summed_up.revision == third.revision
    assert summed_up.batch.counts.tolist() == [0, 1]
    late.close()
    current = fusion.client.watch(third.revision)
    nothing = next(current)
    assert nothing.last
    assert nothing.batch is None
    current.close()


def test_a_watcher_of_a_region_gets_only_that_region(fusion: RunningServer) -> None:
    session = fusion.client.join("ant", GRID).session_id
    fusion.contribute_subsets(session, make_subset("ant", 1, {0: [1], 5: [1]}))
    watch = fusion.client.watch(region=AxisAlignedBox((0.4, 0.0, 0.0), (0.6, 0.1, 2.0)))
    assert next(watch).batch.keys.tolist() == keys(5).tolist()
    fusion.contribute_subsets(session, make_subset("ant", 2, {0: []}))
    assert next(watch).batch is None
    fusion.contribute_subsets(session, make_subset("ant", 3, {5: []}))
    assert next(watch).batch.counts.tolist() == [0]
    watch.close()
    upside_down = pb.WatchFusedMapRequest()
    upside_down.region.min_m.x = 1.0
    with pytest.raises(grpc.RpcError) as caught:
        next(fusion.stub.WatchFusedMap(upside_down))
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT


def test_a_revision_from_before_a_restart_is_out_of_range(fusion: RunningServer) -> None:
    for revision in (1, fusion.client.join("ant", GRID).fused_revision + 1000):
        with pytest.raises(RevisionGoneError):
            next(fusion.client.watch(revision))


def follow(updates: Iterator[MapUpdate], watched: VoxelBatch) -> VoxelBatch:
    """Return the watched map after the next revision."""
    for update in updates:
        watched = update.apply_to(watched)
        if update.last:
            break
    return watched


def test_applying_all_updates_gives_the_fused_map(fusion: RunningServer) -> None:
    ant, bee = (fusion.client.join(name, GRID).session_id for name in ("ant", "bee"))
    watch = fusion.client.watch()
    watched = follow(watch, empty_batch())
    assert len(watched) == 0
    many = {cell: [1] * 8 for cell in range(3000)}
    for change in (
        lambda: fusion.contribute_subsets(ant, make_subset("ant", 1, {0: [5], 1: [1]})),
        lambda: fusion.contribute_subsets(
            bee, make_subset("bee", 1, {1: [2], **{cell: many[cell] for cell in range(2, 1500)}})
        ),
        lambda: fusion.contribute_subsets(ant, make_subset("ant", 2, {0: [], 1: [7, 1]})),
        lambda: fusion.client.leave(bee, forget=True),
    ):
        change()
        watched = follow(watch, watched)
        now = follow(fusion.client.watch(), empty_batch())
        assert watched.keys.tolist() == now.keys.tolist()
        assert watched.kappa_sums.tolist() == now.kappa_sums.tolist()
        np.testing.assert_array_equal(watched.gaussians.means_m, now.gaussians.means_m)
    # a later snapshot replaces the map, however many parts it has
    for part in range(3):
        fusion.contribute_subsets(
            ant, make_subset("ant", 3 + part, {cell: many[cell] for cell in range(part * 1000, part * 1000 + 1000)})
        )
    again = follow(fusion.client.watch(), watched)
    assert again.keys.tolist() == keys(*range(3000)).tolist()
    watch.close()


def test_a_large_map_is_sent_in_several_blocks_of_one_revision(fusion: RunningServer) -> None:
    session = fusion.client.join("ant", GRID).session_id
    for part in range(3):
        fusion.contribute_subsets(
            session, make_subset("ant", part + 1, {cell: [1] * 8 for cell in range(part * 1000, part * 1000 + 1000)})
        )
    blocks = []
    for block in fusion.client.watch():
        blocks.append(block)
        if block.last:
            break
    assert len(blocks) > 1
    assert len({block.revision for block in blocks}) == 1
    assert [block.last for block in blocks] == [False] * (len(blocks) - 1) + [True]
    assert np.concatenate([block.batch.keys for block in blocks]).tolist() == keys(*range(3000)).tolist()
