"""Contract of the training step: forward, loss, backward and Adam on visible rows."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from splat_scenes import GROUPS, Scene, TargetImage, named_scene, relative_error, scene_for
from step_training import ADAM, LOSS, StepResult, applied_gradient, tables, target_for, train
from torch_oracle.rasterizer import training_loss

from gausslite.render.rasterizer import (
    FULL_FRAME,
    GRAD_2D_COUNT,
    GRAD_2D_SUM,
    MAX_UPDATE_COUNT,
    UPDATE_COUNT,
    LossWeights,
    Rasterizer,
    Subset,
)

TOLERANCE = 1e-4
SATURATED_TOLERANCE = {"cuda": 0.1}
"""Of backends with other limits of alpha and transmittance, on images with saturated pixels: there a nearly opaque
splat may receive a gradient in one backend only."""
CASES = {
    "whole image": {},
    "masked": {"masked": True},
    "colour only": {"loss": LossWeights(1.0, 0.0, 0.0)},
    "depth only": {"loss": LossWeights(0.0, 1.0, 0.0)},
    "ssim only": {"loss": LossWeights(0.0, 0.0, 1.0)},
    "masked, normalised by image": {"loss": LossWeights(normalise_by_image=True), "masked": True},
    "normalised by image": {"loss": LossWeights(normalise_by_image=True)},
    "ssim only, masked": {"loss": LossWeights(0.0, 0.0, 1.0), "masked": True},
    "without ssim, masked": {"loss": LossWeights(0.8, 1.0, 0.0), "masked": True},
    "some tiles, masked": {
        "masked": True,
        "subset": Subset(tiles=np.array([[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 0, 0]], np.bool_)),
    },
    "some tiles, without ssim": {
        "loss": LossWeights(0.8, 1.0, 0.0),
        "subset": Subset(tiles=np.array([[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 0, 0]], np.bool_)),
    },
    "some rows": {"subset": Subset(ids=np.arange(0, 200, 3, dtype=np.uint32))},
}


def assert_same_step(result: StepResult, expected: StepResult, tolerance: float = TOLERANCE) -> None:
    assert result.report.loss == pytest.approx(expected.report.loss, rel=1e-4)
    np.testing.assert_array_equal(result.report.visible, expected.report.visible)
    for group, columns in GROUPS.items():
        error = relative_error(applied_gradient(result)[:, columns], applied_gradient(expected)[:, columns])
        assert error < tolerance, f"{group}: relative error {error:.2e}"


@pytest.mark.parametrize("case", CASES)
def test_step_gradient_matches_oracle(rasterizer: Rasterizer, oracle: Rasterizer, case: str) -> None:
    options = CASES[case]
    scene = named_scene("medium splats")
    target = target_for(scene, oracle, options.get("subset", FULL_FRAME))
    result, expected = train(rasterizer, scene, target, **options), train(oracle, scene, target, **options)
    assert_same_step(result, expected)


@pytest.mark.parametrize("name", ["odd size", "opaque", "broken rows", "needles and sheets", "behind the camera"])
def test_step_gradient_matches_oracle_on_other_scenes(rasterizer: Rasterizer, oracle: Rasterizer, name: str) -> None:
    scene = named_scene(name)
    saturated = not np.array_equal(scene.comparable, scene_for(rasterizer, name).comparable)
    tolerance = SATURATED_TOLERANCE[rasterizer.name] if saturated else TOLERANCE
    target = target_for(scene, oracle)
    result, expected = train(rasterizer, scene, target), train(oracle, scene, target)
    assert_same_step(result, expected, tolerance)


@pytest.mark.parametrize("dilation_px2", [0.1375, 0.9])
def test_the_given_dilation_is_used(rasterizer: Rasterizer, oracle: Rasterizer, dilation_px2: float) -> None:
    scene = named_scene("small splats")
    target = replace(target_for(scene, oracle), dilation_px2=dilation_px2)
    result, expected = train(rasterizer, scene, target), train(oracle, scene, target)
    assert_same_step(result, expected)
    assert expected.report.loss != train(oracle, scene, target_for(scene, oracle)).report.loss
    view = scene.rows, scene.camera, scene.T_camera_world, FULL_FRAME, None, dilation_px2
    difference = rasterizer.forward(*view).rgb - oracle.forward(*view).rgb
    assert np.abs(difference[scene.comparable]).max() < 2e-5


@pytest.mark.parametrize("corner", [(0, 0), (30, 44), (59, 84)])
def test_small_region_step_matches_oracle(rasterizer: Rasterizer, oracle: Rasterizer, corner: tuple[int, int]) -> None:
    scene = named_scene("many")
    region = np.zeros(scene.size, np.float32)
    region[corner[0] : corner[0] + 11, corner[1] : corner[1] + 16] = 1.0
    near = np.pad(region, 5)
    tiles = np.zeros((5, 7), np.bool_)
    for row, column in np.ndindex(tiles.shape):
        tiles[row, column] = near[16 * row : 16 * row + 26, 16 * column : 16 * column + 26].any()
    subset = Subset(tiles=tiles)
    target = replace(target_for(scene, oracle, subset), pixel_weights=region)
    result, expected = (train(backend, scene, target, masked=True, subset=subset) for backend in (rasterizer, oracle))
    assert_same_step(result, expected)


@pytest.mark.parametrize("masked", [False, True])
def test_step_matches_separate_forward_and_backward(rasterizer: Rasterizer, oracle: Rasterizer, masked: bool) -> None:
    scene = named_scene("odd size")
    target = target_for(scene, oracle)
    rendering = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world)
    images = np.concatenate([rendering.rgb, rendering.depth_m[..., None], rendering.alpha[..., None]], axis=2)
    leaf = torch.from_numpy(images.astype(np.float64)).requires_grad_()
    loss = training_loss(leaf, target.view(oracle, scene), LOSS, masked)
    loss.backward()
    d = leaf.grad.numpy().astype(np.float32)
    separate = rasterizer.backward(rendering, d[..., :3].copy(), d[..., 3].copy(), d[..., 4].copy())
    fused = train(rasterizer, scene, target, masked=masked)
    assert fused.report.loss == pytest.approx(loss.item(), rel=1e-4)
    np.testing.assert_array_equal(fused.report.visible, separate.visible)
    assert relative_error(applied_gradient(fused), separate.d_rows) < TOLERANCE
    added = (fused.first_moment - fused.before[1])[separate.visible, GRAD_2D_SUM]
    assert relative_error(added, separate.mean_2d_grad_norm) < TOLERANCE


@pytest.mark.parametrize("decay_after_updates", [math.inf, 9.0])
def test_rows_change_by_adam(rasterizer: Rasterizer, oracle: Rasterizer, decay_after_updates: float) -> None:
    scene = named_scene("medium splats")
    decaying = replace(ADAM, decay_after_updates=decay_after_updates)
    result = train(rasterizer, scene, target_for(scene, oracle), with_history=True, adam=decaying)
    ids = result.report.visible
    before, after = result.before[0][ids, :14].astype(np.float64), result.rows[ids, :14]
    gradient = applied_gradient(result)[ids, :14]
    second = ADAM.beta2 * result.before[2][ids, :14] + (1 - ADAM.beta2) * gradient**2
    np.testing.assert_allclose(result.second_moment[ids, :14], second, rtol=2e-2, atol=1e-12)
    updates = result.rows[ids, UPDATE_COUNT].astype(np.float64)[:, None]
    np.testing.assert_array_equal(updates[:, 0], result.before[0][ids, UPDATE_COUNT] + 1)
    first_unbiased = result.first_moment[ids, :14] / (1 - ADAM.beta1**updates)
    second_unbiased = result.second_moment[ids, :14] / (1 - ADAM.beta2**updates)
    rate_decay = np.sqrt(np.minimum(1.0, decay_after_updates / np.minimum(updates, MAX_UPDATE_COUNT)))
    step = rate_decay * ADAM.row_rates()[:14] * first_unbiased / (np.sqrt(second_unbiased) + ADAM.epsilon)
    assert relative_error(after - before, -step) < TOLERANCE
    assert not result.rows[:, 15].any()


def test_density_statistics_count_visible_steps(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = named_scene("medium splats")
    target = target_for(scene, oracle)
    result, expected = (train(backend, scene, target, with_history=True) for backend in (rasterizer, oracle))
    visible = result.report.visible
    added = result.first_moment - result.before[1]
    np.testing.assert_array_equal(added[visible, GRAD_2D_COUNT], 1.0)
    result_sum, expected_sum = (
        added[visible, GRAD_2D_SUM],
        (expected.first_moment - expected.before[1])[visible, GRAD_2D_SUM],
    )
    assert relative_error(result_sum, expected_sum) < TOLERANCE
    assert not result.second_moment[:, 14:].any()


def test_step_on_empty_map_returns_loss_of_black_image(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = Scene(np.zeros((0, 16), np.float32), named_scene("odd size").camera, np.eye(4))
    target = target_for(scene, oracle)
    result, expected = train(rasterizer, scene, target), train(oracle, scene, target)
    assert result.report.loss == pytest.approx(expected.report.loss, rel=1e-5)
    assert len(result.report.visible) == 0


def test_thirty_steps_reduce_the_loss(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = named_scene("medium splats")
    goal_rendering = oracle.forward(named_scene("large splats").rows, scene.camera, scene.T_camera_world)
    target = TargetImage(
        (goal_rendering.rgb.clip(0, 1) * 255).astype(np.uint8),
        goal_rendering.expected_depth_m(),
        np.ones_like(goal_rendering.alpha),
    )
    view = target.view(rasterizer, scene)
    rows, first, second = scene.rows.copy(), np.zeros_like(scene.rows), np.zeros_like(scene.rows)
    losses = [rasterizer.step(rows, first, second, view, scene.T_camera_world, LOSS, ADAM).loss for _ in range(30)]
    assert losses[-1] < 0.8 * losses[0]
    assert rows[:, UPDATE_COUNT].max() == 30


def test_bound_and_unbound_tables_train_equally(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = named_scene("medium splats")
    view = target_for(scene, oracle).view(rasterizer, scene)
    unbound, bound = tables(scene, with_history=True), tables(scene, with_history=True)
    reports = [rasterizer.step(*unbound, view, scene.T_camera_world, LOSS, ADAM) for _ in range(3)]
    with rasterizer.bind_tables(*bound):
        bound_reports = [rasterizer.step(*bound, view, scene.T_camera_world, LOSS, ADAM) for _ in range(3)]
    for result, expected in zip(bound, unbound, strict=True):
        np.testing.assert_array_equal(result, expected)
    for result, expected in zip(bound_reports, reports, strict=True):
        assert result.loss == expected.loss
        np.testing.assert_array_equal(result.visible, expected.visible)


def test_tables_are_written_back_after_an_exception(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = named_scene("medium splats")
    view = target_for(scene, oracle).view(rasterizer, scene)
    bound = tables(scene, with_history=False)

    def step_and_raise() -> None:
        with rasterizer.bind_tables(*bound):
            rasterizer.step(*bound, view, scene.T_camera_world, LOSS, ADAM)
            raise KeyError("test")

    pytest.raises(KeyError, step_and_raise)
    assert bound[0][:, UPDATE_COUNT].max() == 1
