"""One fused step is forward, loss, backward and Adam on the rows that it may move."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from splat_scenes import GROUPS, Picture, Scene, relative_error, scene_for, scene_named
from step_training import ADAM, LOSS, gradient_seen, picture_for, tables, train

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
from gausslite.render.reference.loss import training_loss

TOLERANCE = 1e-4


SATURATED_TOLERANCE = {"cuda": 0.1}


"""Of the backends that clamp and stop otherwise than the seam says, on whole images with saturated pixels: a nearly
opaque splat then gets a gradient from pixels that give it none, and the other way round."""


CASES = {
    "whole image": {},
    "masked": {"masked": True},
    "colour alone": {"loss": LossWeights(1.0, 0.0, 0.0)},
    "depth alone": {"loss": LossWeights(0.0, 1.0, 0.0)},
    "structure alone": {"loss": LossWeights(0.0, 0.0, 1.0)},
    "masked, by share": {"loss": LossWeights(normalise_by_image=True), "masked": True},
    "by share": {"loss": LossWeights(normalise_by_image=True)},
    "structure alone, masked": {"loss": LossWeights(0.0, 0.0, 1.0), "masked": True},
    "without structure, masked": {"loss": LossWeights(0.8, 1.0, 0.0), "masked": True},
    "some tiles, masked": {
        "masked": True,
        "subset": Subset(tiles=np.array([[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 0, 0]], np.bool_)),
    },
    "some tiles, without structure": {
        "loss": LossWeights(0.8, 1.0, 0.0),
        "subset": Subset(tiles=np.array([[1, 1, 0, 0], [0, 1, 1, 0], [0, 0, 0, 0]], np.bool_)),
    },
    "some rows": {"subset": Subset(ids=np.arange(0, 200, 3, dtype=np.uint32))},
}


@pytest.mark.parametrize("case", CASES)
def test_step_feeds_adam_the_oracles_gradient(rasterizer: Rasterizer, oracle: Rasterizer, case: str) -> None:
    options = CASES[case]
    scene = scene_named("medium splats")
    picture = picture_for(scene, oracle, options.get("subset", FULL_FRAME))
    came, wanted = train(rasterizer, scene, picture, **options), train(oracle, scene, picture, **options)
    assert came.report.loss == pytest.approx(wanted.report.loss, rel=1e-4)
    np.testing.assert_array_equal(came.report.visible, wanted.report.visible)
    for group, columns in GROUPS.items():
        error = relative_error(gradient_seen(came)[:, columns], gradient_seen(wanted)[:, columns])
        assert error < TOLERANCE, f"{group}: relative error {error:.2e}"


@pytest.mark.parametrize("name", ["odd size", "opaque", "broken rows", "needles and sheets", "behind the camera"])
def test_step_matches_the_oracle_on_other_scenes(rasterizer: Rasterizer, oracle: Rasterizer, name: str) -> None:
    scene = scene_named(name)
    saturated = not np.array_equal(scene.steady, scene_for(rasterizer, name).steady)
    tolerance = SATURATED_TOLERANCE[rasterizer.name] if saturated else TOLERANCE
    picture = picture_for(scene, oracle)
    came, wanted = train(rasterizer, scene, picture), train(oracle, scene, picture)
    assert came.report.loss == pytest.approx(wanted.report.loss, rel=1e-4)
    for group, columns in GROUPS.items():
        error = relative_error(gradient_seen(came)[:, columns], gradient_seen(wanted)[:, columns])
        assert error < tolerance, f"{group}: relative error {error:.2e}"


@pytest.mark.parametrize("corner", [(0, 0), (30, 44), (59, 84)])
def test_a_small_region_trains_as_the_oracle_trains_it(
    rasterizer: Rasterizer, oracle: Rasterizer, corner: tuple[int, int]
) -> None:
    scene = scene_named("many")
    region = np.zeros(scene.size, np.float32)
    region[corner[0] : corner[0] + 11, corner[1] : corner[1] + 16] = 1.0
    near = np.pad(region, 5)
    tiles = np.zeros((5, 7), np.bool_)
    for row, column in np.ndindex(tiles.shape):
        tiles[row, column] = near[16 * row : 16 * row + 26, 16 * column : 16 * column + 26].any()
    subset = Subset(tiles=tiles)
    picture = replace(picture_for(scene, oracle, subset), weight=region)
    came, wanted = (train(backend, scene, picture, masked=True, subset=subset) for backend in (rasterizer, oracle))
    assert came.report.loss == pytest.approx(wanted.report.loss, rel=1e-4)
    np.testing.assert_array_equal(came.report.visible, wanted.report.visible)
    for group, columns in GROUPS.items():
        error = relative_error(gradient_seen(came)[:, columns], gradient_seen(wanted)[:, columns])
        assert error < TOLERANCE, f"{group}: relative error {error:.2e}"


@pytest.mark.parametrize("masked", [False, True])
def test_step_equals_the_separate_path(rasterizer: Rasterizer, oracle: Rasterizer, masked: bool) -> None:
    scene = scene_named("odd size")
    picture = picture_for(scene, oracle)
    drawn = rasterizer.forward(scene.rows, scene.camera, scene.T_camera_world)
    images = np.concatenate([drawn.rgb, drawn.depth_m[..., None], drawn.alpha[..., None]], axis=2)
    leaf = torch.from_numpy(images.astype(np.float64)).requires_grad_()
    loss = training_loss(leaf, picture.view(oracle, scene), LOSS, masked)
    loss.backward()
    d = leaf.grad.numpy().astype(np.float32)
    separate = rasterizer.backward(drawn, d[..., :3].copy(), d[..., 3].copy(), d[..., 4].copy())
    fused = train(rasterizer, scene, picture, masked=masked)
    assert fused.report.loss == pytest.approx(loss.item(), rel=1e-4)
    np.testing.assert_array_equal(fused.report.visible, separate.visible)
    assert relative_error(gradient_seen(fused), separate.d_rows) < TOLERANCE
    grown = (fused.first_moment - fused.before[1])[separate.visible, GRAD_2D_SUM]
    assert relative_error(grown, separate.mean_2d_norm) < TOLERANCE


@pytest.mark.parametrize("decay_after_updates", [math.inf, 9.0])
def test_rows_move_by_adams_rule(rasterizer: Rasterizer, oracle: Rasterizer, decay_after_updates: float) -> None:
    scene = scene_named("medium splats")
    slowing = replace(ADAM, decay_after_updates=decay_after_updates)
    done = train(rasterizer, scene, picture_for(scene, oracle), seasoned=True, adam=slowing)
    moved = done.report.visible
    before, after = done.before[0][moved, :14].astype(np.float64), done.rows[moved, :14]
    gradient = gradient_seen(done)[moved, :14]
    second = ADAM.beta2 * done.before[2][moved, :14] + (1 - ADAM.beta2) * gradient**2
    np.testing.assert_allclose(done.second_moment[moved, :14], second, rtol=2e-2, atol=1e-12)
    updates = done.rows[moved, UPDATE_COUNT].astype(np.float64)[:, None]
    np.testing.assert_array_equal(updates[:, 0], done.before[0][moved, UPDATE_COUNT] + 1)
    first_unbiased = done.first_moment[moved, :14] / (1 - ADAM.beta1**updates)
    second_unbiased = done.second_moment[moved, :14] / (1 - ADAM.beta2**updates)
    slowed = np.sqrt(np.minimum(1.0, decay_after_updates / np.minimum(updates, MAX_UPDATE_COUNT)))
    step = slowed * ADAM.row_rates()[:14] * first_unbiased / (np.sqrt(second_unbiased) + ADAM.epsilon)
    assert relative_error(after - before, -step) < TOLERANCE
    assert not done.rows[:, 15].any()


def test_density_statistics_count_the_steps_seen(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    picture = picture_for(scene, oracle)
    came, wanted = (train(backend, scene, picture, seasoned=True) for backend in (rasterizer, oracle))
    visible = came.report.visible
    grown = came.first_moment - came.before[1]
    np.testing.assert_array_equal(grown[visible, GRAD_2D_COUNT], 1.0)
    came_sum, wanted_sum = grown[visible, GRAD_2D_SUM], (wanted.first_moment - wanted.before[1])[visible, GRAD_2D_SUM]
    assert relative_error(came_sum, wanted_sum) < TOLERANCE
    assert not came.second_moment[:, 14:].any()


def test_a_step_on_an_empty_map_costs_the_whole_image(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = Scene(np.zeros((0, 16), np.float32), scene_named("odd size").camera, np.eye(4))
    picture = picture_for(scene, oracle)
    came, wanted = train(rasterizer, scene, picture), train(oracle, scene, picture)
    assert came.report.loss == pytest.approx(wanted.report.loss, rel=1e-5)
    assert len(came.report.visible) == 0


def test_thirty_steps_reduce_the_loss(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    goal = oracle.forward(scene_named("large splats").rows, scene.camera, scene.T_camera_world)
    picture = Picture((goal.rgb.clip(0, 1) * 255).astype(np.uint8), goal.expected_depth_m(), np.ones_like(goal.alpha))
    view = picture.view(rasterizer, scene)
    rows, first, second = scene.rows.copy(), np.zeros_like(scene.rows), np.zeros_like(scene.rows)
    losses = [rasterizer.step(rows, first, second, view, scene.T_camera_world, LOSS, ADAM).loss for _ in range(30)]
    assert losses[-1] < 0.8 * losses[0]
    assert rows[:, UPDATE_COUNT].max() == 30


def test_tables_on_loan_end_up_as_step_by_step(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    view = picture_for(scene, oracle).view(rasterizer, scene)
    alone, lent = tables(scene, seasoned=True), tables(scene, seasoned=True)
    reports = [rasterizer.step(*alone, view, scene.T_camera_world, LOSS, ADAM) for _ in range(3)]
    with rasterizer.bind_tables(*lent):
        lent_reports = [rasterizer.step(*lent, view, scene.T_camera_world, LOSS, ADAM) for _ in range(3)]
    for came, wanted in zip(lent, alone, strict=True):
        np.testing.assert_array_equal(came, wanted)
    for came, wanted in zip(lent_reports, reports, strict=True):
        assert came.loss == wanted.loss
        np.testing.assert_array_equal(came.visible, wanted.visible)


def test_an_error_ends_the_loan_with_what_was_trained(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    view = picture_for(scene, oracle).view(rasterizer, scene)
    lent = tables(scene, seasoned=False)

    def one_step_and_a_mishap() -> None:
        with rasterizer.bind_tables(*lent):
            rasterizer.step(*lent, view, scene.T_camera_world, LOSS, ADAM)
            raise KeyError("a mishap")

    with pytest.raises(KeyError):
        one_step_and_a_mishap()
    assert lent[0][:, UPDATE_COUNT].max() == 1
