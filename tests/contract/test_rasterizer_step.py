"""One fused step is forward, loss, backward and Adam on the rows that it may move."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from splat_scenes import GROUPS, Picture, Scene, picture_near, relative_error, scene_for, scene_named

from gausslite.errors import ShapeError
from gausslite.render.rasterizer import (
    EVERYTHING,
    GRAD_2D_COUNT,
    GRAD_2D_SUM,
    UPDATES,
    AdamSettings,
    LossWeights,
    Rasterizer,
    StepReport,
    Subset,
    Tally,
)
from gausslite.render.reference.loss import training_loss

TOLERANCE = 1e-4
SATURATED_TOLERANCE = {"cuda": 0.1}
"""Of the backends that clamp and stop otherwise than the seam says, on whole images with saturated pixels: a nearly
opaque splat then gets a gradient from pixels that give it none, and the other way round."""
LOSS, ADAM = LossWeights(), AdamSettings()


@dataclass
class Trained:
    """The three tables before and after, and what the step said."""

    before: tuple[np.ndarray, np.ndarray, np.ndarray]
    rows: np.ndarray
    first_moment: np.ndarray
    second_moment: np.ndarray
    report: StepReport


def tables(scene: Scene, seasoned: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """New rows with empty moments, or rows with some updates behind them and moments to match."""
    rng = np.random.default_rng(0)
    rows = scene.rows.copy()
    if not seasoned:
        return rows, np.zeros_like(rows), np.zeros_like(rows)
    rows[:, UPDATES] = rng.integers(0, 30, len(rows))
    first = np.zeros_like(rows)
    second = np.zeros_like(rows)
    moved = (rows[:, UPDATES] > 0)[:, None]
    first[:, :14] = rng.normal(0, 1e-4, (len(rows), 14)) * moved
    second[:, :14] = rng.uniform(1e-9, 1e-7, (len(rows), 14)) * moved
    first[:, GRAD_2D_SUM] = rng.uniform(0, 1, len(rows))
    first[:, GRAD_2D_COUNT] = rng.integers(0, 9, len(rows))
    return rows, first, second


def train(
    rasterizer: Rasterizer,
    scene: Scene,
    picture: Picture,
    *,
    loss: LossWeights = LOSS,
    masked: bool = False,
    subset: Subset = EVERYTHING,
    trainable: np.ndarray | None = None,
    seasoned: bool = False,
) -> Trained:
    before = tables(scene, seasoned)
    rows, first, second = (table.copy() for table in before)
    view = picture.view(rasterizer, scene)
    report = rasterizer.step(rows, first, second, view, scene.T_camera_world, loss, ADAM, masked, subset, trainable)
    return Trained(before, rows, first, second, report)


def picture_for(scene: Scene, oracle: Rasterizer, subset: Subset = EVERYTHING) -> Picture:
    return picture_near(oracle.forward(scene.rows, scene.camera, scene.T_camera_world, subset))


def gradient_seen(trained: Trained) -> np.ndarray:
    """The gradient that the step fed to Adam, from the change of the first moment."""
    change = trained.first_moment.astype(np.float64) - ADAM.beta1 * trained.before[1]
    change[:, 14:] = 0.0
    moved = trained.rows[:, UPDATES] != trained.before[0][:, UPDATES]
    return change * moved[:, None] / (1.0 - ADAM.beta1)


CASES = {
    "whole image": {},
    "masked": {"masked": True},
    "colour alone": {"loss": LossWeights(1.0, 0.0, 0.0)},
    "depth alone": {"loss": LossWeights(0.0, 1.0, 0.0)},
    "structure alone": {"loss": LossWeights(0.0, 0.0, 1.0)},
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
    picture = picture_for(scene, oracle, options.get("subset", EVERYTHING))
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


def test_rows_move_by_adams_rule(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    done = train(rasterizer, scene, picture_for(scene, oracle), seasoned=True)
    moved = done.report.visible
    before, after = done.before[0][moved, :14].astype(np.float64), done.rows[moved, :14]
    gradient = gradient_seen(done)[moved, :14]
    second = ADAM.beta2 * done.before[2][moved, :14] + (1 - ADAM.beta2) * gradient**2
    np.testing.assert_allclose(done.second_moment[moved, :14], second, rtol=2e-2, atol=1e-12)
    updates = done.rows[moved, UPDATES].astype(np.float64)[:, None]
    np.testing.assert_array_equal(updates[:, 0], done.before[0][moved, UPDATES] + 1)
    first_unbiased = done.first_moment[moved, :14] / (1 - ADAM.beta1**updates)
    second_unbiased = done.second_moment[moved, :14] / (1 - ADAM.beta2**updates)
    step = ADAM.row_rates()[:14] * first_unbiased / (np.sqrt(second_unbiased) + ADAM.epsilon)
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


def test_rows_out_of_sight_are_untouched(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("outside the view")
    done = train(rasterizer, scene, picture_for(scene, oracle), seasoned=True)
    hidden = np.setdiff1d(np.arange(len(scene.rows)), done.report.visible)
    assert len(hidden) > 10
    for after, before in zip((done.rows, done.first_moment, done.second_moment), done.before, strict=True):
        np.testing.assert_array_equal(after[hidden], before[hidden])


def test_frozen_rows_are_untouched_and_the_others_move_as_ever(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    picture = picture_for(scene, oracle)
    trainable = np.random.default_rng(5).random(len(scene.rows)) < 0.5
    free = train(rasterizer, scene, picture, seasoned=True)
    held = train(rasterizer, scene, picture, trainable=trainable, seasoned=True)
    np.testing.assert_array_equal(held.report.visible, free.report.visible)
    for after, before, unheld in zip(
        (held.rows, held.first_moment, held.second_moment),
        held.before,
        (free.rows, free.first_moment, free.second_moment),
        strict=True,
    ):
        np.testing.assert_array_equal(after[~trainable], before[~trainable])
        assert relative_error(after[trainable], unheld[trainable]) < 1e-4


def test_a_tally_counts_the_rows_that_moved_and_no_others(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    view = picture_for(scene, oracle).view(rasterizer, scene)
    lent, rng = tables(scene, seasoned=False), np.random.default_rng(6)
    trainable, among = rng.random((2, len(scene.rows))) < 0.5
    everywhere, some = (Tally(np.full(len(scene.rows), 7, np.uint32), choice) for choice in (None, among))
    with rasterizer.holding(*lent):
        for step in range(10):
            rasterizer.step(*lent, view, scene.T_camera_world, LOSS, ADAM, trainable=trainable, tally=everywhere)
            if step < 3:
                rasterizer.step(*lent, view, scene.T_camera_world, LOSS, ADAM, tally=some)
    trained = lent[0][:, UPDATES]
    np.testing.assert_array_equal(some.counts[~among], 7)
    assert set(some.counts[among]) == {7, 10}
    np.testing.assert_array_equal(everywhere.counts[~trainable], 7)
    np.testing.assert_array_equal((everywhere.counts - 7 + 3 * (trained > 0))[trainable], trained[trainable])


def test_a_tally_of_another_length_or_that_may_not_be_written_is_refused(
    rasterizer: Rasterizer, oracle: Rasterizer
) -> None:
    scene = scene_named("medium splats")
    view = picture_for(scene, oracle).view(rasterizer, scene)
    sealed = np.zeros(len(scene.rows), np.uint32)
    sealed.flags.writeable = False
    for counts in (np.zeros(len(scene.rows) - 1, np.uint32), sealed):
        with pytest.raises(ShapeError, match="tally counts"):
            rasterizer.step(*tables(scene, seasoned=False), view, scene.T_camera_world, LOSS, ADAM, tally=Tally(counts))


def test_pixels_of_weight_zero_do_not_matter_to_a_masked_step(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    picture = picture_for(scene, oracle)
    other_rgb, other_depth_m = 255 - picture.rgb, picture.depth_m + np.float32(0.5)
    unseen = picture.weight == 0
    changed = Picture(
        np.where(unseen[..., None], other_rgb, picture.rgb),
        np.where(unseen, other_depth_m, picture.depth_m),
        picture.weight,
    )
    loss = replace(LOSS, ssim=0.0)
    first = train(rasterizer, scene, picture, loss=loss, masked=True)
    second = train(rasterizer, scene, changed, loss=loss, masked=True)
    assert first.report.loss == pytest.approx(second.report.loss, rel=1e-6)
    assert relative_error(second.first_moment, first.first_moment) < 1e-5


def test_an_empty_mask_has_no_loss_and_no_gradient(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    picture = replace(picture_for(scene, oracle), weight=np.zeros(scene.size, np.float32))
    done = train(rasterizer, scene, picture, masked=True)
    assert done.report.loss == 0.0
    assert np.abs(gradient_seen(done)).max() < 1e-9
    assert np.isfinite(done.rows).all()


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
    assert rows[:, UPDATES].max() == 30


def test_moments_of_another_length_are_refused(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    view = picture_for(scene, oracle).view(rasterizer, scene)
    rows, first, second = tables(scene, seasoned=False)
    with pytest.raises((ShapeError, TypeError)):
        rasterizer.step(rows, first[:-1], second, view, scene.T_camera_world, LOSS, ADAM)


def test_a_view_of_another_size_than_its_camera_is_refused(rasterizer: Rasterizer) -> None:
    camera = scene_named("odd size").camera
    with pytest.raises(ShapeError, match="rgb"):
        rasterizer.prepare_view(np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), camera)


def test_tables_on_loan_end_up_as_step_by_step(rasterizer: Rasterizer, oracle: Rasterizer) -> None:
    scene = scene_named("medium splats")
    view = picture_for(scene, oracle).view(rasterizer, scene)
    alone, lent = tables(scene, seasoned=True), tables(scene, seasoned=True)
    reports = [rasterizer.step(*alone, view, scene.T_camera_world, LOSS, ADAM) for _ in range(3)]
    with rasterizer.holding(*lent):
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
        with rasterizer.holding(*lent):
            rasterizer.step(*lent, view, scene.T_camera_world, LOSS, ADAM)
            raise KeyError("a mishap")

    with pytest.raises(KeyError):
        one_step_and_a_mishap()
    assert lent[0][:, UPDATES].max() == 1
