"""Contract of `backward`: gradients match the oracle."""

import numpy as np
import pytest
from splat_scenes import (
    CAMERA,
    GROUPS,
    SCENES,
    Scene,
    named_scene,
    random_image_gradients,
    random_rows,
    relative_error,
    scene_for,
)

from gausslite.render.rasterizer import FULL_FRAME, TILE_PX, Rasterizer, SplatGradients, Subset

TOLERANCE = 1e-4


def gradients(rasterizer: Rasterizer, scene: Scene, subset: Subset = FULL_FRAME) -> SplatGradients:
    rendering = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world, subset)
    return rasterizer.backward(rendering, *random_image_gradients(scene))


def assert_same_gradients(result: SplatGradients, expected: SplatGradients) -> None:
    np.testing.assert_array_equal(result.visible, expected.visible)
    for group, columns in GROUPS.items():
        error = relative_error(result.d_rows[:, columns], expected.d_rows[:, columns])
        assert error < TOLERANCE, f"{group}: relative error {error:.2e}"
    assert relative_error(result.mean_2d_grad_norm, expected.mean_2d_grad_norm) < TOLERANCE
    assert relative_error(result.d_twist, expected.d_twist) < TOLERANCE
    assert not result.d_rows[:, 14:].any()


@pytest.mark.parametrize("name", SCENES)
def test_gradients_match_the_oracle(rasterizer: Rasterizer, oracle: Rasterizer, name: str) -> None:
    scene = scene_for(rasterizer, name)
    assert_same_gradients(gradients(rasterizer, scene), gradients(oracle, scene))


@pytest.mark.parametrize("channel", range(3))
def test_gradients_of_each_image_match_the_oracle(rasterizer: Rasterizer, oracle: Rasterizer, channel: int) -> None:
    scene = named_scene("medium splats")
    d_images = [d if i == channel else np.zeros_like(d) for i, d in enumerate(random_image_gradients(scene))]
    result, expected = (
        r.backward(r.forward(scene.rows, scene.camera, scene.T_camera_world), *d_images) for r in (rasterizer, oracle)
    )
    assert_same_gradients(result, expected)


@pytest.mark.parametrize("name", ["medium splats", "odd size"])
def test_gradients_of_a_tile_subset_match_the_oracle(rasterizer: Rasterizer, oracle: Rasterizer, name: str) -> None:
    scene = named_scene(name)
    grid = (-(-scene.size[0] // 16), -(-scene.size[1] // 16))
    subset = Subset(tiles=np.random.default_rng(1).random(grid) < 0.4)
    result, expected = gradients(rasterizer, scene, subset), gradients(oracle, scene, subset)
    assert_same_gradients(result, expected)
    hidden = np.setdiff1d(np.arange(len(scene.rows)), result.visible)
    assert not result.d_rows[hidden].any()


def test_gradients_of_an_id_subset_match_the_oracle(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = named_scene("medium splats")
    ids = np.flatnonzero(np.random.default_rng(4).random(len(scene.rows)) < 0.3).astype(np.uint32)
    result, expected = gradients(rasterizer, scene, Subset(ids=ids)), gradients(oracle, scene, Subset(ids=ids))
    assert_same_gradients(result, expected)
    assert np.isin(result.visible, ids).all()


def test_gradients_of_ids_and_tiles_match_the_oracle(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = named_scene("dense")
    tiles = np.zeros((3, 4), np.bool_)
    tiles[1, 1:3] = True
    subset = Subset(tiles=tiles, ids=np.arange(0, len(scene.rows), 2, dtype=np.uint32))
    assert_same_gradients(gradients(rasterizer, scene, subset), gradients(oracle, scene, subset))


@pytest.mark.parametrize("subset", [Subset(tiles=np.zeros((3, 4), np.bool_)), Subset(ids=np.zeros(0, np.uint32))])
def test_empty_subset_has_no_gradient(rasterizer: Rasterizer, subset: Subset) -> None:
    result = gradients(rasterizer, Scene(random_rows(0, 20), CAMERA, np.eye(4)), subset)
    assert len(result.visible) == 0
    assert result.d_rows.shape == (20, 16)
    assert not result.d_rows.any()
    assert not result.d_twist.any()


def test_empty_map_has_no_gradient(rasterizer: Rasterizer) -> None:
    result = gradients(rasterizer, Scene(np.zeros((0, 16), np.float32), CAMERA, np.eye(4)))
    assert result.d_rows.shape == (0, 16)
    assert len(result.visible) == len(result.mean_2d_grad_norm) == 0


def test_invalid_rows_have_no_gradient(rasterizer: Rasterizer) -> None:
    scene = named_scene("broken rows")
    result = gradients(rasterizer, scene)
    assert result.visible.min() >= 42
    assert not np.isin(np.arange(60, 80), result.visible).any()
    assert np.isfinite(result.d_rows).all()
    assert not result.d_rows[:42].any()


def test_gradients_are_independent_of_earlier_renderings(rasterizer: Rasterizer) -> None:
    scene, other = named_scene("medium splats"), named_scene("odd size")
    first = gradients(rasterizer, scene)
    gradients(rasterizer, other)
    repeated = gradients(rasterizer, scene)
    np.testing.assert_allclose(repeated.d_rows, first.d_rows, rtol=1e-4, atol=1e-4)


def test_backward_does_not_read_the_tile_mask(rasterizer: Rasterizer) -> None:
    scene = named_scene(SCENES[0])
    grid = tuple(-(-side // TILE_PX) for side in scene.size)
    half = np.arange(grid[1]) % 2 == 0
    subset = Subset(tiles=np.broadcast_to(half, grid).copy())
    expected = gradients(rasterizer, scene, subset)
    assert np.abs(expected.d_rows).sum() > 0.0
    twice_as_wide = np.broadcast_to(half, grid).repeat(2, axis=1)
    for masks in (lambda: np.broadcast_to(half, grid).copy(), lambda: twice_as_wide[:, ::2]):
        rendering = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world, Subset(tiles=masks()))
        # the next allocations reuse the memory of the mask
        allocations = [np.zeros(grid, np.bool_) for _ in range(100)]
        result = rasterizer.backward(rendering, *random_image_gradients(scene))
        assert_same_gradients(result, expected)
        del allocations
