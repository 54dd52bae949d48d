"""Pixel sampling without repeats, weighted and stratified; estimated spacing against a neighbour search."""

import numpy as np
import pytest

from gausslite.domain.camera import Camera
from gausslite.mapping.pixel_sampling import (
    edge_magnitude,
    initial_spacing_m,
    neighbour_distance_px,
    sample_pixels,
    sample_stratified,
)

SHAPE = (96, 128)
EVEN = np.ones(SHAPE, np.float32)
FULL = np.ones(SHAPE, np.bool_)


def neighbours_px(pixels: np.ndarray, width: int) -> np.ndarray:
    """Median distance of each pixel to its three nearest others, by brute force."""
    points = np.stack(np.divmod(pixels, width), axis=1).astype(np.float32)
    squared = np.square(points[:, None] - points[None]).sum(axis=-1)
    np.fill_diagonal(squared, np.inf)
    return np.sqrt(np.median(np.partition(squared, 2, axis=1)[:, :3], axis=1))


@pytest.mark.parametrize("sample", [sample_pixels, sample_stratified])
def test_samples_lie_in_the_pool_and_do_not_repeat(sample) -> None:
    rng = np.random.default_rng(0)
    pool = rng.random(SHAPE) < 0.3
    pixels = sample(pool, 200, EVEN, rng)
    assert len(pixels) <= 200
    assert len(np.unique(pixels)) == len(pixels)
    assert pool.ravel()[pixels].all()


@pytest.mark.parametrize("sample", [sample_pixels, sample_stratified])
def test_a_small_pool_is_returned_whole_and_a_count_of_zero_gives_nothing(sample) -> None:
    rng = np.random.default_rng(0)
    pool = np.zeros(SHAPE, np.bool_)
    pool[3, 4:9] = True
    np.testing.assert_array_equal(sample(pool, 50, EVEN, rng), np.flatnonzero(pool))
    assert len(sample(FULL, 0, EVEN, rng)) == 0
    assert len(sample(np.zeros(SHAPE, np.bool_), 10, EVEN, rng)) == 0


def test_stratified_puts_one_sample_in_each_cell() -> None:
    pixels = sample_stratified(FULL, 64, EVEN, np.random.default_rng(0))
    rows, columns = np.divmod(pixels, SHAPE[1])
    cells = (rows // 12) * 8 + columns // 16
    assert sorted(cells) == list(range(64))


def test_stratified_fills_its_count_where_the_pool_is_a_small_part_of_the_image() -> None:
    pool = np.zeros(SHAPE, np.bool_)
    pool[:32, :32] = True
    assert len(sample_stratified(pool, 100, EVEN, np.random.default_rng(0))) > 80


def test_samples_follow_the_weights() -> None:
    pixel_weights = EVEN.copy()
    pixel_weights[:, 64:] = 9.0
    for sample in (sample_pixels, sample_stratified):
        pixels = sample(FULL, 300, pixel_weights, np.random.default_rng(0))
        share = np.mean(pixels % SHAPE[1] >= 64)
        assert share > (0.85 if sample is sample_pixels else 0.49)


def test_stratified_weights_act_within_cells() -> None:
    pixel_weights = EVEN.copy()
    pixel_weights[:, ::2] = 19.0
    pixels = sample_stratified(FULL, 400, pixel_weights, np.random.default_rng(0))
    assert np.mean(pixels % 2 == 0) > 0.85


def test_edges_have_the_slope_of_the_luminance() -> None:
    ramp = np.repeat(np.arange(0, 250, 5, dtype=np.uint8)[None, :, None], 20, axis=0).repeat(3, axis=2)
    edges = edge_magnitude(ramp)
    np.testing.assert_allclose(edges[:, 1:-1], 5 / 255, rtol=1e-4)
    assert edge_magnitude(np.full((20, 20, 3), 90, np.uint8)).max() < 1e-6


@pytest.mark.parametrize("stratified", [False, True])
@pytest.mark.parametrize("count", [150, 600, 1500])
def test_spacing_agrees_with_a_neighbour_search(stratified: bool, count: int) -> None:
    sample = sample_stratified if stratified else sample_pixels
    pixels = sample(FULL, count, EVEN, np.random.default_rng(count))
    estimated = neighbour_distance_px(pixels, FULL, stratified)
    assert np.median(estimated) == pytest.approx(np.median(neighbours_px(pixels, SHAPE[1])), rel=0.15)


@pytest.mark.parametrize("stratified", [False, True])
def test_spacing_follows_the_local_density(stratified: bool) -> None:
    rng = np.random.default_rng(0)
    left, right = FULL.copy(), FULL.copy()
    left[:, 64:], right[:, :64] = False, False
    sample = sample_stratified if stratified else sample_pixels
    pixels = np.concatenate([sample(left, 150, EVEN, rng), sample(right, 1200, EVEN, rng)])
    estimated = neighbour_distance_px(pixels, FULL, stratified)
    true = neighbours_px(pixels, SHAPE[1])
    for side in (pixels % SHAPE[1] < 32, pixels % SHAPE[1] > 96):
        assert np.median(estimated[side]) == pytest.approx(np.median(true[side]), rel=0.25)


def test_spacing_in_a_narrow_strip_uses_neighbours_within_it() -> None:
    gap = np.zeros(SHAPE, np.bool_)
    gap[40:48, :] = True
    pixels = sample_pixels(gap, 250, EVEN, np.random.default_rng(0))
    estimated = neighbour_distance_px(pixels, gap, stratified=False)
    assert np.median(estimated) == pytest.approx(np.median(neighbours_px(pixels, SHAPE[1])), rel=0.25)


def test_spacing_in_metres_grows_with_depth_and_is_clamped() -> None:
    distance_px = np.array([2.0, 2.0, 1.0], np.float32)
    spacing = initial_spacing_m(distance_px, np.array([1.0, 3.0, 1e-3], np.float32), Camera.centred(100.0, 64, 48))
    np.testing.assert_allclose(spacing, [0.02, 0.06, np.sqrt(1e-7)], rtol=1e-5)
