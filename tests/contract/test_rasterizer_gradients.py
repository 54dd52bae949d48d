"""Every backend's gradients are the oracle's."""

from __future__ import annotations

import numpy as np
import pytest
from splat_scenes import (
    CAMERA,
    GROUPS,
    SCENES,
    Scene,
    random_image_gradients,
    random_rows,
    relative_error,
    scene_for,
    scene_named,
)

from gausslite.render.rasterizer import FULL_FRAME, TILE_PX, Rasterizer, SplatGradients, Subset

TOLERANCE = 1e-4


def gradients(rasterizer: Rasterizer, scene: Scene, subset: Subset = FULL_FRAME) -> SplatGradients:
    drawn = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world, subset)
    return rasterizer.backward(drawn, *random_image_gradients(scene))


def assert_same_gradients(came: SplatGradients, wanted: SplatGradients) -> None:
    np.testing.assert_array_equal(came.visible, wanted.visible)
    for group, columns in GROUPS.items():
        error = relative_error(came.d_rows[:, columns], wanted.d_rows[:, columns])
        assert error < TOLERANCE, f"{group}: relative error {error:.2e}"
    assert relative_error(came.mean_2d_norm, wanted.mean_2d_norm) < TOLERANCE
    assert relative_error(came.d_twist, wanted.d_twist) < TOLERANCE
    assert not came.d_rows[:, 14:].any()


@pytest.mark.parametrize("name", SCENES)
def test_gradients_match_the_oracle(rasterizer: Rasterizer, oracle: Rasterizer, name: str) -> None:
    scene = scene_for(rasterizer, name)
    assert_same_gradients(gradients(rasterizer, scene), gradients(oracle, scene))


@pytest.mark.parametrize("channel", range(3))
def test_each_image_alone_gives_the_oracles_gradients(rasterizer: Rasterizer, oracle: Rasterizer, channel: int) -> None:
    scene = scene_named("medium splats")
    d_images = [d if i == channel else np.zeros_like(d) for i, d in enumerate(random_image_gradients(scene))]
    came, wanted = (
        r.backward(r.forward(scene.rows, scene.camera, scene.T_camera_world), *d_images) for r in (rasterizer, oracle)
    )
    assert_same_gradients(came, wanted)


@pytest.mark.parametrize("name", ["medium splats", "odd size"])
def test_gradients_of_a_tile_subset_match(rasterizer: Rasterizer, oracle: Rasterizer, name: str) -> None:
    scene = scene_named(name)
    grid = (-(-scene.size[0] // 16), -(-scene.size[1] // 16))
    subset = Subset(tiles=np.random.default_rng(1).random(grid) < 0.4)
    came, wanted = gradients(rasterizer, scene, subset), gradients(oracle, scene, subset)
    assert_same_gradients(came, wanted)
    hidden = np.setdiff1d(np.arange(len(scene.rows)), came.visible)
    assert not came.d_rows[hidden].any()


def test_gradients_of_an_id_subset_match(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    ids = np.flatnonzero(np.random.default_rng(4).random(len(scene.rows)) < 0.3).astype(np.uint32)
    came, wanted = gradients(rasterizer, scene, Subset(ids=ids)), gradients(oracle, scene, Subset(ids=ids))
    assert_same_gradients(came, wanted)
    assert np.isin(came.visible, ids).all()


def test_ids_and_tiles_together_match(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("dense")
    tiles = np.zeros((3, 4), np.bool_)
    tiles[1, 1:3] = True
    subset = Subset(tiles=tiles, ids=np.arange(0, len(scene.rows), 2, dtype=np.uint32))
    assert_same_gradients(gradients(rasterizer, scene, subset), gradients(oracle, scene, subset))


@pytest.mark.parametrize("subset", [Subset(tiles=np.zeros((3, 4), np.bool_)), Subset(ids=np.zeros(0, np.uint32))])
def test_nothing_to_draw_has_no_gradient(rasterizer: Rasterizer, subset: Subset) -> None:
    came = gradients(rasterizer, Scene(random_rows(0, 20), CAMERA, np.eye(4)), subset)
    assert len(came.visible) == 0
    assert came.d_rows.shape == (20, 16)
    assert not came.d_rows.any()
    assert not came.d_twist.any()


def test_no_splats_have_no_gradient(rasterizer: Rasterizer) -> None:
    came = gradients(rasterizer, Scene(np.zeros((0, 16), np.float32), CAMERA, np.eye(4)))
    assert came.d_rows.shape == (0, 16)
    assert len(came.visible) == len(came.mean_2d_norm) == 0


def test_rows_that_cannot_be_drawn_get_no_gradient(rasterizer: Rasterizer) -> None:
    scene = scene_named("broken rows")
    came = gradients(rasterizer, scene)
    assert came.visible.min() >= 42
    assert not np.isin(np.arange(60, 80), came.visible).any()
    assert np.isfinite(came.d_rows).all()
    assert not came.d_rows[:42].any()


def test_a_second_rendering_forgets_the_first(rasterizer: Rasterizer) -> None:
    scene, other = scene_named("medium splats"), scene_named("odd size")
    first = gradients(rasterizer, scene)
    gradients(rasterizer, other)
    again = gradients(rasterizer, scene)
    np.testing.assert_allclose(again.d_rows, first.d_rows, rtol=1e-4, atol=1e-4)


def test_a_mask_may_be_gone_on_the_way_back(rasterizer: Rasterizer) -> None:
    scene = scene_named(SCENES[0])
    grid = tuple(-(-side // TILE_PX) for side in scene.size)
    half = np.arange(grid[1]) % 2 == 0
    kept = Subset(tiles=np.broadcast_to(half, grid).copy())
    wanted = gradients(rasterizer, scene, kept)
    assert np.abs(wanted.d_rows).sum() > 0.0
    twice_as_wide = np.broadcast_to(half, grid).repeat(2, axis=1)
    for masks in (lambda: np.broadcast_to(half, grid).copy(), lambda: twice_as_wide[:, ::2]):
        drawn = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world, Subset(tiles=masks()))
        # whoever asks for memory next gets what the mask lay in
        others = [np.zeros(grid, np.bool_) for _ in range(100)]
        came = rasterizer.backward(drawn, *random_image_gradients(scene))
        assert_same_gradients(came, wanted)
        del others
