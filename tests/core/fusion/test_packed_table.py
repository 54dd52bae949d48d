"""The packed table: after any changes it has what a dict has, by voxel and by tile."""

import numpy as np
import pytest

from gausslite.domain.voxels import VoxelGrid, tile_of, tiles_of
from gausslite.fusion import packed_table
from gausslite.fusion.packed_table import PackedTable, keys_of, places_of, tiles_at
from gausslite.fusion.score_index import ROWS, SCORES, ScoreIndex

ABSENT = np.array((-1, 0), np.dtype([("seqs", "i8"), ("counts", "u2")]))


def content(run) -> dict[int, tuple[int, int]]:
    places, elements = run
    assert (np.diff(places) > 0).all()
    return dict(zip(keys_of(places).tolist(), elements.tolist(), strict=True))


def random_keys(rng: np.random.Generator, n: int) -> np.ndarray:
    """Voxels of a few tiles, some of them at the end of the range of keys."""
    axes = rng.choice([0, 1, 15, 16, 17, 40, (1 << 21) - 17, (1 << 21) - 1], (n, 3)).astype(np.int64)
    return np.unique(axes[:, 0] << 42 | axes[:, 1] << 21 | axes[:, 2])


def test_places_are_in_the_order_of_tiles_and_keys() -> None:
    keys = random_keys(np.random.default_rng(0), 500)
    places = places_of(keys)
    assert keys_of(places).tolist() == keys.tolist()
    assert np.argsort(places).tolist() == np.lexsort((keys, tiles_of(keys))).tolist()
    assert keys_of(tiles_at(places)).tolist() == tiles_of(keys).tolist()


@pytest.mark.parametrize("seed", range(4))
def test_a_table_has_what_a_dict_has(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packed_table, "_SMALL_RUN", 8)
    rng = np.random.default_rng(seed)
    table, model = PackedTable(ABSENT), dict[int, tuple[int, int]]()
    for step in range(120):
        keys = rng.permutation(random_keys(rng, int(rng.integers(0, 40))))
        elements = np.full(len(keys), ABSENT)
        chosen = np.flatnonzero(rng.random(len(keys)) < 0.7)
        elements["seqs"][chosen], elements["counts"][chosen] = step, chosen
        assert table.put(places_of(keys), elements).tolist() == [model.get(key, (-1, 0)) for key in keys.tolist()]
        for key, element in zip(keys.tolist(), elements.tolist(), strict=True):
            model.pop(key, None)
            if element[0] >= 0:
                model[key] = element
        other = table.copy()
        assert len(table) == len(model)
        assert table.get(places_of(keys)).tolist() == [model.get(key, (-1, 0)) for key in keys.tolist()]
        recent = {key: element for key, element in model.items() if element[0] > step - 3}
        assert content(table.select(lambda own, first=step - 3: own["seqs"] > first)) == recent
        tiles = np.unique(tiles_of(keys))
        own = {key: element for key, element in model.items() if tile_of(key) in tiles}
        assert content(table.in_tiles(places_of(tiles))) == own
        if step % 10 == 9:
            last = table.last(5)[0]
            ordered = sorted(model, key=lambda key: int(places_of(np.array([key]))[0]))
            assert keys_of(last).tolist() == ordered[-5:]
            gone = content(table.remove_from(int(last[0])))
            assert gone == {key: model.pop(key) for key in ordered[-5:]}
            assert len(content(other.select())) == len(model) + len(gone)
        assert content(table.select()) == model


@pytest.mark.parametrize("seed", range(3))
def test_a_message_asks_the_maps_that_have_its_voxels(seed: int) -> None:
    rng, index, grid = np.random.default_rng(seed), ScoreIndex(), VoxelGrid(0.1)
    for number in range(1, 200):
        name = f"map-{rng.integers(20)}"
        if name in index.agents and rng.random() < 0.3:
            index.remove_from(name, index.last_tiles(name, int(rng.integers(1, 200)))[0])
            continue
        corner_m = 1.6 * rng.integers(-3, 3, 3)
        keys = np.unique(grid.keys((corner_m + rng.uniform(0, 2, (20, 3))).astype(np.float32)))
        index.add_rows(name, np.array([(tile, number, 60) for tile in np.unique(tiles_of(keys)).tolist()], ROWS))
        scores = np.zeros(len(keys), SCORES)
        scores["keys"], scores["update_seqs"], scores["counts"], scores["rows"] = keys, number, 1, number
        index.put(name, scores)
        asked, every = index.scores(keys), index.scores()
        expected = every.take(np.flatnonzero(np.isin(every.scores["keys"], keys)))
        assert np.array_equal(asked.agent_index, expected.agent_index)
        assert np.array_equal(asked.scores, expected.scores)
    far = grid.keys(np.full((1, 3), 50.0, np.float32))
    assert index._near(far) == set()
    for name in index.agents:
        index.remove_from(name, index.last_tiles(name, 1 << 20)[0])
    # nothing is kept of maps that are gone
    assert (index.agents, len(index._at)) == ((), 0)
