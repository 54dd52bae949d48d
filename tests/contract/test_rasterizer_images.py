"""Contract of `forward`: images match the oracle."""

import numpy as np
import pytest
from splat_scenes import CAMERA, SCENES, Scene, named_scene, random_rows, relative_error, rotated_pose, scene_for

from gausslite.domain.errors import InvalidInputError, ShapeError
from gausslite.render.rasterizer import TILE_PX, Rasterizer, Rendering, Subset

ATOL = 2e-5
SATURATED_ATOL = 0.12
"""Of backends with other limits of alpha and transmittance: a transmittance of 0.1, plus twice 0.01."""


def assert_same_images(result: Rendering, expected: Rendering, mask: np.ndarray) -> None:
    far_m = max(1.0, float(np.abs(expected.depth_m).max()))
    assert np.abs(result.rgb - expected.rgb)[mask].max(initial=0.0) < ATOL
    assert np.abs(result.alpha - expected.alpha)[mask].max(initial=0.0) < ATOL
    assert np.abs(result.depth_m - expected.depth_m)[mask].max(initial=0.0) < ATOL * far_m
    assert relative_error(result.rgb[mask], expected.rgb[mask]) < ATOL


@pytest.mark.parametrize("name", SCENES)
def test_images_match_the_oracle(rasterizer: Rasterizer, oracle: Rasterizer, name: str) -> None:
    scene = scene_for(rasterizer, name)
    mask = scene.comparable
    assert named_scene(name).comparable.mean() > 0.8
    result = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world)
    expected = oracle.forward(scene.rows, scene.camera, scene.T_camera_world)
    assert_same_images(result, expected, mask)
    saturated = named_scene(name).comparable & ~mask
    assert np.abs(result.rgb - expected.rgb)[saturated].max(initial=0.0) < SATURATED_ATOL


def test_empty_map_gives_black_image(rasterizer: Rasterizer) -> None:
    rendering = rasterizer.forward(np.zeros((0, 16), np.float32), CAMERA, np.eye(4))
    assert rendering.rgb.shape == (48, 64, 3)
    assert not rendering.rgb.any()
    assert not rendering.depth_m.any()
    assert not rendering.alpha.any()


def test_splats_behind_the_camera_give_black_image(rasterizer: Rasterizer) -> None:
    rows = random_rows(0, 50)
    rows[:, 2] *= -1.0
    rendering = rasterizer.forward(rows, CAMERA, np.eye(4))
    assert not rendering.alpha.any()


def test_splat_has_maximum_alpha_at_its_mean(rasterizer: Rasterizer) -> None:
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
    rendering = rasterizer.forward(rows, CAMERA, np.eye(4))
    np.testing.assert_allclose(rendering.alpha[row, column], 0.5, atol=1e-4)
    np.testing.assert_allclose(rendering.rgb[row, column], [0.5, 0.25, 0.125], atol=1e-4)
    np.testing.assert_allclose(rendering.depth_m[row, column], 1.0, atol=2e-4)
    assert np.unravel_index(rendering.alpha.argmax(), rendering.alpha.shape) == (row, column)


def test_extreme_finite_rows_give_finite_results(rasterizer: Rasterizer) -> None:
    rows = random_rows(1, 64)
    extremes = {0: 1e30, 1: -1e30, 2: 1e30, 3: 80.0, 4: -80.0, 6: 1e-15, 7: 1e15, 10: 1e4, 12: 1e6}
    for i, (column, value) in enumerate(extremes.items()):
        rows[i, column] = value
        rows[20 + i, column] = -value
    rendering = rasterizer.forward(rows, CAMERA, np.eye(4))
    for image in (rendering.rgb, rendering.depth_m, rendering.alpha):
        assert np.isfinite(image).all()
    gradients = rasterizer.backward(
        rendering, np.ones_like(rendering.rgb), np.ones_like(rendering.depth_m), np.ones_like(rendering.alpha)
    )
    assert np.isfinite(gradients.d_rows).all()


def random_tiles(scene: Scene, seed: int = 0) -> np.ndarray:
    height, width = scene.size
    grid = (-(-height // TILE_PX), -(-width // TILE_PX))
    return np.random.default_rng(seed).random(grid) < 0.5


@pytest.mark.parametrize("name", ["medium splats", "odd size", "huge"])
def test_tiles_outside_the_subset_are_black(rasterizer: Rasterizer, name: str) -> None:
    scene = named_scene(name)
    tiles = random_tiles(scene)
    in_subset = np.kron(tiles, np.ones((TILE_PX, TILE_PX), np.bool_))[: scene.size[0], : scene.size[1]]
    whole = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world)
    whole_rgb, whole_alpha = whole.rgb.copy(), whole.alpha.copy()
    part = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world, Subset(tiles=tiles))
    np.testing.assert_allclose(part.rgb[in_subset], whole_rgb[in_subset], atol=1e-6)
    np.testing.assert_allclose(part.alpha[in_subset], whole_alpha[in_subset], atol=1e-6)
    for image in (part.rgb, part.depth_m, part.alpha):
        assert not image[~in_subset].any()


@pytest.mark.parametrize("name", ["medium splats", "broken rows"])
def test_id_subset_renders_like_a_map_of_those_rows(rasterizer: Rasterizer, name: str) -> None:
    scene = named_scene(name)
    ids = np.flatnonzero(np.random.default_rng(3).random(len(scene.rows)) < 0.3).astype(np.uint32)
    part = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world, Subset(ids=ids))
    part_rgb = part.rgb.copy()
    subset_map = rasterizer.forward(scene.rows[ids], scene.camera, scene.T_camera_world)
    np.testing.assert_allclose(part_rgb, subset_map.rgb, atol=1e-6)


def test_input_rows_are_unchanged(rasterizer: Rasterizer) -> None:
    rows = random_rows(2, 100)
    before = rows.copy()
    rendering = rasterizer.forward(rows, CAMERA, rotated_pose())
    rasterizer.backward(
        rendering, np.ones_like(rendering.rgb), np.ones_like(rendering.depth_m), np.ones_like(rendering.alpha)
    )
    np.testing.assert_array_equal(rows, before)


def test_tiles_of_wrong_shape_are_rejected(rasterizer: Rasterizer) -> None:
    with pytest.raises(ShapeError, match="tiles"):
        rasterizer.forward(random_rows(0, 5), CAMERA, np.eye(4), Subset(tiles=np.ones((2, 4), np.bool_)))


@pytest.mark.parametrize("ids", [[3, 1], [1, 1], [4, 5]])
def test_ids_not_ascending_are_rejected(rasterizer: Rasterizer, ids: list[int]) -> None:
    with pytest.raises(InvalidInputError, match="ids"):
        rasterizer.forward(random_rows(0, 5), CAMERA, np.eye(4), Subset(ids=np.array(ids, np.uint32)))
