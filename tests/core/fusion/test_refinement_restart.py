"""The refined map survives a restart of the server."""

import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from fusion_running import GRID, keys, make_subset

from gausslite.domain.errors import CodecError, MismatchError
from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxel_changes import hash_columns
from gausslite.domain.voxels import VoxelBatch, select_voxels
from gausslite.fusion.engine import FusionEngine
from gausslite.fusion.fused_map import MapLayer
from gausslite.fusion.keyframe_pool import EncodedKeyframe
from gausslite.fusion.limits import FusionSettings, MissionConfig
from gausslite.fusion.score_index import VoxelScoreTable
from gausslite.fusion.sqlite_store import SqliteStore

ANYTHING = MissionConfig("", "", GRID.size_m)
Shown = dict[int, tuple[bytes, bytes]]


def open_engine(path: Path) -> FusionEngine:
    return FusionEngine(SqliteStore(path), FusionSettings(grid=GRID))


def red(gaussians: Gaussians) -> Gaussians:
    return replace(gaussians, rgb=np.tile(np.array([1, 0, 0], np.float32), (len(gaussians), 1)))


def shown(engine: FusionEngine) -> Shown:
    """Return what watchers of the refined layer see: means and colours by voxel."""
    changes = engine.maps.changes(0, MapLayer.REFINED)
    batch = changes.won.batch
    exported = engine.maps.refined_map() if engine.maps.is_refined else engine.maps.voted_map()
    assert exported.gaussians.means_m.tobytes() == batch.gaussians.means_m.tobytes()
    assert exported.gaussians.rgb.tobytes() == batch.gaussians.rgb.tobytes()
    return {
        key: (batch.gaussians.means_m[start:end].tobytes(), batch.gaussians.rgb[start:end].tobytes())
        for key, start, end in zip(batch.keys.tolist(), batch.offsets[:-1], batch.offsets[1:], strict=True)
    }


def restart(engine: FusionEngine, path: Path) -> FusionEngine:
    engine.store.close()
    return open_engine(path)


def test_the_refined_map_is_the_same_after_a_restart_at_every_step(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    engine = open_engine(path)
    ant, bee = (engine.join(name, ANYTHING).session.session_id for name in ("ant", "bee"))
    engine.contribute(ant, make_subset("ant", 1, {cell: [5] * 3 for cell in range(10)}), GRID)
    engine.contribute(bee, make_subset("bee", 1, {cell: [2] for cell in range(5)}), GRID)
    pytest.raises(MismatchError, engine.maps.refined_map).match("expected a refinement first")
    engine.keyframes.add(EncodedKeyframe("ant", 1, 1, 1, b"keyframe"))
    revision = engine.maps.revision()
    voted = engine.maps.voted_map().gaussians
    # changes during the refinement: a newer update, a new voxel, a removed one
    engine.contribute(ant, make_subset("ant", 2, {1: [6] * 3, 20: [5], 2: []}), GRID)
    # the refinement moved the Gaussians of the last voxel into one of nobody
    moved = red(voted)
    moved.means_m[-3:] += np.array([5.0, 0, 0], np.float32)
    engine.store_refined(moved, revision, ("ant",))
    before = shown(engine)
    engine = restart(engine, path)
    assert engine.status().refined
    assert shown(engine) == before
    # changes after it: of a winner, of a loser, a removal, a new winner
    engine.contribute(ant, make_subset("ant", 3, {3: [7] * 3, 4: []}), GRID)
    engine.contribute(bee, make_subset("bee", 2, {0: [3], 6: [90]}), GRID)
    before = shown(engine)
    assert keys(4).item() in before  # now of bee
    red_voxels = {key for key, (_, rgb) in before.items() if rgb[:12] == np.array([1, 0, 0], np.float32).tobytes()}
    assert red_voxels >= set(keys(0, 5, 7, 8).tolist())
    assert not red_voxels & set(keys(1, 2, 3, 4, 6, 9, 20).tolist())
    for _ in range(2):
        engine = restart(engine, path)
        assert shown(engine) == before
    engine.evict("bee")
    before = shown(engine)
    engine = restart(engine, path)
    after = shown(engine)
    # the vote is again what the refinement started from, so the refinement is shown again
    assert {key for key in before if before[key] != after[key]} == set(keys(6).tolist())
    assert after[keys(6).item()][1][:12] == np.array([1, 0, 0], np.float32).tobytes()
    engine.store.close()


class WatchedStore(SqliteStore):
    """Notes the largest read of updates, and calls `during` at a read of scores."""

    largest_read = 0
    during: Callable[[], None] | None = None

    def batch(self, agent_id: str, keys: np.ndarray | None = None) -> VoxelBatch:
        batch = super().batch(agent_id, keys)
        self.largest_read = max(self.largest_read, len(batch))
        return batch

    def batches(self, keys: np.ndarray | None = None) -> dict[str, VoxelBatch]:
        batches = super().batches(keys)
        self.largest_read = max(self.largest_read, *map(len, batches.values()))
        return batches

    def scores(self, keys: np.ndarray | None = None) -> VoxelScoreTable:
        during, self.during = self.during, None
        if during is not None:
            during()
        table = super().scores(keys)
        self.largest_read = max(self.largest_read, len(table))
        return table


def test_a_refinement_reads_and_shows_tiles_and_messages_in_between_are_shown_and_kept(tmp_path: Path) -> None:
    path = tmp_path / "store.sqlite"
    store = WatchedStore(path)
    engine = FusionEngine(store, FusionSettings(grid=GRID))
    ant, bee = (engine.join(name, ANYTHING).session.session_id for name in ("ant", "bee"))
    engine.contribute(ant, make_subset("ant", 1, {cell: [5] for cell in range(200)}), GRID)
    revision = engine.maps.revision()
    store.largest_read = 0
    voted = engine.maps.voted_map()
    # of all voxels, except one that the refinement loses
    refined = red(select_voxels(voted, voted.keys != keys(30)).gaussians)

    def send() -> None:
        for seq, cells in enumerate(({150: [90]}, {3: [90]}, {180: [90], 40: [90]}), start=1):
            engine.contribute(bee, make_subset("bee", seq, cells), GRID)
        engine.contribute(ant, make_subset("ant", 2, {100: [], 190: []}), GRID)

    sender = threading.Thread(target=send)
    store.during = sender.start
    engine.store_refined(refined, revision, ())
    sender.join()
    # each cube of 16 voxels alone
    assert 0 < store.largest_read <= 32
    before = shown(engine)
    assert not set(keys(30, 100, 190).tolist()) & before.keys()
    red_voxels = {key for key, (_, rgb) in before.items() if rgb[:12] == np.array([1, 0, 0], np.float32).tobytes()}
    assert before.keys() - red_voxels == set(keys(3, 40, 150, 180).tolist())
    engine = restart(engine, path)
    assert shown(engine) == before
    engine.store.close()


@pytest.mark.parametrize("gone", ["cat", "bee", "frame of cat"])
def test_an_agent_that_is_used_no_more_takes_the_refinement_along_that_its_keyframes_shaped(
    tmp_path: Path, gone: str
) -> None:
    path = tmp_path / "store.sqlite"
    engine = open_engine(path)
    ant, _, cat = (engine.join(name, ANYTHING).session.session_id for name in ("ant", "bee", "cat"))
    engine.contribute(ant, make_subset("ant", 1, {cell: [5] * 3 for cell in range(10)}), GRID)
    for name, session in (("ant", ant), ("cat", cat)):
        engine.keyframes.add(EncodedKeyframe(name, 1, 1, 1, b"keyframe"), session_id=session)
    voted, revision = shown(engine), engine.maps.revision()
    engine.store_refined(red(engine.maps.voted_map().gaussians), revision, ("ant", "cat"))
    refined, since = shown(engine), engine.maps.revision(MapLayer.REFINED)
    if gone == "frame of cat":
        engine.declare_frame("cat", None)
        engine.work_in_background()
    else:
        engine.evict(gone, ban=True)
    expected = voted if gone != "bee" else refined
    assert shown(engine) == expected != (refined if gone != "bee" else voted)
    # watchers of the layer see the vote again
    changed = engine.maps.changes(since, MapLayer.REFINED).won.batch
    assert len(changed) == (10 if gone != "bee" else 0)
    engine = restart(engine, path)
    assert shown(engine) == expected
    assert engine.status().refined == (gone == "bee")
    # one that ran meanwhile is not stored
    with pytest.raises(MismatchError, match="the keyframes of dog to stay"):
        engine.store_refined(red(engine.maps.voted_map().gaussians), engine.maps.revision(), ("ant", "dog"))
    assert shown(engine) == voted
    engine.store.close()


def test_a_damaged_refinement_is_refused() -> None:
    store = SqliteStore()
    store.save_record("", "refined-map", b"\x08\0\0\0\0\0\0\0{}      ")
    with pytest.raises(CodecError, match="stored refinement: expected its arrays"):
        FusionEngine(store, FusionSettings(grid=GRID))


def test_the_hash_of_a_row_depends_on_all_its_columns_and_their_order() -> None:
    seqs, counts = np.arange(1000), np.arange(1000, dtype=np.uint32)[::-1]
    hashes = hash_columns(seqs, counts)
    assert len(np.unique(hashes)) == 1000
    assert not (hashes == hash_columns(counts, seqs)).any()
    assert not (hashes == hash_columns(seqs, counts + 1)).any()
    # fixed, because stores hold it
    assert hash_columns(np.array([1]), np.array([-2]))[0] == HASH_OF_1_AND_MINUS_2


HASH_OF_1_AND_MINUS_2 = 13996643678574006263
