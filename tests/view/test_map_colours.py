"""Colours, legends, the level of detail and the origin check of the page."""

import dataclasses

import numpy as np
import pytest
from sample_gaussians import plain_gaussians, random_gaussians

from gausslite.domain.gaussians import Gaussians
from gausslite_view.contents import (
    NO_AGENT,
    UNASSIGNED_RGB,
    ColourMode,
    ViewContents,
    category_colour,
    colours_of,
    covariances_m2,
    legend_of,
    with_agents,
)


def test_rgb_is_clipped_and_scaled():
    gaussians = plain_gaussians(np.zeros((2, 3)), rgb=[[0, 0.5, 1], [-0.5, 2, 1]])
    colours = colours_of(ViewContents.of_one_agent(gaussians), ColourMode.RGB)
    assert colours.tolist() == [[0, 128, 255], [0, 255, 255]]


def test_kappa_gets_brighter_and_the_legend_shows_its_ends():
    contents = ViewContents.of_one_agent(plain_gaussians(np.zeros((3, 3)), kappa=[0, 10, 1000]))
    colours, legend = colours_of(contents, ColourMode.KAPPA), legend_of(contents, ColourMode.KAPPA)
    assert (np.diff(colours.astype(int).sum(axis=1)) > 0).all()
    assert legend[0] == ("kappa 0", tuple(colours[0].tolist()))
    assert legend[-1] == ("kappa 1000", tuple(colours[-1].tolist()))


def test_agents_and_objects_have_their_own_colours_and_the_rest_is_grey():
    gaussians = plain_gaussians(np.zeros((3, 3)), target=[0, 1, -1])
    agent = np.array([1, 0, NO_AGENT])
    contents = dataclasses.replace(
        ViewContents.of_one_agent(gaussians), agent=agent, agents=("a", "b"), targets=("mug",)
    )
    for mode, first in ((ColourMode.AGENT, 1), (ColourMode.OBJECT, 0)):
        expected = [category_colour(first), category_colour(1 - first), UNASSIGNED_RGB]
        assert [tuple(each) for each in colours_of(contents, mode).tolist()] == expected
    assert [name for name, _ in legend_of(contents, ColourMode.AGENT)] == ["a", "b", "none"]
    assert [name for name, _ in legend_of(contents, ColourMode.OBJECT)] == ["mug", "number 1", "none"]


@pytest.mark.parametrize("mode", ColourMode)
def test_an_empty_map_has_no_colours(mode):
    assert colours_of(ViewContents.of_one_agent(random_gaussians(0)), mode).shape == (0, 3)


def test_covariances_have_the_scales_along_the_rotated_axes():
    gaussians = random_gaussians(50)
    covariances = covariances_m2(gaussians)
    np.testing.assert_allclose(covariances, covariances.transpose(0, 2, 1), rtol=1e-6)
    squared_m2 = np.sort(gaussians.scales_m.astype(np.float64) ** 2, axis=1)
    np.testing.assert_allclose(np.linalg.eigvalsh(covariances.astype(np.float64)), squared_m2, rtol=1e-3, atol=1e-8)
    # a quarter turn about z exchanges the scales of x and y
    turned = plain_gaussians([[0, 0, 0]], quats_wxyz=[0.5**0.5, 0, 0, 0.5**0.5], scales_m=[[1, 2, 3]])
    np.testing.assert_allclose(covariances_m2(turned)[0], np.diag([4, 1, 9]), atol=1e-5)


def test_the_agents_of_a_voted_map_follow_from_their_own_maps():
    rng = np.random.default_rng(0)
    a, b = (random_gaussians(300, seed) for seed in (1, 2))
    left, right = a.take(a.means_m[:, 0] < 0), b.take(b.means_m[:, 0] >= 0)
    rounding = rng.uniform(-1e-4, 1e-4, (len(left) + len(right), 3)).astype(np.float32)
    fused = Gaussians.concatenate([left, right])
    fused = dataclasses.replace(fused, means_m=fused.means_m + rounding)
    contents = with_agents(ViewContents.of_one_agent(fused), {"a": a, "b": b})
    assert contents.agents == ("a", "b")
    expected = np.repeat([0, 1], [len(left), len(right)])
    assert np.mean(contents.agent == expected) > 0.98
    other = dataclasses.replace(a, means_m=a.means_m + np.float32(50))
    assert set(with_agents(ViewContents.of_one_agent(other), {"a": a}).agent) == {NO_AGENT}
