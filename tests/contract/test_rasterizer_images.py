"""Every backend draws what the oracle draws."""

from __future__ import annotations

import numpy as np
import pytest
from splat_scenes import CAMERA, SCENES, Scene, random_rows, relative_error, scene_for, scene_named, turned

from gausslite.errors import InvalidInputError, ShapeError
from gausslite.render.rasterizer import TILE_PX, Rasterizer, Rendering, Subset

ATOL = 2e-5
SATURATED_ATOL = 0.12
"""Where a backend clamps and stops otherwise than the seam says: a tenth that was let through, and twice 0.01."""


def assert_same_images(came: Rendering, wanted: Rendering, where: np.ndarray) -> None:
    far_m = max(1.0, float(np.abs(wanted.depth_m).max()))
    assert np.abs(came.rgb - wanted.rgb)[where].max(initial=0.0) < ATOL
    assert np.abs(came.alpha - wanted.alpha)[where].max(initial=0.0) < ATOL
    assert np.abs(came.depth_m - wanted.depth_m)[where].max(initial=0.0) < ATOL * far_m
    assert relative_error(came.rgb[where], wanted.rgb[where]) < ATOL


@pytest.mark.parametrize("name", SCENES)
def test_images_match_the_oracle(rasterizer: Rasterizer, oracle: Rasterizer, name: str) -> None:
    scene = scene_for(rasterizer, name)
    where = scene.steady
    assert scene_named(name).steady.mean() > 0.8
    came = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world)
    wanted = oracle.forward(scene.rows, scene.camera, scene.T_camera_world)
    assert_same_images(came, wanted, where)
    elsewhere = scene_named(name).steady & ~where
    assert np.abs(came.rgb - wanted.rgb)[elsewhere].max(initial=0.0) < SATURATED_ATOL


def test_no_splats_give_an_empty_image(rasterizer: Rasterizer) -> None:
    drawn = rasterizer.forward(np.zeros((0, 16), np.float32), CAMERA, np.eye(4))
    assert drawn.rgb.shape == (48, 64, 3)
    assert not drawn.rgb.any()
    assert not drawn.depth_m.any()
    assert not drawn.alpha.any()


def test_all_splats_behind_the_camera_give_an_empty_image(rasterizer: Rasterizer) -> None:
    rows = random_rows(0, 50)
    rows[:, 2] *= -1.0
    drawn = rasterizer.forward(rows, CAMERA, np.eye(4))
    assert not drawn.alpha.any()


def test_one_splat_peaks_at_its_pixel_centre(rasterizer: Rasterizer) -> None:
    rows = np.zeros((1, 16), np.float32)
    column, row, z_m = 20, 30, 2.0
    rows[0, :3] = [
        (column + 0.5 - CAMERA.cx_px) / CAMERA.fx_px * z_m,
        (row + 0.5 - CAMERA.cy_px) / CAMERA.fy_px * z_m,
        z_m,
    ]
    rows[0, 3:6] = np.log(0.05)
    rows[0, 6] = 3.0
    rows[0, 10] = 0.0
    rows[0, 11:14] = [1.0, 0.5, 0.25]
    drawn = rasterizer.forward(rows, CAMERA, np.eye(4))
    np.testing.assert_allclose(drawn.alpha[row, column], 0.5, atol=1e-4)
    np.testing.assert_allclose(drawn.rgb[row, column], [0.5, 0.25, 0.125], atol=1e-4)
    np.testing.assert_allclose(drawn.depth_m[row, column], 1.0, atol=2e-4)
    assert np.unravel_index(drawn.alpha.argmax(), drawn.alpha.shape) == (row, column)


def test_extreme_but_finite_rows_never_give_nan(rasterizer: Rasterizer) -> None:
    rows = random_rows(1, 64)
    extremes = {0: 1e30, 1: -1e30, 2: 1e30, 3: 80.0, 4: -80.0, 6: 1e-15, 7: 1e15, 10: 1e4, 12: 1e6}
    for i, (column, value) in enumerate(extremes.items()):
        rows[i, column] = value
        rows[20 + i, column] = -value
    drawn = rasterizer.forward(rows, CAMERA, np.eye(4))
    for image in (drawn.rgb, drawn.depth_m, drawn.alpha):
        assert np.isfinite(image).all()
    gradients = rasterizer.backward(
        drawn, np.ones_like(drawn.rgb), np.ones_like(drawn.depth_m), np.ones_like(drawn.alpha)
    )
    assert np.isfinite(gradients.d_rows).all()


def _some_tiles(scene: Scene, seed: int = 0) -> np.ndarray:
    height, width = scene.size
    grid = (-(-height // TILE_PX), -(-width // TILE_PX))
    return np.random.default_rng(seed).random(grid) < 0.5


@pytest.mark.parametrize("name", ["medium splats", "odd size", "huge"])
def test_tiles_outside_the_subset_stay_empty(rasterizer: Rasterizer, name: str) -> None:
    scene = scene_named(name)
    tiles = _some_tiles(scene)
    shown = np.kron(tiles, np.ones((TILE_PX, TILE_PX), np.bool_))[: scene.size[0], : scene.size[1]]
    whole = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world)
    whole_rgb, whole_alpha = whole.rgb.copy(), whole.alpha.copy()
    part = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world, Subset(tiles=tiles))
    np.testing.assert_allclose(part.rgb[shown], whole_rgb[shown], atol=1e-6)
    np.testing.assert_allclose(part.alpha[shown], whole_alpha[shown], atol=1e-6)
    for image in (part.rgb, part.depth_m, part.alpha):
        assert not image[~shown].any()


@pytest.mark.parametrize("name", ["medium splats", "broken rows"])
def test_an_id_subset_draws_like_a_map_of_those_rows(rasterizer: Rasterizer, name: str) -> None:
    scene = scene_named(name)
    ids = np.flatnonzero(np.random.default_rng(3).random(len(scene.rows)) < 0.3).astype(np.uint32)
    part = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world, Subset(ids=ids))
    part_rgb = part.rgb.copy()
    alone = rasterizer.forward(scene.rows[ids], scene.camera, scene.T_camera_world)
    np.testing.assert_allclose(part_rgb, alone.rgb, atol=1e-6)


def test_the_input_rows_are_left_alone(rasterizer: Rasterizer) -> None:
    rows = random_rows(2, 100)
    before = rows.copy()
    drawn = rasterizer.forward(rows, CAMERA, turned())
    rasterizer.backward(drawn, np.ones_like(drawn.rgb), np.ones_like(drawn.depth_m), np.ones_like(drawn.alpha))
    np.testing.assert_array_equal(rows, before)


def test_tiles_of_the_wrong_grid_are_refused(rasterizer: Rasterizer) -> None:
    with pytest.raises(ShapeError, match="tiles"):
        rasterizer.forward(random_rows(0, 5), CAMERA, np.eye(4), Subset(tiles=np.ones((2, 4), np.bool_)))


@pytest.mark.parametrize("ids", [[3, 1], [1, 1], [4, 5]])
def test_ids_that_are_not_ascending_rows_are_refused(rasterizer: Rasterizer, ids: list[int]) -> None:
    with pytest.raises(InvalidInputError, match="ids"):
        rasterizer.forward(random_rows(0, 5), CAMERA, np.eye(4), Subset(ids=np.array(ids, np.uint32)))
