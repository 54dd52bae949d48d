"""Splat table under random operations: the cap holds, and columns of different Gaussians are never mixed."""

import numpy as np
from few_examples import few_examples
from hypothesis import given
from hypothesis import strategies as st

from gausslite.domain.gaussians import Gaussians
from gausslite.mapping.density import densify, prune
from gausslite.mapping.seeding import Seeds, insert_seeds
from gausslite.mapping.settings import DensitySettings
from gausslite.mapping.splat_table import SplatTable
from gausslite.render.rasterizer import GRAD_2D_COUNT, GRAD_2D_SUM

CAPACITY = 40
ACTIONS = st.lists(
    st.tuples(st.sampled_from(["insert", "densify", "prune", "keep"]), st.integers(0, 2**31), st.integers(0, 60)),
    max_size=12,
)


def random_gaussians(count: int, active: bool, rng: np.random.Generator) -> Gaussians:
    """Return Gaussians whose target and kappa depend on `active`."""
    return Gaussians(
        means_m=rng.normal(size=(count, 3)).astype(np.float32),
        quats_wxyz=rng.normal(size=(count, 4)).astype(np.float32),
        scales_m=rng.uniform(0.001, 0.1, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0.001, 0.99, count).astype(np.float32),
        rgb=rng.uniform(size=(count, 3)).astype(np.float32),
        active=np.full(count, active),
        kappa=np.full(count, 5 if active else 0, np.uint32),
        target=np.full(count, 2 if active else -1, np.int16),
    )


def apply(table: SplatTable, action: str, seed: int, amount: int) -> None:
    rng = np.random.default_rng(seed)
    if action == "insert":
        insert_seeds(
            table, Seeds(random_gaussians(amount // 2, True, rng), random_gaussians(amount, False, rng)), 0.5, rng
        )
    elif action == "densify":
        table.first_moment[:, GRAD_2D_SUM] = rng.random(table.count)
        table.first_moment[:, GRAD_2D_COUNT] = 1.0
        densify(table, DensitySettings(min_mean_gradient=0.5, max_growth=1.0), 2.0)
    elif action == "prune":
        prune(table, DensitySettings(min_opacity=0.1))
    else:
        table.keep(rng.random(table.count) < 0.7)


@few_examples
@given(ACTIONS)
def test_the_cap_holds_and_active_kappa_and_target_stay_together(actions: list[tuple[str, int, int]]) -> None:
    table = SplatTable(CAPACITY)
    for action, seed, amount in actions:
        apply(table, action, seed, amount)
        assert table.count <= CAPACITY
        assert len(table.rows) == len(table.first_moment) == len(table.second_moment) == table.count
        np.testing.assert_array_equal(table.target, np.where(table.active, 2, -1))
        np.testing.assert_array_equal(table.kappa, np.where(table.active, 5, 0))
        assert np.isfinite(table.rows).all()


class CheckedTable(SplatTable):
    """A table that checks its invariants after each change, also inside a densification."""

    changes = 0

    def append_rows(self, *columns: np.ndarray) -> None:
        super().append_rows(*columns)
        self._check()

    def replace(self, ids: np.ndarray, gaussians: Gaussians, anchor: int) -> None:
        super().replace(ids, gaussians, anchor)
        self._check()

    def keep(self, mask: np.ndarray) -> None:
        super().keep(mask)
        self._check()

    def _check(self) -> None:
        self.changes += 1
        assert self.count <= self.capacity == CAPACITY
        # memory is allocated once, and every view lies inside it
        assert np.shares_memory(self.rows, self._columns["rows"]) or self.count == 0
        assert all(self._columns[name].shape == (CAPACITY, 16) for name in ("rows", "first_moment", "second_moment"))


@few_examples
@given(st.integers(CAPACITY - 12, CAPACITY), st.integers(0, 2**31))
def test_cap_holds_after_each_change_in_seeding_and_densification(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    table = CheckedTable(CAPACITY)
    table.append(random_gaussians(count, True, rng))
    apply(table, "densify", seed, 0)
    apply(table, "insert", seed, 60)
    apply(table, "densify", seed, 0)
    assert table.changes > 3


@few_examples
@given(st.integers(1, 40), st.integers(0, 2**31), st.integers(0, 40))
def test_roi_seeds_always_fit_and_evict_active_gaussians_last(count: int, seed: int, seed_count: int) -> None:
    rng = np.random.default_rng(seed)
    table = SplatTable(CAPACITY)
    table.append(random_gaussians(count // 2, True, rng))
    table.append(random_gaussians(count - count // 2, False, rng))
    inactive_before, active_before = int((~table.active).sum()), int(table.active.sum())
    insert_seeds(table, Seeds(random_gaussians(seed_count, True, rng), Gaussians.empty()), 0.5, rng)
    lost_active = active_before + seed_count - int(table.active.sum())
    assert lost_active == max(0, count + seed_count - CAPACITY - inactive_before)
