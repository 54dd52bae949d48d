"""Properties of the image model, for random splats and all backends."""

import numpy as np
from few_examples import few_examples
from hypothesis import given
from hypothesis import strategies as st
from splat_scenes import random_rows, rotated_pose

from gausslite.domain.camera import Camera
from gausslite.render.rasterizer import OPACITY_LOGIT, Rasterizer, Subset

CAMERA = Camera(30.0, 30.0, 16.0, 12.0, 33, 25)
seeds = st.integers(0, 2**32 - 1)
counts = st.integers(0, 80)
sizes_m = st.sampled_from([1e-3, 0.03, 0.2, 1.0])


def images(rasterizer: Rasterizer, rows: np.ndarray, subset: Subset | None = None) -> np.ndarray:
    rendering = rasterizer.forward(rows, CAMERA, rotated_pose(), subset or Subset())
    return np.concatenate([rendering.rgb, rendering.depth_m[..., None], rendering.alpha[..., None]], axis=2)


@few_examples
@given(seed=seeds, n=counts, size_m=sizes_m)
def test_image_is_independent_of_row_order(rasterizer: Rasterizer, seed: int, n: int, size_m: float) -> None:
    rows = random_rows(seed, n, size_m)
    # depths 1 mm apart: ties have no defined order
    rng = np.random.default_rng(seed)
    rows[:, 0] = 0.1 * rng.normal(size=n)
    rows[:, 2] = 1.0 + 0.001 * rng.permutation(n)
    T_camera_world = np.eye(4)
    shuffled = rng.permutation(n)
    first = rasterizer.forward(rows, CAMERA, T_camera_world).rgb.copy()
    second = rasterizer.forward(rows[shuffled], CAMERA, T_camera_world).rgb
    np.testing.assert_allclose(second, first, atol=1e-5)


@few_examples
@given(seed=seeds, n=counts, size_m=sizes_m, logit=st.floats(-8.0, 12.0))
def test_alpha_is_in_unit_range_and_bounds_colour(
    rasterizer: Rasterizer, seed: int, n: int, size_m: float, logit: float
) -> None:
    rendering = images(rasterizer, random_rows(seed, n, size_m, logit))
    alpha = rendering[..., 4]
    assert alpha.min() >= 0.0
    assert alpha.max() <= 1.0
    # splat colours are in [0, 1], so alpha bounds the blended colour
    assert (rendering[..., :3] <= alpha[..., None] + 1e-5).all()


@few_examples
@given(seed=seeds, n=counts, transparent_count=st.integers(1, 20), size_m=sizes_m)
def test_transparent_splats_change_nothing(
    rasterizer: Rasterizer, seed: int, n: int, transparent_count: int, size_m: float
) -> None:
    rows = random_rows(seed, n, size_m)
    invisible = random_rows(seed ^ 1, transparent_count, size_m)
    invisible[:, OPACITY_LOGIT] = -20.0
    first = images(rasterizer, rows)
    second = images(rasterizer, np.concatenate([rows, invisible]))
    np.testing.assert_allclose(second, first, atol=1e-6)


@few_examples
@given(seed=seeds, n=counts, size_m=sizes_m)
def test_image_is_independent_of_quaternion_length(rasterizer: Rasterizer, seed: int, n: int, size_m: float) -> None:
    rows = random_rows(seed, n, size_m)
    longer = rows.copy()
    longer[:, 6:10] *= 4.0
    np.testing.assert_allclose(images(rasterizer, longer), images(rasterizer, rows), atol=1e-4)


@few_examples
@given(seed=seeds, n=counts, size_m=sizes_m, mask=st.lists(st.booleans(), min_size=6, max_size=6))
def test_complementary_tile_subsets_sum_to_the_image(
    rasterizer: Rasterizer, seed: int, n: int, size_m: float, mask: list[bool]
) -> None:
    rows = random_rows(seed, n, size_m)
    tiles = np.array(mask).reshape(2, 3)
    parts = images(rasterizer, rows, Subset(tiles=tiles)) + images(rasterizer, rows, Subset(tiles=~tiles))
    np.testing.assert_allclose(parts, images(rasterizer, rows), atol=1e-6)


@few_examples
@given(seed=seeds, n=st.integers(1, 80))
def test_colour_gradients_are_linear_in_the_images(rasterizer: Rasterizer, seed: int, n: int) -> None:
    rows = random_rows(seed, n)
    rendering = rasterizer.forward(rows, CAMERA, rotated_pose())
    d_rgb = np.random.default_rng(seed).normal(size=rendering.rgb.shape).astype(np.float32)
    nothing = np.zeros_like(rendering.alpha)
    once = rasterizer.backward(rendering, d_rgb, nothing, nothing).d_rows.copy()
    rendering = rasterizer.forward(rows, CAMERA, rotated_pose())
    twice = rasterizer.backward(rendering, 2 * d_rgb, nothing, nothing).d_rows
    np.testing.assert_allclose(twice, 2 * once, rtol=1e-3, atol=1e-3 * max(1.0, float(np.abs(once).max())))
