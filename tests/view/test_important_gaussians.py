"""The most important Gaussians of a map, of the task's region and of the background."""

import numpy as np
import pytest
from sample_gaussians import plain_gaussians, random_gaussians

from gausslite_view.important_gaussians import choose_gaussians


def test_level_of_detail_keeps_the_most_important_of_each_part():
    gaussians = random_gaussians(1000)
    chosen = choose_gaussians(gaussians, 100)
    ordered = np.sort(gaussians.scales_m, axis=1)
    importance = gaussians.opacities * ordered[:, 1] * ordered[:, 2]
    assert len(chosen) == 100
    assert (np.diff(chosen) > 0).all()
    for part in (gaussians.active, ~gaussians.active):
        kept = np.intersect1d(chosen, np.flatnonzero(part))
        assert len(kept) == 50
        dropped = np.setdiff1d(np.flatnonzero(part), chosen)
        assert importance[kept].min() >= importance[dropped].max()


@pytest.mark.parametrize("active_share", [0.0, 0.01, 0.99, 1.0])
def test_level_of_detail_uses_its_limit_whatever_the_share_of_the_region(active_share):
    gaussians = plain_gaussians(np.zeros((1000, 3)), active=np.arange(1000) < 1000 * active_share)
    assert len(choose_gaussians(gaussians, 200)) == 200


def test_a_small_map_is_drawn_completely():
    assert choose_gaussians(random_gaussians(20), 20).tolist() == list(range(20))
