"""Properties of the fusion: the fused map is a function of the agents' latest voxel updates."""

import itertools
import tempfile
import tracemalloc
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from few_examples import few_examples
from hypothesis import given
from hypothesis import strategies as st
from sample_gaussians import uniform_gaussians

from gausslite.domain.gaussians import Gaussians
from gausslite.domain.voxels import (
    RoiSubset,
    VoxelBatch,
    VoxelGrid,
    group_by_voxel,
    merge_batches,
    select_keys,
    select_voxels,
    tombstones,
)
from gausslite.fusion.sqlite_store import SqliteStore
from gausslite.fusion.store import FusionStore
from gausslite.fusion.vote import FusedMap, VoteResult, fuse, rank_voxels, union_maps

GRID = VoxelGrid(0.10)
AGENTS = ("ant", "bee", "cat", "dog")


def gaussians_in(cells: list[tuple[int, int]], seed: int) -> Gaussians:
    """Gaussians of these (cell, kappa), each at a random position in the voxel (cell, 0, 0)."""
    kappa = [kappa for _, kappa in cells]
    gaussians = uniform_gaussians(np.random.default_rng(seed), len(cells), kappa=kappa)
    means_m = gaussians.means_m * 0.098 + 0.001
    means_m[:, 0] += np.array([cell for cell, _ in cells], np.float32) * np.float32(0.1)
    return replace(gaussians, means_m=means_m)


# Strategies draw plain numbers and the tests build from them: the shape checks that run in our types use random
# numbers of their own, which hypothesis does not allow while it draws.
Spec = tuple[list[tuple[int, int]], list[int], int]
WORDS = st.tuples(
    st.lists(st.tuples(st.integers(0, 5), st.integers(0, 3)), max_size=8),
    st.lists(st.integers(0, 5), max_size=4),
    st.integers(0, 2**16),
)
"""(voxel, kappa) of few Gaussians in few voxels, so that ties are common; tombstone voxels; a seed."""
TABLES = st.dictionaries(st.sampled_from(AGENTS), WORDS, max_size=4)
HISTORIES = st.dictionaries(st.sampled_from(AGENTS), st.lists(WORDS, max_size=4), max_size=4)


def batch_from(spec: Spec) -> VoxelBatch:
    cells, buried, seed = spec
    present = group_by_voxel(gaussians_in(cells, seed), GRID)
    centres = np.array([(0.1 * cell + 0.05, 0.05, 0.05) for cell in buried], np.float32).reshape(-1, 3)
    return merge_batches(present, tombstones(np.setdiff1d(GRID.keys(centres), present.keys)))


def table_from(specs: dict[str, Spec]) -> dict[str, VoxelBatch]:
    return {agent_id: batch_from(spec) for agent_id, spec in specs.items()}


def subsets_from(history: dict[str, list[Spec]]) -> list[RoiSubset]:
    """Subsets of up to four agents, each with increasing sequence numbers."""
    return [
        RoiSubset(agent_id, "s", update_seq + 1, update_seq, batch_from(spec))
        for agent_id, specs in history.items()
        for update_seq, spec in enumerate(specs)
    ]


def stored(messages: list[RoiSubset], store: FusionStore | None = None) -> FusionStore:
    store = store or SqliteStore()
    for message in messages:
        store.put(message)
    return store


def assert_same_batch(a: VoxelBatch, b: VoxelBatch) -> None:
    assert a.keys.tolist() == b.keys.tolist()
    assert a.kappa_sums.tolist() == b.kappa_sums.tolist()
    assert a.counts.tolist() == b.counts.tolist()
    for field in fields(Gaussians):
        assert getattr(a.gaussians, field.name).tobytes() == getattr(b.gaussians, field.name).tobytes(), field.name


def votes_of(vote: VoteResult) -> dict[int, list[tuple[str, int, int]]]:
    """Return the agents on each voxel, with Σkappa and number of Gaussians, best first."""
    columns = vote.ranked.agent_index, vote.ranked.scores["kappa_sums"], vote.ranked.scores["counts"]
    ranked = [
        (vote.ranked.agents[agent], kappa_sum, count)
        for agent, kappa_sum, count in zip(*(column.tolist() for column in columns), strict=True)
    ]
    places = itertools.pairwise(vote.offsets.tolist())
    return {key: ranked[start:end] for key, (start, end) in zip(vote.keys.tolist(), places, strict=True)}


def assert_same_map(a: FusedMap, b: FusedMap) -> None:
    """Assert bit-identical Gaussians and equal votes."""
    assert_same_batch(a.batch, b.batch)
    assert votes_of(a.vote) == votes_of(b.vote)


@few_examples
@given(HISTORIES, st.randoms(use_true_random=False))
def test_duplicates_and_reordering_do_not_change_the_map(history: dict[str, list[Spec]], random) -> None:
    subsets = subsets_from(history)
    shuffled = random.sample(subsets + subsets, 2 * len(subsets))
    assert_same_map(fuse(stored(shuffled).batches()), fuse(stored(subsets).batches()))
    assert_same_batch(union_maps(stored(shuffled).batches()), union_maps(stored(subsets).batches()))


@few_examples
@given(HISTORIES, st.integers(0, 20), st.integers(0, 20))
def test_a_resumed_connection_gives_the_same_map(history: dict[str, list[Spec]], dropped: int, again: int) -> None:
    subsets = subsets_from(history)
    resumed = subsets[:dropped] + subsets[max(0, dropped - again) :]
    assert_same_map(fuse(stored(resumed).batches()), fuse(stored(subsets).batches()))


@few_examples
@given(HISTORIES, st.sampled_from(AGENTS))
def test_removing_an_agent_gives_the_map_without_it(history: dict[str, list[Spec]], leaver: str) -> None:
    subsets = subsets_from(history)
    store = stored(subsets)
    store.remove_agent(leaver)
    assert_same_map(fuse(store.batches()), fuse(stored([s for s in subsets if s.agent_id != leaver]).batches()))


@few_examples
@given(TABLES, st.randoms(use_true_random=False))
def test_adding_agents_in_any_order_commutes(specs: dict[str, Spec], random) -> None:
    table = table_from(specs)
    agents = random.sample(sorted(table), len(table))
    assert_same_map(fuse({agent: table[agent] for agent in agents}), fuse(table))


@few_examples
@given(TABLES, st.integers(1, 4))
def test_the_union_of_shards_is_the_whole_map(specs: dict[str, Spec], shards: int) -> None:
    table = table_from(specs)
    parts = [
        fuse({agent: select_voxels(batch, batch.keys % shards == shard) for agent, batch in table.items()})
        for shard in range(shards)
    ]
    merged = parts[0].batch
    for part in parts[1:]:
        merged = merge_batches(merged, part.batch)
    whole = fuse(table)
    assert_same_batch(merged, whole.batch)
    assert {key: ranked for part in parts for key, ranked in votes_of(part.vote).items()} == votes_of(whole.vote)


@few_examples
@given(TABLES)
def test_the_winner_has_the_highest_kappa_sum_then_more_gaussians_then_the_lower_id(specs: dict[str, Spec]) -> None:
    table = table_from(specs)
    fused = fuse(table)
    expected = {}
    for agent_id, batch in table.items():
        for key, kappa_sum, count in zip(
            batch.keys.tolist(), batch.kappa_sums.tolist(), batch.counts.tolist(), strict=True
        ):
            rank = (-kappa_sum, -count, agent_id)
            if count > 0 and (key not in expected or rank < expected[key]):
                expected[key] = rank
    assert {key: best[0] for key, (best, *_) in votes_of(fused.vote).items()} == {k: r[2] for k, r in expected.items()}
    for key, (_, _, agent_id) in expected.items():
        keys = np.array([key], np.int64)
        assert_same_batch(select_keys(fused.batch, keys), select_keys(table[agent_id], keys))


def test_a_few_voxels_of_a_large_map_are_read_without_a_copy_of_its_keys() -> None:
    gaussians = gaussians_in([(cell, 1) for cell in range(50_000)], seed=0)
    batch = group_by_voxel(gaussians, GRID)
    tracemalloc.start()
    try:
        assert len(select_keys(batch, np.append(batch.keys[::5000], batch.keys[-1] + 1))) == 10
        assert tracemalloc.get_traced_memory()[1] < batch.keys.nbytes / 4
    finally:
        tracemalloc.stop()


@few_examples
@given(TABLES)
def test_the_scores_of_a_voxel_descend_and_its_winner_has_gaussians(specs: dict[str, Spec]) -> None:
    table = table_from(specs)
    fused = fuse(table)
    votes = votes_of(fused.vote)
    assert len(fused.batch.gaussians) == int(fused.batch.counts.sum())
    assert [ranked[0][2] for ranked in votes.values()] == fused.batch.counts.tolist()
    for ranked in votes.values():
        assert [score[1] for score in ranked] == sorted((score[1] for score in ranked), reverse=True)
        assert all(count > 0 for _, _, count in ranked)


@few_examples
@given(TABLES)
def test_the_union_map_contains_all_gaussians(specs: dict[str, Spec]) -> None:
    table = table_from(specs)
    everything = union_maps(table)
    assert len(everything.gaussians) == sum(len(batch.gaussians) for batch in table.values())
    assert int(everything.kappa_sums.sum()) == sum(int(batch.kappa_sums.sum()) for batch in table.values())
    assert_same_batch(group_by_voxel(everything.gaussians, GRID), everything)


@few_examples
@given(HISTORIES)
def test_the_vote_on_scores_equals_the_vote_on_batches(history: dict[str, list[Spec]]) -> None:
    subsets = subsets_from(history)
    store = stored(subsets)
    assert votes_of(rank_voxels(store.scores())) == votes_of(fuse(store.batches()).vote)


@few_examples
@given(HISTORIES)
def test_every_store_gives_the_same_map(history: dict[str, list[Spec]]) -> None:
    subsets = subsets_from(history)
    with tempfile.TemporaryDirectory() as folder:
        on_disk = SqliteStore(Path(folder) / "store.sqlite")
        try:
            outcomes = [(on_disk.put(s), memory.put(s)) for memory in [SqliteStore()] for s in subsets]
            for ours, theirs in outcomes:
                assert ours.accepted.tolist() == theirs.accepted.tolist()
                assert ours.stale.tolist() == theirs.stale.tolist()
            assert_same_map(fuse(on_disk.batches()), fuse(stored(subsets).batches()))
        finally:
            on_disk.close()


@pytest.mark.parametrize(
    ("kappas_a", "kappas_b", "winner"),
    [([5], [1, 1], "ant"), ([2], [1, 1], "bee"), ([1, 1], [2], "ant"), ([1, 1], [1, 1], "ant"), ([0], [0, 0], "bee")],
)
def test_ties_go_to_more_gaussians_and_then_to_the_lower_id(
    kappas_a: list[int], kappas_b: list[int], winner: str
) -> None:
    a, b = (gaussians_in([(0, kappa) for kappa in kappas], 1) for kappas in (kappas_a, kappas_b))
    for maps in ({"ant": a, "bee": b}, {"bee": b, "ant": a}):
        batches = {agent_id: group_by_voxel(gaussians, GRID) for agent_id, gaussians in maps.items()}
        assert [best[0] for best, *_ in votes_of(fuse(batches).vote).values()] == [winner]


def test_no_updates_fuse_to_an_empty_map() -> None:
    assert len(fuse({}).batch.gaussians) == len(union_maps({}).gaussians) == 0
    assert len(fuse({"ant": group_by_voxel(Gaussians.empty(), GRID)}).batch.gaussians) == 0
